# SPDX-License-Identifier: Apache-2.0
"""Scenario -> simulated dive: the truth, and what its sensors recorded of it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.random import Generator

from abyssnav.geometry import interpolate
from abyssnav.simulate import sensors
from abyssnav.simulate.beacons import (
    BeaconMotion,
    log_places,
    move_beacons,
    place_beacons,
    record_beacons,
)
from abyssnav.simulate.positions import PositionFixes, fix_positions
from abyssnav.simulate.replies import Scene, SimulatedReplies, simulate_replies
from abyssnav.simulate.scenario import Scenario, draw
from abyssnav.simulate.sound import NOMINAL_MPS, Water, make_water
from abyssnav.simulate.vehicle import STEP_S, Relief, TrueMotion, gauss_markov, make_relief, move
from abyssnav.tables import Beacons, Columns, Depth, Float, Heading, Int, SoundSpeed

#: What dives of one voyage have in common, beside the constant errors of the sensors.
_IN_COMMON = ("floor", "beacons", "survey", "one", "turn_arounds")
_PARTS = (
    "vehicle", "floor", "beacons", "survey", "sound", "compass", "dvl", "depth", "replies", "one",
    "turn_arounds", "buoys", "shape", "drift", "range_bias", "current", "position",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Truth:
    """What nobody aboard knows."""

    motion: TrueMotion
    beacons: Beacons  #: where they really stand, to begin with
    beacon_motion: BeaconMotion
    water: Water
    slowness_drift: Float  #: (n,) share by which sound is slower at each instant of the motion
    odd_beacon: int  #: row of the one that is displaced, moved or late, where one is
    compass: sensors.CompassError
    dvl: sensors.DvlError
    water_mps: Float  #: (n, 3) ENU of the water that the DVL takes for the ground; 0: bottom track
    depth_bias_m: float


@dataclass(frozen=True, eq=False)
class Simulation:
    """One simulated dive: readings in seconds since `start_ns`, and the truth."""

    scenario: Scenario
    start_ns: int
    heading: Heading
    velocity: sensors.DvlReadings
    depth: Depth
    replies: SimulatedReplies
    beacons: Beacons  #: as recorded, first
    beacon_log: BeaconMotion  #: their places as recorded; one row but of buoys
    positions: Mapping[str, PositionFixes]  #: `gnss` and `usbl`, where there are such
    sound_speed: SoundSpeed | None  #: as recorded; None where the log holds none
    truth: Truth

    def position_at(self, t_s: Float) -> Float:
        """True positions (n, 3) m ENU of the navigated point."""
        motion = self.truth.motion
        return interpolate(t_s, motion.t_s, motion.position_enu_m)


def simulate(scenario: Scenario, seed: int | None = None) -> Simulation:
    """Dive of a scenario; the same scenario and seed give the same numbers.

    Each part draws from a generator of its own, so that changing the acoustics moves neither the
    track nor the compass.

    Parameters
    ----------
    seed : in the place of the scenario's

    Raises
    ------
    ConfigError
        `vary` or `choose` name a key that is not there, or give it a value that it does not take.
    """
    if seed is not None:
        scenario = msgspec.structs.replace(scenario, seed=seed)
    scenario = draw(scenario)
    rng = _generators(scenario.seed)
    voyage = rng if scenario.voyage_seed is None else _generators(scenario.voyage_seed)
    rng |= {part: voyage[part] for part in _IN_COMMON}
    relief = make_relief(scenario.floor, rng["floor"])
    motion = move(scenario.vehicle, scenario.floor, relief, scenario.duration_s, rng["vehicle"])
    scene = _scene(scenario, motion, relief, rng)
    altitude_m = scene.floor_depth(motion.position_enu_m) + motion.position_enu_m[:, 2]
    water_mps = sensors.water_tracked(
        scenario.dvl, scenario.vehicle.current_mps, motion.t_s, rng["current"]
    )
    heading, compass_error = sensors.read_compass(
        scenario.compass, motion, (voyage["compass"], rng["compass"])
    )
    velocity, dvl_error = sensors.read_dvl(
        scenario.dvl, motion, altitude_m, water_mps, (voyage["dvl"], rng["dvl"])
    )
    depth, depth_bias_m = sensors.read_depth(
        scenario.depth, motion, (voyage["depth"], rng["depth"])
    )
    one = int(rng["one"].integers(len(scene.beacons)))
    recorded = record_beacons(scene.beacons, scenario, one, rng)
    scene = replace(scene, beacon_motion=move_beacons(scene.beacons, scenario, one, rng["buoys"]))
    truth = Truth(
        motion, scene.beacons, scene.beacon_motion, scene.water, scene.slowness_drift, one,
        compass_error, dvl_error, water_mps, depth_bias_m,
    )  # fmt: skip
    return Simulation(
        scenario=scenario,
        start_ns=_nanoseconds(scenario),
        heading=heading,
        velocity=velocity,
        depth=depth,
        replies=simulate_replies(scenario, scene, rng["replies"], rng["range_bias"]),
        beacons=recorded,
        beacon_log=log_places(recorded, scene.beacon_motion, scenario.buoys, rng["buoys"]),
        positions=fix_positions(scenario.position, motion, rng["position"]),
        sound_speed=scene.water.recorded_profile() if holds_profile(scenario) else None,
        truth=truth,
    )


def _scene(
    scenario: Scenario, motion: TrueMotion, relief: Relief, rng: Mapping[str, Generator]
) -> Scene:
    """The world of a scenario, its beacons at rest."""
    sound = scenario.sound
    beacons = place_beacons(scenario, relief, rng["beacons"])
    error_mps = sound.error_mps + sound.error_sigma_mps * rng["sound"].normal()
    water = make_water(sound, scenario.floor.depth_m, error_mps, rng["shape"])
    drift = gauss_markov(len(motion), STEP_S, sound.slow_time_s, rng["drift"])
    return Scene(
        motion=motion,
        beacons=beacons,
        beacon_motion=BeaconMotion(np.zeros(1), beacons.position_enu_m[None]),
        floor=scenario.floor,
        relief=relief,
        water=water,
        slowness_drift=sound.slow_sigma_mps / NOMINAL_MPS * drift,
        transducer_offset_m=scenario.vehicle.transducer_offset_m,
    )


def holds_profile(scenario: Scenario) -> bool:
    """Whether the log of a scenario's dive holds a sound-speed profile."""
    return scenario.sound.logged and scenario.sound.profile != "constant"


def roles(simulation: Simulation) -> dict[str, Columns]:
    """The recorded columns by role, as `abyssnav.tables.Log` has them."""

    def stamps(t_s: Float, late_s: float = 0.0) -> Int:
        return simulation.start_ns + np.round((t_s + late_s) * 1e9).astype(np.int64)

    clocks, faults = simulation.scenario.clocks, simulation.scenario.faults
    heading, velocity, replies = simulation.heading, simulation.velocity, simulation.replies
    motion, profile = simulation.truth.motion, simulation.sound_speed
    ping_ns = stamps(replies.t_ping_s, clocks.travel_time_s)
    sense = -1.0 if faults.heading_reversed else 1.0
    zeroed = faults.zeros_when_lost & ~velocity.valid
    seldom = motion[:: max(round(1 / (STEP_S * simulation.scenario.reference_rate_hz)), 1)]
    columns: dict[str, Columns] = {
        "heading": {
            "time_ns": stamps(heading.t_s, clocks.heading_s),
            "roll_rad": heading.roll_rad,
            "pitch_rad": heading.pitch_rad,
            "heading_rad": sense * heading.heading_rad % (2 * np.pi),
        },
        "velocity": {
            "time_ns": stamps(velocity.t_s, clocks.velocity_s),
            "velocity_body_mps": np.where(zeroed[:, None], 0.0, velocity.velocity_body_mps),
            "valid": velocity.valid | zeroed,
        },
        "depth": {
            "time_ns": stamps(simulation.depth.t_s, clocks.depth_s),
            "depth_m": simulation.depth.depth_m,
        },
        "travel_time": {
            "time_ns": ping_ns + np.round(replies.travel_time_s * 1e9).astype(np.int64),
            "ping_time_ns": ping_ns,
            "ping_id": replies.ping_id,
            "beacon_id": simulation.beacons.id[replies.beacon],
            "travel_time_s": replies.travel_time_s,
            "snr_db": replies.snr_db,
        },
        "beacons": _beacon_columns(simulation),
        "reference": {
            "time_ns": stamps(seldom.t_s),
            "position_enu_m": np.round(seldom.position_enu_m, 3),
        },
    }
    if profile is not None:
        columns["sound_speed"] = {**_one_message(simulation, len(profile)), **profile.columns()}
    return columns


def _beacon_columns(simulation: Simulation) -> Columns:
    """One row a beacon and message."""
    beacons, log, scenario = simulation.beacons, simulation.beacon_log, simulation.scenario
    n_messages, rows = len(log), len(log) * len(beacons)
    stamps_ns = simulation.start_ns + np.round(log.t_s * 1e9).astype(np.int64)
    repeated = {
        name: np.tile(getattr(beacons, name), n_messages)
        for name in ("id", "name", "turn_around_s", "sigma_m")
    }
    return {
        "time_ns": np.repeat(stamps_ns, len(beacons)),
        "message": np.repeat(np.arange(n_messages), len(beacons)),
        **repeated,
        "position_enu_m": log.position_enu_m.reshape(-1, 3),
        "origin_latitude_deg": np.full(rows, scenario.origin_latitude_deg),
        "origin_longitude_deg": np.full(rows, scenario.origin_longitude_deg),
    }


def _one_message(simulation: Simulation, rows: int) -> Columns:
    message = np.zeros(rows, dtype=np.int64)
    return {"time_ns": message + simulation.start_ns, "message": message}


def _generators(seed: int) -> dict[str, Generator]:
    return {part: np.random.default_rng([seed, place]) for place, part in enumerate(_PARTS)}


def _nanoseconds(scenario: Scenario) -> int:
    """UTC nanoseconds of the start; whole microseconds, so no float is asked to hold them."""
    since = scenario.start - scenario.start.fromtimestamp(0, scenario.start.tzinfo)
    return ((since.days * 86400 + since.seconds) * 1_000_000 + since.microseconds) * 1000
