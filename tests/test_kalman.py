# SPDX-License-Identifier: Apache-2.0
import numpy as np

from abyssnav.estimation.kalman import (
    Transition,
    associated,
    condition,
    correct,
    corrections,
    inverse_of_pairs,
    joint_innovations,
    predict,
    update,
    update_pair,
)


def filters(h, n, seed):
    rng = np.random.default_rng(seed)
    root = rng.normal(0, 1, (h, n, n))
    return rng.normal(0, 1, (h, n)), root @ root.swapaxes(1, 2), rng


def still(h, k, n):
    """Nothing moves between the measurements of a block, and nothing is added."""
    J = np.zeros((h, k, 2, n))
    J[:, :, [0, 1], [0, 1]] = 1.0
    return Transition(J, np.ones((h, k, 1))), np.zeros((h, k, 2, 2))


def updated(x, P, H, z, R, use=None):
    """States and covariances after k measurements of h filters, one by one."""
    (h, k, n), cov = H.shape, P.copy()
    transition, noise = still(h, k, n)
    joint = joint_innovations(cov, H, noise, z - (H @ x[:, :, None])[:, :, 0])
    share = np.zeros((h, k))
    for j in range(k):
        share[:, j] = (1.0 if use is None else use[:, j]) / (joint[:, j, j] + R)
        condition(joint, j, share[:, j])
    states = np.repeat(x[:, None], k, axis=1)
    correct(states, transition, corrections(joint, share))
    update(cov, joint, share)
    return states, cov


def test_an_update_is_josephs_form_and_the_information_form_in_every_filter():
    x, P, rng = filters(5, 9, 1)
    H, z, R = rng.normal(0, 1, (5, 1, 9)), rng.normal(0, 1, (5, 1)), rng.uniform(0.1, 2, 5)
    after, cov = updated(x, P, H, z, R)
    for k in range(5):
        row = H[k, 0]
        K = P[k] @ row / (row @ P[k] @ row + R[k])
        A = np.eye(9) - np.outer(K, row)
        joseph = A @ P[k] @ A.T + R[k] * np.outer(K, K)
        np.testing.assert_allclose(cov[k], joseph, atol=1e-9)
        information = np.linalg.inv(np.linalg.inv(P[k]) + np.outer(row, row) / R[k])
        np.testing.assert_allclose(cov[k], information, atol=1e-7)
        np.testing.assert_allclose(after[k, 0], x[k] + K * (z[k, 0] - row @ x[k]), atol=1e-12)


def test_a_filter_that_does_not_believe_a_number_keeps_its_state_to_the_bit():
    x, P, rng = filters(3, 6, 2)
    use = np.array([[True], [False], [True]])
    after, cov = updated(x, P, rng.normal(0, 1, (3, 1, 6)), np.ones((3, 1)), 40.0, use)
    np.testing.assert_array_equal(after[1, 0], x[1])
    np.testing.assert_array_equal(cov[1], P[1])
    assert not np.array_equal(cov[0], P[0])


def test_a_block_is_its_measurements_one_after_the_other():
    x, P, rng = filters(4, 7, 5)
    H, z, R = rng.normal(0, 1, (4, 6, 7)), rng.normal(0, 1, (4, 6)), 0.5
    use = rng.random((4, 6)) < 0.7
    at_once, cov = updated(x, P, H, z, R, use)
    state, P_one = x, P
    for j in range(6):
        each = slice(j, j + 1)
        states, P_one = updated(state, P_one, H[:, each], z[:, each], R, use[:, each])
        state = states[:, 0]
        np.testing.assert_allclose(at_once[:, j], state, atol=1e-9)
    np.testing.assert_allclose(cov, P_one, atol=1e-9)


def test_noise_between_the_measurements_of_a_block_is_that_of_the_joint_distribution():
    """A random walk seen three times, against the dense normal distribution of all its places."""
    q, R, rng = 0.3, 0.2, np.random.default_rng(6)
    z, P = rng.normal(0, 1, 3), np.diag([2.0, 1.0, 1.0])[None]
    H = np.zeros((1, 3, 3))
    H[0, :, 0] = 1.0
    noise = np.zeros((1, 3, 2, 2))
    noise[0, :, 0, 0] = q * np.arange(3)
    joint, share = joint_innovations(P, H, noise, z[None]), np.zeros((1, 3))
    for j in range(3):
        share[:, j] = 1 / (joint[:, j, j] + R)
        condition(joint, j, share[:, j])
    cov = 2.0 + q * np.minimum(*np.meshgrid(np.arange(3), np.arange(3)))
    for j in range(3):
        seen = slice(0, j + 1)
        gain = cov[j, seen] @ np.linalg.inv(cov[seen, seen] + R * np.eye(j + 1))
        assert np.isclose(corrections(joint, share)[0, j, 0], gain @ z[seen])


def mixture(x, P, H, nu, R, right):
    """Mean and covariance of "right" and "wrong", with their probabilities."""
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    means, covs = np.array([x + K @ nu, x]), [P - K @ S @ K.T, P]
    share = np.array([right, 1 - right])
    apart = means - share @ means
    return share @ means, sum(
        w * (cov + np.outer(d, d)) for w, cov, d in zip(share, covs, apart, strict=True)
    )


def test_what_is_right_with_a_probability_leaves_the_mean_and_covariance_of_both_cases():
    x, P, rng = filters(4, 5, 8)
    H, R, right = rng.normal(0, 1, (4, 1, 5)), 0.4, np.array([1.0, 0.9, 0.3, 0.0])
    nothing, noise = still(4, 1, 5)
    nu = rng.normal(0, 1, (4, 1))
    joint = joint_innovations(P, H, noise, nu)
    S = joint[:, 0, 0] + R
    share, joint[:, 0, -1] = associated(right, nu[:, 0] ** 2 / S, (nu[:, 0], S))
    one, one_cov = np.repeat(x[:, None], 1, axis=1), P.copy()
    correct(one, nothing, corrections(joint, share[:, None]))
    update(one_cov, joint, share[:, None])
    z, pair = rng.normal(0, 1, (4, 2)), np.eye(2, 5)
    two, two_cov, inverse = x.copy(), P.copy(), np.linalg.inv(P[:, :2, :2] + R * np.eye(2))
    update_pair(two, two_cov, inverse, z, right)
    for i in range(4):
        mean, cov = mixture(x[i], P[i], H[i], nu[i], R, right[i])
        np.testing.assert_allclose(one[i, 0], mean, atol=1e-12)
        np.testing.assert_allclose(one_cov[i], cov, atol=1e-12)
        mean, cov = mixture(x[i], P[i], pair, z[i], R * np.eye(2), right[i])
        np.testing.assert_allclose(two[i], mean, atol=1e-12)
        np.testing.assert_allclose(two_cov[i], cov, atol=1e-12)


def test_what_is_hardly_believed_makes_no_covariance_grow():
    share, innovation = associated(np.array([0.5]), np.array([9.0]), (np.array([3.0]), np.ones(1)))
    assert 0 < share[0] < 0.001
    assert np.isclose(share[0] * innovation[0], 0.5 * 3.0)


def test_a_prediction_is_the_matrix_product():
    _, P, rng = filters(3, 7, 7)
    J, fade = rng.normal(0, 1, (3, 2, 5)), rng.uniform(0.1, 1, (3, 2))
    J[:, :, :2] = np.eye(2)
    F = np.tile(np.eye(7), (3, 1, 1))
    F[:, :2, :5], F[:, [2, 3], [2, 3]] = J, fade
    expected = F @ P @ F.swapaxes(1, 2)
    predict(P, Transition(J, fade))
    np.testing.assert_allclose(P, expected, atol=1e-12)


def test_a_pair_at_once_is_two_numbers_one_after_the_other():
    x, P, rng = filters(4, 7, 3)
    R, z = np.array([0.5, 1.5]), rng.normal(0, 1, 2)
    one, one_cov = x.copy(), P.copy()
    S = P[:, :2, :2] + np.diag(R)
    inverse, determinant = inverse_of_pairs(S)
    np.testing.assert_allclose(inverse, np.linalg.inv(S))
    np.testing.assert_allclose(determinant, np.linalg.det(S))
    update_pair(one, one_cov, inverse, z - x[:, :2], np.ones(4))
    two, two_cov = x, P
    for axis in (0, 1):
        H = np.zeros((4, 1, 7))
        H[:, 0, axis] = 1.0
        states, two_cov = updated(two, two_cov, H, np.full((4, 1), z[axis]), R[axis])
        two = states[:, 0]
    np.testing.assert_allclose(one, two, atol=1e-9)
    np.testing.assert_allclose(one_cov, two_cov, atol=1e-9)


def test_repeated_updates_are_the_joint_normal_distribution_conditioned_at_once():
    """A linear case: the filter's recursion against one dense solve."""
    x, P, rng = filters(1, 5, 4)
    G, z, R = rng.normal(0, 1, (30, 5)), rng.normal(0, 2, 30), 0.3
    states, cov = updated(x, P, G[None], z[None], R)
    gain = P[0] @ G.T @ np.linalg.inv(G @ P[0] @ G.T + R * np.eye(30))
    np.testing.assert_allclose(states[0, -1], x[0] + gain @ (z - G @ x[0]), atol=1e-8)
    np.testing.assert_allclose(cov[0], P[0] - gain @ G @ P[0], atol=1e-8)
