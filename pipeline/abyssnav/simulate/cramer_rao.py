# SPDX-License-Identifier: Apache-2.0
"""Posterior Cramér-Rao bound: no estimator can be better on average, with what a dive offers."""

from dataclasses import dataclass

import numpy as np

from abyssnav.geometry import interpolate
from abyssnav.tables import Float, Int, Table

# State, each but the position in units of its own prior standard deviation:
# east, north | bias | sin ψ, cos ψ, sin 2ψ, cos 2ψ | slow heading | scale | misalignment |
# slow forward, slow starboard | sound speed
_SLOW_HEADING, _SLOW_VELOCITY, _SOUND = 7, slice(10, 12), 12


@dataclass(frozen=True)
class ErrorModel:
    """Standard deviations of all that is wrong in a dive; 0 for what is not."""

    travel_time_s: float  #: of the two-way time
    start_m: float  #: of each axis of the position at the track's beginning
    heading_bias_rad: float
    harmonics_rad: tuple[float, float, float, float]  #: of sin ψ, cos ψ, sin 2ψ, cos 2ψ
    heading_slow_rad: float  #: Gauss-Markov
    heading_slow_time_s: float
    velocity_scale: float
    misalignment_rad: float
    velocity_slow_mps: float  #: Gauss-Markov, forward and starboard
    velocity_slow_time_s: float
    white_m2_per_s: float  #: growth of each axis' variance from white noise of all sensors
    sound_speed_scale: float  #: of k = c_used / c_true - 1


@dataclass(frozen=True, eq=False)
class TrueTrack(Table):
    """The true motion, densely."""

    t_s: Float
    position_enu_m: Float  #: (n, 3)
    heading_rad: Float  #: unwrapped
    gap_variance_m2: Float  #: running sum of what losses of bottom lock add to each axis


@dataclass(frozen=True, eq=False)
class TrueReplies(Table):
    """The replies that truly came straight, in the order heard."""

    t_ping_s: Float
    t_reply_s: Float
    beacon_enu_m: Float  #: (n, 3)
    sound_speed_mps: Float  #: harmonic mean between vehicle and beacon


@dataclass(frozen=True, eq=False)
class Bound(Table):
    """Smallest possible horizontal error, √(tr P), over time."""

    t_s: Float
    filter_m: Float  #: with what was heard so far
    smoother_m: Float  #: with the whole dive

    def rms_m(self, from_s: float) -> tuple[float, float]:
        """√(mean tr P) of filter and smoother from `from_s` on."""
        late = self[self.t_s >= from_s]
        return float(np.sqrt(np.mean(late.filter_m**2))), float(
            np.sqrt(np.mean(late.smoother_m**2))
        )


def posterior_bound(
    track: TrueTrack, replies: TrueReplies, model: ErrorModel, step_s: float = 5.0
) -> Bound:
    """Covariance recursion of the filter that knows the exact error model.

        P⁻ = F P Fᵀ + Q,    P = P⁻ - P⁻ Hᵀ (H P⁻ Hᵀ + σ_t²)⁻¹ H P⁻

    with F and H at the truth; its fixed-interval (RTS) form

        G = P Fᵀ (P⁻)⁻¹,    Pˢ = P + G (Pˢ_next - P⁻) Gᵀ

    is the smoother's.  For states that move linearly with Gaussian noise this is the posterior
    bound of P. Tichavský et al., IEEE Trans. Signal Processing 46 (1998), with its expectation
    over dives replaced by the dive at hand.  It is loose in long losses of bottom lock.

    Parameters
    ----------
    track : covers all pings and replies
    replies : at most one a beacon and ping
    step_s : between the rows of the result; short against the correlation times
    """
    every_s = np.arange(track.t_s[0], track.t_s[-1] + 1e-9, step_s)
    t_s = np.concatenate([every_s, replies.t_reply_s])
    order = np.argsort(t_s, kind="stable")
    reply = np.concatenate([np.full(len(every_s), -1), np.arange(len(replies))])[order]
    t_s = t_s[order]

    prior = _prior(model)
    known = prior > 0  # what cannot be wrong is no state
    transition, noise = _steps(t_s, track, model)
    predicted, filtered = _forward(
        transition[:, known][:, :, known],
        noise[:, known],
        _sensitivity(track, replies, model)[:, known],
        reply,
        np.diag(np.where(np.arange(len(prior)) < 2, prior**2, 1.0)[known]),
        model.travel_time_s**2,
    )
    smoothed = _backward(transition[:, known][:, :, known], predicted, filtered)
    on_grid = reply < 0
    return Bound(t_s[on_grid], _distance(filtered[on_grid]), _distance(smoothed[on_grid]))


def _prior(model: ErrorModel) -> Float:
    return np.array(
        [
            model.start_m,
            model.start_m,
            model.heading_bias_rad,
            *model.harmonics_rad,
            model.heading_slow_rad,
            model.velocity_scale,
            model.misalignment_rad,
            model.velocity_slow_mps,
            model.velocity_slow_mps,
            model.sound_speed_scale,
        ]
    )


def _displacement_partials(track: TrueTrack, prior: Float) -> Float:
    """Running sums (n, 2, 13): what one standard deviation of each state does to C(t)."""
    moved = np.diff(track.position_enu_m[:, :2], axis=0)
    heading = 0.5 * (track.heading_rad[1:] + track.heading_rad[:-1])
    step = np.diff(track.t_s)[:, None]
    turned = np.stack([-moved[:, 1], moved[:, 0]], axis=-1)
    shapes = np.stack([f(k * heading) for k in (1, 2) for f in (np.sin, np.cos)], axis=-1)
    partials = np.zeros((len(track), 2, len(prior)))
    rates = partials[1:]
    for state in (2, _SLOW_HEADING, 9):  # bias, slow heading, misalignment: all turn the track
        rates[:, :, state] = turned
    rates[:, :, 3:7] = turned[:, :, None] * shapes[:, None, :]
    rates[:, :, 8] = -moved
    rates[:, :, 10] = -step * np.stack([np.sin(heading), np.cos(heading)], axis=-1)
    rates[:, :, 11] = -step * np.stack([np.cos(heading), -np.sin(heading)], axis=-1)
    return np.asarray(np.cumsum(partials * prior, axis=0))


def _steps(t_s: Float, track: TrueTrack, model: ErrorModel) -> tuple[Float, Float]:
    """Transition F (m, 13, 13) into each instant and the diagonal (m, 13) of its noise Q."""
    prior = _prior(model)
    step_s = np.diff(t_s, prepend=t_s[0])
    partials = interpolate(t_s, track.t_s, _displacement_partials(track, prior))
    decay = np.ones((len(t_s), len(prior)))
    decay[:, _SLOW_HEADING] = np.exp(-step_s / model.heading_slow_time_s)
    decay[:, _SLOW_VELOCITY] = np.exp(-step_s / model.velocity_slow_time_s)[:, None]
    transition = decay[:, :, None] * np.eye(len(prior))
    transition[:, :2, 2:] = np.diff(partials, axis=0, prepend=partials[:1])[:, :, 2:]
    noise = 1 - decay**2
    gap = interpolate(t_s, track.t_s, track.gap_variance_m2)
    noise[:, :2] = (model.white_m2_per_s * step_s + np.diff(gap, prepend=gap[0]))[:, None]
    return transition, noise


def _sensitivity(track: TrueTrack, replies: TrueReplies, model: ErrorModel) -> Float:
    """Rows H (r, 13) of Eq. 3 at the truth, with respect to the state at the reply."""
    prior = _prior(model)
    partials = _displacement_partials(track, prior)
    at_ping = interpolate(replies.t_ping_s, track.t_s, track.position_enu_m) - replies.beacon_enu_m
    at_reply = (
        interpolate(replies.t_reply_s, track.t_s, track.position_enu_m) - replies.beacon_enu_m
    )
    range_ping = np.linalg.norm(at_ping, axis=-1)
    range_reply = np.linalg.norm(at_reply, axis=-1)
    slope_ping = at_ping[:, :2] / (range_ping * replies.sound_speed_mps)[:, None]
    slope_reply = at_reply[:, :2] / (range_reply * replies.sound_speed_mps)[:, None]
    during = interpolate(replies.t_reply_s, track.t_s, partials) - interpolate(
        replies.t_ping_s, track.t_s, partials
    )
    rows: Float = -np.einsum("ri,rij->rj", slope_ping, during)
    rows[:, :2] = slope_ping + slope_reply
    rows[:, _SOUND] = prior[_SOUND] * (range_ping + range_reply) / replies.sound_speed_mps
    return rows


def _forward(
    transition: Float, noise: Float, rows: Float, reply: Int, start: Float, variance_s2: float
) -> tuple[Float, Float]:
    predicted = np.empty_like(transition)
    filtered = np.empty_like(transition)
    P = start
    diagonal = np.arange(len(start))
    for j, F in enumerate(transition):
        P = F @ P @ F.T
        P[diagonal, diagonal] += noise[j]
        predicted[j] = P
        if reply[j] >= 0:
            H = rows[reply[j]]
            PH = P @ H
            P = P - np.outer(PH, PH) / (H @ PH + variance_s2)
        filtered[j] = P
    return predicted, filtered


def _backward(transition: Float, predicted: Float, filtered: Float) -> Float:
    smoothed = filtered.copy()
    for j in range(len(filtered) - 2, -1, -1):
        G = np.linalg.solve(predicted[j + 1], transition[j + 1] @ filtered[j]).T
        smoothed[j] += G @ (smoothed[j + 1] - predicted[j + 1]) @ G.T
    return smoothed


def _distance(covariance: Float) -> Float:
    return np.asarray(np.sqrt(covariance[:, 0, 0] + covariance[:, 1, 1]))
