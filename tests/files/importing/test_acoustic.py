"""Places relative to a vessel become fixes of the vehicle."""

from __future__ import annotations

import format_samples as samples
import format_writers as writers
import numpy as np
import pytest

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.files.formats.mapping import MappingSettings
from factorgraph_dvl.files.importing.raw_files import import_files
from factorgraph_dvl.files.tables import read_table
from factorgraph_dvl.geometry.earth import radii
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


def table(tmp_path, name, header, *columns):
    values = np.column_stack([np.arange(20.0), *(np.full(20, c) for c in columns)])
    np.savetxt(tmp_path / name, values, delimiter=",", header=f"t,{header}", comments="")
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


def test_fixes_of_a_vehicle_that_come_as_gga_serve_as_those_of_a_usbl(tmp_path):
    """Its section takes the table of `gnss` as it is."""
    lines = []
    for k in range(20):
        at = f"1200{k:02d}.00"
        lines += [
            writers.nmea(f"GPZDA,{at},01,06,2023,00,00"),
            writers.nmea(f"GPGGA,{at},5400.0000,N,00300.0000,W,4,12,0.6,-30.0,M,50.0,M,,"),
        ]
    (tmp_path / "rov.log").write_bytes(b"".join(lines))
    import_files([tmp_path / "rov.log"], tmp_path / "trial")
    table = read_table(tmp_path / "trial" / "gnss.parquet", Usbl.required, Usbl.optional)
    usbl = Usbl.from_columns(UsblSettings(), table, "rov.log")
    assert not usbl.missing.any()
    np.testing.assert_allclose(usbl.geodetic[:, 2], 20.0)
    assert np.isfinite(usbl.position_std).all()
