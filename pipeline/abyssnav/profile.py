# SPDX-License-Identifier: Apache-2.0
"""A profile: which topic and fields of a vehicle's log are which of our columns.

Our name stands left, theirs right; one table a role, one TOML file a vehicle.  A field is a dotted
path, `[k]` picks from an array.  The conversion follows from unit, scale and offset, so a profile
holds no code.
"""

import difflib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import msgspec

from abyssnav.config import schemas, settings_from_toml
from abyssnav.errors import ConfigError

#: Unit -> (what it measures, how many of our unit it is).
UNITS = {
    "": ("", 1.0), "dB": ("", 1.0),
    "m": ("length", 1.0), "cm": ("length", 1e-2), "mm": ("length", 1e-3), "km": ("length", 1e3),
    "ft": ("length", 0.3048),
    "s": ("time", 1.0), "ms": ("time", 1e-3), "us": ("time", 1e-6), "ns": ("time", 1e-9),
    "rad": ("angle", 1.0), "deg": ("angle", 0.017453292519943295),
    "m/s": ("speed", 1.0), "cm/s": ("speed", 1e-2), "mm/s": ("speed", 1e-3),
    "km/h": ("speed", 1 / 3.6), "kn": ("speed", 1852 / 3600),
    "Pa": ("pressure", 1.0), "hPa": ("pressure", 1e2), "mbar": ("pressure", 1e2),
    "kPa": ("pressure", 1e3), "dbar": ("pressure", 1e4), "bar": ("pressure", 1e5),
    "psi": ("pressure", 6894.757293168361),
}  # fmt: skip
ROLES = ("heading", "velocity", "depth", "travel_time", "beacons", "sound_speed", "reference")
REQUIRED = ROLES[:4]


class _Profile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pass


class Quantity(_Profile, frozen=True):
    """A field with its conversion: ours = (theirs · scale + offset) in `unit`."""

    field: str
    #: Empty: our own unit, SI with radians.
    unit: str = ""
    scale: float = 1.0
    #: In `unit`: an angle counted from east gets 90 deg, gauge pressure gets 101325 Pa.
    offset: float = 0.0
    #: Number that stands for "no value", before scaling.
    sentinel: float | None = None


class Condition(_Profile, frozen=True):
    """When a message counts: all that is given must hold."""

    field: str
    equals: bool | int | float | str | None = None
    differs_from: bool | int | float | str | None = None
    at_least: float | None = None


class TimeField(_Profile, frozen=True):
    """A number as time: `unit` since 1970 UTC."""

    field: str
    unit: str = "ns"


Value = str | Quantity
Triple = tuple[Value, Value, Value]
Validity = str | Condition | tuple[Condition, ...]


class Role(_Profile, frozen=True):
    """What every role has."""

    topic: str
    #: Expected message type; empty: any that has the fields.
    type: str = ""
    #: `log_time`, a stamp's path, or a number's path and unit.
    time: str | TimeField = "header.stamp"
    #: The message's time is this much later than what it tells; subtracted.
    latency_s: float = 0.0
    #: Messages for which this does not hold have no value; a path alone means that it is true.
    valid: Validity = ()


class HeadingRole(Role, frozen=True):
    """Attitude: a quaternion, or angles clockwise from true north."""

    #: Of `enu_flu` (REP-103) or `ned_frd`.
    orientation_xyzw: tuple[str, str, str, str] | None = None
    frame: Literal["enu_flu", "ned_frd"] = "enu_flu"
    heading: Value | None = None
    roll: Value | None = None
    pitch: Value | None = None


class VelocityRole(Role, frozen=True):
    """Velocity over ground in the vehicle's frame."""

    velocity: Triple = ("", "", "")
    #: Above the floor; it tells where bottom bounces come from.
    altitude: Value | None = None
    #: `flu` is REP-103: x forward, y port, z up; `frd` is forward, starboard, down.
    frame: Literal["flu", "frd"] = "flu"


class DepthRole(Role, frozen=True):
    """Depth, positive down; in a pressure unit it is absolute pressure, and TEOS-10 follows."""

    depth: Value = "depth"
    #: Where pressure is turned into depth: 15 m in 6,000 m from equator to 45 degrees.  None: at
    #: the origin.
    latitude_deg: float | None = None
    atmosphere_pa: float = 101_325.0


class TravelTimeRole(Role, frozen=True):
    """One reply a message."""

    ping_time: str | TimeField = "ping_time"
    #: Empty where the vehicle does not count: pings are then numbered by their times.
    ping_id: str = "ping_id"
    #: A number, or text with one number in it: `B4` is 4.
    beacon_id: str = "beacon_id"
    travel_time: Value = "travel_time"
    snr: Value | None = None


class BeaconsRole(Role, frozen=True):
    """Transponders, one array a message."""

    #: As the replies have it.
    id: str = "beacons.id"
    name: str | None = None
    #: East, north, up.
    position: Triple = ("beacons.position.x", "beacons.position.y", "beacons.position.z")
    turn_around: Value = "beacons.turn_around_time"
    position_sigma: Value | None = None
    origin_latitude: str | None = None
    origin_longitude: str | None = None


class SoundSpeedRole(Role, frozen=True):
    """Sound speed over depth, one profile a message."""

    depth: Value = "depth"
    sound_speed: Value = "sound_speed"


class ReferenceRole(Role, frozen=True):
    """Independent position, for evaluation only."""

    position: Triple = ("pose.pose.position.x", "pose.pose.position.y", "pose.pose.position.z")
    frame: Literal["enu", "ned"] = "enu"


class Profile(_Profile, frozen=True):
    """One vehicle's log."""

    heading: HeadingRole
    velocity: VelocityRole
    depth: DepthRole
    travel_time: TravelTimeRole
    beacons: BeaconsRole | None = None
    sound_speed: SoundSpeedRole | None = None
    reference: ReferenceRole | None = None
    name: str = ""
    about: str = ""

    def roles(self) -> dict[str, Role]:
        """Roles that this profile maps."""
        found = {role: getattr(self, role) for role in ROLES}
        return {role: spec for role, spec in found.items() if spec is not None}


def load_profile(name_or_path: str | Path = "default") -> Profile:
    """Load a profile from `schemas/profiles` by name, or a TOML file by path.

    Raises
    ------
    ConfigError
        No such profile (the nearest is named), an unknown key or unit, or a value of a wrong type.
    """
    text, where = _text_of(str(name_or_path))
    profile = settings_from_toml(text, where, Profile)
    for problem in _problems(profile):
        raise ConfigError(f"{where}: {problem}")
    return profile if profile.name else msgspec.structs.replace(profile, name=Path(where).stem)


def profile_names() -> list[str]:
    """Names of the shipped profiles."""
    files = (schemas() / "profiles").iterdir()
    return sorted(file.name.removesuffix(".toml") for file in files if file.name.endswith(".toml"))


def same_type(one: str, other: str) -> bool:
    """Whether two type names are one: `a/msg/B`, `a/B` and Protobuf's `a.B`."""
    names = [name.replace("/msg/", "/").replace("/", ".") for name in (one, other)]
    return names[0] == names[1]


def quantities(role: Role) -> dict[str, Quantity]:
    """Fields of a role with a conversion, by our name; `name[i]` for the parts of a triple."""
    found: dict[str, Quantity] = {}
    for key, value in _values(role):
        if isinstance(value, Quantity):
            found[key] = value
        elif value:
            found[key] = Quantity(value)
    return found


def _values(role: Role) -> Iterator[tuple[str, Value | None]]:
    plain = {"topic", "type", "time", "latency_s", "valid", "frame", "ping_time"}
    for key in role.__struct_fields__:
        value = getattr(role, key)
        if key in plain or isinstance(value, float):
            continue
        if isinstance(value, tuple):
            yield from ((f"{key}[{i}]", part) for i, part in enumerate(value))
        else:
            yield key, value


def _text_of(name: str) -> tuple[str, str]:
    if re.fullmatch(r"[\w-]+", name):
        file = schemas() / "profiles" / f"{name}.toml"
        if file.is_file():
            return file.read_text(encoding="utf-8"), f"profile {name}"
        nearest = difflib.get_close_matches(name, profile_names(), n=1, cutoff=0.0)
        hint = f"; nearest: {nearest[0]}; or the path of a .toml file" if nearest else ""
        raise ConfigError(f"no profile {name!r}{hint}")
    try:
        return Path(name).read_text(encoding="utf-8"), name
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"profile {name}: cannot be read: {error}") from None


#: What each quantity measures, by its name up to the bracket.
_MEASURES = {
    "orientation_xyzw": (), "heading": ("angle",), "roll": ("angle",), "pitch": ("angle",),
    "velocity": ("speed",), "depth": ("length", "pressure"), "travel_time": ("time",),
    "position": ("length",), "turn_around": ("time",), "position_sigma": ("length",),
    "sound_speed": ("speed",), "altitude": ("length",),
}  # fmt: skip


def _problems(profile: Profile) -> Iterator[str]:
    """Name what no log could be read with."""
    for role, spec in profile.roles().items():
        if spec.topic in ("", "?"):
            yield f"[{role}] topic {spec.topic!r}: name one of the log's (abyssnav inspect)"
        for key in _unset(spec):
            yield f"[{role}] needs {key}"
        for key, quantity in quantities(spec).items():
            measures = _MEASURES.get(key.partition("[")[0], ())
            if quantity.unit not in UNITS:
                known = [unit for unit, (measured, _) in UNITS.items() if measured in measures]
                nearest = difflib.get_close_matches(quantity.unit, known, n=1, cutoff=0.0)
                hint = f"; nearest: {nearest[0]}; known: {', '.join(known)}" if known else ""
                yield f"[{role}] {key}: unknown unit {quantity.unit!r}{hint}"
                continue
            measured = UNITS[quantity.unit][0]
            if measured and measured not in measures:
                yield f"[{role}] {key}: {quantity.unit} is a unit of {measured}"
        for time in (spec.time, getattr(spec, "ping_time", "")):
            if isinstance(time, TimeField) and UNITS.get(time.unit, ("",))[0] != "time":
                yield f"[{role}] {time.field}: {time.unit!r} is no unit of time; s, ms, us, ns are"


def _unset(spec: Role) -> list[str]:
    """Return the keys that a role cannot do without, and whose fields are not named."""
    if isinstance(spec, HeadingRole):
        angle = spec.heading.field if isinstance(spec.heading, Quantity) else spec.heading
        known = spec.orientation_xyzw or angle not in (None, "", "?")
        return [] if known else ["orientation_xyzw or heading"]
    found = []
    for field in msgspec.structs.fields(spec):
        value, left_out = getattr(spec, field.name), field.name in ("type", "ping_id", "valid")
        values = value if isinstance(value, tuple) else (value,)
        fields = [v.field if isinstance(v, Quantity | TimeField) else v for v in values]
        if not left_out and ("" in fields or "?" in fields):
            found.append(field.name + (", three fields" if isinstance(value, tuple) else ""))
    return found
