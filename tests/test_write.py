# SPDX-License-Identifier: Apache-2.0
import csv
import dataclasses
import json
import math
import subprocess
import sys

import numpy as np
import pytest
from solutions import START_NS, make_log, make_solution, make_summary, stripped, write_dive

from abyssnav.compare import error_over_time, summarise
from abyssnav.config import Config, Gate
from abyssnav.geometry import geodetic_to_enu
from abyssnav.outputs.columns import COLUMNS
from abyssnav.outputs.messages import NOT_ESTIMATED
from abyssnav.outputs.summary import write_summary
from abyssnav.tables import ARRIVALS, DECISIONS, Check, Finding, Log


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


@pytest.mark.parametrize("name", COLUMNS)
def test_each_file_has_its_columns_with_unit_meaning_and_version(written, name):
    schema = table(written[2], name).schema
    assert schema.names == [column.name for column in COLUMNS[name]]
    assert schema.metadata[b"abyssnav_version"]
    assert all(field.metadata[b"meaning"] for field in schema)
    kinds = {"text": "string", "time": "timestamp[ns, tz=UTC]", "integer": "int64"}
    kinds |= {"number": "double", "flag": "bool"}
    assert [str(field.type) for field in schema] == [kinds[c.kind] for c in COLUMNS[name]]


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

    for name in COLUMNS:
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
    assert len(names) == 10
    assert [n for n in names if (folder / n).read_bytes() != (again / n).read_bytes()] == []


def test_a_solution_with_nothing_in_it_has_the_same_columns(written, tmp_path):
    solution, _, folder = written
    heard = {m: table[:0] for m, table in solution.statistics.items()}
    empty = stripped(solution, replies=solution.dive.replies[:0])
    empty = dataclasses.replace(empty, statistics=heard)
    got = write_dive(tmp_path / "empty", empty)
    for name in COLUMNS:
        assert len(table(got, name)) == 0
        assert table(got, name).schema.equals(table(folder, name).schema, check_metadata=True)


def test_writing_parquet_does_not_import_pandas(tmp_path):
    code = """
import sys; sys.path.insert(0, {tests!r})
from pathlib import Path
from solutions import make_solution
from abyssnav.compare import error_over_time, summarise
from abyssnav.outputs.write import write
solution, reference = make_solution(duration_s=600.0)
errors = error_over_time(solution, reference)
write(solution, summarise(errors), errors, Path({out!r}))
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
    for method in solution.tracks:
        expected |= {f"/abyssnav/{method}/odometry", f"/abyssnav/{method}/navsatfix"}
    for method in solution.innovations:
        expected |= {f"/abyssnav/{method}/innovation", f"/abyssnav/{method}/statistics"}
    assert set(messages) == expected


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
    forward = (turn.w**2 - turn.z**2, 2 * turn.w * turn.z)
    heading_rad = track.heading_rad[k]
    assert forward == pytest.approx((math.sin(heading_rad), math.cos(heading_rad)), abs=1e-12)
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
    assert got["findings"] == [{"what": "cut short", "where": "a.mcap", "detail": "12 B"}]
    assert got["starts"]["ekf"]["time"] == "2025-10-09T08:55:20.000000000Z"
    gated = got["methods"]["ekf_gated"]
    assert gated["accepted"] + sum(gated["rejected"].values()) == gated["replies"]
    row = comparison[(comparison.method == "ekf_gated") & (comparison.reference == "truth")]
    assert gated["errors"]["truth"]["rms_m"] == row.rms_m[0]
    assert got["methods"]["fix"]["errors"]["fix"] is None
