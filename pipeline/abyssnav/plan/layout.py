# SPDX-License-Identifier: Apache-2.0
"""Layouts: beacons, a planned track and what the sensors are worth."""

from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from abyssnav.config import BeaconSetting, Config, OriginSetting
from abyssnav.errors import ConfigError
from abyssnav.geometry import geodetic_to_enu
from abyssnav.settings import settings_from_toml
from abyssnav.simulate import scenario as simulated
from abyssnav.simulate.scenario import Scenario
from abyssnav.tables import Beacons, Float, Origin

Positive = Annotated[float, Meta(gt=0)]


class PlannedTrack(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where the vehicle shall run."""

    #: East and north of the origin, at least two.
    waypoints_m: tuple[tuple[float, float], ...]
    depth_m: Positive
    speed_mps: Annotated[float, Meta(gt=0, le=10)] = 1.2


class Map(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The map of what to expect."""

    #: Cells along its longer side.
    cells: Annotated[int, Meta(ge=2, le=60)] = 16
    #: Around beacons and track, as a share of their extent.
    margin: Annotated[float, Meta(ge=0, le=2)] = 0.15


class Layout(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A layout to plan with; the sensors' tables are those of a scenario."""

    track: PlannedTrack
    #: As in the settings, which hold them where there are none here.
    beacon: tuple[BeaconSetting, ...] = ()
    origin: OriginSetting | None = None
    #: Radius that the survey needs; not given: 1.5 times the planned track's median.
    target_m: Positive | None = None
    map: Map = Map()
    sound: simulated.Sound = simulated.Sound()
    compass: simulated.Compass = simulated.Compass()
    dvl: simulated.Dvl = simulated.Dvl()
    depth: simulated.DepthSensor = simulated.DepthSensor()
    acoustics: simulated.Acoustics = simulated.Acoustics()

    def scenario(self) -> Scenario:
        """Scenario of dives with these sensors."""
        speed_mps = self.track.speed_mps
        return Scenario(
            vehicle=simulated.Vehicle(speed_mps=(speed_mps, speed_mps)),
            sound=self.sound,
            compass=self.compass,
            dvl=self.dvl,
            depth=self.depth,
            acoustics=self.acoustics,
        )


def load_layout(path: Path) -> Layout:
    """Layout of a TOML file.

    Raises
    ------
    ConfigError
        A file that cannot be read, an unknown key (with the nearest), or a track without a way.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or error
        raise ConfigError(f"{path}: cannot be read: {why}") from None
    layout = settings_from_toml(text, str(path), Layout)
    waypoints_m = np.array(layout.track.waypoints_m)
    if len(waypoints_m) < 2 or not np.any(np.ptp(waypoints_m, axis=0) > 0):
        raise ConfigError(f"{path}: [track] waypoints_m needs two places")
    return layout


def origin_of(layout: Layout, config: Config) -> Origin | None:
    """Origin of the layout, else of the settings, else the first geodetic beacon's place."""
    given = layout.origin or config.origin
    if given is not None:
        return Origin(given.latitude_deg, given.longitude_deg)
    for beacon in layout.beacon or config.beacon:
        if beacon.latitude_deg is not None and beacon.longitude_deg is not None:
            return Origin(beacon.latitude_deg, beacon.longitude_deg)
    return None


def beacons_of(layout: Layout, config: Config) -> Beacons:
    """Beacons of the layout, else of the settings.

    Raises
    ------
    ConfigError
        None, one number twice, or one without a place.
    """
    given = layout.beacon or config.beacon
    if not given:
        raise ConfigError("no beacons: [[beacon]] of the layout or of the settings")
    ids = [beacon.id for beacon in given]
    if len(set(ids)) < len(ids):
        raise ConfigError(f"[[beacon]]: {max(ids, key=ids.count)} is there twice")
    origin = origin_of(layout, config)
    return Beacons(
        id=np.array(ids),
        name=np.array([beacon.name or str(beacon.id) for beacon in given]),
        position_enu_m=np.array([_placed(beacon, origin) for beacon in given]),
        turn_around_s=np.array([beacon.turn_around_s for beacon in given]),
        sigma_m=np.array([beacon.sigma_m or config.errors.beacon_sigma_m for beacon in given]),
    )


def _placed(beacon: BeaconSetting, origin: Origin | None) -> Float:
    if beacon.position_m is not None:
        return np.array(beacon.position_m)
    if (
        beacon.latitude_deg is None
        or beacon.longitude_deg is None
        or beacon.depth_m is None
        or origin is None
    ):
        raise ConfigError(
            f"[[beacon]] {beacon.id}: give position_m, or latitude_deg, longitude_deg and depth_m"
        )
    place = geodetic_to_enu(
        origin.latitude_deg, origin.longitude_deg, np.array(beacon.latitude_deg),
        np.array(beacon.longitude_deg), np.array(-beacon.depth_m),
    )  # fmt: skip
    return np.array([place[0], place[1], -beacon.depth_m])
