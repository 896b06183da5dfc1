# SPDX-License-Identifier: Apache-2.0
"""What the smoother had to learn of compass, DVL, times and beacons beyond what sound ones need.

The limits are those under which dives without a fault stay, on simulators with other sensors too.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from abyssnav.config import Config
from abyssnav.diagnose.cause import CERTAIN, Cause, Evidence, Mend, length
from abyssnav.diagnose.evidence import explained_by_beacon, misfit, positioned_track
from abyssnav.diagnose.motion_causes import (
    LEAST_TURN_DEG,
    Case,
    compass_drift_cause,
    deviation_cause,
    dvl_drift_cause,
    scaled_cause,
    turned_cause,
    water_track_cause,
)
from abyssnav.estimation.dive_states import deviation_shapes
from abyssnav.geometry import interpolate
from abyssnav.tables import VERDICTS, CauseWeight, Dive, Learned, Solution

#: Slow errors of sound sensors stay below: compass, DVL, and DVL over ground (or a current).
_COMPASS_DEG, _DVL_MPS, _GROUND_MPS = 1.5, 0.015, 0.012
#: ... and the compass's error stays within this, whatever its sigma: one that changes slower than
#: the dive lasts is learned as a large sigma of which the dive sees little.
_WANDER_DEG = 2 * _COMPASS_DEG
#: Beyond it, or where it lasts for longer than a DVL's own error does, it is the water that flows;
#: and beyond the last the DVL says nothing of the way made.
_CURRENT_MPS, _CURRENT_S, _NO_VELOCITY_MPS = 0.03, 600.0, 0.3
#: A compass whose error has this sigma, and wanders by twice that, says nothing of the course.
_NO_HEADING_DEG = 25.0
#: Largest deviation of a sound compass, and how well a larger one must be known to be told.
_DEVIATION_DEG, _KNOWN = 4.0, 0.25
#: Causes that compass or DVL read otherwise would be, and the share of the replies that a track
#: explains which contradicts them.
_READ_OTHERWISE = ("heading_sense", "heading_reference", "heading_unit", "dvl_frame")
_MOST_EXPLAINED = 0.55
#: Headings at which a deviation is looked for: every five degrees.
_EVERY_RAD = np.radians(np.arange(0.0, 360.0, 5.0))
#: No compass in a vehicle deviates so much, and no DVL with a lock is so wrong: axes taken
#: otherwise are learned as 20 degrees and more, or as velocities that have nothing to do with it.
_NO_COMPASS_DEG, _NO_DVL_MPS = 15.0, 0.1
#: Noise of the times over the stated one.
_NOISE_RATIO = 2.0
#: Constants: T = x² / (prior variance - posterior variance), about chi-square.
_CONSTANT_T = 12.0
#: Probability that something is wrong with beacons, clock or lever arm, from which on it is said;
#: and where nobody said how well the beacons are surveyed.
_PROBABLY_WRONG, _UNSTATED_WRONG = 0.6, 0.3
#: Log evidence of one hypothesis that is enough by itself: of a delay that all beacons share, which
#: shows only far from their middle, and of an arm that nobody gave, which shows only in turns.
#: Either is as likely as not; with the one in twenty of the gains this is seven to three.
_ENOUGH_GAIN = float(np.log(7.0 / 3.0)) - 3.0
#: That several beacons are off is so many nats likelier than one in twenty; nothing beyond these.
_SEVERAL, _MOST_NATS = 3.0, 50.0
#: What is this near to the likeliest cannot be told from it.
_CLOSE = 3.0
#: Share of the likeliest beacons, among which the wrong one is.
_AMONG = 0.9
#: Evidence of single ranges that noise of the stated size does not make.
_SMALL_GAIN = 7.0
#: Where no likelihood was computed.
_LEARNED = Evidence(8.0, 8.0)


class Suspicion(NamedTuple):
    """What is likeliest wrong with beacons, clock or lever arm by the smoother's hypotheses."""

    name: str  #: one of the contract's causes
    beacon_ids: tuple[int, ...]  #: among which it is, the likeliest first; none: all, or none
    probability: float  #: that any of the hypotheses is true
    gain: float  #: log evidence of the likeliest over that of nothing being wrong
    rivals: tuple[str, ...]  #: causes that the data cannot tell from it
    since_s: float | None = None  #: from when on, where not from the beginning


def parameters_by_name(solution: Solution) -> dict[str, list[Learned]]:
    """What the smoother learned, by name; of the beacons several."""
    by_name: dict[str, list[Learned]] = {}
    for one in solution.learned:
        by_name.setdefault(one.name, []).append(one)
    return by_name


def significance(parameter: Learned) -> float:
    """T = x² / (σ₀² - σ²) of a constant: how far beyond its prior the data pull it."""
    gained = parameter.prior_sigma**2 - parameter.sigma**2
    if gained < 0.05 * parameter.prior_sigma**2:
        return 0.0  # the data say nothing of it
    return (parameter.value - parameter.prior) ** 2 / gained


def overruled(solution: Solution, cause: Cause) -> bool:
    """Whether all replies together contradict a small cause that fixes or single ranges name.

    A DVL that errs for minutes looks like a current to few fixes.  A compass that drifts or steps
    looks like a current or a lever arm to dead reckoning with a fixed heading, and noisy times look
    like a lever arm; the smoother has all as parameters.  A deviation, or minutes of water track,
    may look like a DVL whose starboard is port, and fixes by a beacon that is displaced like those
    of a compass that turns the other way; either is learned as errors that no sensor has, or
    explains no replies.
    """
    learned = parameters_by_name(solution)
    if not learned:
        return False
    if cause.name == "water_track":
        over_ground = _over_ground(learned)
        if over_ground is None:
            return learned["slow_heading_sigma"][0].value > _COMPASS_DEG
        return over_ground.name == "noise"
    if cause.name in _READ_OTHERWISE or (_is_arm(cause) and not _arm_gains(solution)):
        return _are_a_sensors(solution, learned) and _explains_most(solution)
    if cause.name not in ("lever_arm", "turn_around", "beacon_moved", "sound_speed"):
        return False
    ratio = max(one.value / one.prior for one in learned["travel_time_sigma"])
    return ratio > _NOISE_RATIO and cause.gain < _SMALL_GAIN * ratio**2


def _is_arm(cause: Cause) -> bool:
    """Whether a cause stands for a lever arm, or for the late replies that look like one."""
    late = cause.name == "clock_offset" and cause.role == "travel_time"
    return cause.name == "lever_arm" or (late and cause.gain < CERTAIN.gain)


def _arm_gains(solution: Solution) -> bool:
    """Whether all replies together have any use for a lever arm."""
    return any(one.log_gain > 0 for one in solution.causes if one.name == "lever_arm")


def _explains_most(solution: Solution) -> bool:
    """Whether the track explains most replies of most beacons."""
    best = positioned_track(solution)
    if best is None:
        return False
    _, share = explained_by_beacon(solution.dive, misfit(solution.dive, best[1]))
    return bool(np.nanmedian(share) > _MOST_EXPLAINED)


def _are_a_sensors(solution: Solution, learned: Mapping[str, list[Learned]]) -> bool:
    """Whether compass and DVL err by no more than such instruments do, if badly."""
    offset_deg = abs(learned["heading_offset"][0].value)
    names = ("slow_dvl_velocity_sigma", "slow_earth_velocity_sigma")
    return (
        max(_deviation(learned)[0], offset_deg) < _NO_COMPASS_DEG
        and _wander_deg(solution, learned) < 2 * _NO_COMPASS_DEG
        and max(learned[name][0].value for name in names) < _NO_DVL_MPS
    )


def without_dead_reckoning(solution: Solution) -> str:
    """The sensor that says nothing of the way made between replies; empty where both do."""
    learned = parameters_by_name(solution)
    if not learned:
        return ""
    if learned["slow_earth_velocity_sigma"][0].value > _NO_VELOCITY_MPS:
        return "compass and DVL"
    drifts = learned["slow_heading_sigma"][0].value > _NO_HEADING_DEG
    lost = drifts and _wander_deg(solution, learned) > 2 * _NO_HEADING_DEG
    return "the compass" if lost else ""


class Stated(NamedTuple):
    """What the settings or the log say of the geometry."""

    arm: bool  #: where the transducer is
    beacons: bool  #: how well every beacon's position is known

    @classmethod
    def of_dive(cls, dive: Dive, config: Config) -> "Stated":
        """Of a dive and its settings."""
        vehicle = config.vehicle
        arm = vehicle.transducer_offset_m is not None or vehicle.transducer_sigma_m is not None
        return cls(arm, bool(np.all(dive.beacons.sigma_m > 0)))


def suspicion(causes: Sequence[CauseWeight], stated: Stated) -> Suspicion | None:
    """What is likeliest wrong with beacons, clock or lever arm; None where probably nothing is.

    The smoother's own weights serve its covariance; here each hypothesis has the prior of its log
    evidence, one in twenty, but that several beacons of no stated sigma are off is nothing rare:

        P = Σ_wrong e^(g + b) / (Σ_wrong e^(g + b) + Σ_right e^g)

    Parameters
    ----------
    causes : the smoother's hypotheses
    """
    wrong = [one for one in causes if one.name]
    if not wrong:
        return None
    odds = {one: np.exp(min(one.log_gain + _prior(one, stated), _MOST_NATS)) for one in wrong}
    right = sum(np.exp(one.log_gain) for one in causes if not one.name)
    probability = float(sum(odds.values()) / (sum(odds.values()) + right))
    plain = [one for one in wrong if _enough(one, stated)]
    probably = probability > (_PROBABLY_WRONG if stated.beacons else _UNSTATED_WRONG)
    if not (probably or plain):
        return None
    first = max(wrong if probably else plain, key=lambda one: one.log_gain)
    close = [one for one in wrong if one.log_gain > first.log_gain - _CLOSE and one is not first]
    rivals = tuple(dict.fromkeys(one.name for one in close if one.name != first.name))
    among = _among_beacons(odds, first)
    return Suspicion(first.name, among, probability, first.log_gain, rivals, first.since_s)


def _prior(one: CauseWeight, stated: Stated) -> float:
    """Log prior beyond one in twenty."""
    several = one.name == "beacon_moved" and one.beacon_id is None
    return _SEVERAL if several and not stated.beacons else 0.0


def _enough(one: CauseWeight, stated: Stated) -> bool:
    if one.beacon_id is not None:
        return False
    if one.name == "lever_arm":
        return not stated.arm and one.log_gain > _ENOUGH_GAIN
    return one.name == "turn_around" and one.log_gain > _ENOUGH_GAIN


def _among_beacons(odds: Mapping[CauseWeight, float], first: CauseWeight) -> tuple[int, ...]:
    """Ids of the beacons among which the wrong one is; none where it is all of them."""
    if first.beacon_id is None:
        return ()
    by_id: dict[int, float] = {}
    for one, share in odds.items():
        if one.beacon_id is not None:
            by_id[one.beacon_id] = by_id.get(one.beacon_id, 0.0) + share
    ranked = sorted(by_id, key=lambda number: -by_id[number])
    ranked.remove(first.beacon_id)
    ranked.insert(0, first.beacon_id)
    passed = np.cumsum([by_id[number] for number in ranked]) / sum(by_id.values())
    return tuple(ranked[: int(np.searchsorted(passed, _AMONG)) + 1])


def learned_causes(solution: Solution, config: Config) -> list[Cause]:
    """What is wrong with compass, DVL and times by the errors that the smoother had to learn."""
    learned = parameters_by_name(solution)
    if not learned:
        return []
    case = Case(solution.dive, config)
    causes = (
        _over_ground(learned),
        _compass(solution, learned),
        _dvl(learned["slow_dvl_velocity_sigma"][0].value),
        _offset(case, learned["heading_offset"][0]),
        _scale(learned["dvl_scale"][0]),
        _noisy_times(learned["travel_time_sigma"]),
        _slow_times(learned),
    )
    return [cause for cause in causes if cause is not None]


def _over_ground(learned: Mapping[str, list[Learned]]) -> Cause | None:
    sigma_mps, lasts_s = (
        learned[f"slow_earth_velocity_{name}"][0].value for name in ("sigma", "time")
    )
    if sigma_mps < _GROUND_MPS:
        return None
    if sigma_mps < _CURRENT_MPS and lasts_s < _CURRENT_S:
        return dvl_drift_cause(sigma_mps, _LEARNED)
    return water_track_cause(
        f"{sigma_mps:.2f} m/s", _LEARNED,
        "Whatever the heading, the beacons' replies drift against the DVL's velocity, by about "
        f"{sigma_mps:.2f} m/s in a part of the dive.",
    )  # fmt: skip


def _compass(solution: Solution, learned: Mapping[str, list[Learned]]) -> Cause | None:
    if learned["slow_heading_sigma"][0].value > _COMPASS_DEG:
        wander_deg = _wander_deg(solution, learned)
        if wander_deg > _WANDER_DEG:
            return compass_drift_cause(wander_deg, _LEARNED)
    most_deg, sigma_deg = _deviation(learned)
    if most_deg > _DEVIATION_DEG and sigma_deg < _KNOWN * most_deg:
        return deviation_cause(most_deg, _LEARNED)
    return None


def _wander_deg(solution: Solution, learned: Mapping[str, list[Learned]]) -> float:
    """Between the extremes of the compass's error in the dive, its deviation left out."""
    error, compass = solution.estimates["smoother"], solution.dive.heading
    heading_rad = interpolate(error.t_s, compass.t_s, compass.heading_rad)
    deviation_deg = deviation_shapes(heading_rad) @ [one.value for one in _harmonics(learned)]
    return float(np.ptp(np.degrees(error.heading_error_rad) - deviation_deg))


def _deviation(learned: Mapping[str, list[Learned]]) -> tuple[float, float]:
    """Largest deviation on any heading, degrees, and its sigma."""
    shapes, harmonics = deviation_shapes(_EVERY_RAD), _harmonics(learned)
    deviation_deg = shapes @ [one.value for one in harmonics]
    most = int(np.argmax(np.abs(deviation_deg)))
    sigma_deg = np.sqrt(shapes[most] ** 2 @ [one.sigma**2 for one in harmonics])
    return float(abs(deviation_deg[most])), float(sigma_deg)


def _harmonics(learned: Mapping[str, list[Learned]]) -> list[Learned]:
    """Sine and cosine of the heading, then of twice the heading."""
    return [learned[f"deviation_{wave}_{k}"][0] for k in (1, 2) for wave in ("sin", "cos")]


def _dvl(sigma_mps: float) -> Cause | None:
    return dvl_drift_cause(sigma_mps, _LEARNED) if sigma_mps > _DVL_MPS else None


def _offset(case: Case, offset: Learned) -> Cause | None:
    if significance(offset) < _CONSTANT_T or abs(offset.value) < LEAST_TURN_DEG:
        return None
    return turned_cause(case, offset.value, _LEARNED)


def _scale(scale: Learned) -> Cause | None:
    if significance(scale) < _CONSTANT_T:
        return None
    return scaled_cause(1 / (1 + scale.value), _LEARNED)


def _noisy_times(sigmas: Sequence[Learned]) -> Cause | None:
    worst = max(sigmas, key=lambda one: one.value / one.prior)
    if worst.value < _NOISE_RATIO * worst.prior:
        return None
    return Cause(
        "travel_time", "noise", f"{1e3 * worst.value:.1f} ms", _LEARNED,
        Mend(f"travel_time_sigma_s = {worst.value:.4f}", "under [acoustics] of the settings"),
        f"The travel times of beacon {worst.beacon_id} scatter by {1e3 * worst.value:.1f} ms, "
        f"where {1e3 * worst.prior:.1f} ms are stated.",
        "It is the travel times.",
    )  # fmt: skip


def _slow_times(learned: Mapping[str, list[Learned]]) -> Cause | None:
    if "slow_travel_time_sigma" not in learned:
        return None
    sigma, time = (learned[f"slow_travel_time_{name}"][0] for name in ("sigma", "time"))
    if sigma.value < sigma.prior:
        return None
    return Cause(
        "travel_time", "noise", f"{1e3 * sigma.value:.1f} ms", _LEARNED,
        Mend(
            "",
            "Look for echoes close behind the direct path, and for a detection that shifts with "
            "the level; of this dive use the smoother's track, whose 95 % radius counts it",
        ),
        f"The travel times of each beacon are wrong by about {1e3 * sigma.value:.1f} ms for "
        f"{length(time.value)} at a time.",
        "It is the travel times.",
    )  # fmt: skip


def needs_detective(solution: Solution, stated: Stated) -> bool:
    """Whether anything in what the smoother learned is unusual enough to look for a cause.

    Each limit is below that of `learned_causes`, which is asked in any case; of a deviation its
    components are looked at one by one, not their amplitude.
    """
    learned = parameters_by_name(solution)
    if not learned or not solution.causes:
        return True
    unusual = (
        learned["slow_earth_velocity_sigma"][0].value > 0.6 * _GROUND_MPS,
        learned["slow_heading_sigma"][0].value > 0.6 * _COMPASS_DEG,
        learned["slow_dvl_velocity_sigma"][0].value > 0.8 * _DVL_MPS,
        max(one.value / one.prior for one in learned["travel_time_sigma"]) > 0.85 * _NOISE_RATIO,
        any(significance(learned[name][0]) > 9.0 for name in _CONSTANTS),
        any(abs(one.value) > 3 * one.prior_sigma for name in _ARMS for one in learned[name]),
        suspicion(solution.causes, stated) is not None,
        _gates_unwell(solution),
    )
    return any(unusual)


_CONSTANTS = ("heading_offset", "dvl_scale", "sound_speed_scale", "clock")
_ARMS = (
    "lever_arm_forward", "lever_arm_starboard", "deviation_sin_1", "deviation_cos_1",
    "deviation_sin_2", "deviation_cos_2",
)  # fmt: skip
#: Names of gate verdicts under which a method does not see what is wrong, and their share.
_UNWELL, _UNWELL_SHARE = ("starving", "captured"), 0.1


def _gates_unwell(solution: Solution) -> bool:
    codes = [VERDICTS.index(name) for name in _UNWELL]
    return any(
        len(solution.watch[method])
        and float(np.mean(np.isin(solution.watch[method].verdict, codes))) > _UNWELL_SHARE
        for method in ("smoother", "ekf")
        if method in solution.watch
    )
