# SPDX-License-Identifier: Apache-2.0
"""How late acoustics, compass and DVL are against each other, by the dive itself."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from abyssnav.diagnose.motion import SOUND, motion_regression
from abyssnav.diagnose.regression import Prepared, prepare, prior_sigmas, robust_inflation
from abyssnav.tables import Dive, Fixes

#: Sensor whose stamps each column moves, and the sign by which its value is a lateness.
_COLUMNS = (
    ("travel_time", "clock", -1.0),
    ("heading", "compass_clock", -1.0),
    ("velocity", "dvl_clock", 1.0),
)
#: Beyond it the dive does not tell.
_UNKNOWN_S = 3.0


@dataclass(frozen=True)
class Latency:
    """How much later than the others one sensor's stamps are."""

    sensor: str  #: role of the profile
    late_s: float
    sigma_s: float

    @property
    def is_known(self) -> bool:
        """Whether the dive tells it at all."""
        return self.sigma_s < _UNKNOWN_S


def latencies(dive: Dive, fixes: Fixes) -> tuple[Latency, ...]:
    """Lateness of each sensor beside the other two; none: too few fixes.

    The fixes less dead reckoning hold, for stamps that are late by τ,

        -v τ (acoustics),    -∫ ψ' i v dt τ (compass),    ∫ R v_b' dt τ (DVL)

    Each is estimated alone, with all other errors as of sound instruments.  With a column a, the
    others' covariance K₀ and its own prior σ², K = K₀ + σ² a aᵀ:

        τ = aᵀ K⁻¹ y / m,    σ_τ² = 1 / m - σ²,    m = aᵀ K⁻¹ a

    At a steady speed the first two can hardly be told apart: either explains the other.
    """
    problem = motion_regression(dive, fixes)
    if problem is None:
        return ()
    sigma = prior_sigmas(problem.names, SOUND)
    prepared = prepare(problem, sigma, robust_inflation(problem, sigma))
    return tuple(
        Latency(sensor, *_alone(prepared, problem.names.index(name), sign))
        for sensor, name, sign in _COLUMNS
    )


def _alone(prepared: Prepared, column: int, sign: float) -> tuple[float, float]:
    information = float(prepared.information[column, column])
    if information <= 0:
        return 0.0, float("inf")
    variance = 1 / information - float(prepared.sigma[column]) ** 2
    return sign * float(prepared.pull[column]) / information, float(np.sqrt(max(variance, 0.0)))


def plain(of_sensors: Sequence[Latency]) -> list[dict[str, Any]]:
    """As `inspect --json` prints them: those that the dive tells."""
    return [asdict(one) for one in of_sensors if one.is_known]
