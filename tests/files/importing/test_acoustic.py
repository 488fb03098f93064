"""Places relative to a vessel become fixes of the vehicle."""

from __future__ import annotations

import format_samples as samples
import format_writers as writers
import numpy as np
import pytest

from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.files.formats.mapping import MappingSettings
from factorgraph_dvl.files.importing.raw_files import import_files
from factorgraph_dvl.files.tables import read_table
from factorgraph_dvl.geometry.earth import radii
from factorgraph_dvl.sensors.usbl import CARTESIAN_COLUMNS as CARTESIAN
from factorgraph_dvl.sensors.usbl import POLAR_COLUMNS as POLAR
from factorgraph_dvl.sensors.usbl import Usbl, UsblSettings
from factorgraph_dvl.settings.yaml_file import read_yaml

DEG = np.pi / 180.0


def imported(tmp_path, *names, **keys):
    tables = samples.underwater_gps(**keys)
    paths = []
    for name in names:
        paths.append(tmp_path / f"{name}.csv")
        paths[-1].write_bytes(tables[name])
    return import_files(paths, tmp_path / "trial"), tmp_path / "trial" / "usbl.parquet"


def columns(path, *names):
    table = read_table(path, names)
    return [table[name] for name in names]


@pytest.mark.parametrize(
    ("heading", "north", "east"), [(90.0, -5.0, 10.0), (0.0, 10.0, 5.0), (180.0, -10.0, -5.0)]
)
@pytest.mark.parametrize("sentences", [False, True])
def test_a_place_by_hand(tmp_path, heading, north, east, sentences):
    names = ("gga", "hdt") if sentences else ("position",)
    decisions, gnss = imported(tmp_path, "acoustic", *names, heading=heading)
    lat, lon, height = columns(gnss, "lat_deg", "lon_deg", "height_m")
    meridian, transverse = radii(54.0 * DEG)
    assert (lat[0] - 54.0) * DEG * meridian == pytest.approx(north, abs=1e-3)
    place = (lon[0] + 3.0) * DEG * transverse * np.cos(54.0 * DEG)
    assert place == pytest.approx(east, abs=1e-3)
    np.testing.assert_allclose(height, -3.0)
    # 1.5 m of the place, 2 cm of the vessel, and 1° at 11.2 m.
    std = np.sqrt(1.5**2 + 0.02**2 + (np.hypot(10.0, 5.0) * DEG) ** 2)
    east_std, up_std = columns(gnss, "std_e_m", "std_u_m")
    np.testing.assert_allclose(east_std[0], std, rtol=1e-6)
    np.testing.assert_allclose(up_std, 1.5)
    account = {row[0]: row[1:] for row in decisions.accounts[0].rows()}
    assert account["locator (acoustic)"] == (15, 5, "status")
    assert account["row"] == (0, 20, "repeats another one")


def test_positions_of_the_vessel_are_not_those_of_the_vehicle(tmp_path):
    with pytest.raises(DataError, match="no data"):
        imported(tmp_path, "orientation")
    decisions, gnss = imported(tmp_path, "acoustic", "gga", "orientation")
    assert not gnss.exists()
    assert "no file has the heading of the vessel" in decisions.text("")
    assert "orientation.csv: contains no data that a trial can use" in decisions.warnings


def test_positions_without_an_orientation_are_those_of_the_vehicle(tmp_path):
    _, gnss = imported(tmp_path, "global")
    (lat,) = columns(gnss, "lat_deg")
    np.testing.assert_allclose(lat, 54.00001)


def test_the_vessel_is_not_known_in_a_gap(tmp_path):
    tables = samples.underwater_gps(80)
    lines = tables["position"].splitlines(keepends=True)
    (tmp_path / "a.csv").write_bytes(tables["acoustic"])
    (tmp_path / "b.csv").write_bytes(b"".join(lines[:20] + lines[60:]))
    import_files([tmp_path / "a.csv", tmp_path / "b.csv"], tmp_path / "trial")
    time, lat = columns(tmp_path / "trial" / "usbl.parquet", "time_s", "lat_deg")
    inside = (time > 4.8) & (time < 14.7)
    assert np.isnan(lat[inside]).all()
    assert np.isfinite(lat[~inside]).all()


def test_sentences_of_a_usbl_beside_those_of_the_ship(tmp_path):
    """10 m ahead and 5 m to starboard of a ship with the bow to the east; another transponder."""
    lines = []
    for k in range(20):
        at = f"1200{k:02d}.00"
        lines += [
            writers.nmea(f"GPZDA,{at},01,06,2023,00,00"),
            writers.nmea(f"GPGGA,{at},5400.0000,N,00300.0000,W,4,12,0.6,10.0,M,50.0,M,,"),
            writers.nmea("HEHDT,90.0,T"),
            writers.nmea(f"PSIMSSB,{at},B01,A,,C,H,M,5.0,10.0,30.0,1.5,N,,"),
        ]
        if k % 4 == 0:
            lines.append(writers.nmea(f"PSIMSSB,{at},B02,A,,C,H,M,50.0,-10.0,60.0,1.5,N,,"))
    (tmp_path / "ship.log").write_bytes(b"".join(lines))
    decisions = import_files([tmp_path / "ship.log"], tmp_path / "trial")
    path = tmp_path / "trial" / "usbl.parquet"
    lat, lon, height = columns(path, "lat_deg", "lon_deg", "height_m")
    meridian, transverse = radii(54.0 * DEG)
    np.testing.assert_allclose((lat - 54.0) * DEG * meridian, -5.0, atol=1e-3)
    east = (lon + 3.0) * DEG * transverse * np.cos(54.0 * DEG)
    np.testing.assert_allclose(east, 10.0, atol=1e-3)
    np.testing.assert_allclose(height, -30.0)
    assert lat.size == 20
    assert "other transponders left out: PSIMSSB B02 (5)" in decisions.text("")


NOON = 1685620800.0


def table(tmp_path, name, header, *columns, start=0.0):
    values = np.column_stack([start + np.arange(20.0), *(np.full(20, c) for c in columns)])
    np.savetxt(tmp_path / name, values, "%.9f", ",", header=f"t,{header}", comments="")
    return tmp_path / name


def test_tables_of_a_usbl_need_a_mapping_only(tmp_path):
    """Places relative to a ship with the bow to the east, and the ship's own positions."""
    paths = [
        table(tmp_path, "usbl.csv", "x,y,z,s", 10.0, -5.0, -30.0, 1.5),
        table(tmp_path, "ship.csv", "lat,lon,hdg", 54.0, -3.0, 90.0),
    ]
    mapping = tmp_path / "map.yaml"
    mapping.write_text("""tables:
  - file: usbl.csv
    kind: acoustic
    time: {column: t}
    columns: {forward: x, starboard: {column: y, sign: -1}, down: {column: z, sign: -1}, std: s}
  - file: ship.csv
    kind: topside
    time: {column: t}
    columns: {lat: lat, lon: lon, heading: hdg}
""")
    import_files(paths, tmp_path / "trial", mapping=read_yaml(mapping, MappingSettings))
    lat, lon, height = columns(
        tmp_path / "trial" / "usbl.parquet", "lat_deg", "lon_deg", "height_m"
    )
    meridian, transverse = radii(54.0 * DEG)
    np.testing.assert_allclose((lat - 54.0) * DEG * meridian, -5.0, atol=1e-3)
    east = (lon + 3.0) * DEG * transverse * np.cos(54.0 * DEG)
    np.testing.assert_allclose(east, 10.0, atol=1e-3)
    np.testing.assert_allclose(height, -30.0)


@pytest.mark.parametrize("polar", [True, False])
@pytest.mark.parametrize("sentences", [True, False])
def test_what_a_transceiver_measured_comes_with_its_ship(tmp_path, polar, sentences):
    """The ship turns, rolls and goes north; its own positions are no fixes of the vehicle."""
    names = ("range", "bearing", "depression") if polar else ("forward", "starboard", "down")
    measured = (60.0, 300.0, 40.0) if polar else (10.0, -5.0, 30.0)
    mapping = f"""tables:
  - file: usbl.csv
    kind: transceiver
    time: {{column: t, clock: utc}}
    columns: {{{", ".join(f"{n}: {i}" for i, n in enumerate(names, 2))}}}
"""
    paths = [table(tmp_path, "usbl.csv", ",".join(names), *measured, start=NOON)]
    rows = [(k, 54.0 + 1e-6 * k, 12.0 + 0.1 * k, 2.0 - k, 358.0 + k) for k in range(20)]
    if sentences:
        paths.append(tmp_path / "ship.log")
        paths[-1].write_bytes(b"".join(_of_ship(*row) for row in rows))
    else:
        paths.append(tmp_path / "ship.csv")
        stamped = rows + np.array([NOON, 0.0, 0.0, 0.0, 0.0])
        np.savetxt(paths[-1], stamped, "%.9f", ",", header="t,lat,h,roll,hdg", comments="")
        mapping += """  - file: ship.csv
    kind: topside
    time: {column: t, clock: utc}
    columns: {lat: lat, lon: lat, height: h, roll: roll, pitch: roll, heading: hdg}
"""
    (tmp_path / "map.yaml").write_text(mapping)
    import_files(
        paths, tmp_path / "trial", mapping=read_yaml(tmp_path / "map.yaml", MappingSettings)
    )
    found = columns(tmp_path / "trial" / "usbl.parquet", *(POLAR if polar else CARTESIAN))
    np.testing.assert_allclose(np.transpose(found), [measured] * 20)
    ship = tmp_path / "trial" / "ship.parquet"
    time, lat, height, roll, heading = columns(
        ship, "time_s", "lat_deg", "height_m", "roll_deg", "heading_deg"
    )
    k, expected_lat, expected_height, expected_roll, expected_heading = np.transpose(rows)
    np.testing.assert_allclose(time, k, atol=1e-6)
    np.testing.assert_allclose(lat, expected_lat, atol=1e-8)
    np.testing.assert_allclose(height, expected_height, atol=0.06)
    np.testing.assert_allclose(roll, expected_roll, atol=0.01)
    np.testing.assert_allclose((heading - expected_heading) % 360.0, 0.0, atol=0.01)
    assert not (tmp_path / "trial" / "gnss.parquet").exists()
    settings = (tmp_path / "trial" / "trial.yaml").read_text()
    assert "ship: {file: ship.parquet, transceiver_lever_arm_m: [0.0, 0.0, 0.0]}" in settings


def _of_ship(k, lat, height, roll, heading):
    at = f"1200{k:02d}.00"
    return b"".join(
        map(
            writers.nmea,
            (
                f"GPZDA,{at},01,06,2023,00,00",
                f"GPGGA,{at},54{60.0 * (lat - 54.0):010.7f},N,05400.0,E,4,12,0.6,{height},M,,M,,",
                f"PASHR,{at},{heading % 360.0:.2f},T,{roll:.2f},{roll:.2f},0.0,0.1,0.1,0.1,1,0",
            ),
        )
    )


def test_fixes_of_the_vehicle_s_own_antenna_stay_beside_a_transceiver(tmp_path):
    paths = [
        table(tmp_path, "usbl.csv", "r,b,d", 60.0, 300.0, 40.0, start=NOON),
        tmp_path / "ship.log",
        tmp_path / "auv.log",
    ]
    for path, height in zip(paths[1:], (12.0, 1.0), strict=True):
        path.write_bytes(b"".join(_of_ship(k, 54.0, height, 1.0, 90.0) for k in range(20)))
    (tmp_path / "map.yaml").write_text("""tables:
  - file: usbl.csv
    kind: transceiver
    time: {column: t, clock: utc}
    columns: {range: r, bearing: b, depression: d}
sentences: {auv.log: fix}
""")
    mapping = read_yaml(tmp_path / "map.yaml", MappingSettings)
    import_files(paths, tmp_path / "trial", mapping=mapping)
    (height,) = columns(tmp_path / "trial" / "ship.parquet", "height_m")
    np.testing.assert_allclose(height, 12.0)
    (height,) = columns(tmp_path / "trial" / "gnss.parquet", "height_m")
    np.testing.assert_allclose(height, 1.0)
    assert (tmp_path / "trial" / "usbl.parquet").exists()


def test_a_transceiver_without_attitude_of_its_ship_is_not_used(tmp_path):
    paths = [
        table(tmp_path, "usbl.csv", "r,b,d", 60.0, 300.0, 40.0),
        table(tmp_path, "ship.csv", "lat,lon", 54.0, -3.0),
    ]
    (tmp_path / "map.yaml").write_text("""tables:
  - file: usbl.csv
    kind: transceiver
    time: {column: t}
    columns: {range: r, bearing: b, depression: d}
  - file: ship.csv
    kind: topside
    time: {column: t}
    columns: {lat: lat, lon: lon}
""")
    mapping = read_yaml(tmp_path / "map.yaml", MappingSettings)
    decisions = import_files(paths, tmp_path / "trial", mapping=mapping)
    assert any("roll, pitch and heading of the ship" in text for text in decisions.warnings)
    assert not (tmp_path / "trial" / "usbl.parquet").exists()


def test_a_table_of_fixes_under_water_is_that_of_a_usbl(tmp_path):
    path = table(tmp_path, "rov.csv", "lat,lon,depth,s", 54.0, -3.0, 30.0, 0.7)
    mapping = tmp_path / "map.yaml"
    mapping.write_text("""tables:
  - kind: transponder
    time: {column: t}
    columns: {lat: lat, lon: lon, altitude: {column: depth, sign: -1}, std_e: s, std_n: s}
""")
    import_files([path], tmp_path / "trial", mapping=read_yaml(mapping, MappingSettings))
    lat, height, std = columns(
        tmp_path / "trial" / "usbl.parquet", "lat_deg", "height_m", "std_n_m"
    )
    np.testing.assert_allclose(lat, 54.0)
    np.testing.assert_allclose(height, -30.0)
    np.testing.assert_allclose(std, 0.7)
    assert not (tmp_path / "trial" / "gnss.parquet").exists()


def test_positions_by_the_example_of_the_document(tmp_path):
    lines = [
        "PTSAG,#16068,124544.449,18,12,2017,1,4305.25355,N,00631.76852,E,F,1013.10,1,9999.00",
        "PTSAG,#16069,124545.449,18,12,2017,1,4305.25355,N,00631.76852,E,F,1013.10,1,9999.00",
        "PTSAG,#16071,124546.173,18,12,2017,0,4305.25123,N,00631.79102,E,F,0002.89,1,9999.00",
    ]
    (tmp_path / "gaps.txt").write_bytes(b"".join(map(writers.nmea, lines)))
    import_files([tmp_path / "gaps.txt"], tmp_path / "trial")
    names = ("lat_deg", "lon_deg", "height_m")
    lat, lon, height = columns(tmp_path / "trial" / "usbl.parquet", *names)
    np.testing.assert_allclose(lat, 43.0 + 5.25355 / 60.0)
    np.testing.assert_allclose(lon, 6.0 + 31.76852 / 60.0)
    np.testing.assert_allclose(height, -1013.1)


def test_fixes_of_a_vehicle_that_come_as_gga_are_those_of_a_usbl_by_a_mapping(tmp_path):
    for name, height, count in (("usbl.log", -30.0, 20), ("ship.log", 10.0, 60)):
        lines = [
            writers.nmea(text)
            for k in range(count)
            for text in (
                f"GPZDA,1200{k:02d}.00,01,06,2023,00,00",
                f"GPGGA,1200{k:02d}.00,5400.0000,N,00300.0000,W,4,12,0.6,{height},M,50.0,M,,",
            )
        ]
        (tmp_path / name).write_bytes(b"".join(lines))
    (tmp_path / "map.yaml").write_text('sentences: {"usbl*": transponder, "ship*": topside}\n')
    mapping = read_yaml(tmp_path / "map.yaml", MappingSettings)
    import_files(
        [tmp_path / "usbl.log", tmp_path / "ship.log"], tmp_path / "trial", mapping=mapping
    )
    table = read_table(tmp_path / "trial" / "usbl.parquet", Usbl.required, Usbl.optional)
    usbl = Usbl.from_columns(UsblSettings(), table, "usbl.log")
    assert usbl.time.size == 20
    np.testing.assert_allclose(usbl.geodetic[:, 2], 20.0)
    assert np.isfinite(usbl.position_std).all()
    assert not (tmp_path / "trial" / "gnss.parquet").exists()


def test_a_mapping_has_tables_or_sentences(tmp_path):
    (tmp_path / "map.yaml").write_text("trial: {}\n")
    with pytest.raises(ConfigError, match="`tables` or `sentences`"):
        read_yaml(tmp_path / "map.yaml", MappingSettings)
