# SPDX-License-Identifier: Apache-2.0
"""Reasons in the surveyor's words: what was seen, the likeliest cause, what to do."""

from collections.abc import Sequence

import numpy as np

from abyssnav.diagnose.cause import MEANING, length
from abyssnav.diagnose.clocks import Loss
from abyssnav.diagnose.evidence import Stretches
from abyssnav.tables import CauseWeight, Dive, Reason


def percent(share: float) -> str:
    """A share in whole percent."""
    return f"{100 * share:.0f} %"


def sensor_lost(loss: Loss) -> Reason:
    """A sensor stopped before the last reply, or began after the first."""
    when = "stops" if loss.at_end else "begins only"
    other = "before the last reply" if loss.at_end else "after the first reply"
    return Reason(
        "sensor_lost",
        f"The {loss.sensor} sensor was off, failed, or was not recorded for part of the dive.",
        f"The {loss.sensor} record {when} {length(loss.length_s)} {other}, "
        f"{percent(loss.share)} of the time in which beacons answered.",
        "Look for the missing part of the recording; if there is none, trust that part of the "
        "track only where beacons answered often.",
    )


def no_track(dive: Dive, answering: int, sides: str = "") -> Reason:
    """No method could be positioned by the beacons."""
    seen = (
        f"{len(dive.replies):,} replies came from {answering} of {len(dive.beacons)} beacons, "
        "and no place of the vehicle agrees with enough of them."
    )
    if sides:
        seen = seen.replace("no place of the vehicle agrees with enough of them.", f"{sides}.")
    if answering < 3:
        return Reason(
            "too_few_beacons",
            "Too few beacons answered: one or two beacons leave two places, "
            "mirrored in the line between them.",
            seen,
            "Give the position at the beginning of the dive under [start] position_m in the "
            "settings, or find out why the other beacons did not answer.",
        )
    return Reason(
        "no_acoustics",
        "The replies do not fit the beacons as they are given.",
        seen,
        "Check the beacons' numbers and positions, and the unit and meaning of the travel times; "
        "what is shown is dead reckoning only.",
    )


def left_out(beacon_id: int, share: float, others: float) -> Reason:
    """A beacon whose replies do not fit the track that the others make."""
    return Reason(
        "beacon_moved",
        MEANING["beacon_moved"] + " Its turn-around time may be wrong instead.",
        f"The track explains {percent(share)} of the replies of beacon {beacon_id}, "
        f"and {percent(others)} of those of the others.",
        f"Check position and turn-around time given for beacon {beacon_id} (abyssnav calibrate "
        "estimates them from dives), or leave it out as [[beacon]] in the settings.",
    )


def mirrored(dive: Dive, answering: int) -> Reason:
    """A track by one or two beacons, whose side was chosen by what little tells it."""
    return Reason(
        "too_few_beacons",
        "One or two beacons leave two tracks, mirrored in the line between them; the one shown is "
        "the likelier.",
        f"{answering} of {len(dive.beacons)} beacons answered in the whole dive.",
        "Make sure that the vehicle was on this side of the beacons, or give its position at the "
        "beginning of the dive under [start] position_m in the settings.",
    )


def contradicted(method: str, off: Stretches, share: float) -> Reason:
    """Fixes or replies say that the vehicle was elsewhere."""
    far_m = off.fix_distance_m
    seen = (
        f"In {percent(share)} of the dive the track by {method} explains "
        f"{percent(off.explained.sum() / max(off.replies.sum(), 1))} of the replies"
    )
    if np.isfinite(far_m).any():
        seen += f" and lies {np.nanmax(far_m):,.0f} m from the fixes made of the same replies"
    return Reason(
        "noise",
        "Compass or DVL contradict the beacons' replies, and it cannot be told which is right.",
        seen + ".",
        "Compare the track with the fixes on the map before using any of it, and check how "
        "compass and DVL are mounted and read.",
    )


def unsupported(share: float) -> Reason:
    """Stretches of the dive in which hardly any beacon is heard as the track has it."""
    return Reason(
        "no_acoustics",
        "Hardly any beacon was heard there, so the track is dead reckoning.",
        f"In {percent(share)} of the dive fewer than two beacons answered as the track has it.",
        "Trust the track there no further than its 95 % radius, which grows with time.",
    )


def mixture(gains: Sequence[CauseWeight]) -> Reason:
    """The likeliest of the smoother's hypotheses, and those that it cannot be told from."""
    first = gains[0]
    close = [one for one in gains if one.log_gain > first.log_gain - 3.0]
    beacons = list(dict.fromkeys(one.beacon_id for one in close if one.beacon_id is not None))
    which = f" It concerns beacon {' or '.join(map(str, beacons))}." if beacons else ""
    others = [one.name for one in close if one.name != first.name]
    doubt = f" It may as well be {others[0].replace('_', ' ')}." if others else ""
    return Reason(
        first.name,
        MEANING[first.name] + which + doubt,
        "The replies fit the track better, by a factor of "
        f"{np.exp(min(first.log_gain, 13.8)):,.0f} or more, if that is taken into account.",
        "Check what is given for it in the settings or the log (`learned` and `beacons` in "
        "summary.json hold the estimates); the smoother has taken it into account as far as the "
        "data allow.",
    )
