# SPDX-License-Identifier: Apache-2.0
"""What the settings know of the sensors' own errors, taken out before anything is navigated."""

from dataclasses import replace

import numpy as np

from abyssnav.config import Calibration
from abyssnav.estimation.dive_states import deviation_shapes
from abyssnav.geometry import body_to_body
from abyssnav.tables import Check, Columns, Float, Log


def apply_calibration(log: Log, calibration: Calibration) -> tuple[Log, list[Check]]:
    """Sensors as they would have read without the errors of `[calibration]`.

        ψ = ψ_read - bias - a₁ sin ψ_read - b₁ cos ψ_read - a₂ sin 2ψ_read - b₂ cos 2ψ_read
        v = R v_read / (1 + s),     R = Rz(yaw) Ry(pitch) Rx(roll),     t = t_stamp - latency

    A velocity of the earth's frame is stretched only: its instrument turned it by a compass of its
    own.  The profile's declination, mounting and latency have been applied before.
    """
    if calibration == Calibration():
        return log, []
    changes = {"heading": _true_heading, "velocity": _true_velocity}
    roles = dict(log.roles)
    for role in ("heading", "velocity", "travel_time"):
        if role not in roles:
            continue
        columns = _in_time(roles[role], getattr(calibration.latency_s, role))
        roles[role] = changes[role](columns, calibration) if role in changes else columns
    check = Check("align", "calibration_applied", 1, 1, "", True, _words(calibration), "min")
    return replace(log, roles=roles), [check]


def _in_time(columns: Columns, latency_s: float) -> Columns:
    late_ns = round(latency_s * 1e9)
    stamps = [name for name in ("time_ns", "ping_time_ns") if name in columns and late_ns]
    return {**columns, **{name: columns[name] - late_ns for name in stamps}}


def _true_heading(columns: Columns, calibration: Calibration) -> Columns:
    read_rad = columns["heading_rad"]
    return {**columns, "heading_rad": read_rad - compass_error(read_rad, calibration)}


def compass_error(read_rad: Float, calibration: Calibration) -> Float:
    """What the compass reads too much (n,) rad, at what it reads."""
    amplitudes_rad = np.radians(calibration.deviation_deg)
    by_heading = deviation_shapes(read_rad) @ amplitudes_rad
    return np.asarray(np.radians(calibration.heading_bias_deg) + by_heading)


def _true_velocity(columns: Columns, calibration: Calibration) -> Columns:
    changed = dict(columns)
    if "velocity_body_mps" in columns:
        turned = body_to_body(
            np.asarray(columns["velocity_body_mps"], dtype=float),
            *np.radians(calibration.mount_rpy_deg),
        )
        changed["velocity_body_mps"] = turned / (1 + calibration.dvl_scale)
    if "velocity_enu_mps" in columns:
        changed["velocity_enu_mps"] = columns["velocity_enu_mps"] / (1 + calibration.dvl_scale)
    return changed


def _words(calibration: Calibration) -> str:
    late = calibration.latency_s
    return (
        f"heading {calibration.heading_bias_deg:+.2f}°, DVL scale {calibration.dvl_scale:+.4f}, "
        f"latencies of heading, velocity, travel time {late.heading:+.3f}, {late.velocity:+.3f}, "
        f"{late.travel_time:+.3f} s taken out"
    )
