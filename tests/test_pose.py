# SPDX-License-Identifier: Apache-2.0
"""Poses at any instants: the track's own rows, the truth between them, a sensor's place."""

import subprocess
import sys
from importlib import import_module
from pathlib import Path

import msgspec
import numpy as np
import pandas as pd
import pytest
from oracles import rotation_enu_body

from abyssnav.align import reference
from abyssnav.config import Config, Output
from abyssnav.errors import ConfigError, ReadError
from abyssnav.pose import (
    Mounting,
    poses_of_dive,
    read_instants,
    write_photogrammetry,
    write_poses,
)
from abyssnav.pose.instants import Instants
from abyssnav.profile import load_profile
from abyssnav.read import read_optional
from abyssnav.run import Setup, run_dive
from abyssnav.simulate import load_scenario, simulate, write_log


def at(time_ns):
    return Instants(np.asarray(time_ns, np.int64), (), "")


def track_of(folder, method):
    table = pd.read_parquet(folder / "tracks.parquet").query("method == @method")
    return table.reset_index(drop=True), table["time"].astype("int64").to_numpy()


@pytest.fixture(scope="module")
def turning(tmp_path_factory):
    """Folder of a dive with turns, and its truth ten times a second."""
    base = tmp_path_factory.mktemp("turning")
    scenario = load_scenario("clean")
    scenario = msgspec.structs.replace(scenario, duration_s=1500.0, reference_rate_hz=10.0)
    write_log(simulate(scenario), base / "turning.mcap")
    files = Output(files=("tracks.parquet",))
    result = run_dive(
        [base / "turning.mcap"], Setup(Config(output=files), load_profile()), base / "out"
    )
    log = read_optional([base / "turning.mcap"], load_profile(), ("reference", "beacons"))
    return result.folder, reference(log)


@pytest.mark.parametrize("method", ["smoother", "ekf", "ekf_gated", "dead_reckoning"])
def test_poses_at_the_tracks_own_instants_are_the_tracks(turning, tmp_path, method):
    table, time_ns = track_of(turning[0], method)
    poses = poses_of_dive(turning[0], at(time_ns), method)
    assert poses.inside.all()
    write_poses(poses, tmp_path / "poses.parquet")
    got = pd.read_parquet(tmp_path / "poses.parquet")
    assert set(got) == (set(table) - {"dive", "method"}) | {"inside"}
    numbers = [name for name in got if name not in ("time", "inside", "altitude_m")]
    np.testing.assert_allclose(got[numbers], table[numbers], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(got["altitude_m"], table["altitude_m"])
    assert (got["time"] == table["time"]).all()


def test_between_its_rows_a_track_errs_no_more_than_at_them(turning):
    folder, truth = turning
    table, time_ns = track_of(folder, "smoother")
    poses = poses_of_dive(folder, at(truth.time_ns))
    rows = poses.inside
    error_m = (poses.track.position_enu_m - truth.position_enu_m)[rows, :2]
    own_m = np.column_stack(
        [
            table[name] - np.interp(time_ns, truth.time_ns, truth.position_enu_m[:, axis])
            for axis, name in enumerate(("east_m", "north_m"))
        ]
    )
    own_between_m = np.column_stack(
        [np.interp(truth.time_ns[rows], time_ns, own_m[:, axis]) for axis in (0, 1)]
    )
    beyond_m = np.hypot(*(error_m - own_between_m).T)
    assert np.sqrt(np.mean(beyond_m**2)) < 0.02
    assert rows.sum() > 14_000


def test_instants_outside_the_track_are_null_and_say_so(turning, tmp_path):
    _, time_ns = track_of(turning[0], "smoother")
    instants = at([time_ns[0] - 1, time_ns[0], time_ns[-1], time_ns[-1] + 1])
    poses = poses_of_dive(turning[0], instants)
    assert poses.inside.tolist() == [False, True, True, False]
    write_poses(poses, tmp_path / "poses.csv")
    got = pd.read_csv(tmp_path / "poses.csv")
    assert got["inside"].tolist() == poses.inside.tolist()
    assert got["east_m"].isna().tolist() == [True, False, False, True]
    assert got["time"].tolist()[1] == f"{np.datetime64(int(time_ns[0]), 'ns')}Z"


def test_a_sensor_lies_at_the_end_of_its_lever_and_points_as_it_is_mounted(turning):
    folder, _ = turning
    _, time_ns = track_of(folder, "smoother")
    when = at(time_ns[100:-100:50] + 300_000_000)
    offset_m, rpy_deg = (3.0, -1.0, 0.5), (10.0, -20.0, 130.0)
    vehicle = poses_of_dive(folder, when).track
    sensor = poses_of_dive(folder, when, None, Mounting(offset_m, rpy_deg)).track
    down_by = np.diag([1.0, 1.0, -1.0])
    for row in range(len(when)):
        attitude = (vehicle.roll_rad[row], vehicle.pitch_rad[row], vehicle.heading_rad[row])
        rot_enu_body = rotation_enu_body(*attitude)
        lever_m = sensor.position_enu_m[row] - vehicle.position_enu_m[row]
        np.testing.assert_allclose(lever_m, rot_enu_body @ offset_m, atol=1e-9)
        # a vehicle heading north is north, east, down: its mount is a rotation in that frame
        rot_body_sensor = (down_by @ rotation_enu_body(*np.radians(rpy_deg)))[[1, 0, 2]]
        attitude = (sensor.roll_rad[row], sensor.pitch_rad[row], sensor.heading_rad[row])
        np.testing.assert_allclose(
            rotation_enu_body(*attitude), rot_enu_body @ rot_body_sensor, atol=1e-9
        )


def test_the_speed_of_a_sensor_is_that_of_its_place(turning):
    folder, _ = turning
    _, time_ns = track_of(folder, "dead_reckoning")
    step_ns = 100_000_000
    middle = time_ns[200:-200:7] + 450_000_000
    mounting = Mounting((8.0, 2.0, 0.0), (0.0, 0.0, 90.0))
    first, now, last = (
        poses_of_dive(folder, at(middle + k * step_ns), "dead_reckoning", mounting).track
        for k in (-1, 0, 1)
    )
    moved_mps = (last.position_enu_m - first.position_enu_m)[:, :2] / 0.2
    sin, cos = np.sin(now.heading_rad), np.cos(now.heading_rad)
    speed_mps = np.column_stack(
        [
            now.forward_mps * sin + now.starboard_mps * cos,
            now.forward_mps * cos - now.starboard_mps * sin,
        ]
    )
    assert (
        np.sqrt(np.mean((moved_mps - speed_mps) ** 2)) < 0.05
    )  # the DVL's noise; the lever turns at up to 0.3 m/s


# --- what instants come from -------------------------------------------------------------------

NS = np.array([1_760_000_000_123_456_789, 1_760_000_001_000_000_000], dtype=np.int64)


@pytest.mark.parametrize(
    ("text", "said", "digits"),
    [
        ("time,x\n2025-10-09T08:53:20.123456789Z,1\n2025-10-09T08:53:21Z,2\n", "ISO 8601", 9),
        ("x;utc\n1;2025-10-09 10:53:20.123456+02:00\n2;2025-10-09 10:53:21+02:00\n", "ISO", 6),
        ("stamp\n2025-10-09T08:53:20.123\n2025-10-09T08:53:21.000\n", "ISO 8601", 3),
        ("label,t\na,1760000000.123456789\nb,1760000001\n", "Unix time in s", 9),
        ("# timestamp\n1760000000123.456789\n1760000001000\n", "Unix time in ms", 9),
        ("time\n1760000000123456\n1760000001000000\n", "Unix time in us", 6),
        ("time\n1760000000123456789\n1760000001000000000\n", "Unix time in ns", 9),
    ],
)
def test_a_column_of_times_is_recognised_and_said(tmp_path, text, said, digits):
    (tmp_path / "given.csv").write_text(text)
    instants = read_instants(tmp_path / "given.csv")
    exact = NS - NS % 10 ** (9 - digits)
    np.testing.assert_array_equal(instants.time_ns, exact)
    assert said in instants.source


@pytest.mark.parametrize("kind", ["datetime64[ns, UTC]", "int64", "float64"])
def test_a_parquet_column_of_any_kind_is_read(tmp_path, kind):
    times = pd.Series(NS).astype("datetime64[ns]").dt.tz_localize("UTC")
    column = {"datetime64[ns, UTC]": times, "int64": NS, "float64": NS / 1e9}[kind]
    pd.DataFrame({"seen": column, "other": 1}).to_parquet(tmp_path / "given.parquet")
    instants = read_instants(tmp_path / "given.parquet", time_column="seen")
    np.testing.assert_allclose(instants.time_ns - NS, 0, atol=200 if kind == "float64" else 0)


def test_of_an_mcap_file_the_headers_stamps_count(dive_log: Path):
    instants = read_instants(dive_log, "/imu")
    log = read_optional([dive_log], load_profile(), ("heading",))
    np.testing.assert_array_equal(
        np.sort(instants.time_ns), np.sort(log.roles["heading"]["time_ns"])
    )
    assert "own stamps" in instants.source


def test_stamps_of_a_packed_file_are_read_too(dive_log: Path, tmp_path: Path):
    zstandard = pytest.importorskip("zstandard")
    packed = tmp_path / "dive.mcap.zst"
    packed.write_bytes(zstandard.ZstdCompressor(level=1).compress(dive_log.read_bytes()))
    plain = read_instants(dive_log, "/imu")
    np.testing.assert_array_equal(read_instants(packed, "/imu").time_ns, plain.time_ns)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("a,b\n1,2\n", "no column of times; give --time-column; there are a, b"),
        ("time\n2025-10-09T08:53:20Z\nnever\n", "row 2: 'never' is no time"),
        ("time\n1760000000\nx\n", "row 2: 'x' is no time"),
        ("time\n", "nothing in row 1"),
    ],
)
def test_what_holds_no_times_is_refused_with_its_row(tmp_path, text, match):
    (tmp_path / "given.csv").write_text(text)
    with pytest.raises(ReadError, match=match):
        read_instants(tmp_path / "given.csv")


def test_a_topic_that_is_not_there_gets_the_nearest(dive_log: Path):
    with pytest.raises(ReadError, match="no topic '/imv'; nearest: /imu"):
        read_instants(dive_log, "/imv")
    with pytest.raises(ReadError, match="which topic"):
        read_instants(dive_log)


# --- files and the command ---------------------------------------------------------------------


def test_photogrammetry_gets_degrees_by_label(turning, tmp_path):
    folder, _ = turning
    table, time_ns = track_of(folder, "smoother")
    instants = Instants(time_ns[[5, 50]], ("a.jpg", "b.jpg"), "")
    poses = poses_of_dive(folder, instants)
    if poses.origin is None:
        with pytest.raises(ConfigError, match="no origin"):
            write_photogrammetry(poses, instants, tmp_path / "ref.csv")
        return
    assert write_photogrammetry(poses, instants, tmp_path / "ref.csv") == 2
    got = pd.read_csv(tmp_path / "ref.csv")
    assert got["#label"].tolist() == ["a.jpg", "b.jpg"]
    rows = table.iloc[[5, 50]]
    np.testing.assert_allclose(got["latitude_deg"], rows["latitude_deg"], atol=1e-9)
    np.testing.assert_allclose(got["height_m"], -rows["depth_m"], atol=1e-4)
    np.testing.assert_allclose(got["yaw_deg"], np.degrees(rows["heading_rad"]), atol=1e-4)
    np.testing.assert_allclose(got["accuracy_east_m"], rows["sigma_east_m"], atol=1e-4)


def test_rows_of_text_are_in_order_however_many_write_them(turning, tmp_path, monkeypatch):
    _, time_ns = track_of(turning[0], "smoother")
    poses = poses_of_dive(turning[0], at(time_ns[:100]))
    write_poses(poses, tmp_path / "whole.csv")
    module = import_module("abyssnav.pose.write")  # `abyssnav.pose` itself is a function
    monkeypatch.setattr(module, "_ROWS_OF_TEXT", 7)
    monkeypatch.setattr(module, "cores", lambda: 3)
    write_poses(poses, tmp_path / "parts.csv")
    whole = (tmp_path / "whole.csv").read_bytes()
    assert (tmp_path / "parts.csv").read_bytes() == whole
    assert whole.count(b"\n") == 101
    write_poses(poses_of_dive(turning[0], at([])), tmp_path / "none.csv")
    assert (tmp_path / "none.csv").read_bytes() == whole[: whole.index(b"\n") + 1]


def test_poses_of_a_command_import_no_pandas(turning, tmp_path):
    _, time_ns = track_of(turning[0], "smoother")
    (tmp_path / "shots.csv").write_text(f"time\n{time_ns[9]}\n")
    command = ["pose", str(turning[0]), "--at", str(tmp_path / "shots.csv")]
    code = (
        "import atexit, sys; from abyssnav.__main__ import main; "
        f"sys.argv[1:] = {command!r}; "
        "atexit.register(lambda: print('pandas' in sys.modules)); main()"
    )
    ended = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert ended.stdout.splitlines()[-1] == "False"


def test_the_command_writes_and_counts(abyssnav, turning, tmp_path):
    folder, _ = turning
    _, time_ns = track_of(folder, "smoother")
    (tmp_path / "shots.csv").write_text(f"time\n{time_ns[9]}\n{time_ns[-1] + 10**9}\n")
    path = tmp_path / "poses.csv"
    ended = abyssnav("pose", folder, "--at", tmp_path / "shots.csv", "-o", path)
    assert ended.status == 0
    assert "2 instants, column time: Unix time in ns" in ended.err
    assert "1 outside the track" in ended.err
    assert len(pd.read_csv(path)) == 2
    wrong = abyssnav("pose", folder, "--at", tmp_path / "shots.csv", "--offset-m", "1,2")
    assert wrong.status == 2
    unknown = abyssnav("pose", folder, "--at", tmp_path / "shots.csv", "--method", "smother")
    assert (unknown.status, "nearest: smoother" in unknown.err) == (2, True)
    other = abyssnav("pose", folder, "--at", tmp_path / "shots.csv", "-o", tmp_path / "poses.txt")
    assert (other.status, ".csv or .parquet expected" in other.err) == (1, True)
