# SPDX-License-Identifier: Apache-2.0
"""Symmetric positive block-tridiagonal equations, solved by odd-even elimination.

Of the nodes of a chain every second one is eliminated, all at once, which leaves a chain of half
the length, and so on until none is left: log₂ n levels of products in batches, where elimination
from one end takes n steps one after the other.  It is a Cholesky factorisation of the equations in
another order (D. Heller, "Some Aspects of the Cyclic Reduction Algorithm for Block Tridiagonal
Linear Systems", SIAM J. Numer. Anal. 13, 1976).
"""

from typing import NamedTuple

import numpy as np

from abyssnav.tables import Float

#: Keeps the unit of a state that nothing holds finite.
_TINY = 1e-200


class Level(NamedTuple):
    """Nodes 0, 2, 4 ... of a chain, eliminated; q of them with b states each.

    With A_kk = L Lᵀ and the neighbours l and r on either side:
    """

    inverse: Float  #: (q, b, b) L⁻¹
    coupling: Float  #: (q, b, 2 b) L⁻¹ [A_kl A_kr]; zero where there is no neighbour
    right: Float  #: (q, b, m) L⁻¹ times the right sides


class Inverse(NamedTuple):
    """Blocks of A⁻¹."""

    own: Float  #: (n, b, b) on the diagonal
    next: Float  #: (n - 1, b, b) of node k + 1 with node k


def eliminate(diagonal: Float, below: Float, right: Float) -> tuple[Level, ...]:
    """All nodes of A x = y eliminated, level by level.

    Parameters
    ----------
    diagonal, below : (n, b, b) A_kk and (n - 1, b, b) A_{k+1,k}
    right : (n, b, m) y, a column for each of m right sides

    Raises
    ------
    numpy.linalg.LinAlgError
        A is not positive.
    """
    levels = []
    while len(diagonal):
        level = _eliminate_evens(diagonal, below, right)
        levels.append(level)
        diagonal, below, right = _odds(level, diagonal, right)
    return tuple(levels)


def _eliminate_evens(diagonal: Float, below: Float, right: Float) -> Level:
    even = diagonal[::2]
    q, b, p = len(even), even.shape[1], len(diagonal) // 2
    # In units of each state's own: of a triangle of seventeen decades no digit is inverted right.
    unit = 1 / np.sqrt(np.abs(np.diagonal(even, axis1=1, axis2=2)) + _TINY)
    inverse = np.linalg.inv(np.linalg.cholesky(even * unit[:, :, None] * unit[:, None]))
    inverse *= unit[:, None]
    rows = np.zeros((q, b, 2 * b + right.shape[2]))
    rows[1:, :, :b] = below[1::2]
    rows[:p, :, b : 2 * b] = below[::2].swapaxes(1, 2)
    rows[:, :, 2 * b :] = right[::2]
    whitened = inverse @ rows
    return Level(inverse, whitened[:, :, : 2 * b], whitened[:, :, 2 * b :])


def _odds(level: Level, diagonal: Float, right: Float) -> tuple[Float, Float, Float]:
    """Equations of the nodes that remain, A_ij - A_ik A_kk⁻¹ A_kj for k eliminated."""
    _, coupling, rest = level
    b, p = coupling.shape[1], len(diagonal) // 2
    back = coupling.swapaxes(1, 2)
    ties, pull = back @ coupling, back @ rest
    diagonal, right = diagonal[1::2].copy(), right[1::2].copy()
    diagonal -= ties[:p, b:, b:]  # of the node before
    right -= pull[:p, b:]
    diagonal[: len(ties) - 1] -= ties[1:, :b, :b]  # and of the one behind
    right[: len(pull) - 1] -= pull[1:, :b]
    return diagonal, -ties[1:p, b:, :b], right


def solve_chain(levels: tuple[Level, ...]) -> Float:
    """Solutions (n, b, m) x of A x = y."""
    b, m = levels[0].right.shape[1:]
    x = np.zeros((0, b, m))
    for inverse, coupling, right in reversed(levels):
        p = len(x)
        neighbours = np.zeros((len(right), 2 * b, m))
        neighbours[1:, :b] = x[: len(right) - 1]
        neighbours[:p, b:] = x
        even = inverse.swapaxes(1, 2) @ (right - coupling @ neighbours)
        x = _interleaved(even, x)
    return x


def invert_chain(levels: tuple[Level, ...]) -> Inverse:
    """Diagonal and neighbouring blocks of A⁻¹.

    With G = -L⁻ᵀ L⁻¹ [A_kl A_kr] and Z the inverse's blocks of both neighbours,
        Z_kk = A_kk⁻¹ + G Z Gᵀ,    [Z_kl Z_kr] = G Z
    (K. Takahashi et al., 1973).
    """
    b = levels[0].right.shape[1]
    own, beyond = np.zeros((0, b, b)), np.zeros((0, b, b))
    for inverse, coupling, _ in reversed(levels):
        q, p = len(inverse), len(own)
        neighbours = np.zeros((q, 2 * b, 2 * b))
        neighbours[1:, :b, :b] = own[: q - 1]
        neighbours[:p, b:, b:] = own
        neighbours[1:p, b:, :b] = beyond[: p - 1]
        neighbours[1:p, :b, b:] = beyond[: p - 1].swapaxes(1, 2)
        back = inverse.swapaxes(1, 2)
        gain = back @ coupling
        joint = gain @ neighbours
        even = back @ inverse + joint @ gain.swapaxes(1, 2)
        beyond = _interleaved(-joint[:p, :, b:].swapaxes(1, 2), -joint[1:, :, :b])
        own = _interleaved(even, own)
    return Inverse(own, beyond)


class OneSided(NamedTuple):
    """Equations of each node with all nodes on one side of it eliminated, and no others."""

    information: Float  #: (n, b, b)
    right: Float  #: (n, b)


def one_sided(inverse: Inverse, below: Float, x: Float) -> tuple[OneSided, OneSided]:
    """What the nodes before each, and those behind it, leave of A x = y.

    The inverse's block of two neighbours, inverted, holds what all others leave of their equations:
        [Z_k Z_kl; Z_lk Z_l]⁻¹ = [S_k A_kl; A_lk T_l],    y_k = S_k x_k + A_kl x_l,    l = k + 1

    Parameters
    ----------
    below, x : (n - 1, b, b) A_{k+1,k} and (n, b) the solution
    """
    own, beyond = inverse
    across = beyond.swapaxes(1, 2)
    past, future = own.copy(), own.copy()
    past[:-1] -= across @ np.linalg.solve(own[1:], beyond)
    future[1:] -= beyond @ np.linalg.solve(own[:-1], across)
    before, behind = (_with_right(cov, x) for cov in (past, future))
    before.right[:-1] += (below.swapaxes(1, 2) @ x[1:, :, None])[:, :, 0]
    behind.right[1:] += (below @ x[:-1, :, None])[:, :, 0]
    return before, behind


def _with_right(cov: Float, x: Float) -> OneSided:
    information = np.asarray(np.linalg.inv(cov))
    return OneSided(information, (information @ x[:, :, None])[:, :, 0])


def log_determinant(levels: tuple[Level, ...]) -> float:
    """Natural logarithm of |A|."""
    pivots = (np.diagonal(level.inverse, axis1=1, axis2=2) for level in levels)
    return -2.0 * float(sum(np.log(pivot).sum() for pivot in pivots))


def _interleaved(even: Float, odd: Float) -> Float:
    both = np.empty((len(even) + len(odd), *even.shape[1:]))
    both[::2], both[1::2] = even, odd
    return both
