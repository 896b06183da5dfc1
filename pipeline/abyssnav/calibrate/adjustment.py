# SPDX-License-Identifier: Apache-2.0
"""Least squares over many dives: each dive's nodes eliminated, what dives share summed and solved.

    min Σ_d [ ½ x_dᵀ S_d x_d - h_dᵀ x_d ] + ½ xᵀ Λ x,     x_d = x[columns_d] + offset_d

S_d is the Schur complement of dive d's nodes (`abyssnav.estimation.normal_equations`), linearised
anew at every step.  It is the block elimination of large networks: F. R. Helmert, "Die
mathematischen und physikalischen Theorieen der höheren Geodäsie" (1880); P. Wolf, "Surveying and
Mapping" 38 (1978).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from abyssnav.calibrate.clock_offsets import N_FURTHER
from abyssnav.calibrate.evidence import (
    DiveEvidence,
    DiveIterate,
    Reduced,
    moved,
    reduce_dive,
    relearned,
)
from abyssnav.calibrate.unknowns import Layout, Unknown
from abyssnav.tables import Float, Int

#: μ of the robust weights, step by step; then the final weights.
_GRADUATION = (5.0, 2.0)
_MOST_STEPS = 15
#: Noise is learned in these steps.
_LEARNING = range(2, 8)
#: Done once no unknown moves by more than this share of its sigma.
_STILL = 0.02
#: The prior sigmas of a group count for so many unknowns; they are learned upwards only.
_NU = 3.0
_LARGEST_RATIO = 100.0


class Normal(NamedTuple):
    """Quadratic of the shared unknowns, priors not in it: ½ xᵀ S x - hᵀ x."""

    information: Float
    right: Float


@dataclass(frozen=True, eq=False)
class Adjustment:
    """The unknowns by all dives."""

    layout: Layout
    prior_sigma: Float  #: (x,) as learned: not below the layout's
    iterates: tuple[DiveIterate, ...]
    reduced: tuple[Reduced, ...]  #: of every dive at its iterate

    @cached_property
    def normal(self) -> Normal:
        """What all dives say at the end, priors not in it."""
        return sum_dives(self.layout, self.reduced)

    @cached_property
    def solution(self) -> tuple[Float, Float]:
        """Unknowns (x,) and their covariance (x, x)."""
        return solve(self.normal, self.prior_sigma)


def sum_dives(layout: Layout, reduced: Sequence[Reduced | Normal]) -> Normal:
    """What all dives together say of the unknowns."""
    n = len(layout.unknowns)
    total = Normal(np.zeros((n, n)), np.zeros(n))
    for columns, offset, part in zip(layout.columns, layout.offset, reduced, strict=True):
        total.information[np.ix_(columns, columns)] += part.information
        total.right[columns] += part.right - part.information @ offset
    return total


def solve(normal: Normal, prior_sigma: Float) -> tuple[Float, Float]:
    """Unknowns (x,) and their covariance under independent priors of mean zero.

    Done in units of the priors' sigmas, so that seconds and metres do not meet.
    """
    lower = _factor(normal, prior_sigma)
    inverse = np.linalg.inv(lower)
    cov = inverse.T @ inverse
    value = cov @ (normal.right * prior_sigma)
    return value * prior_sigma, cov * np.outer(prior_sigma, prior_sigma)


def log_evidence(normal: Normal, prior_sigma: Float) -> float:
    """Of the priors, up to what none of them changes: ½ hᵀ C h - ½ ln |1 + σ S σ|."""
    lower = _factor(normal, prior_sigma)
    half = np.linalg.solve(lower, normal.right * prior_sigma)
    return float(0.5 * half @ half - np.log(np.diagonal(lower)).sum())


def _factor(normal: Normal, prior_sigma: Float) -> Float:
    scaled = normal.information * np.outer(prior_sigma, prior_sigma)
    return np.asarray(np.linalg.cholesky(scaled + np.eye(len(scaled))))


def adjust(
    dives: Sequence[DiveEvidence], layout: Layout, start: Sequence[DiveIterate]
) -> Adjustment:
    """Unknowns of a layout by Gauss-Newton steps; noise and priors learned with them."""
    iterates = list(start)
    prior_sigma, value = layout.sigma.copy(), np.zeros(len(layout.unknowns))
    for step in range(_MOST_STEPS):
        mu = _GRADUATION[step] if step < len(_GRADUATION) else None
        reduced = [reduce_dive(*pair, mu) for pair in zip(dives, iterates, strict=True)]
        normal = sum_dives(layout, reduced)
        before = value
        value, cov = solve(normal, prior_sigma)
        for number, (dive, part) in enumerate(zip(dives, reduced, strict=True)):
            columns = layout.columns[number]
            constant = value[columns] + layout.offset[number]
            noise = iterates[number].noise
            if step in _LEARNING:
                own_cov = cov[np.ix_(columns, columns)]
                noise = relearned(dive, iterates[number], part, constant, own_cov)
            iterates[number] = moved(iterates[number], part, constant)._replace(noise=noise)
        prior_sigma = learned_priors(layout, value, cov, prior_sigma)
        still = np.all(np.abs(value - before) < _STILL * np.sqrt(np.diagonal(cov)))
        if mu is None and still and step > _LEARNING.start:
            break
    ends = tuple(reduce_dive(*pair, None) for pair in zip(dives, iterates, strict=True))
    return Adjustment(layout, prior_sigma, tuple(iterates), ends)


def begin(dives: Sequence[DiveEvidence]) -> list[DiveIterate]:
    """Where every dive alone leaves its unknowns."""
    return [DiveIterate(dive.states, np.zeros(N_FURTHER), dive.noise) for dive in dives]


def learned_priors(layout: Layout, value: Float, cov: Float, now: Float) -> Float:
    """Prior sigmas no smaller than stated, larger where the unknowns of a kind say so.

        s² <- (Σ (x / σ₀)² + ν) / (Σ (1 - C / σ²) + ν)

    as `abyssnav.estimation.variance_components` has it for one dive.
    """
    sigma = now.copy()
    for rows in prior_groups(layout.unknowns):
        stated = layout.sigma[rows]
        ratio2 = float(np.sum((value[rows] / stated) ** 2))
        kept = float(np.sum(1 - np.minimum(np.diagonal(cov)[rows] / now[rows] ** 2, 1.0)))
        wanted = np.sqrt((ratio2 + _NU) / (kept + _NU))
        scale = float(now[rows[0]] / stated[0])
        wanted = float(np.clip(wanted, scale / 2, 2 * scale))
        sigma[rows] = min(max(wanted, 1.0), _LARGEST_RATIO) * stated
    return sigma


def prior_groups(unknowns: Sequence[Unknown]) -> list[Int]:
    """Rows of unknowns whose prior sigmas are learned together.

    Each beacon has its own, so that one that stands elsewhere does not make the others doubtful.
    """
    quantity: dict[tuple[str, int | None, str | None], list[int]] = {}
    for row, unknown in enumerate(unknowns):
        kind = unknown.kind
        name = kind.name
        if kind.group in ("lever arm", "place"):
            name = kind.group
        elif name.startswith("deviation"):
            name = f"deviation {name[-1]}"
        quantity.setdefault((name, unknown.beacon_id, unknown.dive), []).append(row)
    return [np.array(rows) for rows in quantity.values()]
