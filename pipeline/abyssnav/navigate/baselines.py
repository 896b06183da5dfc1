# SPDX-License-Identifier: Apache-2.0
"""The paper's methods: fixes, the start that they confirm, and the two-state filters."""

import numpy as np

from abyssnav.config import Config
from abyssnav.estimation.dead_reckoning import DeadReckoning
from abyssnav.estimation.fixes import StartRule, confirm_start, cycles, fix_positions
from abyssnav.estimation.two_state import (
    EkfConfig,
    Nodes,
    filter_fixes,
    filter_travel_times,
    propagate,
)
from abyssnav.navigate.inputs import (
    LevelTrack,
    MethodResult,
    NavigationInputs,
    place_track,
    settings_start,
    since,
)
from abyssnav.tables import Fixes, Start, Track

#: Dead reckoning and the paper's three filters.
PAPER = ("dead_reckoning", "kf_fix", "ekf_ungated", "ekf_gated")


def cycle_fixes(inputs: NavigationInputs, config: Config) -> Fixes:
    """The fix of every cycle that has one."""
    cycle = cycles(inputs.dive.replies, inputs.usable, config.fix.max_cycle_s)
    return fix_positions(
        inputs.usable_replies,
        inputs.geometry,
        cycle[inputs.usable],
        inputs.motion,
        config.acoustics.travel_time_sigma_s,
    )


def confirmed_start(fixes: Fixes, config: Config) -> Start | None:
    """The start that the consistent fixes confirm."""
    settings = config.start
    rule = StartRule(
        settings.m, settings.n, settings.v_min_mps, settings.v_max_mps, settings.a_max_mps2
    )
    return confirm_start(fixes[fixes.consistent], rule)


def run_methods(
    inputs: NavigationInputs, fixes: Fixes, start: Start | None, config: Config
) -> dict[str, MethodResult]:
    """The paper's four methods, from one start."""
    motion, q = inputs.motion, config.process.position_m2_per_s

    def placed(nodes: Nodes | None) -> Track | None:
        if nodes is None:
            return None
        instants = since(inputs.live, float(nodes.t_s[0]))
        reached = propagate(nodes, motion, instants, q)
        return place_track(inputs, LevelTrack(instants.t_s, *reached, instants.heading_rad))

    known = settings_start(inputs, config)
    reckoned = start if known is None else known.start
    anchor = _anchor(reckoned, fixes, motion, config.start.sigma_m)
    results = {"dead_reckoning": MethodResult(placed(anchor), start=reckoned)}
    sigma_s = config.acoustics.travel_time_sigma_s
    if start is not None:
        noise = EkfConfig(config.start.sigma_m, q, config.fix.sigma_m, config.fix.gamma)
        results["kf_fix"] = MethodResult(
            placed(filter_fixes(fixes, motion, start, noise)), start=start
        )
    for method, gamma in (("ekf_ungated", np.inf), ("ekf_gated", config.gate.threshold)):
        nodes, innovations = filter_travel_times(
            inputs.times,
            motion,
            start,
            EkfConfig(config.start.sigma_m, q, sigma_s, gamma),
        )
        results[method] = MethodResult(placed(nodes), innovations, gamma, start, noise_s=sigma_s)
    return results


def _anchor(start: Start | None, fixes: Fixes, motion: DeadReckoning, sigma_m: float) -> Nodes:
    """Where dead reckoning begins: the confirmed start, else a fix, else the frame's origin."""
    if start is not None:
        t_s, position_m = start.t_s, [start.east_m, start.north_m]
    elif len(fixes):
        first = int(np.argmax(fixes.consistent))
        t_s, position_m = float(fixes.t_s[first]), fixes.position_enu_m[first, :2].tolist()
    else:
        t_s, position_m = float(motion.t_s[0]), [0.0, 0.0]
    return Nodes(np.array([t_s]), np.array([position_m]), sigma_m**2 * np.eye(2)[None])
