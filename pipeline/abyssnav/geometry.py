# SPDX-License-Identifier: Apache-2.0
"""Rotations, wrapping, interpolation, local ENU and geodetic coordinates, depth from pressure."""

from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from abyssnav.tables import Float, Int

#: Horizontal vectors as complex numbers, east + i north: a turn by an angle is a factor.
Plane = NDArray[np.complex128]
#: What can be interpolated.
Number = TypeVar("Number", np.float64, np.complex128)

#: χ² of two degrees of freedom at 95 %.
CHI2_95_OF_2: Final = 5.991464547107979

# WGS 84
_SEMI_MAJOR_M = 6378137.0
_FLATTENING = 1 / 298.257223563
_E2 = _FLATTENING * (2 - _FLATTENING)


def plane(vector_m: Float) -> Plane:
    """Complex numbers (...) from vectors (..., 2), east and north."""
    return np.ascontiguousarray(vector_m).view(np.complex128)[..., 0]


def pairs(complex_m: Plane) -> Float:
    """East and north (..., 2) of complex numbers (...)."""
    return np.asarray(complex_m, order="C")[..., None].view(np.float64)


def wrap_angle(angle_rad: Float) -> Float:
    """Angle (...) brought into [-π, π)."""
    return (angle_rad + np.pi) % (2 * np.pi) - np.pi


def body_to_enu(vector_body: Float, roll_rad: Float, pitch_rad: Float, heading_rad: Float) -> Float:
    """Vectors turned from body to ENU: v_enu = E · Rz(ψ) Ry(θ) Rx(φ) · v_body.

    E swaps north-east-down for east-north-up.  At zero roll and pitch this is Eq. 2:
    v_e = v cos ψ + u sin ψ,  v_n = -v sin ψ + u cos ψ.

    Parameters
    ----------
    vector_body : (..., 3), forward, starboard, down
    roll_rad, pitch_rad, heading_rad : (...) rad

    Returns
    -------
    vector_enu : (..., 3), east, north, up
    """
    forward, starboard, down = leveled(vector_body, roll_rad, pitch_rad)
    sin_heading, cos_heading = np.sin(heading_rad), np.cos(heading_rad)
    return np.stack(
        [
            starboard * cos_heading + forward * sin_heading,
            -starboard * sin_heading + forward * cos_heading,
            -down,
        ],
        axis=-1,
    )


def enu_to_body(vector_enu: Float, roll_rad: Float, pitch_rad: Float, heading_rad: Float) -> Float:
    """Vectors turned from ENU to the body, the inverse of `body_to_enu`: v_body = Rᵀ · v_enu.

    Parameters
    ----------
    vector_enu : (n, 3), east, north, up

    Returns
    -------
    vector_body : (n, 3), forward, starboard, down
    """
    east, north, up = np.moveaxis(np.asarray(vector_enu, dtype=float), -1, 0)
    sin_heading, cos_heading = np.sin(heading_rad), np.cos(heading_rad)
    ahead = east * sin_heading + north * cos_heading
    starboard = east * cos_heading - north * sin_heading
    return to_body(np.stack([ahead, starboard, -up], axis=-1), roll_rad, pitch_rad)


def body_to_body(vector: Float, roll_rad: float, pitch_rad: float, yaw_rad: float) -> Float:
    """Vectors turned from an instrument's axes to the vehicle's: v_body = Rz(ψ) Ry(θ) Rx(φ) · v.

    Parameters
    ----------
    vector : (..., 3), the instrument's forward, starboard, down
    roll_rad, pitch_rad, yaw_rad : how the instrument is turned on the vehicle, rad

    Returns
    -------
    vector_body : (..., 3), forward, starboard, down
    """
    forward, starboard, down = leveled(vector, np.asarray(roll_rad), np.asarray(pitch_rad))
    sin_yaw, cos_yaw = np.sin(yaw_rad), np.cos(yaw_rad)
    return np.stack(
        [forward * cos_yaw - starboard * sin_yaw, forward * sin_yaw + starboard * cos_yaw, down],
        axis=-1,
    )


def leveled(vector_body: Float, roll_rad: Float, pitch_rad: Float) -> tuple[Float, Float, Float]:
    """Forward, starboard and down (...) in the level frame: Ry(θ) Rx(φ) v.

    Parameters
    ----------
    vector_body : (..., 3), forward, starboard, down
    """
    forward, starboard, down = np.moveaxis(np.asarray(vector_body, dtype=float), -1, 0)
    sin_roll, cos_roll = np.sin(roll_rad), np.cos(roll_rad)
    sin_pitch, cos_pitch = np.sin(pitch_rad), np.cos(pitch_rad)
    rolled_down = starboard * sin_roll + down * cos_roll
    return (
        forward * cos_pitch + rolled_down * sin_pitch,
        starboard * cos_roll - down * sin_roll,
        -forward * sin_pitch + rolled_down * cos_pitch,
    )


def body_axes(roll_rad: Float, pitch_rad: Float, heading_rad: Float) -> tuple[Plane, Float]:
    """Horizontal (n, 3) and upward (n, 3) parts of the body's axes: forward, starboard, down."""
    axes = np.broadcast_to(np.eye(3), (len(heading_rad), 3, 3))
    bow, starboard, down = leveled(axes, roll_rad[:, None], pitch_rad[:, None])
    ahead = np.sin(heading_rad) + 1j * np.cos(heading_rad)
    return (bow - 1j * starboard) * ahead[:, None], -down


def to_body(vector_level: Float, roll_rad: Float, pitch_rad: Float) -> Float:
    """Vectors (n, 3) turned from the level frame to the body's: (Ry(θ) Rx(φ))ᵀ v.

    Parameters
    ----------
    vector_level : (n, 3), forward, starboard, down, but for the heading level
    """
    forward, starboard, down = np.asarray(vector_level, dtype=float).T
    sin_roll, cos_roll = np.sin(roll_rad), np.cos(roll_rad)
    sin_pitch, cos_pitch = np.sin(pitch_rad), np.cos(pitch_rad)
    pitched_down = forward * sin_pitch + down * cos_pitch
    vector_body = np.empty((3, len(forward)))  # a column's numbers side by side, as they are used
    vector_body[0] = forward * cos_pitch - down * sin_pitch
    vector_body[1] = starboard * cos_roll + pitched_down * sin_roll
    vector_body[2] = pitched_down * cos_roll - starboard * sin_roll
    return vector_body.T


def quaternion_xyzw(roll_rad: Float, pitch_rad: Float, heading_rad: Float) -> Float:
    """Quaternions (n, 4) from forward-port-up to ENU, as ROS has them (REP-103).

    q = q_z(π/2 - ψ) q_y(-θ) q_x(φ): yaw counter-clockwise from east, pitch positive bow down.
    A roll or pitch that is not known (NaN) is taken as level.
    """
    roll, pitch = 0.5 * np.nan_to_num(roll_rad), -0.5 * np.nan_to_num(pitch_rad)
    yaw = 0.5 * (0.5 * np.pi - heading_rad)
    sr, cr, sp, cp = np.sin(roll), np.cos(roll), np.sin(pitch), np.cos(pitch)
    sy, cy = np.sin(yaw), np.cos(yaw)
    quat_xyzw = np.empty((4, len(sr)))
    quat_xyzw[0] = sr * (cp * cy) - cr * (sp * sy)
    quat_xyzw[1] = cr * (sp * cy) + sr * (cp * sy)
    quat_xyzw[2] = cr * (cp * sy) - sr * (sp * cy)
    quat_xyzw[3] = cr * (cp * cy) + sr * (sp * sy)
    return quat_xyzw.T


def ellipse_95(cov_m2: Float) -> tuple[Float, Float]:
    """Half axes (n, 2) m, the larger first, of the ellipses that hold 95 %, and their directions.

    The eigenvalues of [[a, b], [b, d]] are (a + d) / 2 ± √((a - d)² / 4 + b²); a half axis is
    √(χ² λ), and the larger one lies ½ atan2(2 b, a - d) from east towards north, (n,) rad.

    Parameters
    ----------
    cov_m2 : (n, 2, 2) of a horizontal position
    """
    (east_m2, cross_m2), (_, north_m2) = np.moveaxis(cov_m2, 0, -1)
    mean_m2, half_gap_m2 = 0.5 * (east_m2 + north_m2), 0.5 * (east_m2 - north_m2)
    off_mean_m2 = np.hypot(half_gap_m2, cross_m2)
    variance_m2 = np.column_stack([mean_m2 + off_mean_m2, mean_m2 - off_mean_m2])
    half_m = np.sqrt(CHI2_95_OF_2 * np.maximum(variance_m2, 0.0))
    return half_m, 0.5 * np.arctan2(cross_m2, half_gap_m2)


def interpolate(t_s: Float, knots_s: Float, values: NDArray[Number]) -> NDArray[Number]:
    """Linear interpolation of any column (n, ...) at once; the ends are held.

    Parameters
    ----------
    t_s : (m,) s, where to interpolate
    knots_s : (n,) s, rising
    values : (n, ...)
    """
    return blend(values, *bracket(t_s, knots_s))


def bracket(t_s: Float, knots_s: Float) -> tuple[Int, Int, Float]:
    """Rows of the knots before and after each instant, and the share (m,) of the later one."""
    if len(knots_s) == 1:
        first = np.zeros(len(t_s), dtype=np.int64)
        return first, first, np.zeros(len(t_s))
    right = np.clip(np.searchsorted(knots_s, t_s, side="right"), 1, len(knots_s) - 1)
    left = right - 1
    share = np.clip((t_s - knots_s[left]) / (knots_s[right] - knots_s[left]), 0.0, 1.0)
    return left, right, share


def blend(values: NDArray[Number], left: Int, right: Int, share: Float) -> NDArray[Number]:
    """Values (n, ...) between two rows each, as of `bracket`.

    Parameters
    ----------
    values : (m, ...) at the knots
    left, right : (n,) rows
    share : (n,) of the way from the left to the right one
    """
    share = share.reshape(share.shape + (1,) * (values.ndim - 1))
    return np.asarray((1 - share) * values[left] + share * values[right])


def geodetic_to_enu(
    origin_latitude_deg: float,
    origin_longitude_deg: float,
    latitude_deg: Float,
    longitude_deg: Float,
    height_m: Float,
) -> Float:
    """WGS 84 coordinates in the tangent frame (east, north, up) of the origin at height 0.

    Returns
    -------
    position_enu_m : (..., 3) m
    """
    origin = _ecef(np.asarray(origin_latitude_deg), np.asarray(origin_longitude_deg), np.zeros(()))
    place = _ecef(np.asarray(latitude_deg), np.asarray(longitude_deg), np.asarray(height_m))
    return (place - origin) @ _rot_enu_ecef(origin_latitude_deg, origin_longitude_deg).T


def enu_to_geodetic(
    origin_latitude_deg: float, origin_longitude_deg: float, position_enu_m: Float
) -> tuple[Float, Float, Float]:
    """Tangent-frame positions as WGS 84 latitude, longitude (degrees) and height (m).

    The latitude comes from Bowring's formula, refined twice and kept as a tangent till the end;
    exact to a nanometre at sea.

    Parameters
    ----------
    position_enu_m : (..., 3) m, ENU
    """
    origin = _ecef(np.asarray(origin_latitude_deg), np.asarray(origin_longitude_deg), np.zeros(()))
    rot_enu_ecef = _rot_enu_ecef(origin_latitude_deg, origin_longitude_deg)
    east, north, up = np.ascontiguousarray(np.moveaxis(np.asarray(position_enu_m), -1, 0))
    x, y, z = (  # a matrix product would wake all threads of BLAS for it
        east * a + north * b + up * c + shift
        for (a, b, c), shift in zip(rot_enu_ecef.T, origin, strict=True)
    )
    equatorial = np.maximum(np.hypot(x, y), 1e-6)  # not 0 / 0 at a pole
    flat = 1 - _FLATTENING
    tangent, cos, sin = z / equatorial, np.ones(()), np.zeros(())
    for _ in range(3):
        reduced = flat * tangent
        cos = 1 / np.sqrt(1 + reduced * reduced)
        sin = reduced * cos
        tangent = (z + _E2 / (1 - _E2) * flat * _SEMI_MAJOR_M * sin**3) / (
            equatorial - _E2 * _SEMI_MAJOR_M * cos**3
        )
    cos = 1 / np.sqrt(1 + tangent * tangent)
    sin = tangent * cos
    height = equatorial * cos + z * sin - _SEMI_MAJOR_M * np.sqrt(1 - _E2 * sin * sin)
    return np.degrees(np.arctan(tangent)), np.degrees(np.arctan2(y, x)), height


def depth_of_pressure(pressure_dbar: Float, latitude_deg: float) -> Float:
    """Depth (n,) m, positive down, from the pressure above that of the air (n,) dbar.

    TEOS-10 (IOC, SCOR and IAPSO, "The International Thermodynamic Equation of Seawater", 2010).
    """
    import gsw  # which takes a tenth of a second, and few dives need it

    return -np.asarray(gsw.z_from_p(pressure_dbar, latitude_deg))


def _ecef(latitude_deg: Float, longitude_deg: Float, height_m: Float) -> Float:
    latitude, longitude = np.radians(latitude_deg), np.radians(longitude_deg)
    vertical = _SEMI_MAJOR_M / np.sqrt(1 - _E2 * np.sin(latitude) ** 2)
    return np.stack(
        [
            (vertical + height_m) * np.cos(latitude) * np.cos(longitude),
            (vertical + height_m) * np.cos(latitude) * np.sin(longitude),
            (vertical * (1 - _E2) + height_m) * np.sin(latitude),
        ],
        axis=-1,
    )


def _rot_enu_ecef(latitude_deg: float, longitude_deg: float) -> Float:
    """Rotation that takes ECEF vectors to the ENU of a place."""
    latitude, longitude = np.radians(latitude_deg), np.radians(longitude_deg)
    sin_lat, cos_lat = np.sin(latitude), np.cos(latitude)
    sin_lon, cos_lon = np.sin(longitude), np.cos(longitude)
    return np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )
