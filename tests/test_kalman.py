# SPDX-License-Identifier: Apache-2.0
import numpy as np

from abyssnav.estimation.kalman import update_pair, update_scalar


def filters(h, n, seed):
    rng = np.random.default_rng(seed)
    root = rng.normal(0, 1, (h, n, n))
    return rng.normal(0, 1, (h, n)), root @ root.swapaxes(1, 2), rng


def test_a_scalar_update_is_josephs_form_and_the_information_form_in_every_filter():
    x, P, rng = filters(5, 9, 1)
    H, innovation, R = rng.normal(0, 1, (5, 9)), rng.normal(0, 1, 5), rng.uniform(0.1, 2, 5)
    PH = (P @ H[:, :, None])[:, :, 0]
    S = (H * PH).sum(axis=1) + R
    after, cov = x.copy(), P.copy()
    update_scalar(after, cov, (PH, S), innovation, np.ones(5, dtype=bool))
    for k in range(5):
        K = P[k] @ H[k] / S[k]
        A = np.eye(9) - np.outer(K, H[k])
        joseph = A @ P[k] @ A.T + R[k] * np.outer(K, K)
        np.testing.assert_allclose(cov[k], joseph, atol=1e-9)
        information = np.linalg.inv(np.linalg.inv(P[k]) + np.outer(H[k], H[k]) / R[k])
        np.testing.assert_allclose(cov[k], information, atol=1e-7)
        np.testing.assert_allclose(after[k], x[k] + K * innovation[k], atol=1e-12)


def test_a_filter_that_does_not_believe_a_number_keeps_its_state_to_the_bit():
    x, P, rng = filters(3, 6, 2)
    PH, S = rng.normal(0, 1, (3, 6)), np.full(3, 40.0)
    after, cov = x.copy(), P.copy()
    update_scalar(after, cov, (PH, S), np.ones(3), np.array([True, False, True]))
    np.testing.assert_array_equal(after[1], x[1])
    np.testing.assert_array_equal(cov[1], P[1])
    assert not np.array_equal(cov[0], P[0])


def test_a_pair_at_once_is_two_numbers_one_after_the_other():
    x, P, rng = filters(4, 7, 3)
    R, z = np.array([0.5, 1.5]), rng.normal(0, 1, 2)
    one, one_cov = x.copy(), P.copy()
    S = P[:, :2, :2] + np.diag(R)
    update_pair(one, one_cov, S, z - x[:, :2], np.ones(4, dtype=bool))
    two, two_cov = x.copy(), P.copy()
    for axis in (0, 1):
        PH = two_cov[:, :, axis].copy()
        S_axis = two_cov[:, axis, axis] + R[axis]
        update_scalar(two, two_cov, (PH, S_axis), z[axis] - two[:, axis], np.ones(4, dtype=bool))
    np.testing.assert_allclose(one, two, atol=1e-9)
    np.testing.assert_allclose(one_cov, two_cov, atol=1e-9)


def test_repeated_updates_are_the_joint_normal_distribution_conditioned_at_once():
    """A linear case: the filter's recursion against one dense solve."""
    x, P, rng = filters(1, 5, 4)
    prior, cov0 = x.copy(), P.copy()
    G, z, R = rng.normal(0, 1, (30, 5)), rng.normal(0, 2, 30), 0.3
    for h, value in zip(G, z, strict=True):
        PH = P @ h
        update_scalar(x, P, (PH, PH @ h + R), value - x @ h, np.ones(1, dtype=bool))
    gain = cov0[0] @ G.T @ np.linalg.inv(G @ cov0[0] @ G.T + R * np.eye(30))
    np.testing.assert_allclose(x[0], prior[0] + gain @ (z - G @ prior[0]), atol=1e-8)
    np.testing.assert_allclose(P[0], cov0[0] - gain @ G @ cov0[0], atol=1e-8)
