"""PD0: real files against mhkit and their decodes, and a writer that follows the document."""

from __future__ import annotations

import shutil
import struct
from datetime import UTC, datetime, timedelta
from pathlib import Path

import format_writers as writers
import numpy as np
import pytest
from format_samples import WHEN, ensemble
from scipy.spatial.transform import Rotation

from factorgraph_dvl.files.formats import janus
from factorgraph_dvl.files.formats.framing import map_file
from factorgraph_dvl.files.formats.pd0 import read_pd0
from factorgraph_dvl.files.formats.velocities import EARTH, SHIP

DATA = Path(__file__).resolve().parents[4] / "shared" / "data"
NENANA = DATA / "nenana_river" / "nenana_2010-09-23.PD0"
WINRIVER = DATA / "adcp_raw" / "winriver01.PD0"
VMDAS_FILE = DATA / "adcp_raw" / "vmdas01_wh.ENX"
DEG = np.pi / 180.0


class File:
    def __init__(self, data):
        blocks = list(read_pd0(data))
        cells = max((block.water.shape[1] for block in blocks), default=0)
        pad = [
            np.pad(
                b.water, ((0, 0), (0, cells - b.water.shape[1]), (0, 0)), constant_values=np.nan
            )
            for b in blocks
        ]
        self.pings = np.concatenate([block.pings for block in blocks]) if blocks else np.empty(0)
        self.water = np.concatenate(pad) if blocks else np.empty((0, 0, 4))
        self.vmdas = np.concatenate([block.vmdas for block in blocks]) if blocks else np.empty(0)
        self.nmea = {
            k: np.concatenate([b.nmea[k] for b in blocks])
            for k in (blocks[0].nmea if blocks else ())
        }


def to_beams(velocity, beam_angle):
    """Return velocities along convex beams of those in the axes of the instrument."""
    x, y, z, error = velocity.T
    across = np.sin(beam_angle)
    vertical, twist = z * np.cos(beam_angle), error * across / np.sqrt(2.0)
    sides = (across * x + twist, twist - across * x, -across * y - twist, across * y - twist)
    return np.stack([vertical + side for side in sides], axis=1)


@pytest.fixture(scope="module", params=[NENANA, WINRIVER, VMDAS_FILE], ids=lambda p: p.name)
def pair(request, tmp_path_factory):
    if not request.param.exists():
        pytest.skip(f"{request.param} is not here")
    dolfyn = pytest.importorskip("mhkit.dolfyn")
    copy = tmp_path_factory.mktemp("oracle") / request.param.name
    shutil.copy(request.param, copy)
    theirs = dolfyn.read(str(copy))
    return File(map_file(request.param)), theirs[0] if isinstance(theirs, tuple) else theirs


def test_velocities_are_mhkits_to_a_millimetre_per_second(pair):
    ours, theirs = pair
    # mhkit leaves out the last ensemble of two of the files.
    count = theirs.sizes["time"]
    assert len(ours.pings) - count in (0, 1)
    water = ours.water[:count].transpose(2, 1, 0)
    np.testing.assert_array_equal(np.isnan(water), np.isnan(theirs["vel"].values))
    np.testing.assert_allclose(water, theirs["vel"].values, atol=1e-5)
    if "vel_bt" in theirs:
        bottom = ours.pings["bottom_velocity"][:count].T
        expected = theirs["vel_bt"].values
        np.testing.assert_allclose(bottom, np.where(expected < -32.0, np.nan, expected), atol=1e-5)
        far = theirs["dist_bt"].values
        np.testing.assert_allclose(
            ours.pings["bottom_range"][:count].T, np.where(far == 0, np.nan, far), atol=1e-4
        )
        for name, other in (("correlation", "corr"), ("amplitude", "amp"), ("good", "prcnt_gd")):
            np.testing.assert_array_equal(
                ours.pings[f"bottom_{name}"][:count].T, theirs[f"{other}_bt"].values
            )


def test_times_and_attitude_are_mhkits(pair):
    ours, theirs = pair
    count = theirs.sizes["time"]
    seconds = theirs["time"].values.astype("datetime64[ns]").astype(float) * 1e-9
    np.testing.assert_allclose(ours.pings["time"][:count], seconds, atol=1e-6)
    for name in ("heading", "pitch", "roll"):
        np.testing.assert_allclose(ours.pings[name][:count] / DEG, theirs[name].values, atol=1e-4)
    np.testing.assert_array_equal(ours.pings["number"][:count], theirs["number"].values)


@pytest.mark.skipif(not NENANA.exists(), reason=f"{NENANA} is not here")
def test_every_fix_is_kept_with_its_receive_time():
    """The decode beside the file was made by other hands; mhkit keeps one fix a ping."""
    ours = File(map_file(NENANA))
    for name, columns in (
        ("GGA", ("lat_deg", "lon_deg", "alt_msl_m", "utc_s_of_day")),
        ("VTG", ("cog_true_deg", "sog_mps")),
    ):
        table = np.genfromtxt(str(NENANA)[:-4] + f"_{name.lower()}.csv", delimiter=",", names=True)
        records = ours.nmea[name]
        binary = records[np.isfinite(records["received"])]
        assert len(binary) == len(table) == 2321
        received = ours.pings["time"][0] + table["ens_t_s"] - table["delta_t_s"]
        np.testing.assert_allclose(binary["received"], received, atol=2e-3)
        if name == "GGA":
            mine = (binary["lat"] / DEG, binary["lon"] / DEG, binary["altitude"], binary["second"])
            atol = (1e-8, 1e-8, 1e-3, 1e-3)
        else:
            mine = (binary["course"] / DEG, binary["speed"])
            atol = (1e-3, 1e-4)
        for own, column, tolerance in zip(mine, columns, atol, strict=True):
            np.testing.assert_allclose(own, table[column], atol=tolerance)
        # The text that WinRiver stores once a ping repeats one of these.
        assert len(records) - len(binary) == len(ours.pings)
    text = ours.nmea["GGA"][~np.isfinite(ours.nmea["GGA"]["received"])]
    assert np.isin(text["second"], binary_seconds(ours)).all()


def binary_seconds(ours):
    records = ours.nmea["GGA"]
    return records["second"][np.isfinite(records["received"])]


@pytest.mark.skipif(not VMDAS_FILE.exists(), reason=f"{VMDAS_FILE} is not here")
def test_vmdas_has_a_fix_before_each_ping():
    ours = File(map_file(VMDAS_FILE))
    assert len(ours.vmdas) == len(ours.pings) == 3713
    np.testing.assert_array_equal(ours.vmdas["at"], ours.pings["at"])
    assert np.all(ours.pings["coordinates"] == EARTH)
    # The PC showed local time, 7 h behind UTC; the ping comes a second after the fix.
    assert np.all(ours.vmdas["pc_minus_utc"] == -7 * 3600.0)
    lag = ours.vmdas["time"] - ours.vmdas["pc_minus_utc"] - ours.vmdas["last_utc"]
    assert np.all(np.abs(lag - 1.01) < 0.02)


def test_what_was_written_is_read():
    ours = File(
        ensemble(
            70000,
            (None, -0.2, 0.3, 0.4),
            heading=359.99,
            pitch=-1.5,
            roll=2.25,
            frame=SHIP,
            alignment=-4500,
            up=True,
            convex=False,
        )
    )
    (ping,) = ours.pings
    assert ping["number"] == 70000
    assert ping["time"] == pytest.approx((WHEN + timedelta(seconds=70000)).timestamp(), abs=1e-6)
    np.testing.assert_allclose(
        [ping["heading"], ping["pitch"], ping["roll"]], np.array([359.99, -1.5, 2.25]) * DEG
    )
    np.testing.assert_allclose(ping["bottom_velocity"], [np.nan, -0.2, 0.3, 0.4])
    np.testing.assert_allclose(ping["bottom_range"], [10.0, 700.0, 12.34, np.nan])
    assert (ping["coordinates"], ping["up"], ping["convex"], ping["tilts_used"]) == (
        SHIP,
        True,
        False,
        True,
    )
    assert ping["beam_angle"] == pytest.approx(20 * DEG)
    assert ping["heading_alignment"] == pytest.approx(-45 * DEG)
    np.testing.assert_allclose(ours.water[0, 0], [4.464, -4.464, 0.003, np.nan])


def test_two_digit_years_without_a_century():
    (ping,) = File(ensemble(1, century=False)).pings
    assert ping["time"] == pytest.approx((WHEN + timedelta(seconds=1)).timestamp(), abs=1e-6)


def test_whole_ensembles_survive_damage_around_them():
    first, second, third = (ensemble(n) for n in (1, 2, 3))
    flipped = bytearray(second)
    flipped[50] ^= 0x10
    data = (
        b"\x7f" * 7
        + first
        + b"noise\x7f\x7f\xff\xff"
        + bytes(flipped)
        + third[:60]
        + third
        + third[:-1]
    )
    np.testing.assert_array_equal(File(data).pings["number"], [1, 3])


def test_a_checksum_counts_past_two_to_the_sixteen():
    cells = [(-1, -1, -1, -1)] * 250
    body = writers.pd0(
        [
            writers.fixed_leader(cells=250),
            writers.variable_leader(1, WHEN),
            writers.water_profile(cells),
        ]
    )
    assert sum(body) > 1 << 16
    assert len(File(body).pings) == 1


def test_sentences_in_all_forms():
    more = [
        writers.winriver_gga(0.4, "120953.25", 44.921, -66.99, 2, 9.3, -28.1),
        writers.winriver_gga(0.2, "120953.50", -44.921, 66.99, 2, 9.3, 0.0),
        writers.winriver_text(
            204, -0.1, b"$GPGGA,120954.00,4455.26,N,06659.56,W,2,7,1.3,9.3,M,-28.1,M,4.0,0133"
        ),
        writers.winriver_text(
            200, 0.0, writers.nmea("PRDID,1.0,2.0,3.0") + writers.nmea("GPHDT,4.0,T")
        ),
        b"\x01\x21\x4e\x00$GPGGA,120955.00,4455.26,N,06659.56,W,2,7,1.3,9.3,M,-28.1,M,4.0,0133\r\n?Q",
        b"\x04\x21$GPHDT,5.0,T\r\n",
    ]
    ours = File(
        ensemble(1, more=more)
        + ensemble(2, more=[writers.winriver_text(204, 0.5, b"$GPGGA,broken")])
    )
    gga = ours.nmea["GGA"]
    now = ours.pings["time"][0]
    np.testing.assert_allclose(gga["received"] - now, [-0.4, -0.2, 0.1, np.nan], atol=1e-6)
    np.testing.assert_allclose(gga["lat"][:2] / DEG, [44.921, -44.921])
    np.testing.assert_allclose(gga["lon"][:2] / DEG, [-66.99, 66.99])
    np.testing.assert_allclose(gga["second"] - 43793.0, [0.25, 0.5, 1.0, 2.0])
    np.testing.assert_allclose(gga["height"], [-18.8, np.nan, -18.8, -18.8], atol=1e-5)
    np.testing.assert_allclose(ours.nmea["HDT"]["heading"] / DEG, [4.0, 5.0])
    assert len(ours.nmea["PRDID"]) == 1


def test_a_speed_whose_bytes_hold_a_comma():
    course = struct.unpack("<f", b",,,C")[0]
    body = b"$GPVTG\0" + struct.pack(
        "<fcfcfcfcc", course, b"T", 1.0, b"M", 2.0, b"N", 3.7, b"K", b"A"
    )
    (vtg,) = File(ensemble(1, more=[writers.winriver_text(105, 0.1, body)])).nmea["VTG"]
    assert vtg["course"] / DEG == pytest.approx(course)
    assert vtg["speed"] == pytest.approx(2.0 * 1852 / 3600)


def test_vmdas_listed_or_not():
    first, last = (86399.0, 48.1, -123.04), (1.0, 48.1001, -123.0402)
    block = writers.vmdas(
        datetime(2020, 8, 20), first, last, -25200.0, datetime(2020, 8, 19), 61201.5, 12.5, 0x7FF
    )
    listed = ensemble(1, more=[block])
    hidden = bytearray(ensemble(1)[:-2] + block)
    hidden[2:4] = struct.pack("<H", len(hidden))
    hidden += struct.pack("<H", sum(hidden) % 65536)
    for data in (listed, bytes(hidden)):
        (fix,) = File(data).vmdas
        assert fix["last_utc"] == datetime(2020, 8, 20, 0, 0, 1, tzinfo=UTC).timestamp()
        assert fix["first_utc"] == fix["last_utc"] - 2.0
        np.testing.assert_allclose(
            [fix["last_lat"] / DEG, fix["last_lon"] / DEG], last[1:], atol=1e-7
        )
        assert fix["time"] - fix["pc_minus_utc"] == pytest.approx(fix["last_utc"] + 0.5)
        np.testing.assert_allclose(
            [fix["speed"], fix["course"] / DEG, fix["heading"] / DEG], [1.5, 90.0, 12.5], atol=5e-3
        )


def test_a_missing_leader_costs_the_ensemble_only():
    lone = writers.pd0([writers.fixed_leader(), writers.bottom_track((1, 1, 1, 1), (1, 1, 1, 1))])
    assert len(File(lone + ensemble(4)).pings) == 1


def about(axis, angles):
    return Rotation.from_rotvec(np.outer(angles, np.eye(3)[axis]))


@pytest.mark.parametrize("up", [False, True])
def test_beams_of_a_moving_instrument_turn_into_its_velocity_in_every_frame(up):
    """Geometry of its own: directions of beams, and rotations about named axes."""
    rng = np.random.default_rng(5)
    count, angle, alignment = 50, 20.0 * DEG, 0.3
    east_north_up = rng.normal(size=(count, 3))
    roll, pitch, heading = (
        rng.uniform(-0.3, 0.3, count),
        rng.uniform(-0.2, 0.2, count),
        rng.uniform(0, 6, count),
    )
    level = about(2, -heading) * about(0, pitch) * about(1, roll)
    outer = level * about(1, np.full(count, np.pi if up else 0.0))
    instrument = outer.inv().apply(east_north_up)
    s, c = np.sin(angle), np.cos(angle)
    # Beam 1 to port of 2, 3 ahead of 4, all away from the face, which is below.
    outward = np.array([[-s, 0, -c], [s, 0, -c], [0, s, -c], [0, -s, -c]])
    beams = instrument @ outward.T
    # Beams of PD0 see the bottom come: that is the transducer's velocity outward. The axes
    # are then those of the bottom's velocity.
    xyz = janus.from_beams(beams, angle)
    np.testing.assert_allclose(xyz[:, :3], -instrument, atol=1e-12)
    np.testing.assert_allclose(xyz[:, 3], 0.0, atol=1e-12)
    np.testing.assert_allclose(to_beams(xyz, angle), beams, atol=1e-12)
    np.testing.assert_allclose(janus.beam_directions(angle), outward)
    earth = janus.instrument_to_outer(EARTH, roll, pitch, heading, 9.9, True, up)
    np.testing.assert_allclose(janus.to_instrument(-east_north_up, earth), xyz[:, :3], atol=1e-12)
    ship = janus.instrument_to_outer(SHIP, roll, pitch, heading, alignment, True, up)
    turned = about(2, heading - alignment).apply(-east_north_up)
    np.testing.assert_allclose(janus.to_instrument(turned, ship), xyz[:, :3], atol=1e-12)


def test_one_lost_beam_is_replaced_and_two_are_not():
    velocity = np.array([[0.5, -1.0, 0.2, 0.0]] * 3)
    beams = to_beams(velocity, 20 * DEG)
    beams[0, 2] = np.nan
    beams[1, [0, 3]] = np.nan
    back = janus.from_beams(beams, 20 * DEG)
    np.testing.assert_allclose(back[0, :3], velocity[0, :3])
    assert np.isnan(back[0, 3])
    assert np.isnan(back[1]).all()
    np.testing.assert_allclose(back[2], velocity[2], atol=1e-12)


@pytest.mark.skipif(not NENANA.exists(), reason=f"{NENANA} is not here")
def test_the_boat_moves_against_the_bottom():
    """Signs: the bottom's velocity in ship axes, reversed and turned, is that of the GNSS."""
    ours = File(map_file(NENANA))
    gga = ours.nmea["GGA"][np.isfinite(ours.nmea["GGA"]["received"])]
    order = np.argsort(gga["received"])
    t, lat, lon = (gga[n][order] for n in ("received", "lat", "lon"))
    grid = np.arange(t[0] + 5, t[-1] - 5, 1.0)
    north = np.gradient(np.interp(grid, t, lat), grid) * 6.38e6
    east = np.gradient(np.interp(grid, t, lon), grid) * 6.38e6 * np.cos(lat[0])
    ping = ours.pings[np.isfinite(ours.pings["bottom_velocity"][:, 0])]
    starboard, forward = -ping["bottom_velocity"][:, :2].T
    h = ping["heading"] + 18.0 * DEG
    v_e, v_n = (
        starboard * np.cos(h) + forward * np.sin(h),
        forward * np.cos(h) - starboard * np.sin(h),
    )
    residual = np.hypot(
        v_e - np.interp(ping["time"], grid, east), v_n - np.interp(ping["time"], grid, north)
    )
    assert np.median(residual) < 0.1
