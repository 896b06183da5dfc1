# SPDX-License-Identifier: Apache-2.0
"""What the comparison with others rests on: one reading, one model, and its short form."""

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from abyssnav.align import align
from abyssnav.config import Config
from abyssnav.estimation.dead_reckoning import dead_reckon
from abyssnav.profile import load_profile
from abyssnav.read import read
from abyssnav.simulate import benchmark_dives, write_benchmark

PEERS = Path(__file__).parent / "peers"
MINUTES = 20.0
sys.path.insert(0, str(PEERS))

import compare_peers  # noqa: E402
import dive_reader  # noqa: E402
import lbl_model  # noqa: E402


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    (dive, *_) = benchmark_dives("benchmark", ["nominal"])
    folder = tmp_path_factory.mktemp("peers") / "logs"
    write_benchmark(folder, [compare_peers.shortened(dive, 60.0 * MINUTES)])
    return folder / f"{dive.name}.mcap"


@pytest.fixture(scope="module")
def dive(log):
    return dive_reader.read_dive(log)


def test_the_peers_get_what_we_get(dive, log):
    ours = align(read([log], load_profile()), Config())
    assert dive.start_ns == ours.start_ns
    assert len(dive.replies) == len(ours.replies)
    np.testing.assert_allclose(dive.replies["t_ping"], ours.replies.t_ping_s, atol=1e-6)
    np.testing.assert_allclose(dive.replies["travel_time"], ours.replies.travel_time_s, atol=1e-9)
    for number, (place, turn_around_s, _) in dive.beacons.items():
        (row,) = np.flatnonzero(ours.beacons.id == number)
        np.testing.assert_allclose(place, ours.beacons.position_enu_m[row])
        assert turn_around_s == ours.beacons.turn_around_s[row]


def test_their_dead_reckoning_runs_as_ours(dive, log):
    ours = align(read([log], load_profile()), Config())
    span_s = (0.0, float(dive.t_s[-1]))
    motion = dead_reckon(ours.velocity, ours.heading, span_s, 0.1, 1.0)
    t_s = np.arange(60.0, 60.0 * MINUTES - 60.0, 60.0)
    run = motion.interpolate(t_s).displacement_m
    theirs = np.array([dive.interpolated(t, dive.run_m) for t in t_s])
    off_m = (theirs - theirs[0]) - (run - run[0])
    assert np.hypot(*off_m.T).max() < 1.5  # of more than a kilometre


def test_the_derivatives_of_their_travel_time_are_differences(dive):
    row = next(dive.replies.itertuples())
    reply = lbl_model.TravelTime(dive, row, row.t_reply)
    x = np.array([300.0, -200.0, 0.05, 0.01, 1e-3])
    _, H = reply.predict(x)
    for j, step in enumerate([0.01, 0.01, 1e-5, 1e-5, 1e-6]):
        h = np.zeros(5)
        h[j] = step
        slope = (reply.predict(x + h)[0] - reply.predict(x - h)[0]) / (2 * step)
        assert H[j] == pytest.approx(slope, rel=1e-5, abs=1e-10)


def test_the_derivatives_of_their_motion_are_differences(dive):
    x = np.array([300.0, -200.0, 0.05, 0.01, 1e-3])
    _, F, Q = lbl_model.motion(dive, 100.0, 160.0, x)
    for j, step in enumerate([0.01, 0.01, 1e-5, 1e-5]):
        h = np.zeros(5)
        h[j] = step
        ahead, behind = (
            (x + s * h)[:2] + lbl_model.motion(dive, 100.0, 160.0, x + s * h)[0] for s in (1, -1)
        )
        np.testing.assert_allclose(F[:2, j], (ahead - behind) / (2 * step), atol=1e-4)
    assert np.all(np.diag(Q)[[0, 1, 2]] > 0)


def test_a_loss_of_the_velocity_counts_the_same_in_any_steps(dive):
    x = np.zeros(5)
    whole = lbl_model.motion(dive, 0.0, 1000.0, x)[2]
    steps = sum(lbl_model.motion(dive, t, t + 10.0, x)[2] for t in np.arange(0.0, 1000.0, 10.0))
    np.testing.assert_allclose(steps, whole, rtol=1e-9)


def test_lines_of_code_are_those_with_code(tmp_path):
    script = tmp_path / "script.py"
    lines = ['"""Words."""', "", "# more words", "import os", "", "def f(a):", '    """Do."""']
    lines += ["    return (", "        a", "    )"]
    script.write_text("\n".join(lines), encoding="utf-8")
    assert compare_peers.lines_of(script) == 5


def is_installed(peer):
    return find_spec(peer.package.replace("-", "_")) is not None


@pytest.mark.parametrize("peer", compare_peers.PEERS[5:], ids=lambda peer: peer.name)
def test_every_peer_makes_a_track_that_is_scored(peer, log, tmp_path):
    if not is_installed(peer):
        pytest.skip(f"{peer.package} is not installed: pip install --group peers")
    run = compare_peers.measured(compare_peers.command(peer, log, tmp_path))
    assert run.status == 0
    assert run.seconds > 0
    assert run.memory_mb > 10
    (result,) = compare_peers.score_folder(
        log.parent, tmp_path, compare_peers.Options(None, compare_peers.FROM_S)
    )
    assert result.score is not None
    assert result.score.rms_m < 5.0
    assert result.score.coverage > 0.95
    assert result.score.outliers_accepted is not None


def test_the_comparison_prints_its_tables(log, tmp_path):
    words = [sys.executable, str(PEERS / "compare_peers.py"), "--out", str(tmp_path)]
    words += ["--set", "benchmark", "--kinds", "nominal", "--seeds", "1"]
    words += ["--minutes", str(MINUTES), "--peers", "smoother,ekf,SciPy"]
    ended = subprocess.run(words, check=True, capture_output=True, text=True)
    lines = [line for line in ended.stdout.splitlines() if line.startswith("| nominal")]
    assert len(lines) == 2
    for name in ("smoother", "ekf", "SciPy script"):
        assert f"| {name} | 1 of 1 |" in ended.stdout
    assert "mcap-ros2-support 0" in ended.stdout
