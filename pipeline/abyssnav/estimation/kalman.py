# SPDX-License-Identifier: Apache-2.0
"""The Kalman filter's equations (R. Kalman, 1960), for h filters side by side.

Measurements come in blocks of k that are linearised together.  Between them the state moves, so
each error is expressed as that of the state at the block's beginning,

    e_j = F_j⁻¹ (x_j - x̂_j),      cov(e_i, e_j) = P + N_min(i,j)

with F_j the transition from there to measurement j, and N_j = Σ_{i<=j} F_i⁻¹ Q_i F_i⁻ᵀ the process
noise so far, referred to the beginning.
"""

from functools import cache
from typing import NamedTuple

import numpy as np

from abyssnav.tables import Float

_ADJUGATE_SIGNS = np.array([[1.0, -1.0], [-1.0, 1.0]])
#: Least share of itself to which doubt brings a measurement's weight: it may be divided by.
_LEAST = 1e-3


class Transition(NamedTuple):
    """F of h filters, over one step or over k (h, k, ...): rows of the position, and what fades.

    On the moving states F = [J; 0 diag(a)], J with the identity of the position in it.
    """

    position: (
        Float  #: (h, ..., 2, m) rows of the first two states by the first m, identity included
    )
    fade: Float  #: (h, ..., f) factors of the f states behind them; all others stay

    def row(self, j: int) -> "Transition":
        """That to measurement j."""
        return Transition(self.position[:, j], self.fade[:, j])


def predict(P: Float, step: Transition) -> None:
    """P⁻ = F P Fᵀ, in place (Eq. 6 without the noise); P is (h, N, N).

    Only the rows and columns that change are touched: the position's, and those that fade.
    """
    J, fade = step
    last, moving = 2 + fade.shape[1], J.shape[2]
    JP = J @ P[:, :moving]
    position = JP[:, :, :moving] @ J.swapaxes(1, 2)
    JP[:, :, 2:last] *= fade[:, None]
    P[:, 2:last] *= fade[:, :, None]
    P[:, :, 2:last] *= fade[:, None]
    P[:, :2] = JP
    P[:, :, :2] = JP.swapaxes(1, 2)
    P[:, :2, :2] = 0.5 * (position + position.swapaxes(1, 2))  # rounding would add up


def joint_innovations(P: Float, H: Float, noise: Float, innovation: Float) -> Float:
    """What k scalar measurements have in common with each other and with the state.

        row j:   H_i X_j for i = 0 .. k - 1  |  X_j  |  ν_j,        X_j = (P + N_j) H_jᵀ

    H_i X_j is the covariance of the innovations i and j, i >= j, without R.  X_j is the covariance
    of the error with innovation j.

    Parameters
    ----------
    P, H : (h, N, N) and (h, k, N) gradients by the state at the block's beginning
    noise : (h, k, n, n) N_j, of the first n states
    innovation : (h, k) ν = z - h(x⁻)

    Returns
    -------
    joint : (h, k, k + N + 1)
    """
    h, k, n_states = H.shape
    joint = np.empty((h, k, k + n_states + 1))
    X = joint[:, :, k:-1]
    np.matmul(H, P, out=X)
    n = noise.shape[2]
    X[:, :, :n] += (H[:, :, None, :n] @ noise)[:, :, 0]
    np.matmul(X, H.swapaxes(1, 2), out=joint[:, :, :k])
    joint[:, :, -1] = innovation
    return joint


def associated(right: Float, nis: Float, measured: tuple[Float, Float]) -> tuple[Float, Float]:
    """Share and innovation (h,) of a measurement that is right with a probability only.

    Mean and covariance of "right: x + K ν, P - K S Kᵀ; wrong: x, P", K = X / S, are

        x + X β ν / S,    P - X (β - β (1 - β) ν² / S) Xᵀ / S

    (probabilistic data association: Y. Bar-Shalom and E. Tse, Automatica 11, 1975).  That is a
    certain measurement of a smaller share and a larger innovation,

        share = β s / S,    ν / s,    s = 1 - (1 - β) ν² / S

    with s not below a thousandth: a covariance never grows.

    Parameters
    ----------
    right, nis : (h,) β, 0 where it is not believed, and ν² / S
    measured : ν and S (h,)
    """
    innovation, variance = measured
    smaller = np.maximum(1.0 - (1.0 - right) * nis, _LEAST)
    return right * smaller / variance, innovation / smaller


def condition(joint: Float, j: int, share: Float) -> None:
    """Take measurement j into what is expected of the later ones, in place (Eqs. 8-9).

        X_l = X_l - X_j S_lj / S_jj,   ν_l = ν_l - ν_j S_lj / S_jj,   l > j

    Parameters
    ----------
    share : (h,) 1 / S_jj with R, less where it is not believed for certain, 0 where not
    """
    row, rest = joint[:, j], slice(j + 1, joint.shape[1])
    gain = row[:, rest] * share[:, None]
    # The columns up to j are those of measurements that were taken.
    joint[:, rest, j + 1 :] -= gain[:, :, None] * row[:, None, j + 1 :]


def corrections(joint: Float, share: Float) -> Float:
    """Σ K_l ν_l over l <= j (h, k, N), K = X / S: what each measurement adds to the errors' means.

    Parameters
    ----------
    joint : as `condition` left it
    share : (h, k) as `condition` was given it
    """
    k = joint.shape[1]
    return running_sums(joint[:, :, k:-1] * (share * joint[:, :, -1])[:, :, None])


def running_sums(terms: Float) -> Float:
    """Sums (h, k, ...) over the first 1, 2, ... k rows, by one product of matrices."""
    h, k = terms.shape[:2]
    return terms if k == 1 else (ones_below(k) @ terms.reshape(h, k, -1)).reshape(terms.shape)


@cache
def ones_below(k: int) -> Float:
    """Lower triangle (k, k) of ones, the diagonal with it."""
    ones = np.tri(k)
    ones.flags.writeable = False
    return ones


def correct(x: Float, step: Transition, error: Float) -> None:
    """Correct predicted states, x = x⁻ + F e, in place; x and e are (h, k, N), F to each of k."""
    J, fade = step
    last, moving = 2 + fade.shape[-1], J.shape[-1]
    x[..., :2] += (J @ error[..., :moving, None])[..., 0]
    x[..., 2:last] += fade * error[..., 2:last]
    x[..., last:] += error[..., last:]


def update(P: Float, joint: Float, share: Float) -> None:
    """P = P⁻ - Σ S_j K_j K_jᵀ, in place (Eqs. 8-9), by all measurements that have a share.

    With the optimal gain this equals Joseph's form, (I - K H) P⁻ (I - K H)ᵀ + K R Kᵀ (R. Bucy and
    P. Joseph, 1968).  It is symmetric as it stands, but a difference: unlike Joseph's form it is
    positive only up to rounding.
    """
    root = joint[:, :, joint.shape[1] : -1] * np.sqrt(share)[:, :, None]
    P -= root.swapaxes(1, 2) @ root


def update_pair(x: Float, P: Float, S_inverse: Float, innovation: Float, right: Float) -> None:
    """Take in, in place, a measurement of the first two states that is right with probability β.

        K = P Hᵀ S⁻¹,   x = x⁻ + β K ν,   P = P⁻ - β K H P + β (1 - β) K ν νᵀ Kᵀ,    H = [I₂, 0]

    These are the mean and covariance of `associated`, but that a covariance may grow.

    Parameters
    ----------
    x, P : (h, N) and (h, N, N), changed in place
    S_inverse : (h, 2, 2) of S = P_pp + R
    innovation, right : (h, 2) ν, and (h,) β
    """
    PH = P[:, :, :2]
    K = PH @ S_inverse
    moved = K @ innovation[:, :, None]
    x += right[:, None] * moved[:, :, 0]
    spread = np.sqrt(right * (1.0 - right))[:, None, None] * moved
    known = np.concatenate([right[:, None, None] * K, -spread], axis=2)
    P -= known @ np.concatenate([PH, spread], axis=2).swapaxes(1, 2)


def inverse_of_pairs(S: Float) -> tuple[Float, Float]:
    """Inverse (h, 2, 2) and determinant (h,) of symmetric S."""
    determinant = S[:, 0, 0] * S[:, 1, 1] - S[:, 0, 1] ** 2
    adjugate = S[:, ::-1, ::-1] * _ADJUGATE_SIGNS
    return adjugate / determinant[:, None, None], determinant
