# SPDX-License-Identifier: Apache-2.0
"""Scenario -> simulated dive: the truth, and what its sensors recorded of it."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator

from abyssnav.geometry import interpolate
from abyssnav.simulate import sensors
from abyssnav.simulate.replies import HeardReplies, Scene, hear_replies, place_beacons
from abyssnav.simulate.scenario import Scenario
from abyssnav.simulate.sound import Water, make_water
from abyssnav.simulate.vehicle import STEP_S, TrueMotion, make_relief, move
from abyssnav.tables import Beacons, Columns, Depth, Float, Heading, Int, SoundSpeed

_PARTS = ("vehicle", "floor", "beacons", "survey", "sound", "compass", "dvl", "depth", "replies")


@dataclass(frozen=True, eq=False)
class Truth:
    """What nobody aboard knows."""

    motion: TrueMotion
    beacons: Beacons  #: where they really stand
    water: Water
    compass: sensors.CompassError
    dvl: sensors.DvlError
    depth_bias_m: float


@dataclass(frozen=True, eq=False)
class Simulation:
    """One simulated dive: readings in seconds since `start_ns`, and the truth."""

    scenario: Scenario
    start_ns: int
    heading: Heading
    velocity: sensors.DvlReadings
    depth: Depth
    replies: HeardReplies
    beacons: Beacons  #: as recorded
    sound_speed: SoundSpeed | None  #: as recorded; None where the scenario's speed is one constant
    truth: Truth

    def position_at(self, t_s: Float) -> Float:
        """True positions (n, 3) m ENU of the navigated point."""
        motion = self.truth.motion
        return interpolate(t_s, motion.t_s, motion.position_enu_m)


def simulate(scenario: Scenario) -> Simulation:
    """Dive of a scenario; the same scenario gives the same numbers.

    Each part draws from a generator of its own, so that changing the acoustics moves neither the
    track nor the compass.
    """
    rng = _generators(scenario.seed)
    relief = make_relief(scenario.floor, rng["floor"])
    motion = move(scenario.vehicle, scenario.floor, relief, scenario.duration_s, rng["vehicle"])
    beacons = place_beacons(scenario.beacons, scenario.floor, relief, rng["beacons"])
    sound = scenario.sound
    error_mps = sound.error_mps + sound.error_sigma_mps * rng["sound"].normal()
    water = make_water(sound, error_mps)
    scene = Scene(
        motion, beacons, scenario.floor, relief, water, scenario.vehicle.transducer_offset_m
    )
    heading, compass_error = sensors.read_compass(scenario.compass, motion, rng["compass"])
    velocity, dvl_error = sensors.read_dvl(scenario.dvl, motion, rng["dvl"])
    depth, depth_bias_m = sensors.read_depth(scenario.depth, motion, rng["depth"])
    survey_error = scenario.beacons.survey_sigma_m * rng["survey"].normal(size=(len(beacons), 3))
    return Simulation(
        scenario=scenario,
        start_ns=_nanoseconds(scenario),
        heading=heading,
        velocity=velocity,
        depth=depth,
        replies=hear_replies(scenario, scene, rng["replies"]),
        beacons=replace(beacons, position_enu_m=beacons.position_enu_m + survey_error),
        sound_speed=water.recorded_profile() if water.munk else None,
        truth=Truth(motion, beacons, water, compass_error, dvl_error, depth_bias_m),
    )


def roles(simulation: Simulation) -> dict[str, Columns]:
    """The recorded columns by role, as `abyssnav.tables.Log` has them."""

    def stamps(t_s: Float) -> Int:
        return simulation.start_ns + np.round(t_s * 1e9).astype(np.int64)

    heading, velocity, replies = simulation.heading, simulation.velocity, simulation.replies
    motion, profile = simulation.truth.motion, simulation.sound_speed
    ping_ns = stamps(replies.t_ping_s)
    seldom = motion[:: max(round(1 / (STEP_S * simulation.scenario.reference_rate_hz)), 1)]
    columns: dict[str, Columns] = {
        "heading": {
            "time_ns": stamps(heading.t_s),
            "roll_rad": heading.roll_rad,
            "pitch_rad": heading.pitch_rad,
            "heading_rad": heading.heading_rad % (2 * np.pi),
        },
        "velocity": {
            "time_ns": stamps(velocity.t_s),
            "velocity_body_mps": velocity.velocity_body_mps,
            "valid": velocity.valid,
        },
        "depth": {"time_ns": stamps(simulation.depth.t_s), "depth_m": simulation.depth.depth_m},
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
    beacons, scenario = simulation.beacons, simulation.scenario
    return {
        **_one_message(simulation, len(beacons)),
        **beacons.columns(),
        "origin_latitude_deg": np.full(len(beacons), scenario.origin_latitude_deg),
        "origin_longitude_deg": np.full(len(beacons), scenario.origin_longitude_deg),
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
