# SPDX-License-Identifier: Apache-2.0
"""How long sound takes: the true profile, direct paths and bounces, the two-way time (Eq. 3)."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.random import Generator

from abyssnav.acoustics.ray_tracing import travel_time
from abyssnav.errors import SolveError
from abyssnav.simulate import scenario as settings
from abyssnav.tables import Float, Int, SoundSpeed

#: Paths of one leg.
DIRECT, BOTTOM, SURFACE = 0, 1, 2

# Sixteen nodes integrate 1/c(z) of Munk's profile from the surface to 6 km to 1e-10.
_NODE, _WEIGHT = np.polynomial.legendre.leggauss(16)
_LEVEL_M = 50.0
_FINE_LEVEL_M = 10.0
#: Sound speed at the floor of Munk's profile, by which errors in m/s become relative ones.
NOMINAL_MPS = 1550.0
_DEEPEST_M = 6100.0
#: Half the longest wave of a recorded profile's wrong shape.
MISFIT_M = 3000.0


@dataclass(frozen=True)
class Water:
    """The sound speed over depth, true and as recorded."""

    profile: Literal["munk", "linear", "constant"]
    speed_mps: float  #: the constant; of one gradient, at `depth_m`
    scale: float = 0.0  #: k = c_recorded / c_true - 1
    gradient_per_s: float = 0.0
    depth_m: float = 0.0
    misfit_mps: tuple[float, ...] = ()  #: of the recorded shape, wave by wave
    misfit_phase_rad: tuple[float, ...] = ()

    @property
    def bends(self) -> bool:
        """Whether sound goes other than straight."""
        return self.profile != "constant"

    def shape_mps(self, depth_m: Float) -> Float:
        """Profile that the true one is in proportion to.

        Munk's: c = 1500 (1 + 0.00737 (η - 1 + exp(-η))), η = 2 (z - 1300) / 1300.
        """
        depth_m = np.asarray(depth_m)
        if self.profile == "munk":
            eta = 2 * (depth_m - 1300.0) / 1300.0
            return np.asarray(1500.0 * (1 + 0.00737 * (eta - 1 + np.exp(-eta))))
        gradient = self.gradient_per_s if self.profile == "linear" else 0.0
        return np.asarray(self.speed_mps + gradient * (depth_m - self.depth_m))

    def recorded_mps(self, depth_m: Float) -> Float:
        """What the log or the navigator takes for the sound speed."""
        wave = [
            mps * np.cos(np.pi * number * np.asarray(depth_m) / MISFIT_M + phase)
            for number, (mps, phase) in enumerate(
                zip(self.misfit_mps, self.misfit_phase_rad, strict=True), start=1
            )
        ]
        return np.asarray(self.shape_mps(depth_m) + sum(wave))

    def true_mps(self, depth_m: Float) -> Float:
        """What the sound obeys."""
        return np.asarray(self.shape_mps(depth_m) / (1 + self.scale))

    def recorded_profile(self) -> SoundSpeed:
        """The cast that the log holds: a level every 50 m."""
        depth_m = np.arange(0.0, _DEEPEST_M + 1, _LEVEL_M)
        return SoundSpeed(depth_m, self.recorded_mps(depth_m))

    def fine_profile(self) -> SoundSpeed:
        """What rays go through: levels so close that their time is the curve's to a microsecond."""
        depth_m = np.arange(0.0, _DEEPEST_M + 1, _FINE_LEVEL_M)
        return SoundSpeed(depth_m, self.true_mps(depth_m))

    def mean_slowness(self, depth_a_m: Float, depth_b_m: Float) -> Float:
        """Mean of 1/c between two depths [s/m]: one over the harmonic mean speed."""
        middle, half = 0.5 * (depth_a_m + depth_b_m), 0.5 * (depth_b_m - depth_a_m)
        depth = middle[..., None] + half[..., None] * _NODE
        return np.asarray(0.5 * (1 / self.true_mps(depth)) @ _WEIGHT)


def make_water(sound: settings.Sound, floor_m: float, error_mps: float, rng: Generator) -> Water:
    """Water in which the recorded speed is `error_mps` above the true one, and misshapen.

    Three waves of random height and phase over depth make the wrong shape.
    """
    nominal_mps = NOMINAL_MPS if sound.profile == "munk" else sound.speed_mps
    height_mps = sound.shape_sigma_mps * np.sqrt(2 / 3) * rng.normal(size=3)
    return Water(
        profile=sound.profile,
        speed_mps=sound.speed_mps,
        scale=error_mps / (nominal_mps - error_mps),
        gradient_per_s=sound.gradient_per_s,
        depth_m=floor_m,
        misfit_mps=tuple(height_mps.tolist()),
        misfit_phase_rad=tuple(rng.uniform(0, 2 * np.pi, 3).tolist()),
    )


def leg_time(
    vehicle_enu_m: Float, beacon_enu_m: Float, path: Int, floor_depth_m: Float, water: Water
) -> Float:
    """One way through the water: by the bent ray, a bounce straight with its depths' mean slowness.

    A bounce is the straight path to the beacon's mirror image.  In the surface the image lies z_b
    above it; in the floor, a plane from below the vehicle to below the beacon, heights h above it,
        L² = r² + 4 h_v h_b        (r: slant range of the direct path)

    Parameters
    ----------
    vehicle_enu_m, beacon_enu_m : (n, 3) m, ENU
    path : (n,) DIRECT, BOTTOM or SURFACE
    floor_depth_m : (n, 2) m, below the vehicle and below the beacon

    Returns
    -------
    time_s : (n,) s
    """
    depth = -np.stack([vehicle_enu_m[:, 2], beacon_enu_m[:, 2]], axis=-1)
    height = floor_depth_m - depth
    range_m = np.linalg.norm(vehicle_enu_m - beacon_enu_m, axis=-1)
    four_products = np.select(
        [path == BOTTOM, path == SURFACE], [height.prod(axis=-1), depth.prod(axis=-1)], 0.0
    )
    length_m = np.sqrt(range_m**2 + 4 * four_products)
    to_floor = _weighted(water.mean_slowness(depth, floor_depth_m), height)
    to_surface = _weighted(water.mean_slowness(depth, np.zeros_like(depth)), depth)
    direct = water.mean_slowness(depth[:, 0], depth[:, 1])
    slowness = np.select([path == BOTTOM, path == SURFACE], [to_floor, to_surface], direct)
    time_s = np.asarray(length_m * slowness)
    if water.bends:
        rows = np.flatnonzero(path == DIRECT)
        level_m = np.hypot(*(vehicle_enu_m - beacon_enu_m)[rows, :2].T)
        bent_s = travel_time(water.fine_profile(), depth[rows, 0], depth[rows, 1], level_m)
        time_s[rows] = np.where(np.isnan(bent_s), time_s[rows], bent_s)
    return time_s


def two_way_time(
    position: Callable[[Float], Float],
    t_ping_s: Float,
    turn_around_s: Float,
    leg_s: Callable[[Float, int], Float],
) -> Float:
    """Time from ping to reply, as the moving vehicle hears it (Eq. 3).

        T = leg(p(t)) + τ + leg(p(t + T))

    by fixed-point iteration; each pass shrinks the error by vehicle speed over sound speed.

    Parameters
    ----------
    position : (n,) s -> (n, 3) m, ENU: of the transducer
    t_ping_s, turn_around_s : (n,) s
    leg_s : time of a leg from the vehicle's positions (n, 3); 0 is the way out, 1 the way back

    Raises
    ------
    SolveError
        Ten passes do not reach 1e-12 s: the vehicle outruns sound.
    """
    out_s = leg_s(position(t_ping_s), 0) + turn_around_s
    total_s = 2 * out_s - turn_around_s
    for _ in range(10):
        before_s = total_s
        total_s = out_s + leg_s(position(t_ping_s + total_s), 1)
        if np.all(np.abs(total_s - before_s) < 1e-12):
            return total_s
    raise SolveError("two-way time does not settle in ten passes: the vehicle outruns sound")


def _weighted(slowness: Float, weight: Float) -> Float:
    """Mean slowness of two stretches, by their vertical extents."""
    return np.asarray((slowness * weight).sum(axis=-1) / weight.sum(axis=-1))
