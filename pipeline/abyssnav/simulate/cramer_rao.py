# SPDX-License-Identifier: Apache-2.0
"""Posterior Cramér-Rao bound: no estimator can be better on average, with what a dive offers."""

from dataclasses import dataclass, field, replace

import numpy as np

from abyssnav.geometry import interpolate
from abyssnav.tables import Float, Int, Table

_EAST, _NORTH = 0, 1
#: States that every dive has, in this order: all but the position in units of their own prior
#: standard deviation.  The currents of water track and the beacons' follow.
_STATES = (
    "east", "north", "heading_bias", "sin", "cos", "sin2", "cos2", "heading_jump", "heading_slow",
    "scale", "mount", "slow_forward", "slow_starboard", "unknown_forward", "unknown_starboard",
    "heading_clock", "velocity_clock", "travel_time_clock", "sound", "sound_slow", "gradient",
    "depth", "lever_forward", "lever_starboard", "lever_down", "turn_around",
)  # fmt: skip
_PLACE = {name: row for row, name in enumerate(_STATES)}
_CURRENTS = len(_STATES)
#: Of each beacon: east, north, up, turn-around, slow bias.
_OF_A_BEACON = 5


@dataclass(frozen=True, eq=False)
class BeaconErrors(Table):
    """Standard deviations of what is wrong with each beacon, one row a beacon."""

    position_sigma_m: Float  #: (b, 3) east, north, up
    turn_around_sigma_s: Float
    slow_sigma_s: Float  #: of a slow bias of its times (Gauss-Markov)


@dataclass(frozen=True)
class Current:
    """A stretch of water track: the standard deviation of each axis of the water's velocity."""

    from_s: float
    until_s: float
    sigma_mps: float


@dataclass(frozen=True)
class ErrorModel:
    """Standard deviations of all that is wrong in a dive; 0 for what is not."""

    start_m: float  #: of each axis of the position at the track's beginning
    heading_bias_rad: float = 0.0
    harmonics_rad: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)  #: sin ψ, cos ψ, 2ψ
    heading_jump_rad: float = 0.0  #: what is added to the heading from `heading_jump_at_s` on
    heading_jump_at_s: float = 0.0
    heading_slow_rad: float = 0.0  #: Gauss-Markov
    heading_slow_time_s: float = 300.0
    velocity_scale: float = 0.0
    mount_rad: float = 0.0  #: the DVL's turn about the down axis
    velocity_slow_mps: float = 0.0  #: Gauss-Markov, forward and starboard
    velocity_slow_time_s: float = 300.0
    unknown_time_s: float = 600.0  #: for how long a velocity that nothing measures stays alike
    white_m2_per_s: float = 0.0  #: growth of each axis' variance by white noise of all sensors
    heading_clock_s: float = 0.0  #: constant offsets of the sensors' clocks
    velocity_clock_s: float = 0.0
    travel_time_clock_s: float = 0.0
    sound_speed_scale: float = 0.0  #: of k = c_used / c_true - 1
    sound_speed_slow: float = 0.0  #: of a slow part of k, Gauss-Markov
    sound_speed_slow_time_s: float = 1800.0
    gradient_per_s: float = 0.0  #: of the sound speed's gradient, about the depth below
    gradient_depth_m: float = 0.0
    depth_m: float = 0.0  #: bias of the depth sensor
    lever_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  #: forward, starboard, down
    turn_around_s: float = 0.0  #: common to all beacons: one clock
    range_slow_time_s: float = 600.0  #: correlation time of the beacons' slow biases
    currents: tuple[Current, ...] = ()
    beacons: BeaconErrors = field(
        default_factory=lambda: BeaconErrors(np.zeros((0, 3)), np.zeros(0), np.zeros(0))
    )


@dataclass(frozen=True, eq=False)
class TrueTrack(Table):
    """The true motion, densely."""

    t_s: Float
    position_enu_m: Float  #: (n, 3)
    heading_rad: Float  #: unwrapped
    gap_variance_m2: Float  #: running sum of what losses of bottom lock add to each axis
    unknown_mps: Float  #: standard deviation of a velocity that nothing measures yet, each axis


@dataclass(frozen=True, eq=False)
class TrueReplies(Table):
    """The replies that truly came straight, in the order received."""

    t_ping_s: Float
    t_reply_s: Float
    beacon: Int  #: row of `ErrorModel.beacons`; any number where that has no rows
    beacon_enu_m: Float  #: (n, 3)
    sound_speed_mps: Float  #: harmonic mean between vehicle and beacon
    sigma_s: Float  #: of the two-way time: 1 / √(Fisher information) where noise is not normal


@dataclass(frozen=True, eq=False)
class TruePositions(Table):
    """Position fixes of another kind: GNSS, USBL."""

    t_s: Float
    sigma_m: Float  #: of each axis


@dataclass(frozen=True, eq=False)
class Bound(Table):
    """Smallest possible covariance of the horizontal position over time."""

    t_s: Float
    filter_cov_m2: Float  #: (n, 2, 2) east, north: with what was received so far
    smoother_cov_m2: Float  #: (n, 2, 2): with the whole dive

    @property
    def filter_m(self) -> Float:
        """Smallest possible rms distance √(tr P) (n,) of a filter."""
        return np.asarray(np.sqrt(np.trace(self.filter_cov_m2, axis1=1, axis2=2)))

    @property
    def smoother_m(self) -> Float:
        """Smallest possible rms distance √(tr P) (n,) of a smoother."""
        return np.asarray(np.sqrt(np.trace(self.smoother_cov_m2, axis1=1, axis2=2)))

    def rms_m(self, from_s: float, until_s: float = np.inf) -> tuple[float, float]:
        """√(mean tr P) of filter and smoother between two instants."""
        counted = self[(self.t_s >= from_s) & (self.t_s <= until_s)]
        return (
            float(np.sqrt(np.mean(counted.filter_m**2))),
            float(np.sqrt(np.mean(counted.smoother_m**2))),
        )


@dataclass(frozen=True, eq=False)
class _Observations(Table):
    """Scalar observations: when, what of each state they hold, and how noisy they are."""

    t_s: Float
    H: Float  #: (m, N)
    variance: Float  #: of each


def posterior_bound(
    track: TrueTrack,
    replies: TrueReplies,
    model: ErrorModel,
    positions: TruePositions | None = None,
    step_s: float = 5.0,
) -> Bound:
    """Covariance recursion of the filter that knows the exact error model.

        P⁻ = F P Fᵀ + Q,    P = P⁻ - P⁻ Hᵀ (H P⁻ Hᵀ + σ²)⁻¹ H P⁻

    with F and H at the truth; its fixed-interval (RTS) form

        G = P Fᵀ (P⁻)⁻¹,    Pˢ = P + G (Pˢ_next - P⁻) Gᵀ

    is the smoother's.  For states that move linearly with Gaussian noise this is the posterior
    bound of P. Tichavský et al., IEEE Trans. Signal Processing 46 (1998), with its expectation
    over dives replaced by the dive at hand.  It is loose in long losses of bottom lock.

    Parameters
    ----------
    track : covers all pings and replies
    replies : at most one a beacon and ping
    positions : fixes of another kind
    step_s : between the rows of the result; short against the correlation times
    """
    grid_s = np.arange(track.t_s[0], track.t_s[-1] + 1e-9, step_s)
    prior, time_s = _prior(model), _correlation_times(model)
    known = prior > 0  # what cannot be wrong is no state
    observations = _observations(track, replies, model, positions)
    observed_s, instant = np.unique(observations.t_s, return_inverse=True)
    t_s = np.concatenate([grid_s, observed_s])
    order = np.argsort(t_s, kind="stable")
    transition, noise = _steps(t_s[order], track, model, time_s)
    transition, noise = transition[:, known][:, :, known], noise[:, known]
    start = np.diag(np.where(np.arange(len(prior)) < 2, prior**2, 1.0)[known])
    # observations of each instant, none for the rows of the result
    by_instant = np.split(np.argsort(instant, kind="stable"), np.cumsum(np.bincount(instant))[:-1])
    nothing = np.zeros(0, dtype=np.int64)
    rows = [nothing if k < len(grid_s) else by_instant[k - len(grid_s)] for k in order]
    observations = replace(observations, H=observations.H[:, known])
    predicted, filtered = _forward(transition, noise, observations, rows, start)
    smoothed = _backward(transition, predicted, filtered)
    on_grid = order < len(grid_s)
    return Bound(grid_s, filtered[on_grid, :2, :2], smoothed[on_grid, :2, :2])


def _prior(model: ErrorModel) -> Float:
    """Standard deviations (N,) of all states."""
    common = {
        "east": model.start_m,
        "north": model.start_m,
        "heading_bias": model.heading_bias_rad,
        **dict(zip(("sin", "cos", "sin2", "cos2"), model.harmonics_rad, strict=True)),
        "heading_jump": model.heading_jump_rad,
        "heading_slow": model.heading_slow_rad,
        "scale": model.velocity_scale,
        "mount": model.mount_rad,
        "slow_forward": model.velocity_slow_mps,
        "slow_starboard": model.velocity_slow_mps,
        "unknown_forward": 1.0,
        "unknown_starboard": 1.0,
        "heading_clock": model.heading_clock_s,
        "velocity_clock": model.velocity_clock_s,
        "travel_time_clock": model.travel_time_clock_s,
        "sound": model.sound_speed_scale,
        "sound_slow": model.sound_speed_slow,
        "gradient": model.gradient_per_s,
        "depth": model.depth_m,
        "lever_forward": model.lever_m[0],
        "lever_starboard": model.lever_m[1],
        "lever_down": model.lever_m[2],
        "turn_around": model.turn_around_s,
    }
    beacons = model.beacons
    rows = [beacons.position_sigma_m, beacons.turn_around_sigma_s, beacons.slow_sigma_s]
    return np.concatenate(
        [
            [common[name] for name in _STATES],
            np.repeat([current.sigma_mps for current in model.currents], 2),
            np.column_stack(rows).ravel(),
        ]
    )


def _correlation_times(model: ErrorModel) -> Float:
    """Of all states (N,); infinite for constants."""
    first_beacon = _CURRENTS + 2 * len(model.currents)
    time_s = np.full(first_beacon + _OF_A_BEACON * len(model.beacons), np.inf)
    time_s[_PLACE["heading_slow"]] = model.heading_slow_time_s
    time_s[[_PLACE["slow_forward"], _PLACE["slow_starboard"]]] = model.velocity_slow_time_s
    time_s[[_PLACE["unknown_forward"], _PLACE["unknown_starboard"]]] = model.unknown_time_s
    time_s[_PLACE["sound_slow"]] = model.sound_speed_slow_time_s
    time_s[first_beacon + _OF_A_BEACON - 1 :: _OF_A_BEACON] = model.range_slow_time_s
    return time_s


def _displacement_partials(track: TrueTrack, model: ErrorModel) -> Float:
    """Running sums (n, 2, N'): what one standard deviation of each state does to C(t).

    N' counts all states up to the last of the currents; the beacons' move nothing.
    """
    moved = np.diff(track.position_enu_m[:, :2], axis=0)
    heading = 0.5 * (track.heading_rad[1:] + track.heading_rad[:-1])
    step = np.diff(track.t_s)[:, None]
    turned = np.stack([-moved[:, 1], moved[:, 0]], axis=-1)
    middle_s = 0.5 * (track.t_s[1:] + track.t_s[:-1])
    unknown = 0.5 * (track.unknown_mps[1:] + track.unknown_mps[:-1])[:, None]
    ahead = -step * np.stack([np.sin(heading), np.cos(heading)], axis=-1)
    aside = -step * np.stack([np.cos(heading), -np.sin(heading)], axis=-1)
    jumped = (middle_s >= model.heading_jump_at_s)[:, None]
    rates = {
        "heading_bias": turned,
        "heading_jump": turned * jumped,
        "heading_slow": turned,
        "mount": turned,
        "sin": turned * np.sin(heading)[:, None],
        "cos": turned * np.cos(heading)[:, None],
        "sin2": turned * np.sin(2 * heading)[:, None],
        "cos2": turned * np.cos(2 * heading)[:, None],
        "scale": -moved,
        "slow_forward": ahead,
        "slow_starboard": aside,
        "unknown_forward": unknown * ahead,
        "unknown_starboard": unknown * aside,
        "heading_clock": -turned * np.diff(track.heading_rad)[:, None] / step,
        "velocity_clock": np.diff(moved / step, axis=0, prepend=moved[:1] / step[:1]),
    }
    partials = np.zeros((len(track), 2, _CURRENTS + 2 * len(model.currents)))
    for name, rate in rates.items():
        partials[1:, :, _PLACE[name]] = rate
    for number, current in enumerate(model.currents):
        inside = (middle_s >= current.from_s) & (middle_s < current.until_s)
        for axis in (_EAST, _NORTH):
            partials[1:, axis, _CURRENTS + 2 * number + axis] = step[:, 0] * inside
    return np.asarray(np.cumsum(partials * _prior(model)[: partials.shape[2]], axis=0))


def _steps(t_s: Float, track: TrueTrack, model: ErrorModel, time_s: Float) -> tuple[Float, Float]:
    """Transition F (m, N, N) into each instant and the diagonal (m, N) of its noise Q."""
    step_s = np.diff(t_s, prepend=t_s[0])
    partials = interpolate(t_s, track.t_s, _displacement_partials(track, model))
    moving = partials.shape[2]
    decay = np.exp(-step_s[:, None] / time_s)
    transition = decay[:, :, None] * np.eye(len(time_s))
    transition[:, :2, 2:moving] = np.diff(partials, axis=0, prepend=partials[:1])[:, :, 2:]
    noise = 1 - decay**2
    gap = interpolate(t_s, track.t_s, track.gap_variance_m2)
    noise[:, :2] = (model.white_m2_per_s * step_s + np.diff(gap, prepend=gap[0]))[:, None]
    return transition, noise


def _observations(
    track: TrueTrack, replies: TrueReplies, model: ErrorModel, positions: TruePositions | None
) -> _Observations:
    """Replies, and either axis of each position fix, as they come."""
    H = _sensitivity(track, replies, model)
    times, rows, variances = [replies.t_reply_s], [H], [replies.sigma_s**2]
    if positions is not None:
        for axis in (_EAST, _NORTH):
            times.append(positions.t_s)
            rows.append(np.zeros((len(positions), H.shape[1])))
            rows[-1][:, axis] = 1.0
            variances.append(positions.sigma_m**2)
    return _Observations(np.concatenate(times), np.concatenate(rows), np.concatenate(variances))


def _sensitivity(track: TrueTrack, replies: TrueReplies, model: ErrorModel) -> Float:
    """Rows H (r, N) of Eq. 3 at the truth, with respect to the state at the reply."""
    partials = _displacement_partials(track, model)
    moving, prior = partials.shape[2], _prior(model)
    velocity = np.gradient(track.position_enu_m, track.t_s, axis=0)
    rows = np.zeros((len(replies), len(prior)))
    during = interpolate(replies.t_reply_s, track.t_s, partials) - interpolate(
        replies.t_ping_s, track.t_s, partials
    )
    for at_ping, t_s in ((True, replies.t_ping_s), (False, replies.t_reply_s)):
        place = interpolate(t_s, track.t_s, track.position_enu_m)
        from_beacon = place - replies.beacon_enu_m
        range_m = np.linalg.norm(from_beacon, axis=-1)
        slope = from_beacon / (range_m * replies.sound_speed_mps)[:, None]
        if at_ping:
            rows[:, :moving] -= np.einsum("ri,rij->rj", slope[:, :2], during)
        rows[:, :2] += slope[:, :2]
        rows[:, _PLACE["depth"]] -= slope[:, 2]
        heading = interpolate(t_s, track.t_s, track.heading_rad)
        ahead = slope[:, 0] * np.sin(heading) + slope[:, 1] * np.cos(heading)
        aside = slope[:, 0] * np.cos(heading) - slope[:, 1] * np.sin(heading)
        lever = slice(_PLACE["lever_forward"], _PLACE["lever_down"] + 1)
        rows[:, lever] += np.stack([ahead, aside, -slope[:, 2]], axis=-1)
        # what each leg does to the states that only the acoustics know
        leg_s = range_m / replies.sound_speed_mps
        rows[:, [_PLACE["sound"], _PLACE["sound_slow"]]] += leg_s[:, None]
        depth_m = -0.5 * (place + replies.beacon_enu_m)[:, 2] - model.gradient_depth_m
        rows[:, _PLACE["gradient"]] += leg_s * depth_m / replies.sound_speed_mps
        along = np.sum(slope * interpolate(t_s, track.t_s, velocity), axis=-1)
        rows[:, _PLACE["travel_time_clock"]] += along
        _add_beacons(rows[:, moving:], replies.beacon, slope)
    rows[:, _PLACE["turn_around"]] = 1.0
    in_units = np.arange(len(prior)) >= _PLACE["travel_time_clock"]
    in_units[_CURRENTS:moving] = False  # those are in their units already
    return np.asarray(rows * np.where(in_units, prior, 1.0))


def _add_beacons(rows: Float, beacon: Int, slope: Float) -> None:
    """Add one leg's share of the beacons' own states to their part (r, 5 b) of the rows."""
    if rows.shape[1] == 0:
        return
    reply, first = np.arange(len(beacon)), _OF_A_BEACON * beacon
    for axis in range(3):
        rows[reply, first + axis] -= slope[:, axis]
    for delay in (3, 4):  # turn-around and slow bias come once, half with each leg
        rows[reply, first + delay] += 0.5


def _forward(
    transition: Float, noise: Float, observations: _Observations, rows: list[Int], start: Float
) -> tuple[Float, Float]:
    """Covariances before and after the observations `rows` of each instant."""
    predicted = np.empty_like(transition)
    filtered = np.empty_like(transition)
    P = start
    diagonal = np.arange(len(start))
    for j, F in enumerate(transition):
        P = F @ P @ F.T
        P[diagonal, diagonal] += noise[j]
        predicted[j] = P
        for row in rows[j]:
            h = observations.H[row]
            Ph = P @ h
            P = P - np.outer(Ph, Ph) / (h @ Ph + observations.variance[row])
        filtered[j] = P
    return predicted, filtered


def _backward(transition: Float, predicted: Float, filtered: Float) -> Float:
    smoothed = filtered.copy()
    for j in range(len(filtered) - 2, -1, -1):
        G = np.linalg.solve(predicted[j + 1], transition[j + 1] @ filtered[j]).T
        smoothed[j] += G @ (smoothed[j + 1] - predicted[j + 1]) @ G.T
    return smoothed
