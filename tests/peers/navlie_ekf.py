# SPDX-License-Identifier: Apache-2.0
# ruff: noqa: ARG002, E402  # its methods have the arguments they have
"""navlie's ExtendedKalmanFilter over one log: `python navlie_ekf.py LOG OUT.csv`.

As its README and examples have it: a ProcessModel and MeasurementModels of our own on a
VectorState, `predict` and `correct` in turn, outliers kept away by `reject_outliers=True` (NIS at
99 %).  The package of the registry imports `pylie`, its authors' Lie groups under a former name,
which the registry does not have; a VectorState uses none of it, so empty names stand in.
"""

import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from dive_reader import DiveData, read_dive, write_track
from lbl_model import TravelTime, motion, start_of

GROUPS = {
    "pylie": ("SO2", "SO3", "SE2", "SE3", "SE23", "SL3", "MatrixLieGroup"),
    "pylie.numpy": (),
    "pylie.numpy.base": ("MatrixLieGroup",),
}
for module, groups in GROUPS.items():
    stand_in = types.ModuleType(module)
    for group in groups:
        setattr(stand_in, group, type(group, (), {}))
    sys.modules.setdefault(module, stand_in)

from navlie.filters import ExtendedKalmanFilter
from navlie.lib.states import VectorState
from navlie.types import Measurement, MeasurementModel, ProcessModel, StateWithCovariance


class DeadReckoning(ProcessModel):
    """Displacement between two stamps, by DVL and compass as the state corrects them."""

    def __init__(self, dive: DiveData) -> None:
        self.dive = dive

    def evaluate(self, x: VectorState, u: Any, dt: float) -> VectorState:
        x = x.copy()
        x.value[:2] += motion(self.dive, x.stamp, x.stamp + dt, x.value)[0]
        return x

    def jacobian(self, x: VectorState, u: Any, dt: float) -> Any:
        return motion(self.dive, x.stamp, x.stamp + dt, x.value)[1]

    def covariance(self, x: VectorState, u: Any, dt: float) -> Any:
        return motion(self.dive, x.stamp, x.stamp + dt, x.value)[2]


class TwoWayTime(MeasurementModel):
    """One reply."""

    def __init__(self, reply: TravelTime) -> None:
        self.reply = reply

    def evaluate(self, x: VectorState) -> Any:
        return np.array([self.reply.predict(x.value)[0]])

    def jacobian(self, x: VectorState) -> Any:
        return self.reply.predict(x.value)[1][None]

    def covariance(self, x: VectorState) -> Any:
        return np.array([[self.reply.variance_s2]])


class Fix(MeasurementModel):
    """East and north, by GNSS or USBL."""

    def __init__(self, sigma_m: float) -> None:
        self.R = sigma_m**2 * np.eye(2)

    def evaluate(self, x: VectorState) -> Any:
        return x.value[:2]

    def jacobian(self, x: VectorState) -> Any:
        return np.eye(2, 5)

    def covariance(self, x: VectorState) -> Any:
        return self.R


def measurements(dive: DiveData, from_s: float) -> list[tuple[Measurement, Any]]:
    """All that corrects the state, in order of time, and the reply it is, if one."""
    found: list[tuple[Measurement, Any]] = []
    for row in dive.replies.itertuples():
        if row.t_reply >= from_s and row.beacon_id in dive.beacons:
            model = TwoWayTime(TravelTime(dive, row, row.t_reply))
            found.append((Measurement(np.array([row.travel_time]), row.t_reply, model), row))
    for t_s, place, sigma_m in dive.fixes:
        if t_s >= from_s:
            found.append((Measurement(place, t_s, Fix(sigma_m)), None))
    return sorted(found, key=lambda pair: pair[0].stamp)


def run(dive: DiveData) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Track at 1 Hz, and whether each reply was accepted."""
    t_s, x0, P0 = start_of(dive)
    ekf = ExtendedKalmanFilter(DeadReckoning(dive), reject_outliers=True)
    x = StateWithCovariance(VectorState(x0, stamp=t_s), P0)
    waiting = measurements(dive, t_s)[::-1]
    track, decisions = [], []
    for tick_s in np.arange(np.ceil(t_s), dive.t_s[-1]):
        while waiting and waiting[-1][0].stamp <= tick_s:
            y, row = waiting.pop()
            x = ekf.predict(x, True, y.stamp - x.state.stamp)
            x, details = ekf.correct(x, y, None, output_details=True)
            if row is not None:
                accepted = not details["is_outlier"]
                decisions.append((row.ping_id, row.beacon_id, row.travel_time, accepted))
        x = ekf.predict(x, True, tick_s - x.state.stamp)
        sigma = np.sqrt(np.diag(x.covariance)[:2])
        track.append((tick_s, *x.state.value[:2], *sigma, x.covariance[0, 1]))
    names = ["t", "east_m", "north_m", "sigma_east_m", "sigma_north_m", "cov_east_north_m2"]
    columns = ["ping_id", "beacon_id", "travel_time_s", "accepted"]
    return pd.DataFrame(track, columns=names), pd.DataFrame(decisions, columns=columns)


def main() -> None:
    dive = read_dive(Path(sys.argv[1]))
    write_track(Path(sys.argv[2]), dive, *run(dive))


if __name__ == "__main__":
    main()
