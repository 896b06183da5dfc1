# SPDX-License-Identifier: Apache-2.0
import dataclasses
import subprocess
import sys
import zipfile
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from solutions import START_NS, make_solution, write_dive

from abyssnav.errors import ConfigError, ReadError
from abyssnav.outputs.export import FORMATS, export
from abyssnav.outputs.palette import method_colour

METHOD = "ekf_gated"


@pytest.fixture(scope="module")
def dive(tmp_path_factory):
    solution, reference = make_solution(duration_s=900.0)
    return solution, write_dive(tmp_path_factory.mktemp("out") / "dive_1", solution, reference)


@pytest.fixture(scope="module")
def degrees(dive):
    """Longitude and latitude of the method's track, as the dive's own table has them."""
    pq = pytest.importorskip("pyarrow.parquet")
    rows = pq.read_table(dive[1] / "tracks.parquet", filters=[("method", "==", METHOD)])
    return np.column_stack([rows["longitude_deg"].to_numpy(), rows["latitude_deg"].to_numpy()])


def read_shapes(path, **options):
    """Geometries and fields by GDAL, in a process of its own: it warns as it likes."""
    pytest.importorskip("pyogrio")
    code = (
        "import sys, json, shapely, pyogrio.raw as raw\n"
        f"m, _, g, f = raw.read({str(path)!r}, **{options!r})\n"
        "shapes = [shapely.from_wkb(x) for x in g]\n"
        "coordinates = [shapely.get_coordinates(s, include_z=True).tolist() for s in shapes]\n"
        "fields = {k: [str(v) for v in c] for k, c in zip(m['fields'], f)}\n"
        "print(json.dumps([coordinates, fields]))"
    )
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    import json

    return json.loads(done.stdout)


def test_gdal_reads_the_geojson_as_a_line_a_method(dive, degrees):
    (path,) = export(dive[1], "geojson")
    coordinates, fields = read_shapes(path)
    assert fields["method"] == list(dive[0].tracks)
    assert fields["stroke"] == [method_colour(m) for m in dive[0].tracks]
    places = np.array(coordinates[fields["method"].index(METHOD)])
    np.testing.assert_allclose(places[:, :2], degrees, atol=1e-9)
    height_m = dive[0].tracks[METHOD].position_enu_m[:, 2]
    np.testing.assert_allclose(places[:, 2], height_m, atol=1e-3)


def test_gdal_reads_the_gpx_with_its_times(dive, degrees):
    (path,) = export(dive[1], "gpx")
    coordinates, fields = read_shapes(path, layer="track_points")
    first = sum(len(t) for m, t in dive[0].tracks.items() if m in ("dead_reckoning", "kf_fix"))
    first += len(dive[0].tracks["ekf_ungated"])
    places = np.array(coordinates)[first : first + len(degrees), 0, :2]
    np.testing.assert_allclose(places, degrees, atol=1e-9)
    expected = np.datetime64(START_NS, "ns") + np.timedelta64(120, "s")
    assert np.datetime64(fields["time"][first].replace("Z", "")) == expected


def test_the_kmz_holds_a_coloured_line_a_method(dive, degrees):
    (path,) = export(dive[1], "kmz")
    with zipfile.ZipFile(path) as archive:
        assert archive.namelist() == ["doc.kml"]
        root = ET.fromstring(archive.read("doc.kml"))
    space = {"k": "http://www.opengis.net/kml/2.2"}
    marks = {m.findtext("k:name", None, space): m for m in root.iterfind(".//k:Placemark", space)}
    assert list(marks) == list(dive[0].tracks)
    text = marks[METHOD].findtext(".//k:coordinates", None, space)
    places = np.array([[float(x) for x in place.split(",")] for place in text.split()])
    np.testing.assert_allclose(places[:, :2], degrees, atol=1e-9)
    red, green, blue = (method_colour(METHOD)[k : k + 2] for k in (1, 3, 5))
    assert marks[METHOD].findtext(".//k:color", None, space) == f"ff{blue}{green}{red}"


def test_pandas_reads_the_csv(dive):
    pd = pytest.importorskip("pandas")
    (path,) = export(dive[1], "csv")
    table = pd.read_csv(path)
    mine = table[table["method"] == METHOD]
    track = dive[0].tracks[METHOD]
    np.testing.assert_array_equal(mine["east_m"].to_numpy(), track.position_enu_m[:, 0])
    time_ns = pd.to_datetime(mine["time"]).astype("datetime64[ns, UTC]").astype("int64").to_numpy()
    np.testing.assert_array_equal(time_ns, START_NS + np.rint(track.t_s * 1e9).astype(np.int64))


def test_evo_reads_the_tum_files_pose_by_pose(dive):
    pytest.importorskip("evo")
    paths = export(dive[1], "tum")
    assert [p.name for p in paths] == [f"dive_1_{m}.tum" for m in dive[0].tracks]
    path = next(p for p in paths if p.name == f"dive_1_{METHOD}.tum")
    code = (
        "from evo.tools import file_interface\n"
        f"t = file_interface.read_tum_trajectory_file({str(path)!r})\n"
        "ok, report = t.check()\nassert ok, report\n"
        "import json, numpy as np\n"
        "yaw = [np.arctan2(p[1, 0], p[0, 0]) for p in t.poses_se3]\n"
        "print(json.dumps([t.positions_xyz.tolist(), yaw, t.timestamps.tolist()]))"
    )
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    import json

    places, yaw_rad, stamps = map(np.array, json.loads(done.stdout.splitlines()[-1]))
    track = dive[0].tracks[METHOD]
    np.testing.assert_allclose(places, track.position_enu_m, rtol=1e-8, atol=1e-6)
    turn = np.exp(1j * (yaw_rad - (0.5 * np.pi - track.heading_rad)))
    np.testing.assert_allclose(turn, 1.0, atol=1e-6)
    np.testing.assert_allclose(stamps, START_NS / 1e9 + track.t_s, atol=1e-6)


def test_netcdf_is_a_ragged_array_of_trajectories(dive, degrees):
    netcdf = pytest.importorskip("netCDF4")
    (path,) = export(dive[1], "netcdf")
    with netcdf.Dataset(path) as file:
        names = netcdf.chartostring(file["trajectory"][:]).tolist()
        sizes = file["row_size"][:].tolist()
        first = sum(sizes[: names.index(METHOD)])
        rows = slice(first, first + sizes[names.index(METHOD)])
        np.testing.assert_array_equal(file["lon"][rows], degrees[:, 0])
        np.testing.assert_array_equal(file["lat"][rows], degrees[:, 1])
        when = netcdf.num2date(file["time"][first], file["time"].units)
        assert str(when)[:19] == "2025-10-09 08:55:20"
        assert sum(sizes) == file.dimensions["obs"].size


def test_netcdf_complies_with_cf(dive):
    checker = Path(sys.executable).parent / "compliance-checker"
    if not checker.exists():
        pytest.skip("compliance-checker is not installed")
    (path,) = export(dive[1], "netcdf")
    command = [checker, "--test=cf:1.8", "--criteria=normal", path]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


def test_figures_are_drawn_and_drawn_alike_each_time(dive, tmp_path):
    pytest.importorskip("matplotlib")
    for kind, magic in (("png", b"\x89PNG"), ("svg", b"<?xml")):
        once = export(dive[1], kind, tmp_path / "once")
        again = export(dive[1], kind, tmp_path / "again")
        made = [path.stem for path in once]
        assert made == ["dive_1_plan", "dive_1_error_fix", "dive_1_error_truth"]
        assert all(path.read_bytes().startswith(magic) for path in once)
        assert [a.read_bytes() for a in once] == [b.read_bytes() for b in again]
    svg = (tmp_path / "once" / "dive_1_plan.svg").read_text("utf-8")
    assert method_colour(METHOD) in svg


def test_an_export_lands_beside_the_dive_unless_told_otherwise(dive, tmp_path):
    assert export(dive[1], "csv")[0].parent == dive[1] / "export"
    assert export(dive[1], "csv", tmp_path / "there")[0].parent == tmp_path / "there"


@pytest.mark.parametrize("kind", ["geojson", "kmz", "gpx", "netcdf"])
def test_what_needs_latitude_is_refused_without_an_origin(tmp_path, kind):
    solution, _ = make_solution(duration_s=300.0, origin=None)
    local = write_dive(tmp_path / "local", solution)
    with pytest.raises(ConfigError, match=r"local: .* needs latitude and longitude"):
        export(local, kind)


def test_an_unknown_format_gets_its_nearest_name(dive):
    with pytest.raises(ConfigError, match="no export to 'geojsn'; nearest: geojson; known: "):
        export(dive[1], "geojsn")
    assert list(FORMATS) == ["geojson", "kmz", "gpx", "csv", "tum", "netcdf", "png", "svg"]


def test_a_folder_without_a_dive_is_named(tmp_path):
    with pytest.raises(ReadError, match=r"tracks\.parquet: not the output of a dive"):
        export(tmp_path, "csv")


def test_figures_without_matplotlib_tell_what_to_install(dive, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ConfigError, match="pip install matplotlib"):
        export(dive[1], "png")


def test_a_dive_without_a_reference_has_no_figure_of_truth(tmp_path):
    pytest.importorskip("matplotlib")
    solution, _ = make_solution(duration_s=300.0)
    solution = dataclasses.replace(solution, tracks={METHOD: solution.tracks[METHOD]})
    made = export(write_dive(tmp_path / "alone", solution), "svg")
    assert [path.stem for path in made] == ["alone_plan", "alone_error_fix"]
