# SPDX-License-Identifier: Apache-2.0
"""A dive of a hundred seconds as columns, to be bent in one place at a time."""

import dataclasses

import numpy as np

from abyssnav.tables import Log

START_NS = 1_750_000_000_000_000_000
TOPICS = {
    "heading": "/imu",
    "velocity": "/dvl",
    "depth": "/depth",
    "travel_time": "/lbl/travel_time",
    "beacons": "/lbl/beacons",
    "sound_speed": "/sound_speed/profile",
    "reference": "/reference",
}
PLACES = np.array([[0.0, 2000.0, -4950.0], [1800.0, -900.0, -4960.0], [-1700.0, -1100.0, -4940.0]])


def stamps(t_s):
    return START_NS + np.round(np.asarray(t_s) * 1e9).astype(np.int64)


def small_log(duration_s=100.0, **changed):
    """A turning, pitching dive of a few pings; `changed` gives columns to put in a role's."""
    t_heading, t_velocity = np.arange(0, duration_s, 0.1), 0.07 + np.arange(0, duration_s, 0.2)
    t_depth = 0.3 + np.arange(0, duration_s, 1.0)
    t_ping = np.repeat(5.0 + 24.0 * np.arange(4), 3)
    travel_time_s = 3.0 + 0.1 * np.arange(12)
    n = len(t_velocity)
    roles = {
        "heading": {
            "time_ns": stamps(t_heading),
            "roll_rad": 0.1 * np.sin(t_heading),
            "pitch_rad": 0.05 * np.cos(t_heading),
            "heading_rad": (6.2 + 0.01 * t_heading) % (2 * np.pi),
        },
        "velocity": {
            "time_ns": stamps(t_velocity),
            "velocity_body_mps": np.tile([1.2, 0.1, 0.0], (n, 1)),
            "valid": np.full(n, True),
        },
        "depth": {"time_ns": stamps(t_depth), "depth_m": 4900.0 + 0.5 * t_depth},
        "travel_time": {
            "time_ns": stamps(t_ping + travel_time_s),
            "ping_time_ns": stamps(t_ping),
            "ping_id": np.repeat(np.arange(4), 3),
            "beacon_id": np.tile([3, 1, 2], 4),
            "travel_time_s": travel_time_s,
            "snr_db": np.full(12, 20.0, dtype=np.float32),
        },
        "beacons": beacon_rows([1, 2, 3], PLACES),
    }
    for role, columns in changed.items():
        roles[role] = {**roles.get(role, {}), **columns}
    return Log("small", (), "default", TOPICS, roles)


def beacon_rows(ids, places, message=0, t_s=0.0, origin=(np.nan, np.nan)):
    n = len(ids)
    return {
        "time_ns": np.full(n, stamps(t_s)),
        "message": np.full(n, message),
        "id": np.array(ids),
        "name": np.array([f"B{i}" for i in ids]),
        "position_enu_m": np.array(places, float),
        "turn_around_s": 0.1 * np.array(ids),
        "sigma_m": np.full(n, np.nan),
        "origin_latitude_deg": np.full(n, origin[0]),
        "origin_longitude_deg": np.full(n, origin[1]),
    }


def without(log, role):
    return dataclasses.replace(log, roles={r: c for r, c in log.roles.items() if r != role})


def rows_of(log, role, rows):
    columns = {name: column[rows] for name, column in log.roles[role].items()}
    return dataclasses.replace(log, roles={**log.roles, role: columns})


def check(dive, name):
    (found,) = [c for c in dive.checks if c.name == name]
    return found


def same(one, other):
    return all(
        np.array_equal(column, getattr(other, name), equal_nan=column.dtype.kind == "f")
        for name, column in one.columns().items()
    )
