# SPDX-License-Identifier: Apache-2.0
"""What compass, DVL and sound do wrong, as eleven states: displacement and travel time by them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from abyssnav.acoustics.travel_time import Legs, slant_range
from abyssnav.estimation.dead_reckoning import Motion
from abyssnav.geometry import Plane, pairs, plane
from abyssnav.tables import Float, Table

#: Order of the states: position, heading error ε, DVL scale s, sound-speed scale k; the compass
#: deviation's harmonics a₁ sin ψ + b₁ cos ψ + a₂ sin 2ψ + b₂ cos 2ψ; and, forward and starboard,
#: what the velocity lacks that is held while bottom lock is lost.
EAST, NORTH, HEADING, SCALE, SOUND = range(5)
DEVIATION, HELD = slice(5, 9), slice(9, 11)
#: States in which the displacement is linear.
LINEAR = slice(5, 11)
N_STATES = 11
_BLOCK = 1 << 12


class ErrorModel(NamedTuple):
    """Priors of the states and process noise."""

    start_sigma_m: float
    position_m2_per_s: float
    heading_sigma_rad: float
    heading_time_s: float  #: Gauss-Markov, e-folding
    dvl_scale_sigma: float
    sound_scale_sigma: float
    deviation_sigma_rad: tuple[float, float]  #: first and second harmonic
    held_sigma_mps: float  #: Gauss-Markov
    held_time_s: float

    def prior_variance(self) -> Float:
        """Diagonal of P₀ (11,)."""
        first, second = self.deviation_sigma_rad
        sigma = [
            self.start_sigma_m, self.start_sigma_m, self.heading_sigma_rad, self.dvl_scale_sigma,
            self.sound_scale_sigma, first, first, second, second,
            self.held_sigma_mps, self.held_sigma_mps,
        ]  # fmt: skip
        return np.array(sigma) ** 2


@dataclass(frozen=True, eq=False)
class Steps(Table):
    """What the filter needs of every usable reply, prepared in columns."""

    t_s: Float  #: reply heard
    run_m: Float  #: (n, 2) dead reckoning's running sum C
    linear_m: Float  #: (n, 6, 2) its running sums over harmonics and held stretches
    since_ping_m: Float  #: (n, 2) ΔC from ping to reply
    linear_since_ping_m: Float  #: (n, 6, 2)


def steps(motion: Motion, t_ping_s: Float, t_reply_s: Float) -> Steps:
    """Running sums at every reply and their growth since its ping."""
    at_ping, at_reply = motion.at(t_ping_s), motion.at(t_reply_s)
    return Steps(
        t_s=t_reply_s,
        run_m=at_reply.displacement_m,
        linear_m=at_reply.linear_m,
        since_ping_m=at_reply.displacement_m - at_ping.displacement_m,
        linear_since_ping_m=at_reply.linear_m - at_ping.linear_m,
    )


def displacement(x: Float, run_m: Float, linear_m: Float) -> tuple[Float, Float]:
    """True displacement behind a reckoned one, and its derivatives by the states.

    The compass reads true + ε + deviation(ψ), the DVL (1 + s) · true, hence

        d = R(ε) (ΔC + Σ_j a_j ΔC_j) / (1 + s)
        ∂d/∂ε = (-d_n, d_e),   ∂d/∂s = -d / (1 + s),   ∂d/∂a_j = R(ε) ΔC_j / (1 + s)

    with R(ε) the counter-clockwise rotation and a the six linear states.  Exact in a constant ε
    and in s; the deviation enters to first order.

    Parameters
    ----------
    x : (..., 11) states
    run_m : (..., 2) ΔC
    linear_m : (..., 6, 2) ΔC_j

    Returns
    -------
    d_m, by_state : (..., 2) m and (..., 2, 11)
    """
    turn, linear = turned(x), plane(linear_m)
    by_linear = turn[..., None] * linear
    d = turn * plane(run_m) + np.einsum("...j,...j->...", by_linear, x[..., LINEAR])
    by_state = np.zeros((*d.shape, N_STATES), dtype=complex)
    by_state[..., HEADING] = 1j * d
    by_state[..., SCALE] = -d / (1 + x[..., SCALE])
    by_state[..., LINEAR] = by_linear
    return pairs(d), np.swapaxes(pairs(by_state), -1, -2)


def reckoned(x: Float, run_m: Float, linear_m: Float) -> Float:
    """True displacement (..., 2) m alone; see `displacement`."""
    total = plane(run_m) + np.einsum("...j,...j->...", plane(linear_m), x[..., LINEAR])
    return pairs(turned(x) * total)


def turned(x: Float) -> Plane:
    """R(ε) / (1 + s) (...) as a complex factor."""
    return np.asarray(np.exp(1j * x[..., HEADING]) / (1 + x[..., SCALE]))


def observe(x: Float, steps_of: Steps, legs: Legs) -> tuple[Float, Float]:
    """Flight time predicted from the states at the reply, and its derivatives (Eq. 3).

        h = (1 + k) (ρ_p / c_p + ρ_r / c_r),    p_p = p - d(ε, s, a; ΔC since the ping)
        ∂h/∂p = g_p + g_r,   ∂h/∂(ε, s, a) = -g_p · ∂d/∂(ε, s, a),   ∂h/∂k = h / (1 + k)

    with g = (1 + k) (p - b) / (c ρ) of each leg.

    Parameters
    ----------
    x : (n, 11) states at the replies
    steps_of, legs : n rows

    Returns
    -------
    h_s, H : (n,) s and (n, 11)
    """
    turn, linear = turned(x), plane(steps_of.linear_since_ping_m)
    d = turn * (plane(steps_of.since_ping_m) + np.einsum("nj,nj->n", linear, x[:, LINEAR]))
    reply = plane(x[:, :2]) - plane(legs.aim_reply_m)
    ping = plane(x[:, :2]) - d - plane(legs.aim_ping_m)
    range_ping_m = slant_range(pairs(ping), legs.height_ping_m)
    range_reply_m = slant_range(pairs(reply), legs.height_reply_m)
    time_s = range_ping_m / legs.speed_ping_mps + range_reply_m / legs.speed_reply_mps
    slower = 1 + x[:, SOUND]
    back = np.conj(ping) * (slower / (range_ping_m * legs.speed_ping_mps))
    H = np.empty((len(x), N_STATES))
    H[:, :2] = pairs(np.conj(back) + reply * (slower / (range_reply_m * legs.speed_reply_mps)))
    H[:, HEADING], H[:, SCALE] = (back * d).imag, (back * d).real / (1 + x[:, SCALE])
    H[:, SOUND] = time_s
    H[:, LINEAR] = -((back * turn)[:, None] * linear).real
    return slower * time_s, H


def fading(dt_s: Float, sigma: float, time_s: float) -> tuple[Float, Float]:
    """Gauss-Markov factor a = exp(-Δt / τ) and noise σ² (1 - a²) over each step."""
    a = np.exp(-dt_s / time_s)
    return a, sigma**2 * (1 - a * a)


def deviation(x: Float, heading_rad: Float) -> Float:
    """What the compass reads too much: ε + a₁ sin ψ + b₁ cos ψ + a₂ sin 2ψ + b₂ cos 2ψ (n,) rad."""
    shapes = [f(k * heading_rad) for k in (1, 2) for f in (np.sin, np.cos)]
    return np.asarray(
        x[..., HEADING] + np.sum(x[..., DEVIATION] * np.stack(shapes, axis=-1), axis=-1)
    )


def carry_states(
    t_nodes_s: Float, x: Float, P: Float, motion: Motion, here: Motion, model: ErrorModel
) -> tuple[Float, Float, Float]:
    """Positions, covariances and true headings at any times, from the last states before each.

    Parameters
    ----------
    t_nodes_s, x, P : (n,) s, (n, 11), (n, 11, 11)
    here : m rows of `motion` at those times, none before the first node

    Returns
    -------
    position_m, position_cov_m2, heading_rad : (m, 2), (m, 2, 2), (m,)
    """
    there = motion.at(t_nodes_s)

    def carried(here: Motion) -> tuple[Float, Float, Float]:
        last = np.searchsorted(t_nodes_s, here.t_s, side="right") - 1
        states = x[last]
        d_m, J = displacement(
            states,
            here.displacement_m - there.displacement_m[last],
            here.linear_m - there.linear_m[last],
        )
        J[:, 0, EAST] = J[:, 1, NORTH] = 1.0
        grown_m2 = model.position_m2_per_s * (here.t_s - t_nodes_s[last])
        return (
            states[:, :2] + d_m,
            J @ P[last] @ np.swapaxes(J, 1, 2) + grown_m2[:, None, None] * np.eye(2),
            here.heading_rad - deviation(states, here.heading_rad),
        )

    return in_blocks(carried, here)


def in_blocks(
    work: Callable[[Motion], tuple[Float, Float, Float]], here: Motion
) -> tuple[Float, Float, Float]:
    """Columns that `work` makes of the rows, some thousand at a time.

    The covariances behind a day's output would take a hundred megabytes at once, and no cache
    holds them.
    """
    parts = [work(here[i : i + _BLOCK]) for i in range(0, max(len(here), 1), _BLOCK)]
    position_m, cov_m2, heading_rad = (
        np.concatenate(columns) for columns in zip(*parts, strict=True)
    )
    return position_m, cov_m2, heading_rad
