# SPDX-License-Identifier: Apache-2.0
"""A calibration as settings: TOML that `run` and `batch` take as a further `--config`."""

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import TypeVar

import numpy as np

from abyssnav.calibrate.campaign import CalibrationResult
from abyssnav.calibrate.evidence import DiveEvidence
from abyssnav.calibrate.unknowns import common_origin
from abyssnav.calibrate.verdicts import NOT_DETERMINED, Estimate
from abyssnav.errors import printable
from abyssnav.geometry import enu_to_geodetic
from abyssnav.version import __version__

#: No sigma is written below these, whatever the dives say: deg, share, s, m, m/s.
_LEAST_DEG, _LEAST_SHARE, _LEAST_S, _LEAST_M, _LEAST_MPS = 0.02, 1e-4, 2e-5, 0.02, 0.05
#: No compass reads so much too much on all headings; a DVL is easily turned so on its mount.
_NO_COMPASS_DEG = 15.0

Lines = list[str]
T = TypeVar("T")


def settings_text(result: CalibrationResult) -> str:
    """TOML of what the dives determine, wholly or weakly; what they do not is left as it was."""
    parts = [
        _heading(result),
        _origin(result),
        _acoustics(result),
        _vehicle(result),
        _calibration(result),
        _errors(result),
        _beacons(result),
    ]
    return "\n".join("".join(f"{line}\n" for line in lines) for lines in parts if lines)


def shared(result: CalibrationResult) -> Mapping[str, Estimate]:
    """By name what all dives have in common and what is determined, wholly or weakly."""
    return {
        e.kind.name: e
        for e in result.estimates
        if e.unknown.beacon_id is None and e.unknown.dive is None and e.verdict != NOT_DETERMINED
    }


def _heading(result: CalibrationResult) -> Lines:
    names = ", ".join(printable(dive.name) for dive in result.dives)
    return [
        f"# abyssnav {__version__} calibrate, from {len(result.dives)} dives: {names}",
        "# Further settings: abyssnav run LOG --config SETTINGS --config THIS",
    ]


def _origin(result: CalibrationResult) -> Lines:
    """Of a frame that hangs on a beacon's stated place, which may move."""
    origin = common_origin(result.dives)
    if origin is None or origin.source != "beacon":
        return []
    return [
        "[origin]", f"latitude_deg = {origin.latitude_deg!r}",
        f"longitude_deg = {origin.longitude_deg!r}",
    ]  # fmt: skip


def _acoustics(result: CalibrationResult) -> Lines:
    """Speed and gradient where no profile is known; how well the speed is known."""
    known = shared(result)
    scale, gradient = known.get("sound_speed_scale"), known.get("sound_speed_gradient")
    if scale is None and gradient is None:
        return []
    water, lines = result.dives[0].water, ["[acoustics]"]
    depth_m = water.errors.depth_m
    speed_mps = _stated_speed(result.dives[0])
    if scale is not None:
        if depth_m is not None:
            true_mps = speed_mps / (1 + scale.value)
            lines += [f"sound_speed_mps = {true_mps:.3f}  # {scale.verdict}"]
        sigma_mps = max(scale.sigma * speed_mps, _LEAST_MPS)
        lines += [f"sound_speed_sigma_mps = {sigma_mps:.3f}"]
    if gradient is not None and depth_m is not None:
        per_s = result.config.acoustics.sound_speed_gradient_per_s + gradient.value
        lines += [
            f"sound_speed_gradient_per_s = {per_s:.6f}  # {gradient.verdict}",
            f"sound_speed_depth_m = {depth_m:.1f}",
        ]
    return lines


def _stated_speed(dive: DiveEvidence) -> float:
    """The single speed of a dive without a profile; a profile's mean."""
    profile, depth_m = dive.water.profile, dive.water.errors.depth_m
    if depth_m is None:
        return float(np.mean(profile.sound_speed_mps))
    return float(np.interp(depth_m, profile.depth_m, profile.sound_speed_mps))


def _vehicle(result: CalibrationResult) -> Lines:
    known = shared(result)
    arms = [known.get(f"lever_arm_{axis}") for axis in ("forward", "starboard", "down")]
    if not any(arms):
        return []
    stated_m = result.config.vehicle.lever_arm_m
    offset_m = [
        stated + (arm.value if arm else 0.0) for stated, arm in zip(stated_m, arms, strict=True)
    ]
    level = [arm.sigma for arm in arms[:2] if arm]
    unknown = [] if all(arms[:2]) else [result.config.vehicle.lever_sigma_m]
    sigma_m = max([*level, *unknown, _LEAST_M])
    return [
        "[vehicle]",
        f"transducer_offset_m = [{', '.join(f'{value:.3f}' for value in offset_m)}]",
        f"transducer_sigma_m = {sigma_m:.3f}",
    ]


def _calibration(result: CalibrationResult) -> Lines:
    """What is wrong with the sensors, on top of what was taken out before."""
    known, before = shared(result), result.config.calibration

    def sum_of(stated: float, name: str) -> float:
        return stated + (known[name].value if name in known else 0.0)

    harmonics = ("sin_1", "cos_1", "sin_2", "cos_2")
    deviation = [
        sum_of(stated, f"deviation_{name}")
        for stated, name in zip(before.deviation_deg, harmonics, strict=True)
    ]
    late, scale = before.latency_s, known.get("dvl_scale")
    roll, pitch, yaw = before.mount_rpy_deg
    bias_deg, whose = sum_of(before.heading_bias_deg, "heading_bias"), "compass's bias"
    turned = mounting_deg(result)
    if turned:
        bias_deg, yaw, whose = before.heading_bias_deg, yaw - turned, "DVL's mounting"
    dvl_scale = (1 + before.dvl_scale) * (1 + (scale.value if scale else 0.0)) - 1
    lines = [
        "[calibration]",
        f"heading_bias_deg = {bias_deg:.4f}" + _verdict(known, "heading_bias"),
        f"deviation_deg = [{', '.join(f'{value:.4f}' for value in deviation)}]",
        f"dvl_scale = {dvl_scale:.6f}" + _verdict(known, "dvl_scale"),
        f"mount_rpy_deg = [{roll:.4f}, {pitch:.4f}, {yaw:.4f}]"
        f"  # yaw and the compass's bias are one: taken for the {whose}",
        f"latency_s = {{ heading = {sum_of(late.heading, 'latency_heading'):.4f}, "
        f"velocity = {late.velocity:.4f}, "
        f"travel_time = {sum_of(late.travel_time, 'latency_travel_time'):.4f} }}"
        "  # the velocity's stamps are the others' clock",
    ]
    sound = known.get("sound_speed_scale")
    if sound is not None and result.dives[0].water.errors.depth_m is None:
        stretched = (1 + before.sound_speed_scale) * (1 + sound.value) - 1
        lines += [f"sound_speed_scale = {stretched:.7f}  # {sound.verdict}"]
    return lines


def mounting_deg(result: CalibrationResult) -> float:
    """What turns dead reckoning where it is too much for a compass: the DVL's mounting; else 0."""
    bias = shared(result).get("heading_bias")
    return bias.value if bias is not None and abs(bias.value) > _NO_COMPASS_DEG else 0.0


def _verdict(known: Mapping[str, Estimate], name: str) -> str:
    return f"  # {known[name].verdict}" if name in known else "  # not determined"


def _errors(result: CalibrationResult) -> Lines:
    """How well it is known: the priors of `ekf` and `smoother`."""
    known, stated = shared(result), result.config.errors

    def sigma(names: Sequence[str], otherwise: float, least: float) -> float:
        return max(least, *(known[n].sigma if n in known else otherwise for n in names))

    lines = Lines()
    if "heading_bias" in known:
        bias = sigma(["heading_bias"], 0.0, _LEAST_DEG)
        lines += [f"heading_offset_sigma_deg = {bias:.4f}"]
    first, second = (
        sigma([f"deviation_sin_{n}", f"deviation_cos_{n}"], otherwise, _LEAST_DEG)
        for n, otherwise in ((1, stated.deviation_sigma_deg[0]), (2, stated.deviation_sigma_deg[1]))
    )
    if any(name.startswith("deviation") for name in known):
        lines += [f"deviation_sigma_deg = [{first:.4f}, {second:.4f}]"]
    if "dvl_scale" in known:
        lines += [f"dvl_scale_sigma = {sigma(['dvl_scale'], 0.0, _LEAST_SHARE):.6f}"]
    if "clock" in known:
        lines += [f"clock_sigma_s = {sigma(['clock'], 0.0, _LEAST_S):.6f}"]
    return ["[errors]", *lines] if lines else []


def _beacons(result: CalibrationResult) -> Lines:
    """Every beacon, as each dive has it where it moved between them."""
    if any(np.any(dive.beacons.moving) for dive in result.dives):
        return ["# A beacon moves within a dive: its places stay where they are logged."]
    entries = dict[int, list[tuple[DiveEvidence, int]]]()
    for dive in result.dives:
        for row, number in enumerate(dive.beacons.id.tolist()):
            entries.setdefault(number, []).append((dive, row))
    lines = Lines()
    for uses in entries.values():
        for place, (dive, row) in enumerate(uses if _moved(result, uses) else uses[:1]):
            lines += _beacon(result, dive, row)
            if place:
                lines += [f"from = {_instant(dive.begin_ns)}"]
            if _moved(result, uses) and place + 1 < len(uses):
                lines += [f"until = {_instant(uses[place + 1][0].begin_ns)}"]
            lines += [""]
    return lines[:-1]


def _moved(result: CalibrationResult, uses: Sequence[tuple[DiveEvidence, int]]) -> bool:
    dive, row = uses[0]
    number = int(dive.beacons.id[row])
    return any(group.beacon_id == number for group in result.adjustment.layout.own)


def _beacon(result: CalibrationResult, dive: DiveEvidence, row: int) -> Lines:
    number, origin = int(dive.beacons.id[row]), common_origin(result.dives)
    own = {
        e.kind.name: e
        for e in result.estimates
        if e.unknown.beacon_id == number and e.unknown.dive in (None, dive.name)
    }
    layout = result.adjustment.layout
    place_m = _of_dive(layout.place_m, number, dive)
    place_m = place_m + [own[f"beacon_{axis}"].value for axis in ("east", "north", "up")]
    common_s = shared(result)["clock"].value if "clock" in shared(result) else 0.0
    turn_around_s = _of_dive(layout.turn_around_s, number, dive)
    turn_around_s += own["beacon_turn_around"].value + common_s
    sigma_m = _each_axis_m(own)
    name = str(dive.beacons.name[row]).replace("\\", "\\\\").replace('"', '\\"')
    lines = ["[[beacon]]", f"id = {number}", f'name = "{printable(name)}"']
    if origin is None:
        lines += [f"position_m = [{', '.join(f'{value:.3f}' for value in place_m)}]"]
    else:
        latitude, longitude, _ = enu_to_geodetic(
            origin.latitude_deg, origin.longitude_deg, place_m[None]
        )
        lines += [
            f"latitude_deg = {float(latitude[0]):.10f}",
            f"longitude_deg = {float(longitude[0]):.10f}",
            f"depth_m = {-place_m[2]:.3f}",
        ]
    verdicts = {own[f"beacon_{axis}"].verdict for axis in ("east", "north")}
    return [
        *lines,
        f"turn_around_s = {turn_around_s:.6f}  # {own['beacon_turn_around'].verdict}",
        f"sigma_m = {sigma_m:.3f}  # {' and '.join(sorted(verdicts))}",
    ]


def _each_axis_m(own: Mapping[str, Estimate]) -> float:
    """One sigma for all axes: the larger of the level ones, and the height's where it is known."""
    level_m = max(own["beacon_east"].sigma, own["beacon_north"].sigma)
    up = own["beacon_up"]
    if up.verdict != NOT_DETERMINED:
        level_m = max(level_m, float(np.sqrt((2 * level_m**2 + up.sigma**2) / 3)))
    return max(level_m, _LEAST_M)


def _of_dive(values: Mapping[tuple[int, str | None], T], number: int, dive: DiveEvidence) -> T:
    """A beacon's value, the dive's own where it has one."""
    return values[number, dive.name] if (number, dive.name) in values else values[number, None]


def _instant(time_ns: int) -> str:
    when = datetime.fromtimestamp(time_ns // 10**9, UTC)
    return when.strftime("%Y-%m-%dT%H:%M:%SZ")
