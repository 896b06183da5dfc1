# SPDX-License-Identifier: Apache-2.0
"""The Kalman update (R. Kalman, 1960) of h filters side by side, in place."""

import numpy as np

from abyssnav.tables import Bool, Float


def update_scalar(
    x: Float, P: Float, gain: tuple[Float, Float], innovation: Float, use: Bool
) -> None:
    """Take one number into the filters that believe it (Eqs. 8-9).

        K = P Hᵀ / S,   x = x⁻ + K ν,   P = P⁻ - S K Kᵀ

    With the optimal gain this is Joseph's form, (I - K H) P⁻ (I - K H)ᵀ + K R Kᵀ (R. Bucy and
    P. Joseph, 1968), symmetric as it stands.

    Parameters
    ----------
    x, P : (h, N) and (h, N, N), changed in place
    gain : P⁻ Hᵀ (h, N) and S = H P⁻ Hᵀ + R (h,)
    innovation, use : (h,) ν, and whether it counts
    """
    PH, S = gain
    share = use / S
    x += PH * (innovation * share)[:, None]
    root = PH * np.sqrt(share)[:, None]
    P -= root[:, :, None] * root[:, None, :]


def update_pair(x: Float, P: Float, S: Float, innovation: Float, use: Bool) -> None:
    """Take a measurement of the first two states into the filters that believe it.

        K = P Hᵀ S⁻¹,   x = x⁻ + K ν,   P = P⁻ - K S Kᵀ,    H = [I₂, 0]

    Parameters
    ----------
    x, P : (h, N) and (h, N, N), changed in place
    S : (h, 2, 2) P_pp + R
    innovation, use : (h, 2) ν, and (h,) whether it counts
    """
    PH = P[:, :, :2]
    K = np.linalg.solve(S, PH.swapaxes(1, 2)).swapaxes(1, 2) * use[:, None, None]
    x += (K @ innovation[:, :, None])[:, :, 0]
    P -= K @ S @ K.swapaxes(1, 2)
