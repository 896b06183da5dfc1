# SPDX-License-Identifier: Apache-2.0
"""Dead reckoning under any reading of compass and DVL, and how it changes with their errors."""

from dataclasses import dataclass

import numpy as np

from abyssnav.geometry import Plane, interpolate, leveled
from abyssnav.tables import Dive, Float

#: Rows beyond which velocities are averaged.
_MOST_ROWS = 60_000


@dataclass(frozen=True, eq=False)
class Course:
    """Velocity over ground at the DVL's stamps, complex: east + i north; held where it is lost."""

    t_s: Float
    forward: Plane  #: unit vector of the bow
    bow_mps: Float
    starboard_mps: Float
    heading_rad: Float  #: unwrapped

    @property
    def velocity_mps(self) -> Plane:
        """Velocity (n,) over ground."""
        return np.asarray((self.bow_mps - 1j * self.starboard_mps) * self.forward)

    def run(self, rate: Plane, t_s: Float) -> Plane:
        """∫ rate dt from the first stamp to any instants, by trapezoids; the ends are held."""
        sums = np.zeros(len(rate), dtype=complex)
        np.cumsum(0.5 * np.diff(self.t_s) * (rate[1:] + rate[:-1]), out=sums[1:])
        before, after = np.minimum(t_s - self.t_s[0], 0.0), np.maximum(t_s - self.t_s[-1], 0.0)
        inside = interpolate(t_s, self.t_s, sums)
        return np.asarray(inside + before * rate[0] + after * rate[-1])


def recorded(dive: Dive) -> Course:
    """The course as the log and its profile have it."""
    velocity = dive.velocity
    last = np.maximum.accumulate(np.where(velocity.valid, np.arange(len(velocity)), -1))
    source = np.where(last >= 0, last, int(np.argmax(velocity.valid)))
    bow, starboard, _ = leveled(
        velocity.velocity_body_mps[source], velocity.roll_rad, velocity.pitch_rad
    )
    columns = velocity.t_s, bow, starboard, velocity.heading_rad
    t_s, bow, starboard, heading_rad = (_in_blocks(c, len(velocity) // _MOST_ROWS) for c in columns)
    return with_heading(Course(t_s, np.ones(0, complex), bow, starboard, heading_rad), heading_rad)


def _in_blocks(values: Float, rows: int) -> Float:
    """Means over blocks of so many rows and one: a day needs no more than one a second or two."""
    n = len(values) // (rows + 1) * (rows + 1)
    return np.asarray(values[:n].reshape(-1, rows + 1).mean(axis=1))


def with_heading(course: Course, heading_rad: Float) -> Course:
    """The same velocities under another heading."""
    forward = np.sin(heading_rad) + 1j * np.cos(heading_rad)
    return Course(course.t_s, forward, course.bow_mps, course.starboard_mps, heading_rad)


def with_velocity(course: Course, bow_mps: Float, starboard_mps: Float) -> Course:
    """The same heading under other velocities."""
    return Course(course.t_s, course.forward, bow_mps, starboard_mps, course.heading_rad)


#: A velocity or heading this old no longer tells how the vehicle moves; how wrong it may be, m/s.
_GAP_S, _GAP_MPS = 3.0, 0.3


def lost_variance(dive: Dive, t_s: Float) -> Float:
    """Variance (n,) m² by which dead reckoning is in doubt from gaps of DVL and compass so far.

    A gap of length L adds (0.3 m/s L)², evenly over its time.
    """
    total_m2 = np.zeros(len(t_s))
    for known_s in (dive.velocity.t_s[dive.velocity.valid], dive.heading.t_s):
        length_s = np.diff(known_s)
        growth_m2 = np.where(length_s > _GAP_S, (_GAP_MPS * length_s) ** 2, 0.0)
        total_m2 += np.interp(t_s, known_s, np.concatenate([[0.0], np.cumsum(growth_m2)]))
    return total_m2
