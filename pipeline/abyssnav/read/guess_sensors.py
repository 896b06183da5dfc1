# SPDX-License-Identifier: Apache-2.0
"""Which topic may be compass, DVL, depth, altimeter, position fixes or reference."""

import re
from collections.abc import Mapping
from typing import Any, Final, Literal

import msgspec
import numpy as np

from abyssnav.profile import (
    AltitudeRole,
    Condition,
    DepthRole,
    HeadingRole,
    PositionRole,
    Quantity,
    ReferenceRole,
    Value,
    VelocityRole,
)
from abyssnav.read.guessing import (
    Guess,
    conditions_as_valid,
    head_of,
    quantity,
    sentinel_in,
    triple,
    unit_of_name,
    validity,
)
from abyssnav.read.samples import TopicSample

_ANGLE = r"(heading|yaw|hdg|azimuth)(_?(deg(rees)?|rad(ians)?))?$"
_DEPTH = r"(^|[._])depth(_?(m|cm|mm|ft))?$"
_PRESSURE = r"(^|[._]|pressure_?|press_?)(pressure|press|press_abs|k?pa|hpa|[dm]?bar|psi)$"
_ALTITUDE = r"(^|[._])(altitude|alt|height_above_\w+|distance_to_bottom)(_?(m|cm|mm))?$"
#: Names of three components, and the frame that they speak for; of the vehicle before the earth's.
_VELOCITIES: Final[Mapping[tuple[str, str, str], Literal["flu", "frd", "enu", "ned"]]] = {
    ("forward", "starboard", "down"): "frd", ("forward", "right", "down"): "frd",
    ("fwd", "stbd", "down"): "frd", ("forward", "port", "up"): "flu",
    ("forward", "left", "up"): "flu", ("longitudinal", "transverse", "normal"): "frd",
    ("surge", "sway", "heave"): "frd", ("u", "v", "w"): "frd",
    ("x", "y", "z"): "flu", ("vx", "vy", "vz"): "flu", ("[0]", "[1]", "[2]"): "flu",
    ("x_axis", "y_axis", "z_axis"): "flu",
    ("east", "north", "upwards"): "enu", ("east", "north", "up"): "enu",
    ("ve", "vn", "vu"): "enu", ("e", "n", "u"): "enu", ("n", "e", "d"): "ned",
    ("north", "east", "down"): "ned", ("vn", "ve", "vd"): "ned",
}  # fmt: skip
_PLACES: Final[Mapping[tuple[str, str, str], Literal["enu", "ned"]]] = {
    ("x", "y", "z"): "enu", ("[0]", "[1]", "[2]"): "enu", ("east", "north", "up"): "enu",
    ("e", "n", "u"): "enu", ("north", "east", "down"): "ned", ("n", "e", "d"): "ned",
}  # fmt: skip
_SPEED = r"vel|linear|speed|twist|(^|[._])(vx|surge|forward|b[isx]_|transverse)|longitudinal|delta"
#: What looks like a velocity and is none.
_NO_VELOCITY = r"angle|angular|gyro|rate|accel|magn|wind|covar|sigma|std|pose|(^|[._])bd_"
_INCREMENT = r"(position|dist\w*)_?delta|delta_?(position|dist\w*)|displacement"
_INTERVAL = r"(delta|interval|(^|[._])dt)\w*$"
_TURN_RAD = 2 * np.pi + 0.01
#: Speeds above these are of a smaller unit: m/s, then cm/s.
_FASTEST_MPS, _FASTEST_CMPS = 15.0, 400.0


def guess_heading(sample: TopicSample, hinted: bool) -> Guess | None:
    """A compass: a quaternion, or an angle that is named as one."""
    turn = next(iter(sample.named(r"(orient|quat|attitude|rotation|(^|[._])q)\w*\.x$")), "")
    if turn and sample.has([turn[:-1] + axis for axis in "yzw"]):
        x, y, z, w = (turn[:-1] + axis for axis in "xyzw")
        valid = [
            Condition(path, differs_from=-1.0)
            for path in sample.named(r"orientation_covariance\[0\]$")
        ]
        spec = HeadingRole(
            **head_of(sample), orientation_xyzw=(x, y, z, w), valid=conditions_as_valid(valid)
        )
        return Guess(spec, ("a quaternion, taken as ROS has it",), 1 + 2 * hinted)
    path = sample.first_number(_ANGLE)
    if not path:
        return None
    unit, why = _angle_unit(sample, path)
    part = path[: len(path) - len(re.search(_ANGLE, path, re.IGNORECASE)[0])]  # type: ignore[index]
    suffix = re.search(_ANGLE, path, re.IGNORECASE)[2] or ""  # type: ignore[index]
    scale = 0.01 if unit == "cdeg" else 1.0
    angles: dict[str, Any] = {
        name: Quantity(other, "deg" if unit == "cdeg" else unit)
        for name in ("roll", "pitch")
        if (other := f"{part}{name}{suffix}") in sample.fields
    }
    heading = Quantity(path, "deg" if unit == "cdeg" else unit, scale)
    own = not re.search(r"dvl|bottom|ensemble|(^|[._])(sa|gps|cog)_?", path + sample.topic)
    score = 0.5 + 0.5 * own + 2 * hinted
    return Guess(HeadingRole(**head_of(sample), heading=heading, **angles), (why,), score)


def _angle_unit(sample: TopicSample, path: str) -> tuple[str, str]:
    """Unit of a heading by its name, else by its values."""
    named = unit_of_name(path, "angle")
    if named is not None:
        return named, f"{path}: {named} by its name"
    most = float(np.abs(sample.fields[path].numbers).max(initial=0.0))
    if most > 720:
        return "cdeg", f"{path}: reaches {most:,.0f}, hundredths of degrees"
    if most > _TURN_RAD or not most:
        return "deg", f"{path}: reaches {most:.0f}, degrees"
    return "rad", f"{path}: never above {most:.2f}, rad"


def guess_velocity(sample: TopicSample, hinted: bool) -> Guess | None:
    """A DVL: three components that are named as a velocity, or an increment with its interval."""
    within = "" if hinted else _SPEED
    for paths, frame in triple(sample, _VELOCITIES, within, _NO_VELOCITY):
        interval = sample.first_number(_INTERVAL) if re.search(_INCREMENT, paths[0]) else ""
        if re.search(r"delta", paths[0]) and not interval:
            continue
        numbers = np.concatenate([sample.fields[path].numbers for path in paths])
        sentinel = sentinel_in(numbers)
        unit, why = _speed_unit(paths[0], numbers[numbers != sentinel], bool(interval))
        turned = -1.0 if re.search(r"normal$", paths[2]) else None
        parts = [quantity(path, unit, sentinel=sentinel) for path in paths[:2]]
        parts.append(quantity(paths[2], unit, sentinel=sentinel, scale=turned))
        conditions = validity(sample, _prefix(paths))
        more: dict[str, Any] = {"per": _interval(sample, interval)} if interval else {}
        altitude = _altitude(sample)
        spec = VelocityRole(
            **head_of(sample), velocity=(parts[0], parts[1], parts[2]),
            frame="frd" if interval and frame == "flu" else frame,
            valid=conditions_as_valid(conditions), altitude=altitude, **more,
        )  # fmt: skip
        reasons = [f"{paths[0]} ...: {why}"]
        if sentinel is not None:
            reasons.append(f"{sentinel:g} is no value")
        if turned:
            reasons.append(f"{paths[2]} is taken as up")
        still = 0.5 if numbers.size and np.ptp(numbers) == 0 else 0.0
        return Guess(spec, tuple(reasons), 1 + 2 * hinted - still)
    return None


def _prefix(paths: tuple[str, str, str]) -> str:
    """What three names begin with, up to a separator."""
    common = 0
    while all(len(p) > common and p[common] == paths[0][common] for p in paths):
        common += 1
    return re.sub(r"[^._]*$", "", paths[0][:common])


def _speed_unit(path: str, numbers: Any, is_increment: bool) -> tuple[str, str]:
    """Unit of a velocity or increment by its name, else by how large it is."""
    measure = "length" if is_increment else "speed"
    named = unit_of_name(path, measure)
    if named is not None:
        return named, f"{named or ('m' if is_increment else 'm/s')} by its name"
    most = float(np.percentile(np.abs(numbers), 95)) if len(numbers) else 0.0
    if is_increment or most <= _FASTEST_MPS:
        return "", f"up to {most:.3g}, SI units by its values"
    unit = "cm/s" if most <= _FASTEST_CMPS else "mm/s"
    return unit, f"up to {most:.0f}, {unit} by its values"


def _interval(sample: TopicSample, path: str) -> Value:
    named = unit_of_name(path, "time")
    if named is None:
        middle = float(np.median(sample.fields[path].numbers))
        named = next(u for u, most in (("", 60), ("ms", 6e4), ("us", 6e7), ("ns", np.inf))
                     if middle <= most)  # fmt: skip
    return quantity(path, named)


def _altitude(sample: TopicSample) -> Value | None:
    path = sample.first_number(_ALTITUDE, r"covar|sigma|std")
    if not path or sample.fields[path].numbers.max(initial=0.0) <= 0:
        return None
    return quantity(path, unit_of_name(path, "length") or "")


def guess_depth(sample: TopicSample, hinted: bool) -> Guess | None:
    """A depth, or a pressure on a topic that speaks of one."""
    path = sample.first_number(_DEPTH, r"ts_depth|total|water|max|min")
    if path:
        unit = unit_of_name(path, "length") or ""
        above = float(np.median(sample.fields[path].numbers)) < 0 if _known(sample, path) else False
        depth = quantity(path, unit, scale=-1.0 if above else None)
        why = f"{path}: below 0, so taken as a height" if above else f"{path}, positive down"
        return Guess(DepthRole(**head_of(sample), depth=depth), (why,), 1 + 2 * hinted)
    path = sample.first_number(_PRESSURE, r"diff|temp|variance")
    if not path or not hinted:
        return None
    unit, why = _pressure_unit(path)
    spec = DepthRole(**head_of(sample), depth=Quantity(path, unit))
    return Guess(spec, (why, "absolute, the air's is taken off"), 1 + 2 * hinted)


def _known(sample: TopicSample, path: str) -> bool:
    return len(sample.fields[path].numbers) > 0


def _pressure_unit(path: str) -> tuple[str, str]:
    named = unit_of_name(path, "pressure")
    if named is not None:
        return named, f"{path}: {named} by its name"
    if re.search(r"press_abs$", path):
        return "hPa", f"{path}: hPa, as MAVLink has it"
    return "Pa", f"{path}: Pa, as ROS has it: kPa, hPa, dbar, bar are told by nothing"


def guess_altitude(sample: TopicSample, hinted: bool) -> Guess | None:
    """An altimeter of its own topic."""
    altitude = _altitude(sample)
    if altitude is None and hinted:
        path = sample.first_number(r"(^|[._])(range|distance|data)(_?(m|cm|mm))?$")
        altitude = quantity(path, unit_of_name(path, "length") or "") if path else None
    if altitude is None or not hinted:
        return None
    return Guess(AltitudeRole(**head_of(sample), altitude=altitude), ("by its name",), 3)


def guess_position(sample: TopicSample, hinted: bool) -> Guess | None:
    """GNSS or USBL fixes: latitude and longitude, or a place in the local frame."""
    latitude = sample.first_number(r"(^|[._])lat(itude)?(_?deg)?$")
    longitude = sample.first_number(r"(^|[._])lon(g|gitude)?(_?deg)?$")
    if not hinted:
        return None
    more = _position_quality(sample)
    if latitude and longitude:
        most = float(np.abs(sample.fields[longitude].numbers).max(initial=0.0))
        scale = 1e-7 if most > 360 else None
        spec = PositionRole(
            **head_of(sample), latitude=quantity(latitude, scale=scale),
            longitude=quantity(longitude, scale=scale), **more,
        )  # fmt: skip
        return Guess(spec, (f"{latitude} and {longitude}",), 3)
    for paths, frame in triple(sample, _PLACES, "", r"covar|orient|twist|vel"):
        spec = PositionRole(**head_of(sample), position=paths[:2], frame=frame, **more)
        return Guess(spec, (f"{paths[0]} and {paths[1]} from the origin",), 3)
    return None


def _position_quality(sample: TopicSample) -> dict[str, Any]:
    """Covariance and validity of position fixes, where the messages have them."""
    more: dict[str, Any] = {}
    for path in sample.named(r"covariance(\[0\])?$"):
        more["covariance"] = path.removesuffix("[0]")
        break
    status = sample.first_number(r"status\.status$")
    if status:
        more["valid"] = Condition(status, at_least=0)
    return more


def guess_reference(sample: TopicSample, hinted: bool) -> Guess | None:
    """Independent positions, on a topic that says so."""
    if not hinted:
        return None
    for paths, frame in triple(sample, _PLACES, "", r"covar|orient|twist|vel"):
        return Guess(ReferenceRole(**head_of(sample), position=paths, frame=frame), (), 3)
    return None


def adapted(guess: Guess, sample: TopicSample) -> Guess:
    """A shipped vehicle's role on another's topic: latency and unit or sign of bare numbers anew.

    What a type fixes stays; what only that vehicle was known to do is judged by the values.
    """
    spec, why = msgspec.structs.replace(guess.spec, latency_s=0.0), guess.why
    if isinstance(spec, HeadingRole) and isinstance(spec.heading, Quantity):
        unit, reason = _angle_unit(sample, spec.heading.field)
        if unit != "cdeg":
            spec = msgspec.structs.replace(spec, heading=Quantity(spec.heading.field, unit))
            why = (*why, reason)
    if isinstance(spec, DepthRole) and isinstance(spec.depth, Quantity):
        path = spec.depth.field
        if spec.depth.unit in ("", "m") and _known(sample, path):
            below = float(np.median(sample.fields[path].numbers)) < 0
            depth = msgspec.structs.replace(spec.depth, scale=-1.0 if below else 1.0)
            spec = msgspec.structs.replace(spec, depth=depth)
            why = (*why, f"{path}: {'below 0, so a height' if below else 'positive down'}")
    return Guess(spec, why, guess.score)
