# SPDX-License-Identifier: Apache-2.0
"""Odd-even elimination against dense matrices, for chains of every parity."""

import numpy as np
import pytest

from abyssnav.estimation.block_tridiagonal import (
    eliminate,
    invert_chain,
    log_determinant,
    one_sided,
    solve_chain,
)

B = 3  #: states of a node


class Chain:
    """Equations of n nodes, as blocks and dense."""

    def __init__(self, n):
        rng = np.random.default_rng(n)
        J = np.zeros((4 * B * n, n, B))
        for k in range(n):  # rows of each node and the next one
            J[4 * B * k : 4 * B * (k + 1), k : k + 2] = rng.standard_normal((4 * B, 2, B))[
                :, : n - k
            ]
        self.dense = np.einsum("rki,rlj->kilj", J, J).reshape(n * B, n * B)
        blocks = self.dense.reshape(n, B, n, B)
        every = np.arange(n)
        self.diagonal, self.below = (
            blocks[every, :, every], blocks[every[1:], :, every[:-1]]
        )  # fmt: skip
        self.right = rng.standard_normal((n, B, 2))
        self.levels = eliminate(self.diagonal, self.below, self.right)


@pytest.fixture(params=[1, 2, 3, 4, 5, 7, 8, 12, 17])
def chain(request):
    return Chain(request.param)


def test_the_solution_is_that_of_the_dense_equations(chain):
    expected = np.linalg.solve(chain.dense, chain.right.reshape(-1, 2))
    np.testing.assert_allclose(solve_chain(chain.levels).reshape(-1, 2), expected, atol=1e-10)
    assert log_determinant(chain.levels) == pytest.approx(np.linalg.slogdet(chain.dense)[1])


def test_blocks_are_those_of_the_dense_inverse(chain):
    n = len(chain.diagonal)
    expected = np.linalg.inv(chain.dense).reshape(n, B, n, B)
    own, beyond = invert_chain(chain.levels)
    every = np.arange(n)
    np.testing.assert_allclose(own, expected[every, :, every], atol=1e-10)
    np.testing.assert_allclose(beyond, expected[every[1:], :, every[:-1]], atol=1e-10)


def test_one_side_is_what_elimination_from_that_end_leaves(chain):
    x = solve_chain(chain.levels)[:, :, 0]
    past, future = one_sided(invert_chain(chain.levels), chain.below, x)
    n, flat = len(x), chain.right[:, :, 0].ravel()
    for k in range(n):
        for side, others in ((past, range(k)), (future, range(k + 1, n))):
            rest = np.array([B * j + i for j in others for i in range(B)], dtype=int)
            own = np.arange(B * k, B * k + B)
            gain = chain.dense[np.ix_(own, rest)] @ np.linalg.inv(chain.dense[np.ix_(rest, rest)])
            S = chain.dense[np.ix_(own, own)] - gain @ chain.dense[np.ix_(rest, own)]
            np.testing.assert_allclose(side.information[k], S, atol=1e-9)
            np.testing.assert_allclose(side.right[k], flat[own] - gain @ flat[rest], atol=1e-9)


def test_equations_that_are_not_positive_are_refused():
    chain = Chain(4)
    with pytest.raises(np.linalg.LinAlgError):
        eliminate(-chain.diagonal, chain.below, chain.right)
