# SPDX-License-Identifier: Apache-2.0
"""The gate's self-watch: its numbers by closed form, each verdict provoked."""

from dataclasses import fields

import numpy as np
import pytest

from abyssnav.estimation.gate_integrity import GatedFilter, assess_gate, gate_statistics
from abyssnav.tables import DECISIONS, VERDICTS, Innovations, Track

SIGMA_S, GAMMA, SPEED = 0.002, 9.0, 1500.0


def innovations_of(decisions, sigma_s=0.004, beacon_id=1, step_s=24.0):
    """Replies of one beacon, one a ping."""
    n = len(decisions)
    columns = {column.name: np.zeros(n, dtype=np.int64) for column in fields(Innovations)}
    columns |= {"beacon_id": np.full(n, beacon_id), "t_reply_s": step_s * np.arange(n, dtype=float)}
    columns |= {"innovation_sigma_s": np.full(n, sigma_s), "nis": np.ones(n)}
    columns |= {"decision": np.array([DECISIONS.index(name) for name in decisions])}
    return Innovations(**columns)


def track_at(offset_m, sigma_m=1.0, n=1000):
    position = np.column_stack([np.full(n, float(offset_m)), np.zeros(n), np.zeros(n)])
    cov = np.repeat(sigma_m**2 * np.eye(2)[None], n, axis=0)
    return Track(np.arange(n, dtype=float), position, cov, np.zeros(n), *np.full((5, n), np.nan))


def watch(innovations, track=None, smoothed=None, gamma=GAMMA, noise_s=SIGMA_S):
    ids = np.array([1, 2])
    method = GatedFilter(innovations, track, gamma, noise_s)
    return assess_gate(method, smoothed, ids, SPEED, 900.0)


def verdicts(table, beacon_id=1):
    return [VERDICTS[code] for code in table[table.beacon_id == beacon_id].verdict]


def test_the_smallest_visible_outlier_and_the_largest_unseen_step_by_hand():
    table = watch(innovations_of(["accepted"] * 20))
    own = table[table.beacon_id == 1]
    # half of 1500 m/s times root 9 times 4 ms is 9 m; three quarters of it reach the track
    np.testing.assert_allclose(own.smallest_visible_outlier_m, 9.0)
    np.testing.assert_allclose(own.largest_unseen_step_m, 9.0 * 0.75)


def test_what_is_noise_reaches_no_track():
    """Learned in the second stretch, where all of the 4 ms is noise: no step, still 9 m unseen."""
    learned_s = np.repeat([SIGMA_S, 0.004], [38, 37])
    table = watch(innovations_of(["accepted"] * 75), noise_s=learned_s)
    own = table[table.beacon_id == 1]
    np.testing.assert_allclose(own.smallest_visible_outlier_m, 9.0)
    np.testing.assert_allclose(own.largest_unseen_step_m, [9.0 * 0.75, 0.0], atol=1e-12)


def test_a_beacon_that_nobody_heard_is_silent_and_a_good_one_healthy():
    table = watch(innovations_of(["accepted"] * 80))
    assert verdicts(table) == ["healthy"] * 3
    assert verdicts(table, 2) == ["silent"] * 3


def test_stretches_are_judged_by_themselves():
    table = watch(innovations_of(["accepted"] * 38 + ["gated"] * 37))
    assert verdicts(table) == ["healthy", "starving"]
    assert table[table.beacon_id == 1].accepted.tolist() == [38, 0]


def test_one_reply_in_three_is_no_famine():
    assert verdicts(watch(innovations_of(["accepted", "gated", "gated"] * 5))) == ["healthy"]


@pytest.mark.parametrize(("sigma_s", "gamma"), [(0.1, GAMMA), (0.004, np.inf)])
def test_a_gate_that_passes_anything_is_inert(sigma_s, gamma):
    table = watch(innovations_of(["accepted"] * 10, sigma_s=sigma_s), gamma=gamma)
    assert verdicts(table) == ["inert"]


def test_a_wide_gate_that_yet_rejects_most_is_starving():
    table = watch(innovations_of(["gated"] * 10, sigma_s=0.1))
    assert verdicts(table) == ["starving"]


def test_a_track_that_follows_something_else_is_captured():
    heard = innovations_of(["accepted"] * 30)
    assert verdicts(watch(heard, track_at(60), track_at(0))) == ["captured"]
    assert verdicts(watch(heard, track_at(3), track_at(0))) == ["healthy"]
    honest = track_at(60, sigma_m=50.0)
    assert verdicts(watch(heard, honest, track_at(0))) == ["healthy"]


def test_a_dive_without_replies_that_met_the_gate_is_silent():
    table = watch(innovations_of(["before_start"] * 5))
    assert set(verdicts(table)) == {"silent"}
    assert np.all(np.isnan(table.smallest_visible_outlier_m))


def test_gate_statistics_count_each_decision_and_take_the_worst_stretch():
    names = ["accepted", "accepted", "gated", "duplicate", "before_start", "unknown_beacon"]
    columns = innovations_of(names).columns()
    columns["beacon_id"] = np.array([1, 1, 1, 1, 2, 77])
    columns["innovation_sigma_s"] = np.array([0.004, 0.006, 0.008, 0.006, np.nan, np.nan])
    columns["nis"] = np.array([1.0, 5.0, 40.0, 0.5, np.nan, np.nan])
    innovations = Innovations(**columns)
    found = gate_statistics(innovations, np.array([1, 2]), GAMMA, SPEED, watch(innovations))
    assert found.beacon_id.tolist() == [1, 2, 77]
    assert found.replies.tolist() == [4, 1, 1]
    assert found.accepted.tolist() == [2, 0, 0]
    assert (found.gated[0], found.duplicate[0], found.before_start[1]) == (1, 1, 1)
    assert found.unknown_beacon.tolist() == [0, 0, 1]
    assert found.mean_nis[0] == 3.0
    assert found.nis_inside_95[0] == 0.5
    assert found.smallest_visible_outlier_m[0] == pytest.approx(0.5 * SPEED * 3 * 0.006)
    assert np.all(np.isnan(found.mean_nis[1:]))
    assert [VERDICTS[code] for code in found.verdict] == ["healthy", "silent", "silent"]
    assert found.largest_unseen_step_m[0] == pytest.approx(9 * 0.006 / 0.004 * (1 - 4 / 36))


def test_a_gate_without_bound_sees_no_outlier_however_large():
    innovations = innovations_of(["accepted"] * 5)
    table = watch(innovations, gamma=np.inf)
    found = gate_statistics(innovations, np.array([1, 2]), np.inf, SPEED, table)
    assert found.smallest_visible_outlier_m[0] == np.inf
