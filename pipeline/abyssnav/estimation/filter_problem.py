# SPDX-License-Identifier: Apache-2.0
"""A dive as the real-time filters see it: events, dead reckoning, priors and gate."""

from math import inf
from typing import NamedTuple

from abyssnav.acoustics.travel_time import RayGeometry
from abyssnav.estimation.filter_events import SumsMaker, TimeEvents
from abyssnav.estimation.hypotheses import BankPriors
from abyssnav.geometry import Plane
from abyssnav.tables import Float, Start


class GateConfig(NamedTuple):
    """How measurements are judged."""

    gamma: float  #: of travel times; inf = no gate
    position_gamma: float  #: of position fixes, two degrees of freedom
    #: κ of the Huber weight of what the gate lets in; inf = all counts by its probability.
    huber: float = inf


class PositionEvents(NamedTuple):
    """Position fixes of another kind."""

    t_s: Float  #: (k,)
    position: Plane  #: (k,) less the lever arm, east + i north, m
    cov_m2: Float  #: (k, 2, 2)


class KnownStart(NamedTuple):
    """A start that is known beforehand."""

    start: Start
    sigma_m: float


class Problem(NamedTuple):
    """A dive as the filters see it."""

    times: TimeEvents
    geometry: RayGeometry  #: rows of `times`
    positions: PositionEvents
    sums: SumsMaker
    priors: BankPriors
    gate: GateConfig
    start_sigma_m: float
    stated_time_sigma_s: float
    recover: bool = True
    block: int = 8  #: replies that are linearised together
