# SPDX-License-Identifier: Apache-2.0
"""What the dives determine, and what would determine the rest."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from abyssnav.calibrate.adjustment import Adjustment, Normal, solve
from abyssnav.calibrate.unknowns import Kind, Unknown, group_of
from abyssnav.tables import Float

#: Weak is what the data made better than it was known before by at least this factor.
_BETTER = 0.8
#: A prior below this (in the unit of the equations) says that the unknown is none.
_NONE = 1e-8
#: Correlations from here on are named.
_CORRELATED = 0.7

#: Groups whose priors are wide together with a group's own.
_INSEPARABLE = {"sound speed": ("clock",), "clock": ("sound speed",)}

DETERMINED, WEAK, NOT_DETERMINED = "determined", "weak", "not determined"


class Estimate(NamedTuple):
    """One calibrated number, in the unit of its kind."""

    unknown: Unknown
    value: float  #: correction of what settings and tables say
    sigma: float  #: where it is kept, of what the dives leave of the stated one
    prior_sigma: float  #: by settings and tables
    data_sigma: float  #: by the data, with the other unknowns as well known as before
    verdict: str
    #: Name of the most correlated others, and by how much
    correlated: tuple[tuple[str, float], ...]

    @property
    def kind(self) -> Kind:
        """What it is."""
        return self.unknown.kind


def judge(adjustment: Adjustment) -> list[Estimate]:
    """Every unknown with its verdict.

    Determined: the data alone, with all else as well known as before, give it to its limit and
    better than it was known.  Weak: they make it better known than it was.  All else is not
    determined and kept at its prior.
    """
    layout = adjustment.layout
    prior_sigma = adjustment.prior_sigma
    value, cov = adjustment.solution
    sigma = np.sqrt(np.diagonal(cov))
    alone = _data_sigma(layout.unknowns, adjustment.normal, prior_sigma)
    estimates = []
    correlation = cov / np.outer(sigma, sigma)
    for row, unknown in enumerate(layout.unknowns):
        kind = unknown.kind
        if layout.stated[row] < _NONE:
            continue
        verdict, known = NOT_DETERMINED, prior_sigma[row]
        if kind.factor * alone[row] <= kind.limit and alone[row] <= known:
            verdict = DETERMINED
        elif sigma[row] <= _BETTER * known:
            verdict = WEAK
        kept = verdict == NOT_DETERMINED
        stated = layout.stated[row]
        estimates.append(
            Estimate(
                unknown,
                0.0 if kept else kind.factor * float(value[row]),
                kind.factor * float(known if kept else sigma[row]),
                kind.factor * float(stated),
                kind.factor * float(alone[row]),
                verdict,
                _most_correlated(layout.unknowns, correlation, row),
            )
        )
    return estimates


def _data_sigma(unknowns: Sequence[Unknown], normal: Normal, prior_sigma: Float) -> Float:
    """Sigma (x,) of every unknown where only its own group's priors are wide.

    Of the sound speed and the common turn-around both are: a vehicle that stays where it is knows
    only the two together, and a prior of one of them would pass for data of the other.
    """
    result = np.zeros(len(unknowns))
    keys = [(group_of(unknown), unknown.dive) for unknown in unknowns]
    for key in dict.fromkeys(keys):
        rows = [row for row, other in enumerate(keys) if other == key]
        wide = prior_sigma.copy()
        for row, unknown in enumerate(unknowns):
            if row in rows or unknown.kind.group in _INSEPARABLE.get(key[0].name, ()):
                wide[row] = unknown.kind.wide / unknown.kind.factor
        result[rows] = np.sqrt(np.diagonal(solve(normal, wide)[1]))[rows]
    return result


def _most_correlated(
    unknowns: Sequence[Unknown], correlation: Float, row: int
) -> tuple[tuple[str, float], ...]:
    others = np.argsort(-np.abs(correlation[row])).tolist()
    return tuple(
        (label(unknowns[other]), float(correlation[row, other]))
        for other in others[:4]
        if other != row and abs(correlation[row, other]) >= _CORRELATED
    )


def label(unknown: Unknown) -> str:
    """Name of an unknown with its beacon and dive."""
    parts = [unknown.kind.name.replace("_", " ")]
    if unknown.beacon_id is not None:
        parts = [f"beacon {unknown.beacon_id} {parts[0].removeprefix('beacon ')}"]
    return " ".join([*parts, *([f"({unknown.dive})"] if unknown.dive else [])])
