# SPDX-License-Identifier: Apache-2.0
"""The method `ekf`: the product's own filter in real time."""

from typing import NamedTuple

import numpy as np

from abyssnav.acoustics.travel_time import NOMINAL_MPS
from abyssnav.config import Config
from abyssnav.estimation.dive_states import (
    DEVIATION,
    HEADING,
    N_NODE,
    OFFSET,
    SCALE,
    SOUND,
    SOUND_SCALE,
    deviation_shapes,
)
from abyssnav.estimation.filter_events import UsableTimes, sums_maker, time_events
from abyssnav.estimation.filter_history import Nodes, PositionUpdates, propagate, sound_scale
from abyssnav.estimation.filter_problem import GateConfig, KnownStart, PositionEvents, Problem
from abyssnav.estimation.fixes import ping_numbers
from abyssnav.estimation.hypotheses import HYPOTHESES, bank_priors
from abyssnav.estimation.tracker import SIDES_RATIO, Tracked
from abyssnav.estimation.two_state import BEFORE_START
from abyssnav.geometry import interpolate, pairs, plane
from abyssnav.navigate.inputs import (
    LevelTrack,
    MethodResult,
    NavigationInputs,
    error_priors,
    first_velocity_s,
    innovations_of_usable,
    place_track,
    rows_of_all,
)
from abyssnav.tables import (
    Check,
    Event,
    Float,
    PositionInnovations,
    SensorEstimates,
    Start,
    Track,
)

#: `ekf_huber`, for comparison: the customary κ, and a gate for what no weight should see.
_HUBER_KAPPA, _HUBER_GAMMA = 1.345, 25.0


class Tracking(NamedTuple):
    """The bank's run over the usable replies and the position fixes."""

    problem: Problem
    tracked: Tracked

    @property
    def start(self) -> Start | None:
        """Where it began; None where it never did."""
        return self.tracked.start

    def nodes(self) -> Nodes:
        """The mixture after every event from the start on, which there is."""
        assert self.tracked.history is not None
        return self.tracked.history.nodes


def pose_problem(inputs: NavigationInputs, config: Config, *, huber: bool = False) -> Problem:
    """The dive as the filters see it.

    With `huber` one filter of the nominal priors weighs residuals in place of a tight gate.
    """
    dive, geometry, priors = inputs.dive, inputs.geometry, error_priors(inputs.dive, config)
    first_mps = geometry.speed_reply_mps[:1]  # what comes later must not move an estimate
    speed_mps = float(first_mps[0]) if len(first_mps) else NOMINAL_MPS
    sums = sums_maker(inputs.still, first_velocity_s(dive))
    gate = GateConfig(config.gate.threshold, config.fix.gamma)
    if huber:
        gate = GateConfig(_HUBER_GAMMA, config.fix.gamma, _HUBER_KAPPA)
    return Problem(
        time_events(
            UsableTimes(inputs.usable_replies, ping_numbers(inputs.usable_replies), geometry),
            sums,
            dive.heading,
            priors.gradient_depth_m,
        ),
        geometry,
        _position_events(inputs),
        sums,
        bank_priors(
            priors, dive.beacons.sigma_m, speed_mps, HYPOTHESES[:1] if huber else HYPOTHESES
        ),
        gate,
        config.start.sigma_m,
        config.acoustics.travel_time_sigma_s,
    )


def thinned(problem: Problem, known: KnownStart | None) -> Problem:
    """The same to the bit for the filters, with dead reckoning at the events only."""
    begin_s = np.empty(0) if known is None else np.array([known.start.t_s])
    instants_s = np.concatenate([begin_s, problem.times.t_s, problem.positions.t_s])
    return problem._replace(sums=problem.sums.thinned(instants_s))


def _position_events(inputs: NavigationInputs) -> PositionEvents:
    table = inputs.dive.positions
    if table is None:
        return PositionEvents(np.empty(0), np.empty(0, dtype=complex), np.empty((0, 2, 2)))
    return PositionEvents(table.t_s, plane(table.vehicle_enu_m), table.position_cov_m2)


def real_time(inputs: NavigationInputs, tracking: Tracking, method: str) -> MethodResult:
    """Track, innovations and what was learned, as known at each instant."""
    history, start = tracking.tracked.history, tracking.start
    gamma = tracking.problem.gate.gamma
    if history is None or start is None:
        n = int(inputs.usable.sum())
        decision = np.full(n, BEFORE_START)
        return MethodResult(
            None, innovations_of_usable(inputs, decision, np.full((n, 3), np.nan)), gamma
        )
    times = history.times
    values = np.column_stack([times.predicted_s, times.variance_s2, times.innovation_s])
    grid_s = inputs.grid.t_s
    return MethodResult(
        real_time_places(inputs, tracking, grid_s),
        innovations_of_usable(inputs, times.decision, values),
        gamma,
        start,
        _estimates(inputs, history.nodes),
        _events(history.nodes, start, method),
        rows_of_all(inputs, np.sqrt(times.noise_s2)),
        positions=_position_innovations(tracking.problem.positions, history.positions),
    )


def _position_innovations(
    events: PositionEvents, updates: PositionUpdates
) -> PositionInnovations | None:
    """Every position fix as the filter met it; None without any."""
    if not len(events.t_s):
        return None
    known = np.isfinite(updates.innovation_m[:, 0])
    nis = np.full(len(known), np.nan)
    innovation_m, cov_m2 = updates.innovation_m[known], updates.innovation_cov_m2[known]
    weighted = np.linalg.solve(cov_m2, innovation_m[:, :, None])[:, :, 0]
    nis[known] = np.sum(innovation_m * weighted, axis=1)
    return PositionInnovations(
        events.t_s,
        pairs(events.position),
        np.sqrt(np.diagonal(updates.noise_m2, axis1=1, axis2=2)),
        updates.innovation_m,
        nis,
        updates.decision,
    )


def real_time_places(inputs: NavigationInputs, tracking: Tracking, t_s: Float) -> Track:
    """The filter's track at any instants, those before its start left out."""
    nodes = tracking.nodes()
    t_s = t_s[np.searchsorted(t_s, nodes.t_s[0]) :]
    heading_rad = interpolate(t_s, inputs.motion.t_s, inputs.motion.heading_rad)
    problem = tracking.problem
    live = propagate(nodes, problem.sums, problem.priors, (t_s, heading_rad))
    heading_rad = heading_rad - live.heading_error_rad
    speed_scale = 1 / (1 + live.dvl_scale)
    level = LevelTrack(t_s, live.position_m, live.position_cov_m2, heading_rad, speed_scale)
    return place_track(inputs, level)


def side_checks(tracking: Tracking) -> tuple[Check, ...]:
    """Which of two mirrored starts the replies chose, where beacons in a line left both open."""
    sides = tracking.tracked.sides
    if not sides:
        return ()
    chosen = tracking.start is not None
    one, other = (f"({side.east_m:.1f}, {side.north_m:.1f})" for side in sides)
    detail = (
        f"the vehicle is at {one} or, mirrored in the line of the beacons, at {other} m "
        f"east and north {sides[0].t_s:.0f} s into the dive; "
    )
    detail += (
        f"the replies chose ({tracking.start.east_m:.1f}, {tracking.start.north_m:.1f})"
        if tracking.start is not None
        else "the replies choose neither"
    )
    ratio = abs(tracking.tracked.log_ratio) / np.log(10)
    limit = float(np.log10(SIDES_RATIO))
    return (Check("navigate", "mirrored_starts", ratio, limit, "", chosen, detail),)


def _estimates(inputs: NavigationInputs, nodes: Nodes) -> SensorEstimates:
    """Errors of compass, DVL and sound at every event; deviation counts in the heading's."""
    motion, x, P = inputs.motion, nodes.x, nodes.P
    shapes = deviation_shapes(interpolate(nodes.t_s, motion.t_s, motion.heading_rad))
    turning = [HEADING, N_NODE + OFFSET, *range(N_NODE + 1, N_NODE + DEVIATION.stop)]
    by = np.column_stack([np.ones((len(x), 2)), shapes])
    error_rad = np.sum(by * x[:, turning], axis=1)
    cov = P[:, np.array(turning)[:, None], turning]
    variance = np.einsum("ni,nij,nj->n", by, cov, by)
    sound = P[:, [SOUND, N_NODE + SOUND_SCALE]][:, :, [SOUND, N_NODE + SOUND_SCALE]]
    scale = N_NODE + SCALE
    return SensorEstimates(
        nodes.t_s,
        error_rad,
        np.sqrt(np.maximum(variance, 0.0)),
        x[:, scale].copy(),  # not a view of all the states
        np.sqrt(np.maximum(P[:, scale, scale], 0.0)),
        sound_scale(x),
        np.sqrt(np.maximum(sound.sum(axis=(1, 2)), 0.0)),
    )


def _events(nodes: Nodes, start: Start, method: str) -> tuple[Event, ...]:
    """The start, and every recovery with how far it moved the track."""
    begun = Event(start.t_s, method, f"start confirmed by {start.how} after {start.cycles} cycles")
    again = np.flatnonzero(np.diff(nodes.segment) > 0) + 1
    moved_m = np.linalg.norm(nodes.x[again, :2] - nodes.x[again - 1, :2], axis=1)
    return begun, *(
        Event(t, method, f"recovered by consensus, {m:.0f} m away from where it was")
        for t, m in zip(nodes.t_s[again].tolist(), moved_m.tolist(), strict=True)
    )
