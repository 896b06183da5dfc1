# SPDX-License-Identifier: Apache-2.0
"""Columns thinned for the eye, and packed for the page."""

import base64
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from abyssnav.tables import Float, Int


def keep_corners(enu_m: Float, n_points: int) -> Int:
    """Rows of a track (n, 3), about `n_points`, that keep its shape.

    Of each stretch its first point and the one farthest from the straight line to its last.
    """
    n = len(enu_m)
    if n <= n_points:
        return np.arange(n)
    length = math.ceil(2 * n / n_points)
    blocks = n // length
    first = np.arange(blocks) * length
    xy_m = enu_m[: blocks * length, :2].reshape(blocks, length, 2)
    chord_m = xy_m[:, -1] - xy_m[:, 0]
    away_m = xy_m - xy_m[:, :1]
    off = np.abs(chord_m[:, None, 0] * away_m[:, :, 1] - chord_m[:, None, 1] * away_m[:, :, 0])
    tail = np.arange(blocks * length, n, max(1, length // 2))
    return np.unique(np.concatenate([first, first + off.argmax(axis=1), tail, [n - 1]]))


def keep_extremes(values: Float, n_points: int) -> Int:
    """Rows of a curve (n,), about `n_points`: the least and the largest of each stretch."""
    n = len(values)
    if n <= n_points:
        return np.arange(n)
    length = math.ceil(2 * n / n_points)
    blocks = n // length
    stretch = values[: blocks * length].reshape(blocks, length)
    first = np.arange(blocks) * length
    tail = np.arange(blocks * length, n, max(1, length // 2))
    low, high = first + stretch.argmin(axis=1), first + stretch.argmax(axis=1)
    return np.unique(np.concatenate([[0], low, high, tail, [n - 1]]))


def packed(values: NDArray[Any], kind: str) -> str:
    """Base64 of a column as little-endian `f4`, `i4` or `u1`."""
    return base64.b64encode(np.ascontiguousarray(values).astype("<" + kind).tobytes()).decode()
