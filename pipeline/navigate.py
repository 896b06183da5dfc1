# SPDX-License-Identifier: Apache-2.0
"""`Dive` -> `Solution`: every method, each step from the one before."""

from typing import NamedTuple

import numpy as np

from pipeline.config import Config
from pipeline.errors import ConfigError
from pipeline.nav.acoustics import Legs, is_physical, legs
from pipeline.nav.augmented import N_STATES, ErrorModel, Steps, carry_states, deviation, steps
from pipeline.nav.batch import Batch, estimate
from pipeline.nav.estimation import (
    ACCEPTED,
    DUPLICATE,
    GATED,
    Nodes,
    TwoStates,
    carry,
    filter_fixes,
    filter_travel_times,
    gate_statistics,
    innovation_rows,
    undecided,
)
from pipeline.nav.fixes import confirm_start, cycles, fix_positions, ping_numbers
from pipeline.nav.geometry import interpolate
from pipeline.nav.motion import Motion, dead_reckon
from pipeline.nav.smoothing import between, one_a_ping, smooth
from pipeline.nav.tracker import Trail, track
from pipeline.nav.update import Judge
from pipeline.tables import (
    METHODS,
    Bool,
    Check,
    Dive,
    Event,
    Fixes,
    Float,
    Innovations,
    Int,
    Replies,
    SensorEstimates,
    Solution,
    Start,
    Track,
)


class _Run(NamedTuple):
    """What one method made of the dive; its gate's threshold; what it learned and met."""

    track: Track | None
    innovations: Innovations | None = None
    gamma: float = np.inf
    start: Start | None = None
    estimates: SensorEstimates | None = None
    events: tuple[Event, ...] = ()


class _Evidence(NamedTuple):
    """What every method starts from: dead reckoning, the replies and the output's instants."""

    dive: Dive
    motion: Motion
    usable: Bool  #: (n,) of a known beacon and physical
    heard: Replies  #: the usable ones
    legs: Legs  #: of the usable ones
    grid_s: Float
    live_s: Float  #: those from the first velocity on; before it dead reckoning is hindsight


def navigate(dive: Dive, config: Config) -> Solution:
    """Tracks, fixes and innovations of one dive by every method asked for.

    Methods do not hear of each other: leaving one out, or another output rate, moves no estimate.
    Without a confirmed start there are dead reckoning (from the first fix, or the frame's origin),
    the fixes, innovations that all say `before_start`, and a check that says so.

    Raises
    ------
    ConfigError
        An unknown name in `output.methods`.
    """
    wanted = _methods(config)
    evidence = _evidence(dive, config)
    fixes = _fixes(evidence, config)
    start = _start(fixes, config)
    runs = _paper_methods(evidence, fixes, start, config)
    if {"ekf", "smoother"} & set(wanted):
        runs |= _best_methods(evidence, start, config)
    runs = {method: runs[method] for method in wanted if method in runs}

    speed_mps = float(np.mean(evidence.legs.speed_reply_mps)) if len(evidence.legs) else 0.0
    return Solution(
        dive=dive,
        tracks={m: r.track for m, r in runs.items() if r.track is not None},
        fixes=fixes,
        innovations={m: r.innovations for m, r in runs.items() if r.innovations is not None},
        statistics={
            m: gate_statistics(r.innovations, dive.beacons.id, r.gamma, speed_mps)
            for m, r in runs.items()
            if r.innovations is not None
        },
        starts={m: r.start for m, r in runs.items() if r.start is not None},
        gamma=config.gate.threshold,
        estimates={m: r.estimates for m, r in runs.items() if r.estimates is not None},
        events=tuple(e for r in runs.values() for e in r.events),
        checks=_checks(start, fixes, dive),
    )


def _methods(config: Config) -> tuple[str, ...]:
    """The methods asked for, in the order in which people read them."""
    asked = config.output.methods
    for name in asked:
        if name not in (*METHODS, "all"):
            known = ", ".join(("all", *METHODS))
            raise ConfigError(f"[output] methods: unknown {name!r}; known: {known}")
    return METHODS if "all" in asked else tuple(m for m in METHODS if m in asked)


def _evidence(dive: Dive, config: Config) -> _Evidence:
    """Dead reckoning over all that sensors and replies span; the replies that are of use."""
    times = (dive.velocity.t_s, dive.depth.t_s, dive.replies.t_ping_s, dive.replies.t_reply_s)
    span_s = (min(float(t.min()) for t in times), max(float(t.max()) for t in times))
    process = config.process
    motion = dead_reckon(
        dive.velocity, dive.heading, span_s, process.gap_sigma_mps, process.max_gap_s
    )
    usable = dive.replies.beacon >= 0
    known = dive.replies[usable]
    paths = legs(known, dive.beacons, dive.sound_speed)
    physical = is_physical(paths, known.travel_time_s, config.acoustics.travel_time_sigma_s)
    usable[usable] = physical
    grid_s = _output_times(dive, motion, config.output.rate_hz)
    live_s = grid_s[grid_s >= dive.velocity.t_s[np.argmax(dive.velocity.valid)]]
    return _Evidence(dive, motion, usable, known[physical], paths[physical], grid_s, live_s)


def _output_times(dive: Dive, motion: Motion, rate_hz: float) -> Float:
    """Every multiple of the period in UTC that dead reckoning covers, in seconds of the dive.

    Counted in UTC so that tracks of several dives, rates and methods share their instants.
    """
    period_ns = round(1e9 / rate_hz)
    first_ns = dive.start_ns + int(np.ceil(motion.t_s[0] * 1e9))
    last_ns = dive.start_ns + int(np.floor(motion.t_s[-1] * 1e9))
    ticks = np.arange(-(-first_ns // period_ns), last_ns // period_ns + 1, dtype=np.int64)
    return np.asarray((ticks * period_ns - dive.start_ns) / 1e9)


def _fixes(evidence: _Evidence, config: Config) -> Fixes:
    cycle = cycles(evidence.dive.replies, evidence.usable, config.fix.max_cycle_s)
    return fix_positions(
        evidence.heard,
        evidence.legs,
        cycle[evidence.usable],
        evidence.motion,
        config.acoustics.travel_time_sigma_s,
    )


def _start(fixes: Fixes, config: Config) -> Start | None:
    rule = config.start
    return confirm_start(
        fixes[fixes.consistent], rule.m, rule.n, rule.v_min_mps, rule.v_max_mps, rule.a_max_mps2
    )


def _paper_methods(
    evidence: _Evidence, fixes: Fixes, start: Start | None, config: Config
) -> dict[str, _Run]:
    """The paper's four methods, from one start."""
    motion, q = evidence.motion, config.process.position_m2_per_s

    def placed(nodes: Nodes | None) -> Track | None:
        if nodes is None:
            return None
        t_s = evidence.live_s[evidence.live_s >= nodes.t_s[0]]
        heading_rad = motion.at(t_s).heading_rad
        return _track(evidence, t_s, *carry(nodes, motion, t_s, q), heading_rad)

    anchor = _anchor(start, fixes, motion, config.start.sigma_m)
    runs = {"dead_reckoning": _Run(placed(anchor), start=start)}
    if start is not None:
        noise = TwoStates(config.start.sigma_m, q, config.fix.sigma_m, config.fix.gamma)
        runs["kf_fix"] = _Run(placed(filter_fixes(fixes, motion, start, noise)), start=start)
    for method, gamma in (("ekf_ungated", np.inf), ("ekf_gated", config.gate.threshold)):
        nodes, innovations = filter_travel_times(
            evidence.dive.replies,
            evidence.usable,
            evidence.legs,
            motion,
            start,
            TwoStates(config.start.sigma_m, q, config.acoustics.travel_time_sigma_s, gamma),
        )
        runs[method] = _Run(placed(nodes), innovations, gamma, start)
    return runs


def _anchor(start: Start | None, fixes: Fixes, motion: Motion, sigma_m: float) -> Nodes:
    """Where dead reckoning begins: the confirmed start, else a fix, else the frame's origin."""
    if start is not None:
        t_s, position_m = start.t_s, [start.east_m, start.north_m]
    elif len(fixes):
        first = int(np.argmax(fixes.consistent))
        t_s, position_m = float(fixes.t_s[first]), fixes.position_enu_m[first, :2].tolist()
    else:
        t_s, position_m = float(motion.t_s[0]), [0.0, 0.0]
    return Nodes(np.array([t_s]), np.array([position_m]), sigma_m**2 * np.eye(2)[None])


def _track(
    evidence: _Evidence, t_s: Float, position_m: Float, cov_m2: Float, heading_rad: Float
) -> Track:
    depth = evidence.dive.depth
    up_m = -interpolate(t_s, depth.t_s, depth.depth_m)
    position_enu_m = np.column_stack([position_m, up_m])
    return Track(t_s, position_enu_m, cov_m2, heading_rad % (2 * np.pi))


def _best_methods(evidence: _Evidence, confirmed: Start | None, config: Config) -> dict[str, _Run]:
    """`ekf` and `smoother`; without a start only rows that say so."""
    model, judge = _error_model(evidence, config), _judge(config)
    ping = ping_numbers(evidence.heard)
    prepared = steps(evidence.motion, evidence.heard.t_ping_s, evidence.heard.t_reply_s)
    given = None
    if config.start.ekf == "m_of_n" and confirmed is not None:
        given = (int(np.searchsorted(prepared.t_s, confirmed.t_s, side="right")) - 1, confirmed)
    trail, start = track(evidence.heard.beacon, ping, evidence.legs, prepared, model, judge, given)
    values = np.column_stack([trail.predicted_s, trail.variance_s2, trail.innovation_s])
    innovations = _judged(evidence, trail.decision, values)
    if start is None:
        return {m: _Run(None, innovations, judge.gamma) for m in ("ekf", "smoother")}
    known = trail.segment >= 0
    nodes = (prepared.t_s[known], trail.x[known], trail.P[known])
    t_s = evidence.live_s[evidence.live_s >= nodes[0][0]]
    ekf = _Run(
        _track(evidence, t_s, *carry_states(*nodes, evidence.motion, t_s, model)),
        innovations,
        judge.gamma,
        start,
        _estimates(evidence, *nodes),
        _recoveries(trail, prepared, start),
    )
    return {"ekf": ekf, "smoother": _smoother(evidence, ping, prepared, trail, start, model, judge)}


def _error_model(evidence: _Evidence, config: Config) -> ErrorModel:
    first_mps = evidence.legs.speed_reply_mps[:1]  # what comes later must not move an estimate
    errors = config.errors
    first, second = np.radians(errors.deviation_sigma_deg).tolist()
    return ErrorModel(
        start_sigma_m=config.start.sigma_m,
        position_m2_per_s=errors.position_m2_per_s,
        heading_sigma_rad=float(np.radians(errors.heading_sigma_deg)),
        heading_time_s=errors.heading_time_s,
        dvl_scale_sigma=errors.dvl_scale_sigma,
        sound_scale_sigma=config.acoustics.sound_speed_sigma_mps
        / float(first_mps[0] if len(first_mps) else config.acoustics.sound_speed_mps),
        deviation_sigma_rad=(first, second),
        held_sigma_mps=config.process.gap_sigma_mps,
        held_time_s=errors.held_time_s,
    )


def _judge(config: Config) -> Judge:
    return Judge(config.acoustics.travel_time_sigma_s, config.gate.threshold)


def _judged(evidence: _Evidence, decision: Int, values: Float) -> Innovations:
    """Rows for all replies from those of the usable ones."""
    replies, usable = evidence.dive.replies, evidence.usable
    every = undecided(replies, usable)
    every[usable] = decision
    every_value = np.full((len(replies), 3), np.nan)
    every_value[usable] = values
    return innovation_rows(replies, every, every_value, evidence.legs, usable)


def _estimates(evidence: _Evidence, t_s: Float, x: Float, P: Float) -> SensorEstimates:
    heading_rad = evidence.motion.at(t_s).heading_rad
    sigma = np.sqrt(np.maximum(np.diagonal(P, axis1=1, axis2=2), 0.0))
    return SensorEstimates(
        t_s, deviation(x, heading_rad), sigma[:, 2], x[:, 3], sigma[:, 3], x[:, 4], sigma[:, 4]
    )


def _recoveries(trail: Trail, prepared: Steps, start: Start) -> tuple[Event, ...]:
    begun = Event(start.t_s, "ekf", f"start confirmed by {start.how} after {start.cycles} cycles")
    again = np.flatnonzero(np.diff(trail.segment, prepend=-1) > 0)[1:]
    moved_m = np.linalg.norm(trail.x[again, :2] - trail.x_prior[again, :2], axis=1)
    return begun, *(
        Event(t, "ekf", f"recovered by consensus, {m:.0f} m away from where it was")
        for t, m in zip(prepared.t_s[again].tolist(), moved_m.tolist(), strict=True)
    )


def _smoother(
    evidence: _Evidence,
    ping: Int,
    prepared: Steps,
    trail: Trail,
    start: Start,
    model: ErrorModel,
    judge: Judge,
) -> _Run:
    """Final track: RTS, then the robust batch estimate from it, over the whole dive."""
    x = smooth(trail, prepared, evidence.legs, judge.sigma_s)
    taking_part = one_a_ping(x, ping, evidence.heard.beacon, prepared, evidence.legs)
    batch = estimate(x, prepared, evidence.legs, model, judge.sigma_s, taking_part)
    kept = np.where(batch.residual**2 <= judge.gamma, ACCEPTED, GATED)
    decision = np.where(taking_part, kept, DUPLICATE)
    late_s = batch.residual * judge.sigma_s
    variance_s2 = np.full(len(late_s), judge.sigma_s**2)
    values = np.column_stack([evidence.legs.flight_time_s - late_s, variance_s2, late_s])
    smoothed = between(prepared, batch, evidence.motion, evidence.grid_s, model)
    return _Run(
        _track(evidence, evidence.grid_s, *smoothed),
        _judged(evidence, decision, values),
        judge.gamma,
        start,
        _estimates(evidence, prepared.t_s, batch.x, _covariances(batch)),
    )


def _covariances(batch: Batch) -> Float:
    """Diagonal covariances (n, 11, 11) of what a batch estimate tells one by one."""
    n = len(batch.x)
    variance = np.zeros((n, N_STATES))
    variance[:, :2] = np.diagonal(batch.position_cov_m2, axis1=1, axis2=2)
    variance[:, 2] = batch.heading_variance_rad2
    variance[:, 3:9] = np.diag(batch.shared_cov)
    return np.asarray(variance[:, :, None] * np.eye(N_STATES))


def _checks(start: Start | None, fixes: Fixes, dive: Dive) -> tuple[Check, ...]:
    n_fixes, n_consistent = len(fixes), int(fixes.consistent.sum())
    first_velocity_s = dive.velocity.t_s[np.argmax(dive.velocity.valid)]
    early = int(np.sum(dive.replies.t_reply_s < first_velocity_s))
    back = "dead reckoning goes back from the first velocity, where tracks begin" if early else ""
    found = start is not None
    told = "" if found else "no start confirmed: only dead reckoning and the fixes are given"
    return (
        Check("navigate", "start_confirmed", float(found), 1, "", found, told),
        Check("navigate", "fixes", n_fixes, 1, "", n_fixes > 0),
        Check("navigate", "consistent_fixes", n_consistent, 1, "", n_consistent > 0),
        Check("navigate", "replies_before_first_velocity", early, 0, "", early == 0, back),
    )
