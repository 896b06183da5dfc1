# SPDX-License-Identifier: Apache-2.0
import csv
import dataclasses
import json
import math
import re
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest
from mcap.reader import make_reader
from oracles import rotation_enu_body
from solutions import START_NS, make_log, make_solution, make_summary, stripped, write_dive

from abyssnav import __version__
from abyssnav.compare import error_over_time, summarise
from abyssnav.config import Config, Gate, Output
from abyssnav.errors import ConfigError
from abyssnav.geometry import geodetic_to_enu
from abyssnav.outputs.files import wanted_files, write
from abyssnav.outputs.mcap import NOT_ESTIMATED
from abyssnav.outputs.palette import method_colour
from abyssnav.outputs.parquet import FILES
from abyssnav.outputs.summary import write_summary
from abyssnav.profile import load_profile
from abyssnav.profile.model import PositionRole
from abyssnav.run import Setup, run_dive
from abyssnav.simulate import load_scenario, simulate, write_log
from abyssnav.tables import (
    ARRIVALS,
    DECISIONS,
    Check,
    Evaluation,
    Finding,
    Log,
    PositionInnovations,
)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    solution, reference = make_solution(duration_s=1800.0)
    folder = write_dive(tmp_path_factory.mktemp("out") / "dive_1", solution, reference)
    return solution, reference, folder


def table(folder, name):
    import pyarrow.parquet as pq

    return pq.read_table(folder / f"{name}.parquet")


def numbers(arrow_column):
    return np.array(arrow_column.to_pylist(), dtype=float)


#: Made of any dive that has a reference.
MADE = [name for name in FILES if name != "positions"]


@pytest.mark.parametrize("name", MADE)
def test_each_file_has_its_columns_with_unit_meaning_and_version(written, name):
    schema = table(written[2], name).schema
    columns = FILES[name].columns()
    assert schema.names == [column.name for column in columns]
    assert schema.metadata[b"abyssnav_version"] == __version__.encode()
    origin = written[0].dive.origin
    assert schema.metadata[b"origin"] == f"{origin.latitude_deg},{origin.longitude_deg}".encode()
    assert schema.metadata[b"frame"] == b"ENU"
    assert set(table(written[2], name)["dive"].to_pylist()) == {"dive_1"}
    assert all(field.metadata[b"meaning"] for field in schema)
    kinds = {"text": "string", "time": "timestamp[ns, tz=UTC]", "integer": "int64"}
    kinds |= {"number": "double", "flag": "bool"}
    assert [str(field.type) for field in schema] == [kinds[c.kind] for c in columns]


def test_tracks_come_back_to_the_nanosecond_and_the_last_bit(written):
    solution, _, folder = written
    got = table(folder, "tracks")
    assert list(dict.fromkeys(got["method"].to_pylist())) == sorted(solution.tracks)
    track = solution.tracks["ekf_gated"]
    mine = got.filter(np.array(got["method"].to_pylist()) == "ekf_gated")
    time_ns = mine["time"].cast("int64").to_numpy()
    np.testing.assert_array_equal(time_ns, START_NS + np.rint(track.t_s * 1e9).astype(np.int64))
    np.testing.assert_array_equal(mine["east_m"].to_numpy(), track.position_enu_m[:, 0])
    np.testing.assert_array_equal(mine["depth_m"].to_numpy(), -track.position_enu_m[:, 2])
    np.testing.assert_array_equal(
        mine["sigma_north_m"].to_numpy() ** 2, np.sqrt(track.position_cov_m2[:, 1, 1]) ** 2
    )
    np.testing.assert_array_equal(
        mine["cov_east_north_m2"].to_numpy(), track.position_cov_m2[:, 0, 1]
    )


def test_latitude_and_longitude_lead_back_to_the_local_frame(written):
    solution, _, folder = written
    got, origin = table(folder, "tracks"), solution.dive.origin
    enu_m = geodetic_to_enu(
        origin.latitude_deg,
        origin.longitude_deg,
        got["latitude_deg"].to_numpy(),
        got["longitude_deg"].to_numpy(),
        -got["depth_m"].to_numpy(),
    )
    # The tangent plane leaves the ellipsoid by (distance)²/2R: 0.6 m vertically at 3 km, and the
    # depth below the plane shifts the foot point by depth · distance / R: 2.3 m there.
    np.testing.assert_allclose(enu_m[:, 0], got["east_m"].to_numpy(), atol=0.01)
    np.testing.assert_allclose(enu_m[:, 1], got["north_m"].to_numpy(), atol=0.01)


def test_without_an_origin_latitude_is_null_and_nothing_else_changes(written, tmp_path):
    solution, reference, folder = written
    local = dataclasses.replace(solution, dive=dataclasses.replace(solution.dive, origin=None))
    got = table(write_dive(tmp_path / "local", local, reference), "tracks")
    assert got["latitude_deg"].null_count == got["longitude_deg"].null_count == len(got)
    assert str(got.schema.field("latitude_deg").type) == "double"
    whole = table(folder, "tracks")
    assert got.drop(["latitude_deg", "longitude_deg"]).equals(
        whole.drop(["latitude_deg", "longitude_deg"])
    )


def test_every_reply_of_every_method_is_there_with_its_verdict(written):
    solution, _, folder = written
    got = table(folder, "innovations")
    assert len(got) == sum(len(i) for i in solution.innovations.values())
    tables = [solution.innovations[m] for m in sorted(solution.innovations)]
    decision = np.concatenate([t.decision for t in tables])
    assert got["decision"].to_pylist() == [DECISIONS[k] for k in decision]
    arrival = np.concatenate([t.arrival for t in tables])
    assert got["arrival"].to_pylist() == [ARRIVALS[k] for k in arrival]
    assert got["accepted"].to_pylist() == (decision == 0).tolist()
    unpredicted = np.isnan(np.concatenate([t.predicted_s for t in tables]))
    assert unpredicted.any()
    assert got["predicted_s"].is_null().to_pylist() == unpredicted.tolist()
    np.testing.assert_array_equal(numbers(got["nis"]), np.concatenate([t.nis for t in tables]))


def test_no_column_holds_nan(written):
    import pyarrow.compute as pc

    for name in MADE:
        for column in table(written[2], name).columns:
            if str(column.type) == "double":
                assert not pc.any(pc.is_nan(column)).as_py()


def test_comparison_csv_and_parquet_hold_the_same_numbers(written):
    with (written[2] / "comparison.csv").open() as file:
        rows = list(csv.DictReader(file))
    expected = table(written[2], "comparison").to_pylist()
    assert len(rows) == len(expected) > 0
    for row, wanted in zip(rows, expected, strict=True):
        assert {k: type(wanted[k])(v) for k, v in row.items()} == wanted


def test_the_same_solution_gives_the_same_bytes(written, tmp_path):
    folder = written[2]
    again = write_dive(tmp_path / "again", *make_solution(duration_s=1800.0))
    names = [path.name for path in folder.iterdir()]
    assert len(names) == 12
    assert [n for n in names if (folder / n).read_bytes() != (again / n).read_bytes()] == []


def test_a_solution_with_nothing_in_it_has_the_same_columns(written, tmp_path):
    solution, _, folder = written
    heard = {m: table[:0] for m, table in solution.statistics.items()}
    empty = stripped(solution, replies=solution.dive.replies[:0])
    empty = dataclasses.replace(empty, statistics=heard)
    got = write_dive(tmp_path / "empty", empty)
    for name in set(MADE) - {"beacons", "reference"}:
        assert len(table(got, name)) == 0
        assert table(got, name).schema.equals(table(folder, name).schema, check_metadata=True)


def test_writing_parquet_does_not_import_pandas(tmp_path):
    code = """
import sys; sys.path.insert(0, {tests!r})
from pathlib import Path
from solutions import make_solution
from abyssnav import __version__
from abyssnav.compare import error_over_time, summarise
from abyssnav.outputs.files import write
from abyssnav.tables import Evaluation
solution, reference = make_solution(duration_s=600.0)
errors = error_over_time(solution, reference)
write(Evaluation(solution, summarise(errors), errors, reference), Path({out!r}))
assert "pyarrow" in sys.modules
assert "pandas" not in sys.modules
"""
    tests = str(__file__).rsplit("/", 1)[0]
    done = subprocess.run(
        [sys.executable, "-c", code.format(tests=tests, out=str(tmp_path))],
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr


# --- messages ---------------------------------------------------------------------------------


def messages_of(path):
    """Topic -> decoded messages, by the official library."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    found = {}
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append(message)
    return found


@pytest.fixture(scope="module")
def messages(written):
    return messages_of(written[2] / "solution.mcap")


def test_the_topics_are_those_of_the_contract(written, messages):
    solution = written[0]
    expected = {"/abyssnav/fix", "/lbl/beacons"}
    expected |= {"/tf", "/abyssnav/beacons", "/abyssnav/map", "/abyssnav/reference/path"}
    expected.add("/abyssnav/points")  # beyond it, for Rerun
    for method in solution.tracks:
        kinds = ("odometry", "navsatfix", "path", "pose")
        expected |= {f"/abyssnav/{method}/{kind}" for kind in kinds}
    for method in solution.innovations:
        expected |= {f"/abyssnav/{method}/innovation", f"/abyssnav/{method}/statistics"}
    assert set(messages) == expected


def rotation_by(quat_xyzw):
    """Matrix of a quaternion, by the book."""
    x, y, z, w = quat_xyzw
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def rot_enu_flu(track, row):
    """Forward, port and up of the vehicle in east, north, up."""
    attitude = (track.roll_rad[row], track.pitch_rad[row], track.heading_rad[row])
    return rotation_enu_body(*attitude) @ np.diag([1.0, -1.0, -1.0])


def test_odometry_says_where_the_vehicle_is_and_points(written, messages):
    track, found = written[0].tracks["ekf"], messages["/abyssnav/ekf/odometry"]
    assert len(found) == len(track)
    message, k = found[700], 700
    stamp_ns = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
    assert stamp_ns == START_NS + round(track.t_s[k] * 1e9)
    assert (message.header.frame_id, message.child_frame_id) == ("map", "base_link")
    place = message.pose.pose.position
    assert [place.x, place.y, place.z] == track.position_enu_m[k].tolist()
    turn = message.pose.pose.orientation
    quat = np.array([turn.x, turn.y, turn.z, turn.w])
    np.testing.assert_allclose(rotation_by(quat), rot_enu_flu(track, k), atol=1e-12)
    body_mps = message.twist.twist.linear
    moved_mps = rotation_by(quat) @ [body_mps.x, body_mps.y, body_mps.z]
    heading_rad, forward_mps = track.heading_rad[k], track.forward_mps[k]
    starboard_mps = track.starboard_mps[k]
    sin, cos = math.sin(heading_rad), math.cos(heading_rad)
    expected_mps = [
        forward_mps * sin + starboard_mps * cos,
        forward_mps * cos - starboard_mps * sin,
    ]
    np.testing.assert_allclose(moved_mps, [*expected_mps, 0.0], atol=1e-12)
    covariance = np.reshape(message.pose.covariance, (6, 6))
    np.testing.assert_array_equal(covariance[:2, :2], track.position_cov_m2[k])
    assert covariance[np.arange(2, 6), np.arange(2, 6)].tolist() == [NOT_ESTIMATED] * 4


def test_innovations_and_statistics_are_those_of_the_tables(written, messages):
    innovations = written[0].innovations["ekf_gated"]
    found = messages["/abyssnav/ekf_gated/innovation"]
    assert [m.decision for m in found] == [DECISIONS[k] for k in innovations.decision]
    assert [m.ping_id for m in found] == innovations.ping_id.tolist()
    np.testing.assert_array_equal([m.nis for m in found], innovations.nis)
    statistics = written[0].statistics["ekf_gated"]
    (message,) = messages["/abyssnav/ekf_gated/statistics"]
    assert message.method == "ekf_gated"
    assert [b.gated for b in message.beacons] == statistics.gated.tolist()
    assert [b.smallest_visible_outlier for b in message.beacons] == (
        statistics.smallest_visible_outlier_m.tolist()
    )


def test_fixes_and_beacons_are_those_of_the_dive(written, messages):
    solution = written[0]
    found = [m.pose.pose.position for m in messages["/abyssnav/fix"]]
    assert [[p.x, p.y, p.z] for p in found] == solution.fixes.position_enu_m.tolist()
    (message,) = messages["/lbl/beacons"]
    assert [b.name for b in message.beacons] == solution.dive.beacons.name.tolist()
    assert message.origin_latitude == solution.dive.origin.latitude_deg


def test_without_an_origin_there_is_no_navsatfix(written, tmp_path):
    solution = written[0]
    local = dataclasses.replace(solution, dive=dataclasses.replace(solution.dive, origin=None))
    found = messages_of(write_dive(tmp_path / "local", local) / "solution.mcap")
    assert not [topic for topic in found if topic.endswith("navsatfix")]
    assert math.isnan(found["/lbl/beacons"][0].origin_latitude)


def test_viewers_get_paths_frames_and_beacons(written, messages):
    solution = written[0]
    track = solution.tracks["smoother"]
    (path,) = messages["/abyssnav/smoother/path"]
    assert len(path.poses) == len(track) <= 5000
    assert path.header.stamp.sec * 10**9 + path.header.stamp.nanosec == START_NS
    places = np.array(
        [[p.pose.position.x, p.pose.position.y, p.pose.position.z] for p in path.poses]
    )
    np.testing.assert_array_equal(places, track.position_enu_m)
    assert {p.header.frame_id for p in path.poses} == {"map"}
    stamps = np.array([p.header.stamp.sec for p in path.poses])
    np.testing.assert_array_equal(stamps, START_NS // 10**9 + track.t_s)
    frames = [message.transforms[0] for message in messages["/tf"]]
    assert {(f.header.frame_id, f.child_frame_id) for f in frames} == {("map", "base_link")}
    moved = np.array([[f.transform.translation.x, f.transform.translation.y] for f in frames])
    np.testing.assert_array_equal(moved, track.position_enu_m[:, :2])
    turn = frames[300].transform.rotation
    quat = np.array([turn.x, turn.y, turn.z, turn.w])
    np.testing.assert_allclose(rotation_by(quat), rot_enu_flu(track, 300), atol=1e-12)
    (markers,) = messages["/abyssnav/beacons"]
    names = [m.text for m in markers.markers if m.text]
    assert names == solution.dive.beacons.name.tolist()
    balls = [m.pose.position for m in markers.markers if not m.text]
    np.testing.assert_array_equal(
        [[b.x, b.y, b.z] for b in balls], solution.dive.beacons.position_enu_m
    )
    pose = messages["/abyssnav/ekf/pose"]
    assert len(pose) == len(solution.tracks["ekf"].t_s[::10])


def test_the_map_is_geojson_of_tracks_and_beacons(written, messages):
    solution = written[0]
    (message,) = messages["/abyssnav/map"]
    layer = json.loads(message.geojson)
    by_name = {f["properties"]["name"]: f["geometry"] for f in layer["features"]}
    beside = {"reference", *solution.dive.beacons.name.tolist()}
    assert set(by_name) == {*solution.tracks, *beside}
    line = np.array(by_name["smoother"]["coordinates"])
    rows = table(written[2], "tracks")
    mine = rows.filter(np.array(rows["method"].to_pylist()) == "smoother")
    np.testing.assert_allclose(line[:, 0], mine["longitude_deg"].to_numpy(), atol=1e-8)
    np.testing.assert_allclose(line[:, 1], mine["latitude_deg"].to_numpy(), atol=1e-8)


def test_viewers_without_paths_get_the_dive_as_coloured_points(written, messages):
    solution, reference, _ = written
    (cloud,) = messages["/abyssnav/points"]
    assert [(f.name, f.offset, f.datatype, f.count) for f in cloud.fields] == [
        ("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1), ("rgb", 12, 6, 1)
    ]  # fmt: skip
    assert (cloud.height, cloud.point_step, cloud.row_step) == (1, 16, 16 * cloud.width)
    points = np.frombuffer(bytes(cloud.data), "<f4").reshape(-1, 4)
    colours = np.frombuffer(bytes(cloud.data), "<u4").reshape(-1, 4)[:, 3]
    track = solution.tracks["smoother"].position_enu_m
    violet = int(method_colour("smoother").removeprefix("#"), 16)
    np.testing.assert_allclose(points[colours == violet, :3], track, atol=1e-3)
    beacons = solution.dive.beacons.position_enu_m
    np.testing.assert_allclose(points[: len(beacons), :3], beacons, atol=1e-3)
    assert cloud.width == len(beacons) + solution.fixes.consistent.sum() + len(track) + len(
        reference.position_enu_m
    )


def test_a_method_that_ran_away_is_not_on_the_viewers_map(tmp_path):
    solution, reference = make_solution(duration_s=900.0)
    gone = solution.tracks["ekf_ungated"]
    far = dataclasses.replace(gone, position_enu_m=gone.position_enu_m + np.array([3e5, 0, 0]))
    tracks = dict(solution.tracks) | {"ekf_ungated": far}
    folder = write_dive(tmp_path / "dive", dataclasses.replace(solution, tracks=tracks), reference)
    with (folder / "solution.mcap").open("rb") as stream:
        reader = make_reader(stream)
        (*_, message), *_ = reader.iter_messages(topics=["/abyssnav/map"])
    assert b'"ekf"' in message.data
    assert b"ekf_ungated" not in message.data


def test_rosbags_reads_all_messages_by_the_schemas_in_the_file(written):
    from rosbags.highlevel import AnyReader

    counts = {}
    with AnyReader([written[2] / "solution.mcap"]) as reader:
        for connection, _, raw in reader.messages():
            reader.deserialize(raw, connection.msgtype)
            counts[connection.topic] = counts.get(connection.topic, 0) + 1
    assert counts["/tf"] == len(written[0].tracks["smoother"])
    assert counts["/abyssnav/smoother/path"] == 1


def fields_of(definition, package):
    """Fields of a ROS 2 message's text as `type name`, types with their package."""
    fields = []
    for line in definition.splitlines():
        words = line.split("#")[0].split()
        if len(words) in (2, 3) and "=" not in "".join(words):  # a third word is a default
            kind, size = re.fullmatch(r"([a-zA-Z0-9_/]+)(\[\d*\])?", words[0]).groups()
            kind = kind.replace("/msg/", "/")
            if "/" not in kind and kind[0].isupper():
                kind = f"std_msgs/{kind}" if kind == "Header" else f"{package}/{kind}"
            if kind in ("builtin_interfaces/Time", "builtin_interfaces/Duration"):
                kind = kind.split("/")[1].lower()
            fields.append(f"{kind}{size or ''} {words[1]}")
    return fields


def test_each_type_is_defined_as_the_viewers_libraries_define_it(written):
    """Against `viewer_definitions.json`, which `viewers.mjs` recorded from Foxglove's packages."""
    theirs = json.loads((Path(__file__).parent / "viewer_definitions.json").read_text())
    with (written[2] / "solution.mcap").open("rb") as stream:
        schemas = make_reader(stream).get_summary().schemas.values()
        texts = {schema.name: schema.data.decode() for schema in schemas}
    ours = {}
    for name, text in texts.items():
        first, *others = re.split(r"^=+\n", text, flags=re.MULTILINE)
        ours[name.replace("/msg/", "/")] = first
        for other in others:
            head, definition = other.split("\n", 1)
            ours[head.removeprefix("MSG: ").strip().replace("/msg/", "/")] = definition
    compared = {name for name in ours if not name.startswith(("abyssnav_msgs", "builtin"))}
    assert len(compared) > 15
    for name in compared:
        assert fields_of(ours[name], name.split("/")[0]) == theirs[name]


#: What Lichtblick's panels keep of a layout; a key of no panel would be lost there in silence.
PANEL_KEYS = {
    "map": "center customTileUrl disabledTopics followTopic layer topicColors zoomLevel "
    "maxNativeZoom",
    "Plot": "title paths minXValue maxXValue minYValue maxYValue showLegend legendDisplay "
    "showPlotValuesInLegend showXAxisLabels showYAxisLabels isSynced xAxisVal xAxisPath "
    "followingViewWidth sidebarDimension",
    "RawMessages": "topicPath diffEnabled diffMethod diffTopicPath showFullMessageForDiff",
    "3D": "followTf followMode fixedFrame scene cameraState transforms topics layers publish "
    "imageMode",
}


def test_the_viewers_layout_shows_topics_that_are_there(written, messages):
    path = Path(__file__).parent.parent / "schemas" / "layouts" / "abyssnav.json"
    layout = json.loads(path.read_text())
    named = set(re.findall(r"/(?:abyssnav|lbl)/[a-z_/]+", json.dumps(layout)))
    assert len(named) > 10
    assert {topic for topic in named if "smoother/" not in topic} <= set(messages)
    assert set(layout) == {
        "configById", "globalVariables", "userNodes", "playbackConfig", "layout"
    }  # fmt: skip
    panels = set(re.findall(r'"(\w+![a-z]+)"', json.dumps(layout["layout"])))
    assert panels == set(layout["configById"])
    for panel, config in layout["configById"].items():
        assert set(config) <= set(PANEL_KEYS[panel.split("!")[0]].split())
    maps = layout["configById"]["map!globe"]
    assert maps["layer"] in ("map", "satellite", "custom")
    assert "center" not in maps or {"lat", "lon"} == set(maps["center"])


def test_every_check_says_on_which_side_of_its_limit_it_is_good(result):
    summary = json.loads((result.folder / "summary.json").read_text())
    for check in summary["checks"]:
        value, limit = check["value"], check["limit"]
        if value is not None and limit is not None:
            good = value >= limit if check["bound"] == "min" else value <= limit
            assert good or not check["ok"], check


def test_a_long_track_has_a_path_of_at_most_5000_poses(tmp_path):
    solution, _ = make_solution(duration_s=9000.0)
    solution = dataclasses.replace(solution, tracks={"smoother": solution.tracks["smoother"]})
    found = messages_of(write_dive(tmp_path / "long", solution) / "solution.mcap")
    (path,) = found["/abyssnav/smoother/path"]
    assert 4000 < len(path.poses) <= 5000
    first, last = path.poses[0].pose.position, path.poses[-1].pose.position
    ends = solution.tracks["smoother"].position_enu_m[[0, -1]]
    assert [[first.x, first.y], [last.x, last.y]] == ends[:, :2].tolist()


# --- positions of another kind ----------------------------------------------------------------


def test_positions_of_gnss_or_usbl_are_written_as_each_method_met_them(tmp_path):
    solution, _ = make_solution(duration_s=300.0)
    met = PositionInnovations(
        t_s=np.array([1.0, 2.0]),
        position_enu_m=np.array([[1.0, 2.0], [3.0, 4.0]]),
        sigma_enu_m=np.full((2, 2), 3.0),
        innovation_enu_m=np.array([[0.5, -0.5], [np.nan, np.nan]]),
        nis=np.array([0.05, np.nan]),
        decision=np.array([0, DECISIONS.index("before_start")]),
    )
    solution = dataclasses.replace(solution, positions={"smoother": met, "ekf": met})
    got = table(write_dive(tmp_path / "surfaced", solution), "positions").to_pylist()
    assert [row["method"] for row in got] == ["ekf", "ekf", "smoother", "smoother"]
    assert got[0]["innovation_north_m"] == -0.5
    assert got[1]["innovation_north_m"] is None
    assert [row["accepted"] for row in got[:2]] == [True, False]
    assert got[1]["decision"] == "before_start"


def test_only_the_files_asked_for_are_made(written, tmp_path):
    solution, reference, _ = written
    errors = error_over_time(solution, reference)
    wanted = wanted_files(Output(files=("tracks.parquet", "comparison.csv")))
    write(Evaluation(solution, summarise(errors), errors, reference), tmp_path, wanted)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["comparison.csv", "tracks.parquet"]


def test_a_file_that_is_none_of_ours_is_refused_with_the_nearest():
    with pytest.raises(ConfigError, match=r"no 'track\.parquet'; nearest: tracks\.parquet"):
        wanted_files(Output(files=("track.parquet",)))


# --- summary ----------------------------------------------------------------------------------


def test_the_summary_is_strict_json_with_every_key(written, tmp_path):
    solution, reference, _ = written
    comparison = summarise(error_over_time(solution, reference))
    endless = Check("navigate", "gate is inert", math.inf, math.nan, "m", False)
    odd = dataclasses.replace(solution, checks=(endless,))
    log = make_log(odd)
    log = Log(log.name, log.inputs, "default", {}, {}, (Finding("cut short", "a.mcap", "12 B"),))
    summary = make_summary(odd, comparison, log, Config(gate=Gate(gamma=math.inf)))
    write_summary(summary | {"timings_s": {"read": 0.1}, "peak_memory_mb": 1.0}, tmp_path)

    def refuse(constant):
        raise AssertionError(constant)

    got = json.loads((tmp_path / "summary.json").read_text(), parse_constant=refuse)
    assert {"version", "settings", "profile", "inputs", "starts", "methods", "checks"} < set(got)
    assert got["settings"]["gate"]["gamma"] == "inf"
    assert got["checks"][-1]["value"] is None
    assert got["checks"][-1]["bound"] == "max"
    assert got["verdict"] == {"level": "good", "reasons": []}
    assert got["origin"] == {"latitude_deg": 42.5, "longitude_deg": 145.25, "from": "log"}
    assert got["learned"] == []
    beacons = table(written[2], "beacons").drop_columns(["dive"]).to_pylist()
    assert got["beacons"] == beacons
    assert [b["name"] for b in beacons] == ["Alpha", "Bravo", "Charlie", "Delta"]
    assert got["duration_s"] == 1799.0
    assert got["findings"] == [{"what": "cut short", "where": "a.mcap", "detail": "12 B"}]
    assert got["starts"]["ekf"]["time"] == "2025-10-09T08:55:20.000000000Z"
    gated = got["methods"]["ekf_gated"]
    assert gated["accepted"] + sum(gated["rejected"].values()) == gated["replies"]
    row = comparison[(comparison.method == "ekf_gated") & (comparison.reference == "truth")]
    assert gated["errors"]["truth"]["rms_m"] == row.rms_m[0]
    assert got["methods"]["fix"]["errors"]["fix"] is None


def test_a_dive_with_usbl_has_its_positions_as_ekf_and_smoother_met_them(tmp_path):
    base = load_scenario("clean")
    usbl = msgspec.structs.replace(base.position, usbl_period_s=10.0)
    scenario = msgspec.structs.replace(base, duration_s=900.0, position=usbl)
    write_log(simulate(scenario), tmp_path / "usbl.mcap")
    profile = load_profile()
    role = PositionRole(
        topic="/usbl",
        type="geometry_msgs/msg/PoseWithCovarianceStamped",
        position=("pose.pose.position.x", "pose.pose.position.y"),
        frame="enu",
        covariance="pose.covariance",
    )
    profile = msgspec.structs.replace(profile, position=role)
    config = Config(output=Output(files=("positions.parquet",)))
    result = run_dive([tmp_path / "usbl.mcap"], Setup(config, profile), tmp_path / "out")
    rows = table(result.folder, "positions").to_pandas()
    assert rows.groupby("method").size().to_dict() == {"ekf": 90, "smoother": 90}
    assert rows["accepted"].mean() > 0.8
    assert 0.2 < rows.loc[rows["accepted"], "nis"].median() < 4.0
