# SPDX-License-Identifier: Apache-2.0
"""Position fixes of another kind: GNSS at the surface, and a ship's USBL."""

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from abyssnav.geometry import interpolate
from abyssnav.simulate import scenario as settings
from abyssnav.simulate.vehicle import TrueMotion
from abyssnav.tables import Float, Table

# Neither fires together with the compass.
_GNSS_PHASE_S, _USBL_PHASE_S = 0.13, 3.7
#: A wrong USBL fix is off by about so many sigmas.
_GROSS_SIGMAS = 10.0


@dataclass(frozen=True, eq=False)
class PositionFixes(Table):
    """Fixes of the navigated point as recorded."""

    t_s: Float
    position_enu_m: Float  #: (n, 3)
    sigma_m: Float  #: of each axis


def fix_positions(
    position: settings.Position, motion: TrueMotion, rng: Generator
) -> dict[str, PositionFixes]:
    """Fixes by kind, `gnss` and `usbl`; kinds without a period, or never in reach, are left out."""
    periods_s = {"gnss": position.gnss_period_s, "usbl": position.usbl_period_s}
    phases_s = {"gnss": _GNSS_PHASE_S, "usbl": _USBL_PHASE_S}
    sigmas_m = {"gnss": position.gnss_sigma_m, "usbl": position.usbl_sigma_m}
    fixes = {}
    for kind, period_s in periods_s.items():
        if period_s == 0:
            continue
        t_s = np.arange(phases_s[kind], motion.t_s[-1], period_s)
        true = interpolate(t_s, motion.t_s, motion.position_enu_m)
        noise = sigmas_m[kind] * rng.normal(size=true.shape)
        if kind == "gnss":
            received = -true[:, 2] <= position.gnss_above_m
            t_s, true, noise = t_s[received], true[received], noise[received]
        else:
            noise[rng.random(len(t_s)) < position.usbl_gross] *= _GROSS_SIGMAS
        if len(t_s):
            fixes[kind] = PositionFixes(t_s, true + noise, np.full(len(t_s), sigmas_m[kind]))
    return fixes
