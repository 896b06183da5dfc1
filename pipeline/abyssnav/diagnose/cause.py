# SPDX-License-Identifier: Apache-2.0
"""A likely cause of what is wrong with a dive, and the words for it."""

from dataclasses import dataclass
from typing import NamedTuple

from abyssnav.tables import Reason

#: What each cause is, in the surveyor's words.
MEANING = {
    "heading_constant": "The compass does not follow the vehicle: the heading field is not the one "
    "that the driver fills, or the sensor hangs.",
    "heading_sense": "The heading is counted counter-clockwise where clockwise is expected.",
    "heading_reference": "The heading is counted from east, not from north.",
    "heading_unit": "The unit of the heading is not the one given: degrees and radians are "
    "exchanged.",
    "heading_offset": "The compass reads a constant angle wrong: its mounting, or a magnetic "
    "declination that was not taken into account.",
    "dvl_mount": "The DVL sits turned on its mount.",
    "dvl_frame": "The DVL's axes are not the ones given.",
    "dvl_sign": "The DVL's velocities have the wrong sign.",
    "dvl_scale": "The DVL's velocities are all too large or too small by one factor.",
    "dvl_unit": "The unit of the DVL's velocities is not the one given.",
    "water_track": "The DVL measured its velocity against moving water, not against the sea floor.",
    "zeros_when_lost": "The DVL sends a velocity of exactly zero when it loses the sea floor.",
    "time_one_way": "The travel times are one-way times.",
    "turn_around_removed": "The beacons' turn-around time was already taken off the travel times.",
    "time_unit": "The unit of the travel times is not the one given.",
    "turn_around": "A turn-around time of the beacons is not the one given.",
    "beacon_ids": "Beacons are exchanged: their numbers do not belong to the positions given.",
    "beacon_moved": "A beacon does not lie where it is given.",
    "sound_speed": "The speed of sound is wrong.",
    "lever_arm": "The acoustic transducer is not where the settings say it is on the vehicle.",
    "depth": "The unit, the sign or the zero of the depth is not the one given.",
    "clock_offset": "The clock of the acoustic receiver and that of the vehicle do not agree.",
    "no_overlap": "The clock of the acoustic receiver and that of the vehicle do not agree, "
    "perhaps because one is set to another time zone.",
    "noise": "A sensor errs by more than it should.",
}


class Evidence(NamedTuple):
    """Log likelihood by which a cause beats the others."""

    gain: float  #: over everything being as given
    ratio: float  #: over the runner-up
    runner_up: str = "as given"


#: Where a lateness of pings and replies alike goes; the profile's would move the replies only.
REPLIES_CLOCK = "under [calibration] of the settings (plus what stands there already, if anything)"

#: Of what stands in the numbers or stamps themselves and needs no statistics.
CERTAIN = Evidence(1e6, 1e6)


class Mend(NamedTuple):
    """What mends it: a line of TOML, and where it goes; or, without one, what to do."""

    line: str
    where: str
    otherwise: str = ""  #: what to do where the log does not have what the line needs

    def sentence(self) -> str:
        """The advice."""
        if not self.line:
            return f"{self.where}."
        same = ', with the field that stands there for "..."' if self._keeps_field() else ""
        again = "run it again"
        if "of the profile" in self.where:
            again += " with -p PROFILE (abyssnav inspect LOG --profile-out PROFILE writes one)"
        elif "the settings" in self.where:
            again += " with -c SETTINGS"
        return f"Put {self.line} {self.where}{same}, and {again}. {self.otherwise}".strip()

    def _keeps_field(self) -> bool:
        return '"..."' in self.line and "with the field" not in self.where

    def phrase(self) -> str:
        """The same in a few words, for a list."""
        return f"{self.line} {self.where}".strip()


@dataclass(frozen=True)
class Cause:
    """One thing that is likely wrong, by how much it beats the rest, and what mends it."""

    role: str  #: of the profile
    name: str  #: one of `abyssnav.tables.CAUSES`
    value: str  #: what the data say it is
    evidence: Evidence
    mend: Mend
    seen: str  #: what was seen, with numbers
    doubt: str = ""  #: what could not be told apart

    @property
    def gain(self) -> float:
        """Log likelihood over that of everything being as given."""
        return self.evidence.gain

    def reason(self) -> Reason:
        """The cause as a reason of the verdict."""
        meaning = f"{MEANING[self.name]} {self.doubt}".strip()
        return Reason(self.name, meaning, self.seen, self.mend.sentence())


def length(t_s: float) -> str:
    """A length of time as people say it."""
    if t_s < 90:
        return f"{t_s:.0f} s"
    return f"{t_s / 60:.0f} min" if t_s < 5400 else f"{t_s / 3600:.1f} h"
