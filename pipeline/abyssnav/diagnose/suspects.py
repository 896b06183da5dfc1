# SPDX-License-Identifier: Apache-2.0
"""From the smoother's hypotheses of beacons, clock and lever arm to a cause with its words."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from abyssnav.diagnose.beacon_place import along, locate
from abyssnav.diagnose.cause import Cause, Evidence, Mend, length
from abyssnav.diagnose.evidence import positioned_track
from abyssnav.diagnose.motion_causes import Case, lever_arm_cause
from abyssnav.diagnose.parameters import Suspicion, parameters_by_name
from abyssnav.diagnose.times_causes import common_wait_cause, several_moved_cause, with_place
from abyssnav.geometry import body_to_enu, interpolate
from abyssnav.tables import Dive, Float, Learned, Solution

#: What may be wrong, in a list of what cannot be told apart.
_WHAT = {
    "beacon_moved": "a beacon's place",
    "turn_around": "a turn-around time",
    "lever_arm": "the place of the transducer on the vehicle",
}
#: Where one of more beacons may be wrong, no place is told.
_PLACED = 2
#: Log prior of each hypothesis of the smoother's, which its gains hold.
_RARE = 3.0


def suspected_cause(solution: Solution, suspicion: Suspicion, case: Case) -> Cause:
    """The likeliest hypothesis, as large as the data say, and those that it cannot be told from."""
    gain = suspicion.gain + _RARE
    evidence = Evidence(gain, gain)
    observed = (
        f"The replies fit together only with {_WHAT[suspicion.name]} other than given "
        f"(probability {_in_percent(suspicion.probability)})."
    )
    vague = Cause(
        _ROLE[suspicion.name], suspicion.name, "", evidence, _VAGUE[suspicion.name], observed,
        doubt_words(suspicion),
    )  # fmt: skip
    learned = parameters_by_name(solution)
    if suspicion.name == "lever_arm":
        return lever_arm_cause(case, _arm_m(learned), evidence) or vague
    if len(suspicion.beacon_ids) > _PLACED:
        return vague
    if suspicion.beacon_ids:
        return _of_one_beacon(solution, suspicion, vague)
    if suspicion.name == "turn_around":
        return common_wait_cause(case.dive, learned["clock"][0].value, evidence) or vague
    moved_m = np.zeros((len(case.dive.beacons), 3))
    if solution.beacons is not None:
        moved_m = solution.beacons.position_enu_m - case.dive.beacons.position_enu_m
    return several_moved_cause(case.dive, moved_m, evidence) or vague


def _in_percent(probability: float) -> str:
    return "over 99 %" if probability > 0.99 else f"{100 * probability:.0f} %"


_ROLE = {"lever_arm": "travel_time", "turn_around": "beacons", "beacon_moved": "beacons"}
_VAGUE = {
    "lever_arm": Mend(
        "transducer_offset_m = [0.0, 0.0, 0.0]",
        "with the distances forward, starboard and down as measured on the vehicle under [vehicle] "
        "of the settings",
    ),
    "turn_around": Mend(
        "", "Check the turn-around times given against the beacons' configuration and data sheet"
    ),
    "beacon_moved": Mend(
        "",
        "Check the positions and turn-around times given, or let abyssnav calibrate survey the "
        "beacons from several dives",
    ),
}


def _of_one_beacon(solution: Solution, suspicion: Suspicion, vague: Cause) -> Cause:
    if suspicion.since_s is not None:
        return _moved_in_dive(suspicion.beacon_ids[0], suspicion.since_s, vague.evidence)
    best = positioned_track(solution)
    row = row_of_beacon(solution.dive, suspicion.beacon_ids[0])
    place = None if best is None else locate(solution.dive, row, along(best[1]))
    return vague if place is None else with_place(solution.dive, row, place, vague)


def row_of_beacon(dive: Dive, number: int) -> int:
    """Row of the dive's beacons that has this id."""
    return int(np.flatnonzero(dive.beacons.id == number)[0])


def _moved_in_dive(number: int, since_s: float, evidence: Evidence) -> Cause:
    """A beacon whose replies come from another place from an instant on."""
    observed = (
        f"From {length(since_s)} into the dive on, the replies of beacon {number} come from "
        "another place than before; the smoother takes it for another beacon from then on."
    )
    mend = Mend(
        "",
        f"Find out what moved beacon {number}, and survey it before the next dive; of this dive "
        "use the smoother's track",
    )
    doubt = "It was dragged or came loose during the dive."
    return Cause("beacons", "beacon_moved", f"beacon {number}", evidence, mend, observed, doubt)


def doubt_words(suspicion: Suspicion) -> str:
    """Which beacon it is, and what it may be instead."""
    words = list[str]()
    if len(suspicion.beacon_ids) == 1:
        words.append(f"It is beacon {suspicion.beacon_ids[0]}.")
    elif suspicion.beacon_ids:
        *others, last = (str(number) for number in suspicion.beacon_ids)
        words.append(f"It is one of beacons {', '.join(others)} and {last}.")
    rivals = [_WHAT[name] for name in suspicion.rivals if name in _WHAT]
    if rivals:
        words.append(f"It may as well be {' or '.join(rivals)}: the data cannot tell.")
    return " ".join(words)


def left_out_cause(solution: Solution, row: int, observed: str) -> Cause:
    """A beacon whose replies do not fit the track that the others make, and where it lies."""
    number = int(solution.dive.beacons.id[row])
    best = positioned_track(solution)
    place = None if best is None else locate(solution.dive, row, along(best[1]))
    cause = Cause(
        "beacons", "beacon_moved", f"beacon {number}", _LEFT_OUT,
        Mend("", f"Check position and turn-around time given for beacon {number}"), observed,
        "Its turn-around time may be wrong instead.",
    )  # fmt: skip
    return cause if place is None else with_place(solution.dive, row, place, cause)


_LEFT_OUT = Evidence(100.0, 100.0)


#: What was estimated to be wrong by more is no survey's error: it may be the track's.
_SURVEYED_M, _SURVEYED_S = 15.0, 0.02
#: Share by which a measured sound speed may be wrong.
_MEASURED = 0.005


def with_errors_estimated(solution: Solution) -> Dive:
    """The dive with beacons, turn-arounds, delay of all and lever arm as the smoother leaves them.

    As it is where they would have to be off by more than a survey can be.
    """
    dive, estimate = solution.dive, solution.beacons
    if estimate is None:
        return dive
    learned = parameters_by_name(solution)
    moved_m = estimate.position_enu_m - dive.beacons.position_enu_m
    late_s = estimate.turn_around_s - dive.beacons.turn_around_s + learned["clock"][0].value
    arm_m = _arm_m(learned)
    off_m = max(np.abs(moved_m).max(), np.abs(arm_m).max())
    if off_m > _SURVEYED_M or np.abs(late_s).max() > _SURVEYED_S:
        return dive
    replies, row = dive.replies, dive.replies.beacon
    known = row >= 0
    ping_m, reply_m = (_turned(arm_m, dive, t_s) for t_s in (replies.t_ping_s, replies.t_reply_s))
    return replace(
        dive,
        replies=replace(
            replies,
            lever_ping_enu_m=replies.lever_ping_enu_m + ping_m,
            lever_reply_enu_m=replies.lever_reply_enu_m + reply_m,
            beacon_enu_m=replies.beacon_enu_m + np.where(known[:, None], moved_m[row], 0.0),
            turn_around_s=replies.turn_around_s + np.where(known, late_s[row], 0.0),
        ),
    )


def with_sound_estimated(solution: Solution) -> Dive:
    """The dive with its travel times as they were, had sound the speed that it is given.

    As it is where that would be wrong by more than a measured profile can be.
    """
    dive, learned = solution.dive, solution.estimates.get("smoother")
    if learned is None or np.abs(learned.sound_speed_scale).max() > _MEASURED:
        return dive
    replies = dive.replies
    scale = interpolate(replies.t_reply_s, learned.t_s, learned.sound_speed_scale)
    flight_s = (replies.travel_time_s - replies.turn_around_s) / (1 + scale)
    return replace(dive, replies=replace(replies, travel_time_s=replies.turn_around_s + flight_s))


def _arm_m(learned: Mapping[str, list[Learned]]) -> Float:
    """Forward and starboard (2,), to be added to the arm as given."""
    return np.array([learned[f"lever_arm_{axis}"][0].value for axis in ("forward", "starboard")])


def _turned(arm_m: Float, dive: Dive, t_s: Float) -> Float:
    """An arm forward and starboard in a level vehicle, (n, 3) ENU at instants."""
    heading_rad = interpolate(t_s, dive.heading.t_s, dive.heading.heading_rad)
    level_rad = np.zeros(len(t_s))
    arms_m = np.broadcast_to([*arm_m, 0.0], (len(t_s), 3))
    return body_to_enu(arms_m, level_rad, level_rad, heading_rad)
