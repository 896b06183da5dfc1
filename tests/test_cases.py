# SPDX-License-Identifier: Apache-2.0
"""Small logs of layouts that are met outside, with the profile that inspect proposes, unread.

Each is one simulated dive as another vehicle would log it; the right track is that of the default
layout.  Those of drivers with a profile of their own are in test_drivers.
"""

from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest
from drivers import blueos_mavlink, lbl_aqualoc, settings, teledyne_pd6
from vehicles import instead, json_channel, ros_roles, rows_of

from abyssnav.align import align, reference
from abyssnav.config import Config, schemas
from abyssnav.formats.mcap.writer import Channel, write_mcap
from abyssnav.navigate import navigate
from abyssnav.profile import load_profile, profile_from_toml
from abyssnav.read import inspect, read
from abyssnav.simulate import load_scenario, simulate, to_log
from abyssnav.tables import Log, Reference, Solution

NEAR_M = 0.05
#: One number for the water between is not the water.
NEAR_BY_MEAN_SPEED_M = 0.15


@pytest.fixture(scope="module")
def truth() -> Log:
    scenario = load_scenario(schemas() / "scenarios" / "clean.toml")
    return to_log(simulate(msgspec.structs.replace(scenario, duration_s=1500.0, seed=11)))


@pytest.fixture(scope="module")
def right_m(truth: Log) -> float:
    return error_m(navigate(align(truth, Config()), Config()), reference(truth))


def error_m(solution: Solution, truth: Reference | None) -> float:
    """Root mean square horizontal error of the smoother."""
    assert truth is not None
    track = solution.tracks["smoother"]
    t_s = (truth.time_ns - solution.dive.start_ns) / 1e9
    inside = (t_s >= track.t_s[0]) & (t_s <= track.t_s[-1])
    apart_m = [
        np.interp(t_s[inside], track.t_s, track.position_enu_m[:, axis])
        - truth.position_enu_m[inside, axis]
        for axis in range(2)
    ]
    return float(np.sqrt(np.mean(np.square(apart_m).sum(axis=0))))


def without_reference(channels: list[Channel]) -> list[Channel]:
    return [channel for channel in channels if channel.topic != "/reference"]


def renamed(kind: str, make: Callable[[Log], list[Channel]]) -> Callable[[Log], list[Channel]]:
    """The same messages under a type of nobody: names and values alone must do."""

    def channels(log: Log) -> list[Channel]:
        made = make(log)
        for channel in made:
            if channel.type.endswith(kind):
                definition = channel.definition
                object.__setattr__(channel, "type", f"ourauv_msgs/msg/{kind}")
                object.__setattr__(channel, "definition", definition)
        return made

    return channels


def compass_and_counts(log: Log) -> list[Channel]:
    """Degrees beside an empty Imu, mm/s with a beam count, ms with names, no stamp but log time."""
    heading, velocity = log.roles["heading"], log.roles["velocity"]
    replies = log.roles["travel_time"]
    mm_s = np.where(velocity["valid"][:, None], velocity["velocity_body_mps"] * 1000, -32768)
    rows = rows_of(vel_mm_s=np.round(mm_s).astype(int),
                   num_good_beams=np.where(velocity["valid"], 4, 0))  # fmt: skip
    made = ros_roles(log)
    made["heading"] = json_channel("nav/compass", heading["time_ns"], rows_of(
        heading_deg=np.degrees(heading["heading_rad"]), roll_deg=np.degrees(heading["roll_rad"]),
        pitch_deg=np.degrees(heading["pitch_rad"])))  # fmt: skip
    made["velocity"] = json_channel("rdi/bottom_track", velocity["time_ns"], rows)
    made["travel_time"] = json_channel("lbl/replies", replies["time_ns"], rows_of(
        heard_ns=replies["time_ns"], tx_ns=replies["ping_time_ns"],
        transponder=np.array([f"T{b}" for b in replies["beacon_id"].tolist()]),
        twtt_ms=replies["travel_time_s"] * 1000))  # fmt: skip
    return list(made.values())


def slant_range(log: Log) -> list[Channel]:
    """Range at the modem's own speed, turn-around taken off, the reply's time alone."""
    replies, beacons = log.roles["travel_time"], log.roles["beacons"]
    by_id = dict(zip(beacons["id"].tolist(), beacons["turn_around_s"].tolist(), strict=True))
    net_s = replies["travel_time_s"] - [by_id[b] for b in replies["beacon_id"].tolist()]
    made = ros_roles(log)
    made["travel_time"] = json_channel("modem/range", replies["time_ns"], rows_of(
        heard_ns=replies["time_ns"], src=replies["beacon_id"], range_m=net_s * 1485.0 / 2,
        vos=np.full(len(net_s), 1485.0)))  # fmt: skip
    return list(made.values())


CASES: dict[str, tuple[Callable[[Log], list[Channel]], bool]] = {
    "compass, counts and names": (compass_and_counts, False),
    "slant range": (slant_range, False),
    "ensemble of nobody's type": (
        renamed("Ensemble", instead("velocity", "/navigator/ensemble",
                                    "teledyne_navigator/msg/Ensemble", teledyne_pd6)), False),
    "a topic for each beacon": (lbl_aqualoc, True),
    "json of a recorder": (blueos_mavlink, True),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_the_profile_proposed_gives_the_right_track(
    name: str, truth: Log, right_m: float, tmp_path: Path
) -> None:
    make, needs_settings = CASES[name]
    write_mcap(tmp_path / "a.mcap", without_reference(make(truth)))
    text = inspect([tmp_path / "a.mcap"], load_profile()).proposal
    config = settings(truth) if needs_settings else Config()
    if name == "json of a recorder":  # no log of that kind has the speed of sound
        water = truth.roles["sound_speed"]
        profile = {key: tuple(water[key].tolist()) for key in ("depth_m", "sound_speed_mps")}
        config = msgspec.convert(
            {**msgspec.to_builtins(config), "sound_speed_profile": profile}, Config
        )
    log = read([tmp_path / "a.mcap"], profile_from_toml(text, "proposal"))
    found_m = error_m(navigate(align(log, config), config), reference(truth))
    near_m = NEAR_BY_MEAN_SPEED_M if name == "a topic for each beacon" else NEAR_M
    assert abs(found_m - right_m) < near_m, (found_m, right_m)
