# SPDX-License-Identifier: Apache-2.0
"""Reasons in the surveyor's words: what was seen, the likeliest cause, what to do."""

import numpy as np

from abyssnav.diagnose.cause import length
from abyssnav.diagnose.clocks import Loss
from abyssnav.diagnose.evidence import Stretches
from abyssnav.tables import Dive, Reason

#: A start that is known decides between two mirrored tracks.
_START = (
    "Put position_m = [0.0, 0.0] under [start] of the settings, with where the vehicle was at the "
    "beginning of the dive (east and north of the origin, in metres) for the zeros, and run it "
    "again with -c SETTINGS."
)


def percent(share: float) -> str:
    """A share in whole percent."""
    return f"{100 * share:.0f} %"


def sensor_lost(loss: Loss) -> Reason:
    """A sensor stopped before the last reply, or began after the first."""
    if loss.share >= 1:
        return _never_beside_replies(loss)
    when = "stops" if loss.at_end else "begins only"
    other = "before the last reply" if loss.at_end else "after the first reply"
    return Reason(
        "sensor_lost",
        f"The {loss.sensor} sensor was off, failed, or was not recorded for part of the dive.",
        f"The {loss.sensor} record {when} {length(loss.length_s)} {other}; it lacks "
        f"{percent(loss.share)} of the time in which beacons answered.",
        "Look for the missing part of the recording; if there is none, trust that part of the "
        "track only where beacons answered often.",
    )


def _never_beside_replies(loss: Loss) -> Reason:
    """A sensor's record and the replies share no time: it was off, or its clock is another."""
    when = "stops before the first" if loss.at_end else "begins only after the last"
    role = "heading" if loss.sensor == "compass" else loss.sensor
    return Reason(
        "sensor_lost",
        f"The {loss.sensor} sensor was not recorded while beacons answered, or its clock differs "
        "from the others'.",
        f"The {loss.sensor} record {when} reply, {length(loss.t_s)} into the dive; it lacks all of "
        "the time in which beacons answered.",
        "If the sensor ran all the time, its stamps are off: put latency_s, the seconds by which "
        f"they are late, under [{role}] of the profile (-p). If not, look for the missing part of "
        "the recording.",
    )


def no_track(dive: Dive, answering: int, sides: str = "") -> Reason:
    """No method could be positioned by the beacons."""
    observed = (
        f"{len(dive.replies):,} replies came from {answering} of {len(dive.beacons)} beacons, "
        "and no place of the vehicle agrees with enough of them."
    )
    if sides:
        observed = observed.replace(
            "no place of the vehicle agrees with enough of them.", f"{sides}."
        )
    if answering < 3:
        return Reason(
            "too_few_beacons",
            "Too few beacons answered: one or two beacons leave two places, "
            "mirrored in the line between them.",
            observed,
            f"{_START} Or find out why the other beacons did not answer.",
        )
    return Reason(
        "no_acoustics",
        "The replies do not fit the beacons as they are given.",
        observed,
        "Check the beacons' numbers and positions, and the unit and meaning of the travel times; "
        "what is shown is dead reckoning only.",
    )


def mirrored(dive: Dive, answering: int) -> Reason:
    """A track by one or two beacons, whose side was chosen by what little tells it."""
    return Reason(
        "too_few_beacons",
        "One or two beacons leave two tracks, mirrored in the line between them; the one shown is "
        "the likelier.",
        f"{answering} of {len(dive.beacons)} beacons answered in the whole dive.",
        f"Make sure that the vehicle was on this side of the beacons. If it was not: {_START}",
    )


def contradicted(method: str, off: Stretches, share: float) -> Reason:
    """Fixes or replies say that the vehicle was elsewhere."""
    far_m = off.fix_distance_m
    observed = (
        f"In {percent(share)} of the dive the track of {method} fits "
        f"{percent(off.explained.sum() / max(off.replies.sum(), 1))} of the replies"
    )
    if np.isfinite(far_m).any():
        observed += f" and lies {np.nanmax(far_m):,.0f} m from the fixes made of the same replies"
    return Reason(
        "noise",
        "Compass or DVL contradict the beacons' replies, and it cannot be told which is right.",
        observed + ".",
        "Compare the track with the fixes on the map before using any of it, and check how "
        "compass and DVL are mounted and read.",
    )


def unsupported(share: float) -> Reason:
    """Stretches of the dive in which hardly any reply supports the track."""
    return Reason(
        "no_acoustics",
        "For a part of the dive hardly any beacon was heard, so the track there is dead reckoning.",
        f"In {percent(share)} of the dive fewer than two beacons sent replies that fit the track.",
        "Look at the map for where beacons answered, and use the track only there; find out why "
        "they did not answer elsewhere (range, noise, switched off).",
    )


def weak_geometry(dilution: float, share: float) -> Reason:
    """Beacons that lie nearly in one direction."""
    return Reason(
        "geometry",
        "The beacons lie nearly in one line with the vehicle, which leaves its place across that "
        "line open.",
        f"In {percent(share)} of the dive an error of 1 m in the ranges moves a fix by "
        f"{min(dilution, 100.0):.0f} m (the dilution of precision).",
        "Trust the track no further than its 95 % radius; next time lay the beacons around the "
        "area (abyssnav plan shows the radius before the dive).",
    )


def without_dead_reckoning(sensor: str) -> Reason:
    """Nothing tells the way made between replies."""
    return Reason(
        "noise",
        f"What the log has of {sensor} says nothing of the way that the vehicle made.",
        f"The beacons' replies contradict {sensor} all along: the track between the replies is "
        "a guess.",
        f"Check topic, field, unit and frame of {sensor} in the profile (abyssnav inspect proposes "
        "them); until then use the fixes.",
    )
