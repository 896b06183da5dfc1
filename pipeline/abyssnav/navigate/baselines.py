# SPDX-License-Identifier: Apache-2.0
"""The paper's methods: fixes, the start that they confirm, and the two-state filters."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from abyssnav.config import Config
from abyssnav.estimation.dead_reckoning import Motion
from abyssnav.estimation.fixes import confirm_start, cycles, fix_positions
from abyssnav.estimation.two_state import Nodes, TwoStates, carry, filter_fixes, filter_travel_times
from abyssnav.navigate.inputs import Evidence, Run, place_track, settings_start, since
from abyssnav.tables import Fixes, Start, Track


def fixes_of(evidence: Evidence, config: Config) -> Fixes:
    """The fix of every cycle that has one."""
    cycle = cycles(evidence.dive.replies, evidence.usable, config.fix.max_cycle_s)
    return fix_positions(
        evidence.heard,
        evidence.legs,
        cycle[evidence.usable],
        evidence.motion,
        config.acoustics.travel_time_sigma_s,
    )


def start_of(fixes: Fixes, config: Config) -> Start | None:
    """The start that the consistent fixes confirm."""
    rule = config.start
    return confirm_start(
        fixes[fixes.consistent], rule.m, rule.n, rule.v_min_mps, rule.v_max_mps, rule.a_max_mps2
    )


class Paper(NamedTuple):
    """What the paper makes of a dive."""

    fixes: Fixes
    start: Start | None
    runs: dict[str, Run]


def paper(evidence: Evidence, config: Config) -> Paper:
    """Fixes, the start that they confirm, and the four methods that begin there."""
    fixes = fixes_of(evidence, config)
    start = start_of(fixes, config)
    return Paper(fixes, start, paper_methods(evidence, fixes, start, config))


def of_two_states(evidence: Evidence) -> Evidence:
    """The evidence without what these methods do not look at, nine tenths of it.

    That is the sensors' rows, and the sums by which dead reckoning would grow with their errors.
    """
    dive = evidence.dive
    motion, grid, live = (
        replace(rows, linear_m=rows.linear_m[:, :0])
        for rows in (evidence.motion, evidence.grid, evidence.live)
    )
    dive = replace(dive, heading=dive.heading[:0], velocity=dive.velocity[:0])
    return evidence._replace(dive=dive, motion=motion, grid=grid, live=live)


def paper_methods(
    evidence: Evidence, fixes: Fixes, start: Start | None, config: Config
) -> dict[str, Run]:
    """The paper's four methods, from one start."""
    motion, q = evidence.motion, config.process.position_m2_per_s

    def placed(nodes: Nodes | None) -> Track | None:
        if nodes is None:
            return None
        instants = since(evidence.live, float(nodes.t_s[0]))
        return place_track(
            evidence, instants.t_s, *carry(nodes, motion, instants, q), instants.heading_rad
        )

    known = settings_start(evidence, config)
    reckoned = start if known is None else known.start
    anchor = _anchor(reckoned, fixes, motion, config.start.sigma_m)
    runs = {"dead_reckoning": Run(placed(anchor), start=reckoned)}
    sigma_s = config.acoustics.travel_time_sigma_s
    if start is not None:
        noise = TwoStates(config.start.sigma_m, q, config.fix.sigma_m, config.fix.gamma)
        runs["kf_fix"] = Run(placed(filter_fixes(fixes, motion, start, noise)), start=start)
    for method, gamma in (("ekf_ungated", np.inf), ("ekf_gated", config.gate.threshold)):
        nodes, innovations = filter_travel_times(
            evidence.dive.replies,
            evidence.usable,
            evidence.legs,
            motion,
            start,
            TwoStates(config.start.sigma_m, q, sigma_s, gamma),
        )
        runs[method] = Run(placed(nodes), innovations, gamma, start, noise_s=sigma_s)
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
