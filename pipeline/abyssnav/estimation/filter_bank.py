# SPDX-License-Identifier: Apache-2.0
"""Motion and travel times as h filters predict them; axis 0 is the hypotheses, axis 1 events."""

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
from abyssnav.estimation.filter_events import Displacement, Steps, TimeEvents
from abyssnav.estimation.kalman import Transition, running_sums
from abyssnav.geometry import Plane, pairs
from abyssnav.tables import Float

#: Places of the constants in a filter's state: the node's eight states come first.
_OFFSET, _SCALE, _SOUND_SCALE = N_NODE + OFFSET, N_NODE + SCALE, N_NODE + SOUND_SCALE
_GRADIENT, _CLOCK = N_NODE + GRADIENT, N_NODE + CLOCK
_DEVIATION = slice(N_NODE + 1, N_NODE + 5)
_LEVER = slice(N_NODE + LEVER.start, N_NODE + LEVER.stop)
_BEACON = N_NODE + N_COMMON
#: A step over which more fades is no part of a block; it may only fill one up.
_LEAST_FADE = 0.1
#: States that move the position: the node's, and the first six constants.
N_MOVING = N_NODE + N_MOTION


class Motion(NamedTuple):
    """States of h filters at k events, as predicted from those before the first."""

    x: Float  #: (h, k, N)
    to_first: Transition  #: the step to the first event
    first_noise: Float  #: (h, 8, 8) of the node's states over that step
    transition: Transition  #: from the first event to each
    noise: Float  #: (h, k, 8, 8) since the first event, in terms of the states there


class Prediction(NamedTuple):
    """Travel times as each of h filters predicts them."""

    time_s: Float  #: (h, k) flight time
    H: Float  #: (h, k, N) gradients by the state at the reply


def displace(
    x: Float, stretch: Displacement, mean: tuple[Float | float, Float | float, Float | float]
) -> tuple[Plane, Plane]:
    """True displacement (...) over a stretch, and its derivatives (..., 14) by the states.

        d = e^{iδ} (ΔC + Σ a_j L_j - (w_f - i w_s) A) / (1 + s) + c Δt,    δ = offset + ε

    with L the sums over the harmonics, a their amplitudes, A that of the direction ahead, w the
    DVL's slow error, s its scale and c the velocity in the earth frame.  Exact in constant ε,
    offset and scale; the deviation enters to first order.

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


def move(x: Float, stretch: Displacement, step: Steps) -> Motion:
    """States (h, N) carried over k steps to k events.

        p_j = p + Σ d_i,   ∂p_j/∂x_1 = Σ (∂d_i/∂x_{i-1}) F_{i-1},   1 < i <= j

    and noise u_i ~ Q_i of a step is, at the first event, F_i⁻¹ u_i.
    """
    fade = np.maximum(step.fade, _LEAST_FADE)
    fade[:, 0] = 1.0
    np.cumprod(fade, axis=1, out=fade)
    before = np.ones_like(fade)
    before[:, 1:] = fade[:, :-1] * step.fade[:, :1]
    xs = np.repeat(x[:, None], fade.shape[1], axis=1)
    xs[:, :, 2:N_NODE] *= before
    d, by = displace(xs, stretch, (step.heading, step.ahead, step.current_s))
    first = Transition(_rows(by[:, :1].copy())[:, 0], step.fade[:, 0])
    by[:, 0] = 0.0
    by[:, 1:, 2:N_NODE] *= fade[:, :-1]
    J = _rows(running_sums(pairs(by)).view(complex)[..., 0])
    xs[:, :, :2] += running_sums(pairs(d))
    xs[:, :, 2:N_NODE] = x[:, None, 2:N_NODE] * step.fade[:, :1] * fade
    so_far = _noise_so_far(step.noise, J, fade)
    return Motion(xs, first, step.noise[:, 0], Transition(J, fade), so_far)


def _rows(by: Plane) -> Float:
    """Rows (h, k, 2, 14) of the position, from derivatives (h, k, 14) of the displacement."""
    by[:, :, 0], by[:, :, 1] = 1.0, 1j
    by = np.ascontiguousarray(by)
    return by.view(np.float64).reshape(*by.shape, 2).swapaxes(2, 3)


def _diagonal(matrices: Float) -> Float:
    """Diagonals (h, k, n) of matrices (h, k, n, n), to be written to."""
    return np.asarray(np.einsum("hkii->hki", matrices))


def _noise_so_far(noise: Float, J: Float, fade: Float) -> Float:
    """Σ F_i⁻¹ Q_i F_i⁻ᵀ (h, k, 8, 8) after the first step; F⁻¹ = [I -J/a; 0 1/a], a what fades."""
    back = np.zeros_like(noise)
    if noise.shape[1] == 1:
        return back
    _diagonal(back)[:, :, :2] = 1.0
    _diagonal(back)[:, :, 2:] = 1 / fade
    back[:, :, :2, 2:] = J[:, :, :, 2:N_NODE] * (-1 / fade[:, :, None])
    total = back @ noise @ back.swapaxes(2, 3)
    total[:, 0] = 0.0
    return running_sums(total)


def refer_to_first(prediction: Prediction, transition: Transition) -> Float:
    """Gradients (h, k, N) by the state at the first event: H_j F_j."""
    J, fade = transition
    H = prediction.H.copy()
    H[:, :, 2:N_NODE] *= fade
    H[:, :, 2:N_MOVING] += (H[:, :, None, :2] @ J)[:, :, 0, 2:]
    return H


def observe_times(x: Float, events: TimeEvents) -> Prediction:
    """Travel times of k replies as filters x (h, k, N), constants alike, predict them (Eq. 3).

        T = (1 + k) Σ (1 - g z / c) ρ / c + τ_clock + τ_beacon,   ρ² = |p + l - b|² + height²

    over both legs, with p_p = p - d(since the ping); k the constant and the slow sound-speed scale,
    g the gradient's error, z how far the leg's mean depth lies below the reference, l the lever
    arm's error, b the beacon.
    """
    stretch = events.since_ping
    d, by = displace(x, stretch, (1.0, 1.0, stretch.duration_s))
    event = np.arange(len(events.t_s))
    beacon = _BEACON + N_BEACON * events.beacon
    b = x[:, event[:, None], beacon[:, None] + np.arange(N_BEACON)]
    lever, shape = x[:, 0, _LEVER], (len(x), *events.height_m.shape)
    by_lever = (lever @ events.lever.reshape(-1, 3).T).reshape(shape)
    up_by_lever = (lever @ events.lever_up.reshape(-1, 3).T).reshape(shape)
    place = x[..., 0] + 1j * x[..., 1] - (b[..., 0] + 1j * b[..., 1])
    away = np.stack([place - d, place], axis=-1)
    away += by_lever - events.virtual_beacon
    height = events.height_m + up_by_lever - b[..., 2:3]
    reach = np.sqrt(away.real**2 + away.imag**2 + height**2)
    np.maximum(reach, 1e-9, out=reach)
    below_s = events.below_reference_m / events.speed_mps
    gradient_factor = 1.0 - x[..., _GRADIENT, None] * below_s
    leg = reach / events.speed_mps
    delayed = leg * gradient_factor
    slower = 1.0 + x[..., _SOUND_SCALE] + x[..., SOUND]
    time_s = delayed[..., 0] + delayed[..., 1]
    factor = slower[..., None] * gradient_factor / (reach * events.speed_mps)
    slope, climb = away.conj() * factor, height * factor
    both = slope[..., 0] + slope[..., 1]
    H = np.zeros_like(x)
    H[..., 2:N_MOVING] = -(slope[..., :1] * by[..., 2:]).real
    H[..., 0], H[..., 1] = both.real, -both.imag
    H[..., SOUND] = H[..., _SOUND_SCALE] = time_s
    deep = leg * below_s
    H[..., _GRADIENT] = -slower * (deep[..., 0] + deep[..., 1])
    H[..., _LEVER] = _by_lever(slope, climb, events)
    H[:, event, beacon], H[:, event, beacon + 1] = -both.real, both.imag
    H[:, event, beacon + 2] = -(climb[..., 0] + climb[..., 1])
    H[..., _CLOCK] = H[:, event, beacon + 3] = 1.0
    return Prediction(slower * time_s + x[..., _CLOCK] + b[..., 3], H)


def _by_lever(slope: Plane, climb: Float, events: TimeEvents) -> Float:
    """Derivatives (h, k, 3) of the times by the lever arm: Σ Re(slope l) + climb l_up over legs."""
    by_axes = np.concatenate([slope.real, -slope.imag, climb], axis=2).swapaxes(0, 1)
    axes = np.concatenate([events.lever.real, events.lever.imag, events.lever_up], axis=1)
    return np.asarray((by_axes @ axes).swapaxes(0, 1))
