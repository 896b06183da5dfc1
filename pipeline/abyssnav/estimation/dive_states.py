# SPDX-License-Identifier: Apache-2.0
"""States of a whole dive: eight at every node, and constants that all nodes share."""

from typing import NamedTuple

import numpy as np

from abyssnav.tables import Float, Int

# --- at every node ----------------------------------------------------------------------------
#: Position; slow heading error ε; slow velocity error of the DVL, forward and starboard; slow
#: velocity in the earth frame (what a DVL on water track lacks), east and north; slow part of the
#: sound-speed scale k.
EAST, NORTH, HEADING, FORWARD, STARBOARD, CURRENT_EAST, CURRENT_NORTH, SOUND = range(8)
N_NODE = 8
#: States that fade (Gauss-Markov), and the group of each: heading, DVL, earth, sound.
DRIFTS = slice(2, 8)
DRIFT_GROUP = np.array([0, 1, 1, 2, 2, 3])
#: Group of the slow error of each beacon's times, which are further states where residuals ask for
#: them.
SLOW_TIMES = 4
DRIFT_NAMES = (
    "slow_heading", "slow_dvl_velocity", "slow_earth_velocity", "slow_sound_scale",
    "slow_travel_time",
)  # fmt: skip

# --- of the whole dive ------------------------------------------------------------------------
#: Heading offset (or the DVL's mounting angle: one until the compass deviates); deviation
#: a₁ sin ψ + b₁ cos ψ + a₂ sin 2ψ + b₂ cos 2ψ; DVL scale; sound-speed scale
#: k = c_used / c_true - 1; gradient of the sound speed where no profile is known; clock common to
#: all times; lever arm in the body frame.
OFFSET, DEVIATION, SCALE, SOUND_SCALE, GRADIENT, CLOCK = 0, slice(1, 5), 5, 6, 7, 8
LEVER = slice(9, 12)
#: The first six turn and stretch dead reckoning.
N_MOTION = 6
N_COMMON = 12
#: Of each beacon: east, north, up of its position, turn-around.
N_BEACON = 4


class DiveStates(NamedTuple):
    """The unknowns of a dive of n nodes and b beacons."""

    node: Float  #: (n, s): 8 states, or 8 + b with a slow error of each beacon's times
    constant: Float  #: (12 + 4 b,)

    def moved(self, node: Float, constant: Float) -> "DiveStates":
        """The states after a step."""
        return DiveStates(self.node + node, self.constant + constant)

    def with_slow_times(self) -> "DiveStates":
        """The same with a slow error of each beacon's times, none as yet."""
        return self._replace(node=np.pad(self.node, ((0, 0), (0, len(self.beacon)))))

    @property
    def beacon(self) -> Float:
        """Offsets (b, 4) of the beacons' positions and turn-arounds."""
        return self.constant[N_COMMON:].reshape(-1, N_BEACON)

    def deviation(self, heading_rad: Float) -> Float:
        """Constant part of what the compass reads too much (...) rad, at what it reads."""
        # Summed in order: a matrix product's last bit depends on how many rows it has.
        shapes = np.moveaxis(deviation_shapes(heading_rad), -1, 0)
        total = np.full(np.shape(heading_rad), self.constant[OFFSET])
        for shape, amplitude in zip(shapes, self.constant[DEVIATION], strict=True):
            total = total + amplitude * shape
        return total


def drift_groups(n_states: int) -> Int:
    """Group (n - 2,) of each fading state of a node with so many states."""
    return np.append(DRIFT_GROUP, np.full(n_states - N_NODE, SLOW_TIMES))


def deviation_shapes(heading_rad: Float) -> Float:
    """Harmonics sin ψ, cos ψ, sin 2ψ, cos 2ψ (..., 4)."""
    s, c = np.sin(heading_rad), np.cos(heading_rad)
    return np.stack([s, c, 2 * s * c, (c - s) * (c + s)], axis=-1)


class NoiseModel(NamedTuple):
    """Standard deviations of all that is random, by window of the dive where it may change.

    A window is a stretch of at most two hours; w of them, g groups of observations.
    """

    #: (g,) of each beacon's two-way times, s; last, the factor on the stated sigmas of positions
    observation_sigma: Float
    position_m2_per_s: Float  #: (w,) process noise of dead reckoning, q
    drift_sigma: Float  #: (w, 5) stationary, of the fading states' groups: rad, m/s, m/s, none, s
    drift_time_s: Float  #: (w, 5) e-folding, τ
    constant_sigma: Float  #: (12 + 4 b,) priors of the constants; their means are zero


def beacon_columns(beacon: Int) -> Int:
    """Columns (n, 4) of the constants that belong to beacons (n,)."""
    return N_COMMON + N_BEACON * beacon[:, None] + np.arange(N_BEACON)
