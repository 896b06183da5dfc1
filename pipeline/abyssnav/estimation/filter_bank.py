# SPDX-License-Identifier: Apache-2.0
"""Extended Kalman filters side by side: prediction and measurement; axis 0 is the hypotheses."""

from typing import NamedTuple

import numpy as np

from abyssnav.estimation.dive_states import (
    CLOCK,
    CURRENT_EAST,
    CURRENT_NORTH,
    FORWARD,
    GRADIENT,
    HEADING,
    LEVER,
    N_BEACON,
    N_COMMON,
    N_MOTION,
    N_NODE,
    OFFSET,
    SCALE,
    SOUND,
    SOUND_SCALE,
    STARBOARD,
)
from abyssnav.estimation.filter_events import Displacement, TimeEvents, Transitions
from abyssnav.geometry import Plane
from abyssnav.tables import Float

#: Places of the constants in a filter's state: the node's eight states come first.
_OFFSET, _SCALE, _SOUND_SCALE = N_NODE + OFFSET, N_NODE + SCALE, N_NODE + SOUND_SCALE
_GRADIENT, _CLOCK = N_NODE + GRADIENT, N_NODE + CLOCK
_DEVIATION = slice(N_NODE + 1, N_NODE + 5)
_LEVER = slice(N_NODE + LEVER.start, N_NODE + LEVER.stop)
_BEACON = N_NODE + N_COMMON
#: States that move the position: the node's, and the first six constants.
N_MOVING = N_NODE + N_MOTION


class Prediction(NamedTuple):
    """A travel time as each of h filters predicts it."""

    time_s: Float  #: (h,) flight time
    H: Float  #: (h, N) its gradient


def displace(
    x: Float, stretch: Displacement, mean: tuple[Float | float, Float | float, Float | float]
) -> tuple[Plane, Plane]:
    """True displacement (...) over a stretch, and its derivatives (..., 14) by the states.

        d = e^{iδ} (ΔC + Σ a_j L_j - (w_f - i w_s) A) / (1 + s) + c Δt,    δ = offset + ε

    with L the sums over the harmonics, A that of the direction ahead, w the DVL's slow error and c
    the velocity in the earth frame.  Exact in constant ε, offset and scale; the deviation enters to
    first order.

    Parameters
    ----------
    x : (..., 14) or more states
    stretch : one for all, or (...)
    mean : means over the stretch of ε and w as shares of their values in x, and that of c times Δt
    """
    heading, slow, current_s = mean
    turn = np.exp(1j * (x[..., HEADING] * heading + x[..., _OFFSET])) / (1.0 + x[..., _SCALE])
    by_deviation = turn[..., None] * stretch.deviation
    ahead = turn * (slow * stretch.ahead)
    moved = turn * stretch.displacement + (by_deviation * x[..., _DEVIATION]).sum(axis=-1)
    moved -= (x[..., FORWARD] - 1j * x[..., STARBOARD]) * ahead
    by = np.zeros((*moved.shape, N_MOVING), dtype=complex)
    by[..., HEADING] = (1j * heading) * moved
    by[..., FORWARD], by[..., STARBOARD] = -ahead, 1j * ahead
    by[..., CURRENT_EAST], by[..., CURRENT_NORTH] = current_s, 1j * current_s
    by[..., _OFFSET] = 1j * moved
    by[..., _DEVIATION] = by_deviation
    by[..., _SCALE] = moved / -(1.0 + x[..., _SCALE])
    current = x[..., CURRENT_EAST] + 1j * x[..., CURRENT_NORTH]
    return moved + current_s * current, by


def predict(x: Float, P: Float, stretch: Displacement, step: Transitions) -> None:
    """Move states (h, N) and covariances (h, N, N) over one step, in place (Eqs. 1 and 6).

        p⁻ = p + d,   P⁻ = F P Fᵀ + Q        F = [I, ∂d/∂x; 0, diag(a)]

    Only the rows and columns that change are touched: the position's, and those that fade.
    """
    d, by = displace(x, stretch, (step.heading, step.ahead, step.current_s))
    by[:, 0], by[:, 1] = 1.0, 1j
    J = by.view(np.float64).reshape(len(x), N_MOVING, 2).swapaxes(1, 2)
    fade = step.fade
    x[:, 2:N_NODE] *= fade
    x[:, 0] += d.real
    x[:, 1] += d.imag
    JP = J @ P[:, :N_MOVING]
    own = JP[:, :, :N_MOVING] @ J.swapaxes(1, 2)
    JP[:, :, 2:N_NODE] *= fade[:, None]
    P[:, 2:N_NODE] *= fade[:, :, None]
    P[:, :, 2:N_NODE] *= fade[:, None]
    P[:, :2] = JP
    P[:, :, :2] = JP.swapaxes(1, 2)
    P[:, :2, :2] = own
    P[:, :N_NODE, :N_NODE] += step.noise


def observe_time(x: Float, events: TimeEvents, i: int) -> Prediction:
    """Travel time of reply i as filters x (h, N) at the reply predict it, and its gradient (Eq. 3).

        T = (1 + k) Σ (1 - g z / c) ρ / c + τ_clock + τ_beacon,   ρ² = |p + l - b|² + height²

    over both legs, with p_p = p - d(since the ping); k the constant and the slow sound-speed scale,
    g the gradient's error, l the lever arm's, b the beacon.
    """
    stretch = events.since_ping.row(i)
    d, by = displace(x, stretch, (1.0, 1.0, stretch.duration_s))
    beacon = _BEACON + N_BEACON * int(events.beacon[i])
    b = x[:, beacon : beacon + N_BEACON]
    lever = x[:, _LEVER]
    away = np.empty((len(x), 2), dtype=complex)
    place = x[:, 0] + 1j * x[:, 1] - (b[:, 0] + 1j * b[:, 1])
    away[:, 0], away[:, 1] = place - d, place
    away += lever @ events.lever[i].T - events.virtual_beacon[i]
    height = events.height_m[i] + lever @ events.lever_up[i].T - b[:, 2:3]
    speed = events.speed_mps[i]
    square = away.real**2 + away.imag**2 + height**2
    reach = np.maximum(np.sqrt(square), 1e-9)
    above = events.above_reference_m[i] / speed
    thinner = 1.0 - x[:, _GRADIENT, None] * above
    leg = reach / speed
    slower = 1.0 + x[:, _SOUND_SCALE] + x[:, SOUND]
    time_s = (leg * thinner).sum(axis=1)
    factor = slower[:, None] * thinner / (reach * speed)
    slope = away.conj() * factor
    climb = height * factor
    both = slope.sum(axis=1)
    H = np.zeros_like(x)
    H[:, 2:N_MOVING] = -(slope[:, :1] * by[:, 2:]).real
    H[:, 0], H[:, 1] = both.real, -both.imag
    H[:, SOUND] = H[:, _SOUND_SCALE] = time_s
    H[:, _GRADIENT] = -slower * (leg @ above)
    H[:, _LEVER] = (slope @ events.lever[i]).real + climb @ events.lever_up[i]
    H[:, beacon], H[:, beacon + 1] = -both.real, both.imag
    H[:, beacon + 2] = -climb.sum(axis=1)
    H[:, _CLOCK] = H[:, beacon + 3] = 1.0
    return Prediction(slower * time_s + x[:, _CLOCK] + b[:, 3], H)
