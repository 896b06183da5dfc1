# SPDX-License-Identifier: Apache-2.0
"""`Dive` -> `Solution`: every method, each step from the one before."""

from typing import NamedTuple

import numpy as np

from pipeline.config import Config
from pipeline.errors import ConfigError
from pipeline.nav.acoustics import Legs, is_physical, legs
from pipeline.nav.estimation import (
    Nodes,
    TwoStates,
    carry,
    filter_fixes,
    filter_travel_times,
    gate_statistics,
)
from pipeline.nav.fixes import confirm_start, cycles, fix_positions
from pipeline.nav.geometry import interpolate
from pipeline.nav.motion import Motion, dead_reckon
from pipeline.tables import (
    METHODS,
    Bool,
    Check,
    Dive,
    Fixes,
    Float,
    Innovations,
    Solution,
    Start,
    Track,
)


class _Run(NamedTuple):
    """What a method made of the dive: its nodes, and the gate that its replies met."""

    nodes: Nodes | None
    innovations: Innovations | None = None
    gamma: float = np.inf


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
    motion = _motion(dive, config)
    usable, paths = _usable(dive, config)
    fixes = _fixes(dive, usable, paths, motion, config)
    start = _start(fixes, config)
    runs = _paper_methods(dive, usable, paths, motion, fixes, start, config)

    grid_s = _output_times(dive, motion, config.output.rate_hz)
    gated = {m: r for m, r in runs.items() if m in wanted and r.innovations is not None}
    speed_mps = float(np.mean(paths.speed_reply_mps)) if len(paths) else 0.0
    return Solution(
        dive=dive,
        tracks={
            m: _track(r.nodes, dive, motion, grid_s, config.process.position_m2_per_s)
            for m, r in runs.items()
            if m in wanted and r.nodes is not None
        },
        fixes=fixes,
        innovations={m: r.innovations for m, r in gated.items() if r.innovations is not None},
        statistics={
            m: gate_statistics(r.innovations, dive.beacons.id, r.gamma, speed_mps)
            for m, r in gated.items()
            if r.innovations is not None
        },
        starts={m: start for m in runs if m in wanted} if start is not None else {},
        gamma=config.gate.threshold,
        checks=_checks(start, fixes),
    )


def _methods(config: Config) -> tuple[str, ...]:
    """The methods asked for, in the order in which people read them."""
    asked = config.output.methods
    for name in asked:
        if name not in (*METHODS, "all"):
            known = ", ".join(("all", *METHODS))
            raise ConfigError(f"[output] methods: unknown {name!r}; known: {known}")
    return METHODS if "all" in asked else tuple(m for m in METHODS if m in asked)


def _motion(dive: Dive, config: Config) -> Motion:
    """Dead reckoning over everything that the sensors and the replies span."""
    times = (dive.velocity.t_s, dive.depth.t_s, dive.replies.t_ping_s, dive.replies.t_reply_s)
    span_s = (
        min(float(t.min()) for t in times if len(t)),
        max(float(t.max()) for t in times if len(t)),
    )
    process = config.process
    return dead_reckon(
        dive.velocity, dive.heading, span_s, process.gap_sigma_mps, process.max_gap_s
    )


def _usable(dive: Dive, config: Config) -> tuple[Bool, Legs]:
    """Which replies come from known beacons and are physical, and the legs of those."""
    usable = dive.replies.beacon >= 0
    known = dive.replies[usable]
    paths = legs(known, dive.beacons, dive.sound_speed)
    physical = is_physical(paths, known.travel_time_s, config.acoustics.travel_time_sigma_s)
    usable[usable] = physical
    return usable, paths[physical]


def _fixes(dive: Dive, usable: Bool, paths: Legs, motion: Motion, config: Config) -> Fixes:
    cycle = cycles(dive.replies, usable, config.fix.max_cycle_s)[usable]
    sigma_s = config.acoustics.travel_time_sigma_s
    return fix_positions(dive.replies[usable], paths, cycle, motion, sigma_s)


def _start(fixes: Fixes, config: Config) -> Start | None:
    rule = config.start
    return confirm_start(
        fixes[fixes.consistent], rule.m, rule.n, rule.v_min_mps, rule.v_max_mps, rule.a_max_mps2
    )


def _paper_methods(
    dive: Dive,
    usable: Bool,
    paths: Legs,
    motion: Motion,
    fixes: Fixes,
    start: Start | None,
    config: Config,
) -> dict[str, _Run]:
    """The paper's four methods, from one start."""
    sigma_m, q = config.start.sigma_m, config.process.position_m2_per_s
    runs = {"dead_reckoning": _Run(_anchor(start, fixes, motion, sigma_m))}
    if start is not None:
        noise = TwoStates(sigma_m, q, config.fix.sigma_m, config.fix.gamma)
        runs["kf_fix"] = _Run(filter_fixes(fixes, motion, start, noise))
    for method, gamma in (("ekf_ungated", np.inf), ("ekf_gated", config.gate.threshold)):
        noise = TwoStates(sigma_m, q, config.acoustics.travel_time_sigma_s, gamma)
        nodes, innovations = filter_travel_times(dive.replies, usable, paths, motion, start, noise)
        runs[method] = _Run(nodes, innovations, gamma)
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


def _output_times(dive: Dive, motion: Motion, rate_hz: float) -> Float:
    """Every multiple of the period in UTC that dead reckoning covers, in seconds of the dive.

    Counted in UTC so that tracks of several dives, rates and methods share their instants.
    """
    period_ns = round(1e9 / rate_hz)
    first_ns = dive.start_ns + int(np.ceil(motion.t_s[0] * 1e9))
    last_ns = dive.start_ns + int(np.floor(motion.t_s[-1] * 1e9))
    ticks = np.arange(-(-first_ns // period_ns), last_ns // period_ns + 1, dtype=np.int64)
    return np.asarray((ticks * period_ns - dive.start_ns) / 1e9)


def _track(nodes: Nodes, dive: Dive, motion: Motion, grid_s: Float, q: float) -> Track:
    """A method's track from its first node on."""
    t_s = grid_s[grid_s >= nodes.t_s[0]]
    position_m, cov_m2 = carry(nodes, motion, t_s, q)
    depth_m = interpolate(t_s, dive.depth.t_s, dive.depth.depth_m)
    return Track(
        t_s=t_s,
        position_enu_m=np.column_stack([position_m, -depth_m]),
        position_cov_m2=cov_m2,
        heading_rad=motion.at(t_s).heading_rad % (2 * np.pi),
    )


def _checks(start: Start | None, fixes: Fixes) -> tuple[Check, ...]:
    n_fixes, n_consistent = len(fixes), int(fixes.consistent.sum())
    told = "" if start else "no start confirmed: only dead reckoning and the fixes are given"
    return (
        Check(
            "navigate", "start_confirmed", float(start is not None), 1, "", start is not None, told
        ),
        Check("navigate", "fixes", n_fixes, 1, "", n_fixes > 0),
        Check("navigate", "consistent_fixes", n_consistent, 1, "", n_consistent > 0),
    )
