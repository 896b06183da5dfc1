# SPDX-License-Identifier: Apache-2.0
import dataclasses
import json
import os
import pickle
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from oracles import rotation_enu_body
from solutions import START_NS, make_solution, write_dive

from abyssnav.config import Attribution, Config, plain
from abyssnav.errors import ConfigError, ReadError, UnknownMethodError
from abyssnav.outputs.export import FORMATS, export
from abyssnav.outputs.palette import method_colour

METHOD = "ekf_gated"
CONTRACT = "geojson kmz gpx gpkg csv tum netcdf nve sbet rosbag2 png svg"


@pytest.fixture(scope="module")
def dive(tmp_path_factory):
    solution, reference = make_solution(duration_s=900.0)
    folder = write_dive(tmp_path_factory.mktemp("out") / "dive_1", solution, reference)
    (folder / "summary.json").write_text("{}")
    return solution, folder


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
    return json.loads(done.stdout)


def test_gdal_reads_the_geojson_as_a_line_a_method_and_what_is_beside(dive, degrees):
    (path,) = export(dive[1], "geojson", ["all"])
    coordinates, fields = read_shapes(path)
    tracks = [k for k, kind in enumerate(fields["kind"]) if kind == "track"]
    assert [fields["method"][k] for k in tracks] == list(dive[0].tracks)
    assert [fields["stroke"][k] for k in tracks] == [method_colour(m) for m in dive[0].tracks]
    assert fields["kind"].count("beacon") == 4
    assert fields["kind"].count("fix") == dive[0].fixes.consistent.sum()
    assert fields["kind"].count("reference") == 1
    radii = [
        float(r)
        for r, k in zip(fields["uncertainty_95_m"], fields["kind"], strict=True)
        if k == "leg"
    ]
    np.testing.assert_allclose(radii, dive[0].accuracy.uncertainty_95_m)
    places = np.array(coordinates[fields["method"].index(METHOD)])
    np.testing.assert_allclose(places[:, :2], degrees, atol=1e-9)
    height_m = dive[0].tracks[METHOD].position_enu_m[:, 2]
    np.testing.assert_allclose(places[:, 2], height_m, atol=1e-3)


def test_gdal_reads_the_gpx_with_its_times(dive, degrees):
    (path,) = export(dive[1], "gpx", ["all"])
    coordinates, fields = read_shapes(path, layer="track_points")
    first = sum(len(t) for m, t in dive[0].tracks.items() if m in ("dead_reckoning", "kf_fix"))
    first += len(dive[0].tracks["ekf_ungated"])
    places = np.array(coordinates)[first : first + len(degrees), 0, :2]
    np.testing.assert_allclose(places, degrees, atol=1e-9)
    expected = np.datetime64(START_NS, "ns") + np.timedelta64(120, "s")
    assert np.datetime64(fields["time"][first].replace("Z", "")) == expected
    _, fields = read_shapes(path, layer="waypoints")
    assert fields["type"].count("beacon") == 4
    assert fields["type"].count("fix") == dive[0].fixes.consistent.sum()
    _, fields = read_shapes(path, layer="tracks")
    (radii,) = [text for text in fields["desc"] if text not in ("None", "")]
    said = [float(leg.split("within ")[1].removesuffix(" m")) for leg in radii.split("; ")]
    np.testing.assert_allclose(said, dive[0].accuracy.uncertainty_95_m, atol=0.051)


def test_the_kmz_holds_a_coloured_line_a_method(dive, degrees):
    (path,) = export(dive[1], "kmz", ["all"])
    with zipfile.ZipFile(path) as archive:
        assert archive.namelist() == ["doc.kml"]
        root = ET.fromstring(archive.read("doc.kml"))
    space = {"k": "http://www.opengis.net/kml/2.2", "gx": "http://www.google.com/kml/ext/2.2"}
    marks = {m.findtext("k:name", None, space): m for m in root.iterfind(".//k:Placemark", space)}
    assert {*dive[0].tracks, "reference", "Alpha", "Delta"} <= set(marks)
    track = marks[METHOD].find("gx:Track", space)
    places = np.array([list(map(float, c.text.split())) for c in track.iterfind("gx:coord", space)])
    np.testing.assert_allclose(places[:, :2], degrees, atol=1e-9)
    stamps = [when.text for when in track.iterfind("k:when", space)]
    assert len(stamps) == len(places)
    assert stamps[0] == utc_text(START_NS + 120 * 10**9)
    legs = [m for m in root.iterfind(".//k:Placemark", space) if m.find("k:TimeSpan", space)]
    radii = [float(leg.findtext(".//k:value", None, space)) for leg in legs]
    np.testing.assert_allclose(radii, dive[0].accuracy.uncertainty_95_m)
    red, green, blue = (method_colour(METHOD)[k : k + 2] for k in (1, 3, 5))
    assert marks[METHOD].findtext(".//k:color", None, space) == f"ff{blue}{green}{red}"


def utc_text(time_ns):
    return f"{np.datetime64(time_ns, 'ns').astype('M8[ms]')}Z"


def test_pandas_reads_the_csv(dive):
    pd = pytest.importorskip("pandas")
    paths = export(dive[1], "csv", ["all"])
    kinds = [p.stem.removeprefix("dive_1_") for p in paths]
    assert kinds == ["tracks", "beacons", "fixes", "accuracy", "reference"]
    assert pd.read_csv(paths[1])["name"].tolist() == ["Alpha", "Bravo", "Charlie", "Delta"]
    table = pd.read_csv(paths[0])
    mine = table[table["method"] == METHOD]
    track = dive[0].tracks[METHOD]
    np.testing.assert_array_equal(mine["east_m"].to_numpy(), track.position_enu_m[:, 0])
    time_ns = pd.to_datetime(mine["time"]).astype("datetime64[ns, UTC]").astype("int64").to_numpy()
    np.testing.assert_array_equal(time_ns, START_NS + np.rint(track.t_s * 1e9).astype(np.int64))


def test_evo_reads_the_tum_files_pose_by_pose(dive):
    pytest.importorskip("evo")
    paths = export(dive[1], "tum", ["all"])
    tracks = [f"dive_1_{m}.tum" for m in (*dive[0].tracks, "fix", "reference")]
    beside = [f"dive_1_{k}.csv" for k in ("beacons", "fixes", "accuracy", "reference")]
    assert [p.name for p in paths] == tracks + beside
    path = next(p for p in paths if p.name == f"dive_1_{METHOD}.tum")
    code = (
        "from evo.tools import file_interface\n"
        f"t = file_interface.read_tum_trajectory_file({str(path)!r})\n"
        "ok, report = t.check()\nassert ok, report\n"
        "import json, numpy as np\n"
        "turns = [p[:3, :3].tolist() for p in t.poses_se3]\n"
        "print(json.dumps([t.positions_xyz.tolist(), turns, t.timestamps.tolist()]))"
    )
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    places, turns, stamps = map(np.array, json.loads(done.stdout.splitlines()[-1]))
    track = dive[0].tracks[METHOD]
    np.testing.assert_allclose(places, track.position_enu_m, rtol=1e-8, atol=1e-6)
    for row in range(0, len(turns), 50):
        attitude = (track.roll_rad[row], track.pitch_rad[row], track.heading_rad[row])
        expected = rotation_enu_body(*attitude) @ np.diag([1.0, -1.0, -1.0])
        np.testing.assert_allclose(turns[row], expected, atol=1e-6)
    np.testing.assert_allclose(stamps, START_NS / 1e9 + track.t_s, atol=1e-6)


def test_netcdf_is_a_ragged_array_of_trajectories(dive, degrees):
    netcdf = pytest.importorskip("netCDF4")
    (path,) = export(dive[1], "netcdf", ["all"])
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
    (path,) = export(dive[1], "netcdf", ["all"])
    command = [checker, "--test=cf:1.8", "--criteria=normal", path]
    # its script looks for a module beside itself, which the safe path of our commands forbids
    env = {name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"}
    done = subprocess.run(command, check=False, capture_output=True, text=True, env=env)
    assert done.returncode == 0, done.stdout


def test_who_made_the_data_is_said_where_the_settings_say_it_and_never_invented(dive, tmp_path):
    netcdf = pytest.importorskip("netCDF4")
    folder = shutil.copytree(dive[1], tmp_path / "dive_1")
    stated = {"creator_name": "Ünal & Söhne", "license": "CC-BY-4.0"}
    for given in ({}, stated):
        settings = plain(Config(attribution=Attribution(**given)))
        (folder / "summary.json").write_text(json.dumps({"settings": settings}))
        (path,) = export(folder, "netcdf")
        with netcdf.Dataset(path) as file:
            got = {name: file.getncattr(name) for name in file.ncattrs()}
        assert {name: got[name] for name in given} == given
        known = {"creator_name", "institution", "license", "project", "publisher_name"}
        assert known & got.keys() == given.keys()


def test_a_lost_method_does_not_set_the_extent_of_a_figure(dive):
    pytest.importorskip("matplotlib")
    from abyssnav.outputs.export.figures import _plan
    from abyssnav.outputs.export.source import load

    source = load(dive[1], ["all"])
    lost = dict(source.tracks["ekf_ungated"])
    lost["east_m"] = lost["east_m"] + 9e4
    tracks = dict(source.tracks) | {"ekf_ungated": lost}
    axes, beacons = _plan(dataclasses.replace(source, tracks=tracks), "").axes
    smoother = source.tracks["smoother"]
    assert axes.get_xlim()[1] < smoother["east_m"].max() + 500
    labels = {line.get_label() for line in axes.lines}
    assert {"ekf_ungated", "reference", "start", "end"} <= labels
    assert [text.get_text() for text in beacons.texts] == source.beacons["name"].tolist()


def test_figures_are_drawn_and_drawn_alike_each_time(dive, tmp_path):
    pytest.importorskip("matplotlib")
    for kind, magic in (("png", b"\x89PNG"), ("svg", b"<?xml")):
        once = export(dive[1], kind, ["all"], tmp_path / "once")
        again = export(dive[1], kind, ["all"], tmp_path / "again")
        made = [path.stem for path in once]
        assert made == ["dive_1_plan", "dive_1_error_fix", "dive_1_error_truth"]
        assert all(path.read_bytes().startswith(magic) for path in once)
        assert [a.read_bytes() for a in once] == [b.read_bytes() for b in again]
    svg = (tmp_path / "once" / "dive_1_plan.svg").read_text("utf-8")
    assert method_colour(METHOD) in svg


def test_an_export_lands_beside_the_dive_unless_told_otherwise(dive, tmp_path):
    assert export(dive[1], "csv")[0].parent == dive[1] / "export"
    assert export(dive[1], "csv", folder=tmp_path / "there")[0].parent == tmp_path / "there"


@pytest.mark.parametrize("kind", ["geojson", "kmz", "gpx", "gpkg", "nve", "netcdf"])
def test_what_needs_latitude_is_refused_without_an_origin(tmp_path, kind):
    solution, _ = make_solution(duration_s=300.0, origin=None)
    local = write_dive(tmp_path / "local", solution)
    (local / "summary.json").write_text("{}")
    with pytest.raises(ConfigError, match=r"local: .* needs latitude and longitude"):
        export(local, kind)


def test_an_unknown_format_gets_its_nearest_name(dive):
    with pytest.raises(ConfigError, match="no export to 'geojsn'; nearest: geojson; known: "):
        export(dive[1], "geojsn")
    assert set(FORMATS) == set(CONTRACT.split())


def test_a_folder_without_a_dive_is_named(tmp_path):
    with pytest.raises(ReadError, match=r"holds no result"):
        export(tmp_path, "csv")
    (tmp_path / "summary.json").write_text("{}")
    with pytest.raises(ReadError, match=r"tracks\.parquet: not there"):
        export(tmp_path, "csv")


def test_figures_without_matplotlib_tell_what_to_install(dive, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ConfigError, match="pip install matplotlib"):
        export(dive[1], "png")


def test_a_dive_without_a_reference_has_no_figure_of_truth(tmp_path):
    pytest.importorskip("matplotlib")
    solution, _ = make_solution(duration_s=300.0)
    solution = dataclasses.replace(solution, tracks={METHOD: solution.tracks[METHOD]})
    folder = write_dive(tmp_path / "alone", solution)
    (folder / "summary.json").write_text("{}")
    made = export(folder, "svg")
    assert [path.stem for path in made] == ["alone_plan", "alone_error_fix"]


# --- one method unless more are asked for ------------------------------------------------------


def test_one_method_is_exported_unless_more_are_asked_for(dive, tmp_path):
    def methods(*asked):
        (path, *_) = export(dive[1], "csv", asked, tmp_path)
        return list(dict.fromkeys(line.split(",")[0] for line in path.read_text().splitlines()[1:]))

    assert methods() == ["smoother"]
    assert methods("ekf", "kf_fix") == ["kf_fix", "ekf"]
    assert methods("all") == list(dive[0].tracks)
    with pytest.raises(UnknownMethodError, match="no track by 'smother'; nearest: smoother") as no:
        export(dive[1], "csv", ["smother"], tmp_path)
    again = pickle.loads(pickle.dumps(no.value))  # as from a worker of the caller's
    assert (again.method, str(again)) == ("smother", str(no.value))


def test_an_older_result_is_told_by_name(dive, tmp_path):
    import pyarrow.parquet as pq

    old = shutil.copytree(dive[1], tmp_path / "old")
    table = pq.read_table(old / "tracks.parquet").drop_columns(["roll_rad"])
    table = table.replace_schema_metadata({"abyssnav_version": "0.0.9"})
    pq.write_table(table, old / "tracks.parquet")
    with pytest.raises(ReadError, match=r"made by 0\.0\.9, without roll_rad: run the dive again"):
        export(old, "csv")


# --- formats of the last mile ------------------------------------------------------------------


def test_gdal_reads_the_layers_of_the_geopackage(dive, degrees):
    (path,) = export(dive[1], "gpkg", [METHOD, "smoother"])
    coordinates, fields = read_shapes(path, layer=f"{METHOD}_points")
    places = np.array(coordinates)[:, 0]
    np.testing.assert_allclose(places[:, :2], degrees, atol=1e-12)
    np.testing.assert_allclose(places[:, 2], dive[0].tracks[METHOD].position_enu_m[:, 2])
    roll_rad = np.array(fields["roll_rad"], float)
    np.testing.assert_allclose(roll_rad, dive[0].tracks[METHOD].roll_rad)
    lines, fields = read_shapes(path, layer="tracks")
    assert fields["method"] == [METHOD, "smoother"]
    np.testing.assert_allclose(np.array(lines[0])[:, :2], degrees, atol=1e-12)
    _, fields = read_shapes(path, layer="beacons")
    assert fields["name"] == ["Alpha", "Bravo", "Charlie", "Delta"]
    _, fields = read_shapes(path, layer="legs")
    radii = np.array(fields["uncertainty_95_m"], float)
    np.testing.assert_allclose(radii, dive[0].accuracy.uncertainty_95_m)
    again = path.read_bytes()
    assert export(dive[1], "gpkg", [METHOD, "smoother"])[0].read_bytes() == again


def test_the_nve_file_says_what_its_format_wants(dive, degrees):
    """Read by the format's description: nine numbers of time, then place, attitude and speed."""
    path, *_ = export(dive[1], "nve", [METHOD])
    track, rows = dive[0].tracks[METHOD], []
    for line in path.read_text("ascii").splitlines():
        if line.startswith("#"):
            continue
        fields = line.split()
        assert len(fields) == 15
        year, month, day, hour, minute = map(int, fields[:5])
        midnight = np.datetime64(f"{year:04d}-{month:02d}-{day:02d}", "us")
        seconds = 3600 * hour + 60 * minute + float(fields[5])
        when_s = midnight.astype("int64") / 1e6 + seconds
        assert abs(when_s - float(fields[6])) < 1e-5
        rows.append([float(field) for field in fields[6:]])
    got = np.array(rows)
    np.testing.assert_allclose(got[:, 0], START_NS / 1e9 + track.t_s, atol=1e-6)
    np.testing.assert_allclose(got[:, 1:3], degrees, atol=1e-9)
    np.testing.assert_allclose(got[:, 3], np.degrees(track.heading_rad) % 360, atol=1e-4)
    speed_mps = np.hypot(track.forward_mps, track.starboard_mps)
    np.testing.assert_allclose(got[:, 4], 3.6 * speed_mps, atol=1e-4)
    np.testing.assert_allclose(got[:, 5], -track.position_enu_m[:, 2], atol=1e-4)
    np.testing.assert_allclose(got[:, 6], np.degrees(track.roll_rad), atol=1e-4)
    np.testing.assert_allclose(got[:, 7], np.degrees(track.pitch_rad), atol=1e-4)
    assert not got[:, 8].any()


def test_the_sbet_holds_17_true_fields_a_record(dive):
    """Read by the format's description, with no code of ours: records of 17 doubles."""
    surface_m = 41.5
    path, note, *_ = export(dive[1], "sbet", [METHOD], surface_height_m=surface_m)
    records = np.frombuffer(path.read_bytes(), "<f8").reshape(-1, 17)
    track = dive[0].tracks[METHOD]
    assert len(records) == len(track)
    # 2025-10-09 is a Thursday of a GPS week that began on Sunday the 5th; GPS is 18 s ahead
    week_s = np.datetime64("2025-10-05", "s").astype("int64")
    np.testing.assert_allclose(records[:, 0], START_NS / 1e9 + track.t_s + 18 - week_s, atol=1e-6)
    pq = pytest.importorskip("pyarrow.parquet")
    rows = pq.read_table(dive[1] / "tracks.parquet", filters=[("method", "==", METHOD)])
    for column, name in ((1, "latitude_deg"), (2, "longitude_deg")):
        np.testing.assert_allclose(np.degrees(records[:, column]), rows[name], atol=1e-12)
    np.testing.assert_allclose(records[:, 3], surface_m + track.position_enu_m[:, 2], atol=1e-9)
    np.testing.assert_allclose(records[:, 7], track.roll_rad)
    np.testing.assert_allclose(records[:, 8], track.pitch_rad)
    np.testing.assert_allclose(records[:, 9], track.heading_rad)
    assert not records[:, 10].any()
    assert "UTC is 18 s behind" in note.read_text()
    assert str(surface_m) in note.read_text()


def _with_track(tmp_path, **columns):
    """A folder of a dive of 200 s with one track, and that track."""
    solution = make_solution(duration_s=200.0)[0]
    track = dataclasses.replace(solution.tracks["smoother"], **columns)
    solution = dataclasses.replace(solution, tracks={"smoother": track})
    folder = write_dive(tmp_path / "dive", solution, None)
    (folder / "summary.json").write_text("{}")
    return folder, track


def test_what_the_sbet_derives_leads_back_to_what_it_is_derived_from(tmp_path):
    """Rates and accelerations of the file give its changes of attitude and velocity."""
    t_s = np.arange(200.0)
    angles = {
        "heading_rad": (6.2 + 0.3 * np.sin(t_s / 9)) % (2 * np.pi),
        "roll_rad": 0.2 * np.sin(t_s / 7),
        "pitch_rad": 0.25 * np.cos(t_s / 8),
    }
    folder, track = _with_track(tmp_path, **angles)
    path, *_ = export(folder, "sbet", surface_height_m=0.0)
    records = np.frombuffer(path.read_bytes(), "<f8").reshape(-1, 17)
    attitude = records[:, 7:10]
    ned_of_enu = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    turns = np.array([ned_of_enu @ rotation_enu_body(*angles) for angles in attitude])
    step_s = records[2:, 0] - records[:-2, 0]
    gained_mps = records[2:, 4:7] - records[:-2, 4:7]
    turned = np.einsum("nij,nj->ni", turns[1:-1], records[1:-1, 11:14])
    np.testing.assert_allclose(turned * step_s[:, None], gained_mps, atol=1e-9)
    # the body's rate is that of R' = R [w x], by differences over a row's neighbours
    slope = (turns[2:] - turns[:-2]) / step_s[:, None, None]
    skew = np.einsum("nji,njk->nik", turns[1:-1], slope)
    turning_rad_s = np.column_stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]])
    rate_rad_s = records[1:-1, 14:17]
    assert np.abs(rate_rad_s).max(axis=0).min() > 0.02
    np.testing.assert_allclose(rate_rad_s, turning_rad_s, atol=2e-4)
    speed_mps = np.hypot(records[:, 4], records[:, 5])
    np.testing.assert_allclose(speed_mps, np.hypot(track.forward_mps, track.starboard_mps))


def test_an_sbet_that_would_state_what_nobody_knows_is_refused(dive, tmp_path):
    with pytest.raises(ConfigError, match="--surface-height-m"):
        export(dive[1], "sbet")
    with pytest.raises(ConfigError, match="--surface-height-m is sbet's"):
        export(dive[1], "csv", surface_height_m=2.0)
    folder, _ = _with_track(tmp_path, roll_rad=np.full(200, np.nan))
    with pytest.raises(ConfigError, match="roll_rad is not known in 200 of 200 rows"):
        export(folder, "sbet", surface_height_m=0.0)


def test_rosbags_reads_the_bag_by_its_metadata(dive):
    from rosbags.rosbag2 import Reader

    metadata, recording = export(dive[1], "rosbag2")
    assert recording.read_bytes() == (dive[1] / "solution.mcap").read_bytes()
    with Reader(metadata.parent) as reader:
        n_read = sum(1 for _ in reader.messages())
        assert reader.message_count == n_read > 1000
        assert reader.start_time == START_NS
        kinds = {c.topic: c.msgtype for c in reader.connections}
    assert kinds["/tf"] == "tf2_msgs/msg/TFMessage"


def test_netcdf_holds_attitude_reference_and_who_and_where(dive):
    netcdf = pytest.importorskip("netCDF4")
    (path,) = export(dive[1], "netcdf")
    with netcdf.Dataset(path) as file:
        names = netcdf.chartostring(file["trajectory"][:]).tolist()
        assert names == ["smoother", "reference"]
        n = file["row_size"][0]
        np.testing.assert_array_equal(file["roll"][:n], dive[0].tracks["smoother"].roll_rad)
        assert np.ma.getmaskarray(file["roll"][n:]).all()
        radius_m = file["uncertainty_95"][:n]
        assert set(np.unique(radius_m)) == set(dive[0].accuracy.uncertainty_95_m.tolist())
        assert file.geospatial_lat_min == file["lat"][:].min()
        assert file.time_coverage_start == "2025-10-09T08:53:20Z"
        assert {"summary", "keywords", "title"} <= set(file.ncattrs())
        assert file.time_coverage_resolution == "PT1S"
        corners = file.geospatial_bounds.removeprefix("POLYGON ((").removesuffix("))").split(", ")
        assert corners[0] == corners[-1] == f"{file.geospatial_lat_min} {file.geospatial_lon_min}"


def test_evo_computes_the_error_that_we_tell(tmp_path, result):
    """`evo_ape` of smoother against the exported reference, at the track's own instants."""
    pytest.importorskip("evo")
    files = [p for p in export(result.folder, "tum", folder=tmp_path) if p.suffix == ".tum"]
    paths = {p.stem.rsplit("_", 1)[-1]: p for p in files}
    code = (
        "from evo.tools import file_interface as f\n"
        "from evo.core import sync, metrics\n"
        f"a = f.read_tum_trajectory_file({str(paths['reference'])!r})\n"
        f"b = f.read_tum_trajectory_file({str(paths['smoother'])!r})\n"
        "a, b = sync.associate_trajectories(a, b, max_diff=1e-6)\n"
        "e = a.positions_xyz[:, :2] - b.positions_xyz[:, :2]\n"
        "print(len(e), ((e ** 2).sum(1).mean()) ** 0.5)"
    )
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    n, rms_m = done.stdout.split()[-2:]
    ours = result.comparison
    row = ours[(ours.method == "smoother") & (ours.reference == "truth")]
    assert int(n) > 0.9 * row.n[0]
    assert float(rms_m) == pytest.approx(row.rms_m[0], rel=0.02)


def test_the_command_says_its_formats_and_gives_json(abyssnav, dive, tmp_path):
    ended = abyssnav("export", dive[1], "--to", "csv", "-o", tmp_path, "--json")
    assert Path(json.loads(ended.out)[0]).name == "dive_1_tracks.csv"
    wrong = abyssnav("export", dive[1], "--to", "shp")
    assert wrong.status == 2
    assert "nearest" in wrong.err
