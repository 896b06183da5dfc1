# SPDX-License-Identifier: Apache-2.0
"""A dive as a factor graph in columns: nodes, observations, dead reckoning, Gauss-Markov states."""

from bisect import bisect_right
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from abyssnav.acoustics.travel_time import NOMINAL_MPS, RayGeometry
from abyssnav.estimation.dead_reckoning import DeadReckoning, is_held, vehicle_axes
from abyssnav.estimation.dive_states import (
    DRIFTS,
    FORWARD,
    N_BEACON,
    N_COMMON,
    N_NODE,
    STARBOARD,
    DiveStates,
    NoiseModel,
    deviation_shapes,
    drift_groups,
)
from abyssnav.estimation.normal_equations import Drift, MotionTerms, Slots, make_slots
from abyssnav.estimation.observations import (
    LegTable,
    Observations,
    Offsets,
    PositionTable,
    TimeTable,
)
from abyssnav.estimation.preintegration import Cells, Preintegrated, make_cells
from abyssnav.geometry import Plane, blend, bracket, interpolate, plane
from abyssnav.tables import Beacons, Bool, Float, Heading, Int, Positions, Replies

#: Pings of this stretch share a node: dead reckoning loses nothing in it that a time could tell.
_NODE_S = 10.0
#: Largest sigma (m, per axis) of the constant part of the error of a moving beacon's places.
_MOVING_M = 0.2
#: Without any ping for longer, nodes lie this far apart.
_SILENT_NODE_S = 60.0
#: Noise and priors may be others in every window of the dive.
_WINDOW_S = 7200.0
#: Sigma of a velocity that is held backwards from the first lock, for a vehicle sinks otherwise
#: than it swims: as sure as one held over a short loss, it refused the replies of the change.
_BEFORE_LOCK_MPS = 0.4
#: Variance of a step that takes no time (m²), and of a state that cannot fade.
_TINY_M2, _TINY = 1e-6, 1e-14


class DiveInputs(NamedTuple):
    """What a dive offers its batch estimate."""

    motion: DeadReckoning
    heading: Heading
    replies: Replies  #: usable ones: of known beacons and physical
    geometry: RayGeometry  #: of those
    beacons: Beacons
    positions: Positions | None = None
    start: "Anchor | None" = None


class Anchor(NamedTuple):
    """A place that is known beforehand."""

    t_s: float
    position_m: tuple[float, float]
    sigma_m: float


@dataclass(frozen=True)
class ErrorPriors:
    """How wrong compass, DVL, sound and survey may be, before anything is learned: sigmas."""

    travel_time_s: float = 0.002
    position_m2_per_s: float = 0.0003
    heading_rad: float = np.radians(0.5)  #: slow
    heading_time_s: float = 600.0
    velocity_mps: float = 0.004  #: slow, of the DVL
    velocity_time_s: float = 600.0
    current_mps: float = 0.001  #: slow, in the earth frame
    current_time_s: float = 3600.0
    sound_slow_mps: float = 0.3
    sound_slow_time_s: float = 1800.0
    slow_times_time_s: float = 600.0  #: of an error of each beacon's times, as large as their noise
    offset_rad: float = np.radians(2.0)
    deviation_rad: tuple[float, float] = (np.radians(1.0), np.radians(0.4))
    dvl_scale: float = 0.004
    sound_mps: float = 1.0
    gradient_per_s: float = 0.0
    gradient_depth_m: float | None = None  #: that the stated speed is for; None: the legs' mean
    clock_s: float = 0.001
    lever_m: float = 0.15
    unstated_lever_m: float = 0.0  #: of an arm that nobody gave: counts in the radius alone
    depth_m: float = 0.5  #: constant error of the depth: it acts as an arm that points down
    beacon_m: float = 0.5  #: where none is stated
    turn_around_s: float = 0.0003
    gap_velocity_mps: float = 0.1  #: of a velocity that is held while bottom lock is lost


class Problem(NamedTuple):
    """The nodes of a dive and all that ties them."""

    t_node_s: Float  #: (n,)
    window: Int  #: (n,) of the noise
    heading_rad: Float  #: (n,) as logged, unwrapped
    cells: Cells
    held_variance_m2: Float  #: (n - 1,) where lock was lost for a part of the interval
    held_sigma_mps: Float  #: (n,) of the DVL's slow error where lock is lost, else 0
    observations: Observations
    group: Int  #: (r,) of each row's noise: the beacon; for positions one past the last beacon
    slots: Slots
    n_beacons: int
    offsets: "OffsetMaker"  #: dead reckoning from a node to any instant after it

    @property
    def n_windows(self) -> int:
        """Stretches of the dive with noise of their own."""
        return int(self.window[-1]) + 1

    @property
    def n_times(self) -> int:
        """Travel times; the other rows belong to positions, two each."""
        return len(self.observations.times)


def pose_problem(inputs: DiveInputs, priors: ErrorPriors) -> Problem:
    """Nodes at the pings (those of ten seconds share one) and what lies between and about them."""
    motion, replies, beacons = inputs.motion, inputs.replies, inputs.beacons
    positions = _with_anchor(inputs)
    t_node_s = _node_times(
        np.concatenate([replies.t_ping_s, positions.t_s]), (motion.t_s[0], motion.t_s[-1])
    )
    held_s = np.diff(interpolate(t_node_s, motion.t_s, motion.held_s))
    at_node = is_held(t_node_s, motion.t_s, motion.held_s)
    partly = ~(at_node[1:] & at_node[:-1])
    # Of the first instant's second one half is outside the dive: it is not held by itself.
    before_lock = np.logical_and.accumulate(np.append(True, at_node[1:]))
    lost_mps = priors.gap_velocity_mps
    gap_mps = np.where(before_lock, max(lost_mps, _BEFORE_LOCK_MPS), lost_mps)
    node = _node_before(t_node_s, replies.t_ping_s)
    offsets = OffsetMaker(inputs, t_node_s)
    observations = Observations(
        TimeTable(node, replies.beacon, inputs.geometry.flight_time_s),
        offsets.interpolate(replies.t_ping_s, node),
        offsets.interpolate(replies.t_reply_s, node),
        *_leg_tables(inputs, priors),
        *_position_tables(positions, t_node_s, offsets),
    )
    every_node = np.concatenate([node, np.repeat(observations.positions.node, 2)])
    n_windows = max(1, int(np.ceil((t_node_s[-1] - t_node_s[0]) / _WINDOW_S)))
    window_s = (t_node_s[-1] - t_node_s[0]) / n_windows + 1e-6
    return Problem(
        t_node_s=t_node_s,
        window=((t_node_s - t_node_s[0]) / window_s).astype(int),
        heading_rad=interpolate(t_node_s, motion.t_s, motion.heading_rad),
        cells=make_cells(motion, t_node_s),
        held_variance_m2=np.where(partly, (gap_mps[:-1] * held_s) ** 2, 0.0),
        held_sigma_mps=np.where(at_node, gap_mps, 0.0),
        observations=observations,
        group=np.concatenate([replies.beacon, np.full(2 * len(positions), len(beacons))]),
        slots=make_slots(every_node),
        n_beacons=len(beacons),
        offsets=offsets,
    )


def prior_noise(inputs: DiveInputs, priors: ErrorPriors, problem: Problem) -> NoiseModel:
    """Noise and priors before anything is learned."""
    w, geometry = problem.n_windows, inputs.geometry
    speed_mps = geometry.mean_speed_mps if len(geometry) else NOMINAL_MPS
    drift_sigma = [
        priors.heading_rad,
        priors.velocity_mps,
        priors.current_mps,
        priors.sound_slow_mps / speed_mps,
        priors.travel_time_s,
    ]
    drift_time_s = [
        priors.heading_time_s,
        priors.velocity_time_s,
        priors.current_time_s,
        priors.sound_slow_time_s,
        priors.slow_times_time_s,
    ]
    stated_m = inputs.beacons.sigma_m
    beacon_m = np.where((stated_m > 0) & np.isfinite(stated_m), stated_m, priors.beacon_m)
    # The noise of a moving beacon's places is each reply's own: what stays of it is their mean's.
    beacon_m = np.where(inputs.beacons.moving, np.minimum(beacon_m, _MOVING_M), beacon_m)
    first, second = priors.deviation_rad
    common = [
        priors.offset_rad, first, first, second, second, priors.dvl_scale,
        priors.sound_mps / speed_mps, max(priors.gradient_per_s, 1e-9), priors.clock_s,
        priors.lever_m, priors.lever_m, float(np.hypot(priors.lever_m, priors.depth_m)),
    ]  # fmt: skip
    beacon = np.column_stack(
        [beacon_m, beacon_m, beacon_m, np.full(len(beacon_m), priors.turn_around_s)]
    )
    return NoiseModel(
        np.append(np.full(problem.n_beacons, priors.travel_time_s), 1.0),
        np.full(w, priors.position_m2_per_s),
        np.tile(drift_sigma, (w, 1)),
        np.tile(drift_time_s, (w, 1)),
        np.concatenate([common, beacon.ravel()]),
    )


def row_sigma(problem: Problem, noise: NoiseModel) -> Float:
    """Standard deviation (r,) of every observation."""
    return noise.observation_sigma[problem.group]


def motion_variance(problem: Problem, noise: NoiseModel) -> Float:
    """Variance (n - 1,) m² of dead reckoning over each interval, beside that of the states.

    White noise q Δt; what a lost lock adds; and what the states do between nodes that a straight
    line does not know: a Brownian bridge of diffusion 2 σ² / τ has the integrated variance
    (2 σ² / τ) Δt³ / 12.
    """
    dt_s, window = np.diff(problem.t_node_s), problem.window[:-1]
    diffusion = (2 * noise.drift_sigma**2 / noise.drift_time_s)[window]
    run_m = _run(problem.cells, len(dt_s))
    bridge = (diffusion[:, 0] * (run_m / dt_s) ** 2 + diffusion[:, 1] + diffusion[:, 2]) / 12
    return np.asarray(
        noise.position_m2_per_s[window] * dt_s
        + bridge * dt_s**3
        + problem.held_variance_m2
        + _TINY_M2
    )


def motion_terms(
    problem: Problem, states: DiveStates, step: Preintegrated, noise: NoiseModel
) -> MotionTerms:
    """Dead reckoning between nodes, linearised."""
    position = plane(states.node[:, :2])
    miss = np.diff(position) - step.displacement
    return MotionTerms(
        np.column_stack([miss.real, miss.imag]), step, motion_variance(problem, noise)
    )


def drift_terms(problem: Problem, states: DiveStates, noise: NoiseModel) -> Drift:
    """Fading states: x_{i+1} = a x_i + noise of variance σ² (1 - a²), a = exp(-Δt / τ).

    Where lock is lost the DVL's slow error is that of a velocity held, which ends with the loss.
    """
    groups = drift_groups(states.node.shape[1])
    sigma = noise.drift_sigma[problem.window][:, groups]
    time_s = noise.drift_time_s[problem.window][:, groups]
    held = problem.held_sigma_mps[:, None]
    dvl = slice(FORWARD - DRIFTS.start, STARBOARD - DRIFTS.start + 1)
    sigma[:, dvl] = np.where(held > 0, held, sigma[:, dvl])
    factor = np.zeros_like(sigma)
    factor[1:] = np.exp(-np.diff(problem.t_node_s)[:, None] / time_s[1:])
    changed = np.diff(problem.held_sigma_mps) != 0
    factor[1:, dvl][changed] = 0.0
    values = states.node[:, DRIFTS.start :]
    before = np.concatenate([values[:1], values[:-1]])
    variance = np.maximum(sigma**2 * (1 - factor**2), _TINY)
    return Drift(values, values - factor * before, factor, variance)


def states_along(
    problem: Problem, motion: DeadReckoning, t_s: Float, position_m: Float
) -> DiveStates:
    """States of no error along known places (m, 2), dead reckoning between and beyond them."""
    node = np.zeros((len(problem.t_node_s), N_NODE))
    t_s, first = np.unique(t_s, return_index=True)
    position_m = position_m[first]
    reckoned_m = interpolate(problem.t_node_s, motion.t_s, motion.displacement_m)
    offset_m = position_m - interpolate(t_s, motion.t_s, motion.displacement_m)
    node[:, :2] = reckoned_m + interpolate(problem.t_node_s, t_s, offset_m)
    return DiveStates(node, np.zeros(N_COMMON + N_BEACON * problem.n_beacons))


def _run(cells: Cells, n: int) -> Float:
    """Length (n,) m of what was run in each interval."""
    runs_m = np.bincount(cells.interval, np.abs(cells.displacement), minlength=n)
    return np.asarray(runs_m, dtype=float)


def _node_times(t_s: Float, span_s: tuple[float, float]) -> Float:
    """Instants that have a node: the first of ten seconds' pings; more where all is silent."""
    ordered = np.unique(t_s).tolist()
    times = [float(span_s[0])]
    place = bisect_right(ordered, times[0] + 1.0)
    while place < len(ordered) and ordered[place] < span_s[1] - 1.0:
        times.append(ordered[place])
        place = bisect_right(ordered, times[-1] + _NODE_S - 1e-3)
    times.append(max(float(span_s[1]), times[-1] + 1.0))
    knots = np.array(times)
    n_parts = np.maximum(np.ceil(np.diff(knots) / _SILENT_NODE_S - 1e-9).astype(int), 1)
    start = np.repeat(knots[:-1], n_parts)
    part = np.arange(len(start)) - np.repeat(np.cumsum(n_parts) - n_parts, n_parts)
    filled = start + part * np.repeat(np.diff(knots) / n_parts, n_parts)
    return np.append(filled, knots[-1])


def _node_before(t_node_s: Float, t_s: Float) -> Int:
    return np.clip(np.searchsorted(t_node_s, t_s, side="right") - 1, 0, len(t_node_s) - 1)


class Reckoned(NamedTuple):
    """Dead reckoning as logged since a node."""

    displacement: Plane  #: east + i north, m
    ahead: Plane  #: ∫ (sin ψ + i cos ψ) dt, s
    duration_s: Float
    heading_rad: Float  #: mean of both ends


class OffsetMaker:
    """Dead reckoning between nodes and any instants near them."""

    def __init__(self, inputs: DiveInputs, t_node_s: Float) -> None:
        self._motion, self._heading, self._t_node_s = inputs.motion, inputs.heading, t_node_s
        self._run, self._ahead = plane(inputs.motion.displacement_m), inputs.motion.ahead_s
        place = bracket(t_node_s, inputs.motion.t_s)
        self._node_heading_rad = blend(inputs.motion.heading_rad, *place)
        self._node = [blend(sums, *place) for sums in (self._run, self._ahead)]

    def since(self, t_s: Float, node: Int) -> Reckoned:
        """Dead reckoning as logged from nodes to instants (m,)."""
        place = bracket(t_s, self._motion.t_s)
        run, ahead = (
            blend(sums, *place) - at_node[node]
            for sums, at_node in zip((self._run, self._ahead), self._node, strict=True)
        )
        heading_rad = blend(self._motion.heading_rad, *place)
        middle_rad = 0.5 * (heading_rad + self._node_heading_rad[node])
        return Reckoned(run, ahead, t_s - self._t_node_s[node], middle_rad)

    def interpolate(self, t_s: Float, node: Int) -> Offsets:
        """Offsets of instants (m,) from the nodes before them."""
        run = self.since(t_s, node)
        level, up = vehicle_axes(self._heading, t_s)
        shapes = deviation_shapes(run.heading_rad)
        return Offsets(run.displacement, run.ahead, run.duration_s, shapes, level, up)


def _leg_tables(inputs: DiveInputs, priors: ErrorPriors) -> tuple[LegTable, LegTable]:
    geometry, replies = inputs.geometry, inputs.replies
    beacon_depth_m = -replies.beacon_enu_m[:, 2]
    middle_m = [beacon_depth_m - 0.5 * h for h in (geometry.height_ping_m, geometry.height_reply_m)]
    reference_m = priors.gradient_depth_m
    if reference_m is None:
        reference_m = float(np.mean(middle_m)) if len(replies) else 0.0
    ping = LegTable(
        plane(geometry.virtual_beacon_ping_m),
        geometry.height_ping_m,
        geometry.speed_ping_mps,
        middle_m[0] - reference_m,
    )
    reply = LegTable(
        plane(geometry.virtual_beacon_reply_m),
        geometry.height_reply_m,
        geometry.speed_reply_mps,
        middle_m[1] - reference_m,
    )
    return ping, reply


def _with_anchor(inputs: DiveInputs) -> Positions:
    """Positions of other means, and the start that is known."""
    table = inputs.positions
    if table is None:
        table = Positions(np.empty(0), np.empty((0, 2)), np.empty((0, 2, 2)), np.empty((0, 3)))
    if inputs.start is None:
        return table
    t_s, position_m, sigma_m = inputs.start
    return Positions(
        np.append(table.t_s, t_s),
        np.concatenate([table.position_enu_m, [position_m]]),
        np.concatenate([table.position_cov_m2, [sigma_m**2 * np.eye(2)]]),
        np.concatenate([table.lever_enu_m, np.zeros((1, 3))]),
    )


def _position_tables(
    positions: Positions, t_node_s: Float, offsets: OffsetMaker
) -> tuple[PositionTable, Offsets]:
    node = _node_before(t_node_s, positions.t_s)
    lower = np.linalg.cholesky(positions.position_cov_m2)
    table = PositionTable(
        node,
        plane(positions.vehicle_enu_m),
        np.linalg.inv(lower),
    )
    return table, offsets.interpolate(positions.t_s, node)


def best_reply_per_beacon(residual: Float, ping: Int, beacon: Int) -> Bool:
    """Of several replies of one beacon to one ping, the one of the smallest residual (n,).

    Parameters
    ----------
    residual : (n,) of any unit
    ping, beacon : (n,) numbers
    """
    chosen = np.ones(len(residual), dtype=bool)
    if len(residual):
        number = ping * (beacon.max() + 1) + beacon
        _, key, count = np.unique(number, return_inverse=True, return_counts=True)
        several = np.flatnonzero(count[key] > 1)  # few, as a rule
        order = several[np.lexsort((np.abs(residual[several]), key[several]))]
        chosen[order] = np.diff(key[order], prepend=-1) != 0
    return chosen
