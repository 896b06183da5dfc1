# SPDX-License-Identifier: Apache-2.0
import dataclasses
from functools import cache

import msgspec
import numpy as np
import pytest

from abyssnav.align import align
from abyssnav.config import Acoustics, Config, Gate, Output, StartRule
from abyssnav.errors import ConfigError, PipelineError, SolveError
from abyssnav.navigate import navigate
from abyssnav.simulate import bound, load_scenario, simulate, to_log
from abyssnav.tables import DECISIONS, METHODS

REAL_TIME = ("dead_reckoning", "kf_fix", "ekf_ungated", "ekf_gated", "ekf")
#: The newest sensor sample waits for its next one: depth comes once a second.
NEWEST_S = 1.5


def changed(settings, **changes):
    return msgspec.structs.replace(settings, **changes)


@cache
def simulation(name="voyage_2", seed=3, duration_s=3600.0):
    return simulate(changed(load_scenario(name), seed=seed, duration_s=duration_s))


def recorded(name="voyage_2", seed=3, duration_s=3600.0):
    return to_log(simulation(name, seed, duration_s), name=name)


def solve(log, config=None):
    config = config or Config()
    return navigate(align(log, config), config)


@cache
def solved(name="voyage_2", seed=3, duration_s=3600.0):
    return solve(recorded(name, seed, duration_s))


def mended(log, role, **columns):
    """The log with columns of one role changed: each a function of the old one."""
    old = log.roles[role]
    new = {name: change(old[name].copy()) for name, change in columns.items()}
    return dataclasses.replace(log, roles={**log.roles, role: {**old, **new}})


def kept(log, role, rows):
    columns = {name: column[rows] for name, column in log.roles[role].items()}
    return dataclasses.replace(log, roles={**log.roles, role: columns})


def cut(log, end_ns):
    """What was in the log at `end_ns`."""
    for role in log.roles:
        log = kept(log, role, log.roles[role]["time_ns"] <= end_ns)
    return log


def assert_same(one, other, rows=slice(None)):
    for name, column in one.columns().items():
        theirs = getattr(other, name)[rows]
        assert np.array_equal(column[rows], theirs, equal_nan=column.dtype.kind == "f"), name


# --- what comes out ----------------------------------------------------------------------------


def test_every_method_has_its_track_its_start_and_a_row_a_reply():
    solution = solved()
    assert set(solution.tracks) == set(METHODS) - {"fix"}
    n = len(solution.dive.replies)
    for method in ("ekf_ungated", "ekf_gated"):
        assert len(solution.innovations[method]) == n
        counted = solution.statistics[method]
        assert counted.replies.sum() == n
        assert np.all(counted.replies == sum(getattr(counted, name) for name in DECISIONS))
    assert all(check.ok for check in solution.checks)


def test_the_papers_methods_start_at_one_place_and_have_no_rows_before():
    solution = solved()
    starts = {solution.starts[m] for m in ("dead_reckoning", "kf_fix", "ekf_ungated", "ekf_gated")}
    (start,) = starts
    assert start.how == "m_of_n"
    for method in ("dead_reckoning", "kf_fix", "ekf_ungated", "ekf_gated"):
        track = solution.tracks[method]
        assert 0 <= track.t_s[0] - start.t_s < 1.0
        here_m = np.hypot(*(track.position_enu_m[0, :2] - [start.east_m, start.north_m]))
        assert here_m < 5.0
        before = solution.dive.replies.t_reply_s <= start.t_s
        if method in solution.innovations:
            names = np.array(DECISIONS)[solution.innovations[method].decision]
            assert set(names[before]) <= {"before_start", "not_physical"}
            assert "before_start" not in names[~before]


def test_tracks_stand_on_whole_seconds_of_utc_and_keep_the_measured_depth():
    solution = solved()
    dive = solution.dive
    for track in solution.tracks.values():
        utc_ns = dive.start_ns + np.round(track.t_s * 1e9).astype(np.int64)
        assert np.all(utc_ns % 1_000_000_000 == 0)
        assert np.all(np.diff(utc_ns) == 1_000_000_000)
        depth_m = np.interp(track.t_s, dive.depth.t_s, dive.depth.depth_m)
        np.testing.assert_allclose(-track.position_enu_m[:, 2], depth_m, atol=1e-9)
        assert np.all((track.heading_rad >= 0) & (track.heading_rad < 2 * np.pi))
        assert np.all(np.linalg.eigvalsh(track.position_cov_m2) > 0)


def test_a_smaller_gate_refuses_more_and_a_probability_takes_its_place():
    log = recorded()
    gated = {}
    for gate in (Gate(gamma=1.0), Gate(), Gate(probability=0.998), Gate(gamma=np.inf)):
        config = changed(Config(), gate=gate, output=Output(methods=("ekf_gated",)))
        solution = solve(log, config)
        assert solution.gamma == gate.threshold
        gated[gate] = int(solution.statistics["ekf_gated"].gated.sum())
    small, paper, likely, none = gated.values()
    assert small > paper >= likely > none == 0


# --- methods do not hear of each other, nor of the future ---------------------------------------


@pytest.mark.parametrize("method", REAL_TIME)
def test_leaving_the_others_out_moves_no_estimate_by_a_bit(method):
    config = changed(Config(), output=Output(methods=(method,)))
    alone, together = solve(recorded(), config), solved()
    assert set(alone.tracks) == {method}
    assert_same(alone.tracks[method], together.tracks[method])


def test_another_rate_of_output_moves_no_estimate_by_a_bit():
    fast, usual = solve(recorded(), changed(Config(), output=Output(rate_hz=5.0))), solved()
    for method, track in usual.tracks.items():
        shared = np.isin(fast.tracks[method].t_s, track.t_s)
        assert_same(track, fast.tracks[method][shared])


@pytest.mark.parametrize("at_s", [700.0, 1234.5, 2000.2, 3100.9])
def test_what_a_real_time_method_said_before_a_cut_it_says_without_the_rest(at_s):
    log, whole = recorded(), solved()
    part = solve(cut(log, whole.dive.start_ns + round(at_s * 1e9)))
    for method in REAL_TIME:
        told = part.tracks[method]
        settled = told.t_s <= at_s - NEWEST_S
        assert settled.sum() > 60
        assert_same(told[settled], whole.tracks[method][: int(settled.sum())])
    for method in part.innovations:
        if method in REAL_TIME:
            told = part.innovations[method]
            n = int(np.sum(told.t_reply_s <= at_s - NEWEST_S))
            assert_same(told[:n], whole.innovations[method][:n])


def test_the_huber_filter_runs_when_named_and_moves_no_other_by_a_bit():
    named = changed(Config(), output=Output(methods=("all", "ekf_huber")))
    found, without = solve(recorded(), named), solved()
    assert set(found.tracks) - set(without.tracks) == {"ekf_huber"}
    for method, track in without.tracks.items():
        np.testing.assert_array_equal(found.tracks[method].position_enu_m, track.position_enu_m)
        if method in without.innovations:
            ours, theirs = found.innovations[method], without.innovations[method]
            np.testing.assert_array_equal(ours.decision, theirs.decision)
            np.testing.assert_array_equal(ours.arrival, theirs.arrival)
    truth = simulation()
    rms_m = {}
    for method in ("ekf", "ekf_huber"):
        track = found.tracks[method][300:]
        apart_m = (track.position_enu_m - truth.position_at(track.t_s))[:, :2]
        rms_m[method] = float(np.sqrt(np.mean(np.sum(apart_m**2, axis=1))))
    assert rms_m["ekf_huber"] != rms_m["ekf"]
    assert rms_m["ekf_huber"] < 2.5 * rms_m["ekf"]


def test_the_rays_that_sound_takes_are_told():
    told = {check.name: check for check in solved().checks}
    assert 0.0 <= told["replies_by_bent_rays"].value <= 1.0
    assert told["replies_in_shadow"].ok


def test_no_estimator_sees_the_reference():
    log = recorded()
    lied = mended(log, "reference", position_enu_m=lambda place: place + 1e4)
    one, other = solve(log), solve(lied)
    for method, track in one.tracks.items():
        assert_same(track, other.tracks[method])


# --- what is asked for -------------------------------------------------------------------------


def test_an_unknown_method_is_refused_with_the_known_ones():
    config = changed(Config(), output=Output(methods=("ekf_gatd",)))
    with pytest.raises(ConfigError, match="unknown 'ekf_gatd'; known: all, dead_reckoning, fix"):
        solve(recorded(), config)


def test_without_a_confirmed_start_there_are_dead_reckoning_and_fixes_and_it_is_told():
    methods = ("dead_reckoning", "fix", "kf_fix", "ekf_gated")
    never = StartRule(v_max_mps=1e-3)
    config = changed(Config(), start=never, output=Output(methods=methods))
    solution = solve(recorded(), config)
    assert set(solution.tracks) == {"dead_reckoning"}
    assert not solution.starts
    assert len(solution.fixes) > 50
    names = np.array(DECISIONS)[solution.innovations["ekf_gated"].decision]
    assert set(names) <= {"before_start", "not_physical"}
    (told,) = [c for c in solution.checks if c.name == "start_confirmed"]
    assert not told.ok
    assert "no start confirmed" in told.detail


# --- damage ------------------------------------------------------------------------------------


def tame(solution):
    """No holes in what is given out."""
    for method, track in solution.tracks.items():
        for name, column in track.columns().items():
            known = column[np.isfinite(column)] if name == "altitude_m" else column  # none told
            assert np.all(np.isfinite(known)), (method, name)
        assert np.all(np.linalg.eigvalsh(track.position_cov_m2) > 0), method
    for name, column in solution.fixes.columns().items():
        assert np.all(np.isfinite(column)), name
    for innovations in solution.innovations.values():
        assert len(innovations) == len(solution.dive.replies)
    return solution


@cache
def short():
    return recorded("voyage_2", 5, 1500.0)


def assert_no_worse_than(solution, limit_m, methods=("ekf_gated",)):
    truth = simulation("voyage_2", 5, 1500.0)
    for method in methods:
        track = solution.tracks[method]
        error_m = track.position_enu_m[:, :2] - truth.position_at(track.t_s)[:, :2]
        assert np.sqrt(np.mean(error_m**2) * 2) < limit_m, method


def test_a_dive_of_replies_without_times_has_no_start_and_no_fix():
    solution = tame(solve(mended(short(), "travel_time", travel_time_s=lambda t: t * np.nan)))
    assert set(solution.tracks) == {"dead_reckoning"}
    assert len(solution.fixes) == 0
    for method in ("ekf_gated", "ekf"):
        assert {DECISIONS[d] for d in solution.innovations[method].decision} == {"not_physical"}


@pytest.mark.parametrize("count", [1, 2, 5])
def test_a_handful_of_replies_is_a_dive_without_a_start(count):
    solution = tame(solve(kept(short(), "travel_time", slice(0, count))))
    assert set(solution.tracks) == {"dead_reckoning"}


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 0.0, -2.0, 1e-9, 1e9])
def test_wild_travel_times_among_good_ones_leave_the_gated_filter_alone(value):
    def wild(times):
        times[::9] = value
        return times

    solution = tame(solve(mended(short(), "travel_time", travel_time_s=wild)))
    assert_no_worse_than(solution, 8.0, ("ekf_gated", "ekf"))
    names = np.array(DECISIONS)[solution.innovations["ekf_gated"].decision]
    if not (np.isfinite(value) and value > 1):
        assert set(names[::9]) == {"not_physical"}


def test_pings_stamped_after_their_replies_are_told_and_lived_with():
    def late(ping_time_ns):
        ping_time_ns[::11] += 8_000_000_000
        return ping_time_ns

    dive = align(mended(short(), "travel_time", ping_time_ns=late), Config())
    (told,) = [c for c in dive.checks if c.name == "replies_heard_before_their_ping"]
    assert told.value > 10
    assert_no_worse_than(tame(navigate(dive, Config())), 10.0)


@pytest.mark.parametrize(
    "ids",
    [lambda i: i[::-1].copy(), lambda i: i % 5, lambda i: i * 0, lambda i: -i + 2**31],
    ids=["falling", "starting anew", "unset", "counted down"],
)
def test_ping_ids_that_do_not_rise_cost_nothing(ids):
    usual = solve(short())
    solution = tame(solve(mended(short(), "travel_time", ping_id=ids)))
    if ids(np.arange(10)).tolist() != np.arange(10)[::-1].tolist():
        assert_same(solution.tracks["ekf_gated"], usual.tracks["ekf_gated"])
    assert_no_worse_than(solution, 12.0)


def test_a_log_with_every_reply_twice_gives_the_same_track():
    n = len(short().roles["travel_time"]["time_ns"])
    twice = solve(kept(short(), "travel_time", np.repeat(np.arange(n), 2)))
    assert_same(twice.tracks["ekf_gated"], solve(short()).tracks["ekf_gated"])
    again = np.array(DECISIONS)[twice.innovations["ekf_gated"].decision]
    first = again[::2] == "accepted"
    assert set(again[1::2][first]) == {"duplicate"}


def test_velocity_that_begins_after_the_first_replies_gives_no_track_before_it():
    log = short()
    late_ns = log.roles["velocity"]["time_ns"][0] + 600 * 10**9
    solution = tame(solve(kept(log, "velocity", log.roles["velocity"]["time_ns"] >= late_ns)))
    first_s = (late_ns - solution.dive.start_ns) / 1e9
    for method in REAL_TIME:
        if method != "ekf":
            assert solution.tracks[method].t_s[0] >= first_s, method
    ekf = solution.tracks["ekf"]
    assert ekf.t_s[0] < 200.0, "it needs no velocity, and says how little it knows"
    before, after = ekf.t_s < first_s - 60, ekf.t_s > first_s + 300
    spread_m = np.sqrt(np.trace(ekf.position_cov_m2, axis1=1, axis2=2))
    assert np.median(spread_m[before]) > 1.5 * np.median(spread_m[after])
    (told,) = [c for c in solution.checks if c.name == "replies_before_first_velocity"]
    assert told.value > 20
    assert "goes back from the first velocity" in told.detail


def test_replies_heard_after_the_velocity_ended_still_hold_the_track():
    log = short()
    time_ns = log.roles["velocity"]["time_ns"]
    solution = tame(solve(kept(log, "velocity", time_ns < time_ns[0] + 900 * 10**9)))
    reckoned, gated = solution.tracks["dead_reckoning"], solution.tracks["ekf_gated"]
    assert gated.t_s[-1] > 1480
    assert_no_worse_than(solution, 60.0)
    unheld_m2, held_m2 = (
        np.trace(track.position_cov_m2[-240:], axis1=1, axis2=2) for track in (reckoned, gated)
    )
    # Between pings both grow; of every two pings one at least brings it back.
    assert (unheld_m2 / held_m2).reshape(-1, 48).max(axis=1).min() > 50


@pytest.mark.parametrize("role", ["velocity", "heading", "depth"])
def test_one_sample_of_a_sensor_is_lived_with_and_told(role):
    log = kept(short(), role, slice(2000, 2001) if role != "depth" else slice(700, 701))
    solution = tame(solve(log))
    assert not all(check.ok for check in solution.dive.checks)


def test_a_vehicle_above_the_surface_by_its_depth_sensor_is_still_numbers():
    tame(solve(mended(short(), "depth", depth_m=lambda depth: depth - 5200.0)))


def test_beacons_above_the_vehicle_are_as_good_as_those_below():
    """The same dive turned over: what lay 50 m below lies 50 m above."""
    log = short()
    depth_m = float(np.mean(log.roles["depth"]["depth_m"]))

    def over(place):
        place[:, 2] = -2 * depth_m - place[:, 2]
        return place

    solution = tame(solve(mended(log, "beacons", position_enu_m=over)))
    assert_no_worse_than(solution, 12.0)


@pytest.mark.parametrize("count", [3, 8])
def test_three_beacons_and_eight_are_navigated_with(count):
    scenario = load_scenario("voyage_2")
    scenario = changed(scenario, seed=5, duration_s=1500.0,
                       beacons=changed(scenario.beacons, count=count))  # fmt: skip
    truth = simulate(scenario)
    solution = tame(solve(to_log(truth)))
    track = solution.tracks["ekf_gated"]
    error_m = track.position_enu_m[:, :2] - truth.position_at(track.t_s)[:, :2]
    assert np.hypot(*error_m.T).mean() < 8.0


def test_three_beacons_in_a_line_start_nothing_by_the_papers_rule():
    """On either side the times are the same: no fix may say which it is."""
    scenario = load_scenario("clean")
    log = to_log(simulate(changed(scenario, duration_s=1500.0)))
    n = len(log.roles["beacons"]["id"])
    in_line = np.column_stack([np.linspace(-2500, 2500, n), np.zeros(n), np.full(n, -4950.0)])
    truth = simulate(changed(scenario, duration_s=1500.0))
    replies = log.roles["travel_time"]
    speed_mps, t_s = 1500.0, (replies["ping_time_ns"] - truth.start_ns) / 1e9
    rows = replies["beacon_id"] - 1
    range_m = np.linalg.norm(truth.position_at(t_s) - in_line[rows], axis=1)
    time_s = 2 * range_m / speed_mps + log.roles["beacons"]["turn_around_s"][rows]
    log = mended(log, "beacons", position_enu_m=lambda _: in_line)
    log = mended(log, "travel_time", travel_time_s=lambda _: time_s)
    log = dataclasses.replace(log, roles={r: c for r, c in log.roles.items() if r != "sound_speed"})
    solution = tame(solve(log, changed(Config(), acoustics=Acoustics(sound_speed_mps=speed_mps))))
    assert "ekf_gated" not in solution.tracks
    assert len(solution.fixes) > 20


def test_a_log_that_cannot_be_navigated_says_so_in_one_line():
    log = mended(short(), "travel_time", beacon_id=lambda i: i + 40)
    with pytest.raises(SolveError) as refusal:
        solve(log)
    assert isinstance(refusal.value, PipelineError)
    assert "\n" not in str(refusal.value)


# --- statistics over dives ---------------------------------------------------------------------


@dataclasses.dataclass
class Measured:
    """One simulated dive by one of the paper's filters, from 5 min after the start."""

    error_m: np.ndarray
    nees: np.ndarray
    nis: np.ndarray
    gross_accepted: np.ndarray
    good_rejected: np.ndarray
    bound_m: float


@cache
def measured(name, seed, method):
    truth = simulation(name, seed, 10_800.0)
    methods = Output(methods=("ekf_gated", "ekf_ungated"))
    solution = solve(to_log(truth), changed(Config(), output=methods))
    if method not in solution.tracks:
        return None
    begin_s = solution.starts[method].t_s
    track = solution.tracks[method]
    track = track[track.t_s >= begin_s + 300.0]
    if not len(track):
        return None
    apart_m = (track.position_enu_m - truth.position_at(track.t_s))[:, :2]
    innovations = solution.innovations[method]
    names = np.array(DECISIONS)[innovations.decision]
    gross = np.abs(truth.replies.travel_time_s - truth.replies.direct_s) > 0.010
    met = np.isin(names, ["accepted", "gated"])
    return Measured(
        error_m=np.hypot(*apart_m.T),
        nees=np.einsum("ni,nij,nj->n", apart_m, np.linalg.inv(track.position_cov_m2), apart_m),
        nis=innovations.nis[names == "accepted"],
        gross_accepted=(names == "accepted")[met & gross],
        good_rejected=(names == "gated")[met & ~gross],
        bound_m=bound(truth).rms_m(begin_s + 300.0)[0],
    )


def dives(name, seeds, method):
    found = [measured(name, seed, method) for seed in seeds]
    return [dive for dive in found if dive is not None]


FEW = pytest.param(range(1, 4), id="3 dives")
MANY = pytest.param(range(1, 25), id="24 dives", marks=pytest.mark.slow)


@pytest.mark.parametrize("seeds", [FEW, MANY])
@pytest.mark.parametrize("name", ["voyage_1", "voyage_2"])
def test_the_gated_filter_is_within_three_times_the_cramer_rao_bound(name, seeds):
    found = dives(name, seeds, "ekf_gated")
    assert len(found) >= len(seeds) - 1
    ratio = [np.sqrt(np.mean(dive.error_m**2)) / dive.bound_m for dive in found]
    assert 1.0 < np.median(ratio) <= 3.0


@pytest.mark.parametrize("seeds", [FEW, MANY])
@pytest.mark.parametrize("name", ["voyage_1", "voyage_2"])
def test_the_papers_claim_pooled_over_dives(name, seeds):
    """Tables 1-2: without the gate the mean error is 1.5 times as large and more, std > mean."""
    ungated = np.concatenate([d.error_m for d in dives(name, seeds, "ekf_ungated")])
    gated = np.concatenate([d.error_m for d in dives(name, seeds, "ekf_gated")])
    assert ungated.mean() >= 1.5 * gated.mean()
    assert ungated.std() > ungated.mean()


@pytest.mark.parametrize("seeds", [FEW, MANY])
@pytest.mark.parametrize("name", ["voyage_1", "voyage_2"])
def test_the_gated_filter_tells_its_own_error_and_its_innovations(name, seeds):
    found = dives(name, seeds, "ekf_gated")
    assert 0.5 < np.mean([dive.nees.mean() for dive in found]) < 3.0  # 2 if q were exact
    nis = np.concatenate([dive.nis for dive in found])
    assert 0.4 < np.median(nis) / 0.455 < 1.6


@pytest.mark.parametrize("seeds", [FEW, MANY])
@pytest.mark.parametrize("name", ["voyage_1", "voyage_2"])
def test_the_gate_lets_few_gross_errors_in_and_keeps_few_good_replies_out(name, seeds):
    found = dives(name, seeds, "ekf_gated")
    assert np.mean(np.concatenate([dive.gross_accepted for dive in found])) <= 0.03
    assert np.mean(np.concatenate([dive.good_rejected for dive in found])) <= 0.02


def test_in_clean_acoustics_gate_and_no_gate_are_one():
    solution = solved("clean", 2, 1800.0)
    ungated, gated = solution.tracks["ekf_ungated"], solution.tracks["ekf_gated"]
    if not solution.statistics["ekf_gated"].gated.sum():
        assert_same(ungated, gated)
    assert np.hypot(*(ungated.position_enu_m - gated.position_enu_m)[:, :2].T).max() < 5.0
