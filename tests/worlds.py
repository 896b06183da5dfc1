# SPDX-License-Identifier: Apache-2.0
"""Small made-up worlds for the tests of the mathematics."""

from dataclasses import fields

import numpy as np

from abyssnav.estimation.dead_reckoning import DeadReckoning


def motion_of(t_s, displacement_m, **columns):
    """Dead reckoning that says `displacement_m` (n, 2) and is sure of it, but for `columns`."""
    t_s = np.asarray(t_s, float)
    sure = {column.name: np.zeros(len(t_s)) for column in fields(DeadReckoning)}
    return DeadReckoning(**{**sure, "t_s": t_s, "displacement_m": displacement_m, **columns})


def steady(velocity_mps=(0.0, 0.0)):
    """A vehicle that runs straight, for a day."""
    t_s = np.array([-1e3, 1e5])
    return motion_of(t_s, np.outer(t_s, velocity_mps))
