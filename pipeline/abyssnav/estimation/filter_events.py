# SPDX-License-Identifier: Apache-2.0
"""Measurements, transition factors and process noise of the filters, prepared in columns."""

from dataclasses import dataclass
from math import inf
from typing import NamedTuple

import numpy as np

from abyssnav.acoustics.travel_time import RayGeometry
from abyssnav.estimation.dead_reckoning import (
    ASIDE_S,
    DeadReckoning,
    is_held,
    vehicle_axes,
)
from abyssnav.estimation.dive_states import DRIFT_GROUP, N_NODE
from abyssnav.estimation.hypotheses import BankPriors
from abyssnav.geometry import Plane, blend, bracket, pairs, plane
from abyssnav.tables import Bool, Float, Heading, Int, Replies, Table

#: Sigma, forward and starboard, of a velocity of which nothing is known: that of a way down.
_UNKNOWN_MPS = 0.7
#: Steps that are made at once: what a cache holds.
_CHUNK = 256
#: Events that are linearised together lie within so long.
_LONGEST_S = 60.0


class Displacement(NamedTuple):
    """Dead reckoning as logged over stretches of time (...), with all that its errors scale by."""

    duration_s: Float
    displacement: Plane  #: (...) ΔC, east + i north, m
    deviation: Plane  #: (..., 4) ∫ φ(ψ) i v dt for φ = sin ψ, cos ψ, sin 2ψ, cos 2ψ
    ahead: Plane  #: (...) ∫ (sin ψ + i cos ψ) dt, s
    held_s: Float  #: for how long the velocity was held because bottom lock was lost

    def row(self, i: int | slice | Int) -> "Displacement":
        """One stretch, or some."""
        return Displacement(
            self.duration_s[i],
            self.displacement[i],
            self.deviation[i],
            self.ahead[i],
            self.held_s[i],
        )


@dataclass(frozen=True, eq=False)
class MotionSums(Table):
    """Running sums of dead reckoning at given instants."""

    t_s: Float
    displacement: Plane
    deviation: Plane
    ahead: Plane
    held_s: Float

    def since(self, earlier: "MotionSums") -> Displacement:
        """What lies between earlier instants, row by row or one for all, and these."""
        return Displacement(
            self.t_s - earlier.t_s,
            self.displacement - earlier.displacement,
            self.deviation - earlier.deviation,
            self.ahead - earlier.ahead,
            self.held_s - earlier.held_s,
        )


@dataclass(frozen=True, eq=False)
class SumsMaker:
    """Running sums of a dive's dead reckoning, to be had at any instants."""

    knots: MotionSums
    first_lock_s: float = -inf

    def is_held(self, t_s: Float) -> Bool:
        """Whether the velocity is held at instants (m,), for bottom lock is lost."""
        return is_held(t_s, self.knots.t_s, self.knots.held_s)

    def held_sigma(self, t_s: Float, priors: BankPriors) -> Float:
        """Sigma (m, h) m/s of a velocity that is held: of an unknown one before the first lock."""
        known = priors.held_sigma_mps
        return np.where((t_s < self.first_lock_s)[:, None], np.maximum(_UNKNOWN_MPS, known), known)

    def interpolate(self, t_s: Float) -> MotionSums:
        """Sums interpolated linearly at any times (m,) s."""
        sums = self.knots
        place = bracket(t_s, sums.t_s)
        run, deviation, ahead = (
            blend(values, *place) for values in (sums.displacement, sums.deviation, sums.ahead)
        )
        return MotionSums(t_s, run, deviation, ahead, blend(sums.held_s, *place))

    def thinned(self, t_s: Float) -> "SumsMaker":
        """The same to the bit for who asks at these instants only, in a hundredth of the memory."""
        asked_s = np.unique(np.concatenate([t_s, t_s - ASIDE_S, t_s + ASIDE_S]))
        return SumsMaker(self.interpolate(asked_s), self.first_lock_s)


def sums_maker(motion: DeadReckoning, first_lock_s: float = -inf) -> SumsMaker:
    """Running sums of dead reckoning.

    Parameters
    ----------
    first_lock_s : of the first velocity; before it nothing is known of the vehicle's
    """
    run, deviation = plane(motion.displacement_m), plane(motion.displacement_jacobian)
    knots = MotionSums(motion.t_s, run, deviation, motion.ahead_s, motion.held_s)
    return SumsMaker(knots, first_lock_s)


class TimeEvents(NamedTuple):
    """Travel times in the order heard; of the axis of length 2 the first is the ping's leg."""

    t_s: Float  #: (n,)
    beacon: Int  #: (n,)
    ping: Int  #: (n,) running number
    flight_time_s: Float  #: (n,) measured, less the turn-around as stated
    since_ping: Displacement  #: n rows
    virtual_beacon: Plane  #: (n, 2) beacon less the lever arm as stated
    height_m: Float  #: (n, 2) transducer above the beacon
    speed_mps: Float  #: (n, 2) slant range over travel time
    below_reference_m: Float  #: (n, 2) leg's mean depth below the depth the stated speed is for
    lever: Plane  #: (n, 2, 3) horizontal parts of the body's axes
    lever_up: Float  #: (n, 2, 3)
    at_reply: MotionSums  #: n rows

    def row(self, rows: slice | Int) -> "TimeEvents":
        """Some of them."""
        return TimeEvents(
            self.t_s[rows],
            self.beacon[rows],
            self.ping[rows],
            self.flight_time_s[rows],
            self.since_ping.row(rows),
            self.virtual_beacon[rows],
            self.height_m[rows],
            self.speed_mps[rows],
            self.below_reference_m[rows],
            self.lever[rows],
            self.lever_up[rows],
            self.at_reply[rows],
        )


class Steps(NamedTuple):
    """Steps of h filters from event to event, m of them."""

    heading: Float  #: (h, m) mean of exp(-t / τ) over the step
    ahead: Float  #: (h, m) the same for the DVL's slow error
    current_s: Float  #: (h, m) the same for the current, times the step
    fade: Float  #: (h, m, 6) factors of the drifting states
    noise: Float  #: (h, m, 8, 8) covariance of the node's states

    def row(self, rows: slice | Int) -> "Steps":
        """Some of them."""
        return Steps(*(column[:, rows] for column in self))


#: Over a step: lock at both ends, lost in it, velocity held at both ends, lock regained in it.
_LOCKED, _LOST, _HELD, _REGAINED = range(4)
#: Group of drifting states (see `DRIFT_GROUP`): the DVL's slow error.
_DVL = 1


class Held(NamedTuple):
    """How lock is lost over m steps."""

    code: Int  #: (m,) `_LOCKED`, `_LOST`, `_HELD` or `_REGAINED`
    sigma_mps: Float  #: (m, h) of a velocity that is held


def held_over(sums: SumsMaker, t_s: Float, priors: BankPriors) -> Held:
    """Of the steps between given instants (m + 1,)."""
    is_held = sums.is_held(t_s)
    now, before = is_held[1:], is_held[:-1]
    code = np.where(now, np.where(before, _HELD, _LOST), np.where(before, _REGAINED, _LOCKED))
    return Held(code, sums.held_sigma(t_s[:-1], priors))


def steps(step: Displacement, held: Held, priors: BankPriors) -> Steps:
    """Gauss-Markov states and their integrals over some steps, exact for a straight run.

        w⁺ = a w,  ∫ w dt = τ (1 - a) w,  a = exp(-Δt / τ), with noise of covariance
        σ² (1 - a²)  of w;   σ² τ (1 - a)²  of both;   σ² τ² (2 Δt/τ - 3 + 4 a - a²)  of ∫ w dt

    (integrated Ornstein-Uhlenbeck process: D. Gillespie, Physical Review E 54, 1996).
    A velocity that is held has an error of its own, which begins and ends with the loss of lock. Of
    a step in which it begins, it moves the position by w t_held; of one in which it ends, as far as
    it lasts; where it does both it adds (σ_gap t_held)².

    Parameters
    ----------
    step : m rows
    held : m rows
    """
    gain, a, drift = _gauss_markov(step, held, priors)
    dt_s = np.maximum(step.duration_s, 1e-9)
    noise = _step_noise(step, drift, priors.position_m2_per_s)
    between = held.code == _LOCKED
    lost_m2 = np.where(between[:, None], (held.sigma_mps * step.held_s[:, None]) ** 2, 0.0).T
    for i in range(2):
        noise[:, :, i, i] += lost_m2
    heading, ahead, current = np.moveaxis(gain[:, :, :3], 2, 0).swapaxes(1, 2)
    return Steps(heading, ahead, current * dt_s, a.swapaxes(0, 1)[:, :, DRIFT_GROUP], noise)


class StepsMaker:
    """Steps between successive events, some hundred made at once."""

    def __init__(self, sums: SumsMaker, t_s: Float, priors: BankPriors) -> None:
        knots = sums.interpolate(t_s)
        self._stretch = knots[1:].since(knots[:-1])
        self._held = held_over(sums, t_s, priors)
        self._priors = priors
        #: A block is no longer than what fades within it.
        self.longest_s = min(_LONGEST_S, float(priors.drift_time_s.min()))
        self._first, self._made = 0, self._make(0)

    def begins_anew(self) -> Bool:
        """Steps (m,) that are taken alone: lock is lost or regained, or much fades."""
        code = self._held.code
        too_long = self._stretch.duration_s > self.longest_s
        return np.asarray((code == _LOST) | (code == _REGAINED) | too_long)

    def rows(self, i: int, k: int) -> tuple[Displacement, Steps]:
        """Steps i to i + k; behind the end the last again."""
        if not self._first <= i <= self._first + _CHUNK - k:
            self._first, self._made = i, self._make(i)
        rows = slice(i - self._first, i - self._first + k)
        stretch, step = self._made
        return stretch.row(rows), step.row(rows)

    def _make(self, first: int) -> tuple[Displacement, Steps]:
        rows = np.minimum(first + np.arange(_CHUNK), len(self._held.code) - 1)
        stretch, held = self._stretch.row(rows), self._held
        return stretch, steps(stretch, Held(held.code[rows], held.sigma_mps[rows]), self._priors)


class _Drift(NamedTuple):
    """Noise of the drifting states over m steps of h filters: (m, h, 4) each."""

    var_pp: Float  #: variance of the integral
    var_pw: Float  #: covariance of integral and state
    var_ww: Float  #: variance of the state


def _gauss_markov(
    step: Displacement, held: Held, priors: BankPriors
) -> tuple[Float, Float, _Drift]:
    """Mean of exp(-t / τ) over each step, factor a and noise, (m, h, 4) of the drifting states."""
    shape = (len(step.duration_s), *priors.drift_sigma.shape)
    whole = np.maximum(step.duration_s, 1e-9)[:, None, None]
    sigma, tau, dt = (
        np.broadcast_to(column, shape).copy()
        for column in (priors.drift_sigma, priors.drift_time_s, whole)
    )
    code, held_mps, held_s = held.code, held.sigma_mps, step.held_s[:, None]
    lost, regained = code == _LOST, code == _REGAINED
    began = regained | (code == _HELD)
    sigma[began, :, _DVL] = np.maximum(sigma[began, :, _DVL], held_mps[began])
    tau[began, :, _DVL] = priors.held_time_s
    dt[regained, :, _DVL] = np.maximum(held_s[regained], 1e-9)
    r = dt / tau
    a, gain = np.exp(-r), -np.expm1(-r) / r * (dt / whole)
    # Of short steps the series of 2 r - 3 + 4 a - a², whose terms cancel.
    growth = np.where(r < 1e-2, r**3 * (2 / 3 - r / 2), 2 * r - 3 + 4 * a - a * a)
    var_pp = sigma**2 * tau**2 * np.maximum(growth, 0.0)
    var_pw, var_ww = sigma**2 * tau * (1 - a) ** 2, sigma**2 * (1 - a * a)
    own, lost_m2 = priors.drift_sigma[:, _DVL] ** 2, held_mps[lost] ** 2
    a[lost | regained, :, _DVL], var_pw[regained, :, _DVL] = 0.0, 0.0
    var_pp[lost, :, _DVL] += lost_m2 * held_s[lost] ** 2
    var_pw[lost, :, _DVL] = lost_m2 * held_s[lost]
    var_ww[lost, :, _DVL] = np.maximum(own, lost_m2)
    var_ww[regained, :, _DVL] = own
    return gain, a, _Drift(var_pp, var_pw, var_ww)


def _step_noise(step: Displacement, drift: _Drift, position_m2_per_s: Float) -> Float:
    """Process noise: a heading error moves the position across the run, the rest on both axes."""
    var_pp, var_pw, var_ww = (column.swapaxes(0, 1) for column in drift)
    h, m, _ = var_ww.shape
    dt_s = np.maximum(step.duration_s, 1e-9)
    across, ahead = 1j * step.displacement / dt_s, step.ahead / dt_s
    even_m2 = np.abs(ahead) ** 2 * var_pp[:, :, _DVL] + var_pp[:, :, 2]
    even_m2 += position_m2_per_s[:, None] * step.duration_s
    one = np.ones(m)
    lacking = np.stack([across, -ahead, 1j * ahead, one, 1j * one, 0 * one], axis=1)
    shared = np.moveaxis(pairs(lacking), 2, 1) * var_pw[:, :, None, DRIFT_GROUP]
    noise = np.zeros((h, m, N_NODE, N_NODE))
    for i, part in enumerate((across.real, across.imag)):
        noise[:, :, i, i] = even_m2 + part**2 * var_pp[:, :, 0]
    noise[:, :, 0, 1] = noise[:, :, 1, 0] = across.real * across.imag * var_pp[:, :, 0]
    noise[:, :, :2, 2:], noise[:, :, 2:, :2] = shared, shared.swapaxes(2, 3)
    drifting = np.arange(2, N_NODE)
    noise[:, :, drifting, drifting] = var_ww[:, :, DRIFT_GROUP]
    return noise


class UsableTimes(NamedTuple):
    """Usable replies in the order heard."""

    replies: Replies
    ping: Int  #: (n,) running number
    geometry: RayGeometry


def time_events(
    times: UsableTimes, sums: SumsMaker, heading: Heading, reference_depth_m: float | None = None
) -> TimeEvents:
    """Travel times prepared for the filters.

    Parameters
    ----------
    reference_depth_m : that the stated sound speed is for; by default the mean of the legs
    """
    replies, ping, geometry = times
    at_ping, at_reply = sums.interpolate(replies.t_ping_s), sums.interpolate(replies.t_reply_s)
    height_m = np.column_stack([geometry.height_ping_m, geometry.height_reply_m])
    middle_m = -replies.beacon_enu_m[:, 2:3] - 0.5 * height_m
    if reference_depth_m is None:
        reference_depth_m = float(np.mean(middle_m)) if len(middle_m) else 0.0
    axes = [vehicle_axes(heading, t_s) for t_s in (replies.t_ping_s, replies.t_reply_s)]
    level, up = zip(*axes, strict=True)
    return TimeEvents(
        t_s=replies.t_reply_s,
        beacon=replies.beacon,
        ping=ping,
        flight_time_s=geometry.flight_time_s,
        since_ping=at_reply.since(at_ping),
        virtual_beacon=np.column_stack(
            [plane(geometry.virtual_beacon_ping_m), plane(geometry.virtual_beacon_reply_m)]
        ),
        height_m=height_m,
        speed_mps=np.column_stack([geometry.speed_ping_mps, geometry.speed_reply_mps]),
        below_reference_m=middle_m - reference_depth_m,
        lever=np.stack(level, axis=1),
        lever_up=np.stack(up, axis=1),
        at_reply=at_reply,
    )
