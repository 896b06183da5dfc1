# SPDX-License-Identifier: Apache-2.0
"""Dead reckoning as one cumulative sum, made before any filter runs."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from abyssnav.geometry import Plane, blend, body_axes, bracket, interpolate, leveled, pairs
from abyssnav.tables import Bool, Float, Heading, Int, Table, Velocity

#: How far the second about an instant reaches to either side, see `is_held`.
ASIDE_S = 0.5


@dataclass(frozen=True, eq=False)
class DeadReckoning(Table):
    """What dead reckoning knows, as running sums since the dive's start.

    Every displacement is a difference of two rows, so a filter need run at the replies only.
    The Jacobian is that of the displacement by the amplitudes of the compass deviation
    a₁ sin ψ + b₁ cos ψ + a₂ sin 2ψ + b₂ cos 2ψ, at no deviation.
    """

    t_s: Float  #: (n,)
    displacement_m: Float  #: (n, 2) C = ∫ (v_e, v_n) dt, as logged
    displacement_jacobian: (
        Float  #: (n, 4, 2) ∫ φ(ψ) (-v_n, v_e) dt, φ = sin ψ, cos ψ, sin 2ψ, cos 2ψ
    )
    gap_variance_m2: Float  #: (n,) of each axis, from stretches without bottom lock
    heading_rad: Float  #: (n,) as logged, unwrapped

    @cached_property
    def ahead_s(self) -> Plane:
        """Running integral (n,) s of the direction ahead, sin ψ + i cos ψ, by trapezoids."""
        forward = np.sin(self.heading_rad) + 1j * np.cos(self.heading_rad)
        return _running_sum(self.t_s, forward)

    @cached_property
    def held_s(self) -> Float:
        """Running time (n,) s during which the velocity is held, for bottom lock is lost."""
        step_s, grows = np.diff(self.t_s), np.diff(self.gap_variance_m2) > 0
        return np.concatenate([[0.0], np.cumsum(grows * step_s)])

    def interpolate(self, t_s: Float) -> "DeadReckoning":
        """Rows interpolated linearly at any times (m,) s."""
        place = bracket(t_s, self.t_s)
        columns = {name: blend(c, *place) for name, c in self.columns().items() if name != "t_s"}
        return DeadReckoning(t_s=t_s, **columns)


def dead_reckon(
    velocity: Velocity,
    heading: Heading,
    span_s: tuple[float, float],
    gap_sigma_mps: float,
    max_gap_s: float,
) -> DeadReckoning:
    """Running sums of the displacement over `span_s` (Eqs. 1-2, roll and pitch included).

        C(t) = ∫ E R(t) v_body(t) dt        (trapezoids at the velocity's own stamps)

    While bottom lock is lost (an invalid sample, or stamps more than `max_gap_s` apart) the last
    good body velocity is held and turned by the compass, and each axis' variance grows by
    ∫ 2 σ_gap² age dt = (σ_gap age)².  Before the first good sample that one is held backwards.

    Parameters
    ----------
    velocity : at least one valid row
    heading : for the instants inside gaps of the velocity
    span_s : first and last instant that the sums must cover
    gap_sigma_mps : sigma of a held velocity, per axis; its error is taken as constant in a gap
    max_gap_s : longest step between stamps that is not a gap
    """
    t_s, row = _with_gaps_filled(velocity.t_s, span_s, max_gap_s)
    recorded = row >= 0
    valid = np.zeros(len(t_s), dtype=bool)
    valid[recorded] = velocity.valid
    source, age_s = _held(t_s, valid)

    roll_rad, pitch_rad, heading_rad = (
        _completed(t_s, recorded, heading.t_s, getattr(heading, name), getattr(velocity, name))
        for name in ("roll_rad", "pitch_rad", "heading_rad")
    )
    bow, starboard, _ = leveled(velocity.velocity_body_mps[row[source]], roll_rad, pitch_rad)
    forward = np.sin(heading_rad) + 1j * np.cos(heading_rad)
    logged_mps = (bow - 1j * starboard) * forward
    return DeadReckoning(
        t_s=t_s,
        displacement_m=pairs(_running_sum(t_s, logged_mps)),
        displacement_jacobian=pairs(_harmonic_sums(t_s, logged_mps, forward)),
        gap_variance_m2=_gap_variance(t_s, valid, age_s, gap_sigma_mps, max_gap_s),
        heading_rad=heading_rad,
    )


def is_held(t_s: Float, knots_s: Float, held_s: Float) -> Bool:
    """Whether the velocity is held at instants (m,): for more than half of the second about each.

    Parameters
    ----------
    knots_s, held_s : (n,) s, and the running time during which it is held
    """
    after_s, before_s = (
        interpolate(t_s + aside_s, knots_s, held_s) for aside_s in (ASIDE_S, -ASIDE_S)
    )
    return np.asarray(after_s - before_s > ASIDE_S)


def vehicle_axes(heading: Heading, t_s: Float) -> tuple[Plane, Float]:
    """Horizontal (n, 3) and upward (n, 3) parts of the vehicle's axes at given instants."""
    place = bracket(t_s, heading.t_s)
    angles_rad = heading.roll_rad, heading.pitch_rad, heading.heading_rad
    return body_axes(*(blend(angle_rad, *place) for angle_rad in angles_rad))


def still_before_lock(motion: DeadReckoning, first_s: float) -> DeadReckoning:
    """The same sums for who does not know yet what the first velocity will be, and takes none.

    Parameters
    ----------
    first_s : instant of the first velocity with bottom lock
    """
    row = min(int(np.searchsorted(motion.t_s, first_s)), len(motion) - 1)
    displacement_m, displacement_jacobian = (
        motion.displacement_m.copy(),
        motion.displacement_jacobian.copy(),
    )
    displacement_m[:row], displacement_jacobian[:row] = (
        displacement_m[row],
        displacement_jacobian[row],
    )
    return replace(
        motion, displacement_m=displacement_m, displacement_jacobian=displacement_jacobian
    )


def _harmonic_sums(t_s: Float, velocity_mps: Plane, forward: Plane) -> Plane:
    """Running integral (n, 4) m of φ(ψ) i v, φ the harmonics of a deviation."""
    s, c, turned = forward.real, forward.imag, 1j * velocity_mps
    sums = np.empty((len(t_s), 4), dtype=complex)
    for column, shape in enumerate((s, c, 2 * s * c, (c - s) * (c + s))):
        sums[:, column] = _running_sum(t_s, shape * turned)
    return sums


def _completed(
    t_s: Float, recorded: Bool, knots_s: Float, by_compass: Float, at_velocity: Float
) -> Float:
    """An angle at every instant: the velocity's own where there is one, else the compass's."""
    angle_rad = np.empty(len(t_s))
    angle_rad[recorded] = at_velocity
    angle_rad[~recorded] = interpolate(t_s[~recorded], knots_s, by_compass)
    return angle_rad


def _with_gaps_filled(t_s: Float, span_s: tuple[float, float], step_s: float) -> tuple[Float, Int]:
    """Stamps with gaps filled every `step_s` from their beginning; row of each stamp or -1.

    Counting from the beginning keeps what came before independent of how long the gap will last.
    """
    begin = np.concatenate([[min(span_s[0], t_s[0])], t_s])
    end = np.concatenate([t_s, [max(span_s[1], t_s[-1])]])
    steps = np.maximum(np.ceil((end - begin) / step_s - 1e-9).astype(int) - 1, 0)
    running = np.arange(steps.sum()) - np.repeat(np.cumsum(steps) - steps, steps)
    filled = np.repeat(begin, steps) + (running + 1) * step_s
    ends = np.array([edge for edge in (begin[0], end[-1]) if not t_s[0] <= edge <= t_s[-1]])
    every = np.concatenate([t_s, filled, ends])
    row = np.concatenate([np.arange(len(t_s)), np.full(len(filled) + len(ends), -1)])
    order = np.argsort(every, kind="stable")
    return every[order], row[order]


def _held(t_s: Float, valid: Bool) -> tuple[Int, Float]:
    """For every instant the place of the valid sample that stands for it, and that sample's age."""
    place = np.where(valid, np.arange(len(t_s)), -1)
    last = np.maximum.accumulate(place)
    source = np.where(last >= 0, last, np.argmax(valid))
    return source, np.abs(t_s - t_s[source])


def _gap_variance(
    t_s: Float, valid: Bool, age_s: Float, gap_sigma_mps: float, max_gap_s: float
) -> Float:
    """Running sum of (σ_gap age)² over the stretches whose age passes `max_gap_s`."""

    def grown(age: Float) -> Float:
        return np.where(age > max_gap_s, (gap_sigma_mps * age) ** 2, 0.0)

    step = np.diff(t_s)
    forward = np.arange(1, len(t_s)) > np.argmax(valid)
    age_at_end = np.where(forward, age_s[:-1] + step, age_s[1:])
    growth = np.abs(grown(age_at_end) - grown(age_s[:-1]))
    return np.concatenate([[0.0], np.cumsum(growth)])


def _running_sum(t_s: Float, rate: Plane) -> Plane:
    """Trapezoids of `rate` (n,) over time, summed up from zero."""
    sums = np.zeros(len(rate), dtype=complex)
    np.cumsum(0.5 * np.diff(t_s) * (rate[1:] + rate[:-1]), out=sums[1:])
    return sums
