# SPDX-License-Identifier: Apache-2.0
"""What no log could be read with: unset fields, wrong units, keys that exclude each other."""

from collections.abc import Iterator

import msgspec

from abyssnav.errors import nearest_names
from abyssnav.profile.model import (
    UNITS,
    BeaconsRole,
    HeadingRole,
    PositionRole,
    Profile,
    Quantity,
    Role,
    SoundSpeedRole,
    TimeField,
    TravelTimeRole,
    VelocityRole,
    quantities,
    slots,
)

#: What each quantity measures, by its name up to the bracket.
_MEASURES = {
    "orientation_xyzw": (), "heading": ("angle",), "roll": ("angle",), "pitch": ("angle",),
    "velocity": ("speed",), "depth": ("length", "pressure"), "travel_time": ("time",),
    "position": ("length",), "turn_around": ("time",), "position_sigma": ("length",),
    "sound_speed": ("speed",), "altitude": ("length",), "range": ("length",),
    "range_sound_speed": ("speed",), "turn_around_field": ("time",), "per": ("time",),
    "latitude": ("angle",), "longitude": ("angle",), "sigma": ("length",),
}  # fmt: skip
#: Keys that may stay empty.
_OPTIONAL = ("type", "ping_id", "ping_time", "valid", "bottom_track")


def problems(profile: Profile) -> Iterator[str]:
    """Name what no log could be read with, each with its role and key."""
    if profile.travel_time is None and profile.position is None:
        yield "needs [travel_time]; only a log with [position] goes without"
    for role, spec in profile.roles().items():
        for topic in spec.topics or ("",):
            if topic in ("", "?"):
                yield f"[{role}] topic {topic!r}: name one of the log's (abyssnav inspect)"
        yield from (f"[{role}] needs {key}" for key in _unset(spec))
        yield from (f"[{role}] {problem}" for problem in _units(spec))
        yield from (f"[{role}] {problem}" for problem in _combinations(spec))


def _units(spec: Role) -> Iterator[str]:
    for key, quantity in quantities(spec).items():
        measures = _measures(spec, key.partition("[")[0])
        if quantity.unit not in UNITS:
            known = [unit for unit, (measured, _) in UNITS.items() if measured in measures]
            nearest = nearest_names(quantity.unit, known)
            hint = f"; nearest: {nearest[0]}; known: {', '.join(known)}" if known else ""
            yield f"{key}: unknown unit {quantity.unit!r}{hint}"
            continue
        measured = UNITS[quantity.unit][0]
        if measured and measured not in measures:
            asked = f", not of {' or '.join(measures)}" if measures else ""
            yield f"{key}: {quantity.unit} is a unit of {measured}{asked}"
    for time in (spec.time, getattr(spec, "ping_time", "")):
        if isinstance(time, TimeField) and UNITS.get(time.unit, ("",))[0] != "time":
            yield f"{time.field}: {time.unit!r} is no unit of time; s, ms, us, ns are"


def _measures(spec: Role, key: str) -> tuple[str, ...]:
    if isinstance(spec, VelocityRole) and key == "velocity" and spec.per is not None:
        return ("length",)
    if isinstance(spec, BeaconsRole | SoundSpeedRole) and key == "depth":
        return ("length",)
    return _MEASURES.get(key, ())


def _unset(spec: Role) -> list[str]:
    """Return the keys that a role cannot do without, and whose fields are not named."""
    if isinstance(spec, HeadingRole):
        angle = spec.heading.field if isinstance(spec.heading, Quantity) else spec.heading
        known = spec.orientation_xyzw or angle not in (None, "", "?")
        return [] if known else ["orientation_xyzw or heading"]
    unset = []
    for field in msgspec.structs.fields(spec):
        value = getattr(spec, field.name)
        values = value if isinstance(value, tuple) else (value,)
        fields = [v.field if isinstance(v, Quantity | TimeField) else v for v in values]
        if "?" in fields or ("" in fields and field.name not in _OPTIONAL):
            unset.append(field.name + (", three fields" if isinstance(value, tuple) else ""))
    if isinstance(spec, PositionRole) and spec.latitude is None and spec.position is None:
        unset.append("latitude and longitude, or position")
    return unset


def _combinations(spec: Role) -> Iterator[str]:
    """Name keys that exclude each other, and keys that are nothing without another."""
    match spec:
        case HeadingRole():
            if spec.orientation_xyzw is not None and spec.heading is not None:
                yield "has orientation_xyzw and heading: one of them is to be used"
        case VelocityRole():
            if spec.frame in ("enu", "ned") and any(spec.mount_rpy_deg):
                yield f"frame = {spec.frame!r} has no mount_rpy_deg: the earth is not turned"
        case TravelTimeRole():
            yield from _travel_time(spec)
        case BeaconsRole():
            yield from _place(spec, ("latitude", "longitude", "depth"))
        case PositionRole():
            yield from _place(spec, ("latitude", "longitude"))
            yield from _position(spec)
        case SoundSpeedRole():
            if spec.kind == "mean" and spec.depth is not None:
                yield "kind = 'mean' has no depth: it is of all the water between"


def _place(spec: BeaconsRole | PositionRole, keys: tuple[str, ...]) -> Iterator[str]:
    given = [key for key in keys if getattr(spec, key) is not None]
    if spec.position is not None and given:
        yield f"has position and {given[0]}: one of them is to be used"
    elif given and len(given) < len(keys):
        missing = [key for key in keys if key not in given]
        yield f"{' and '.join(given)} without {' and '.join(missing)}"


def _position(spec: PositionRole) -> Iterator[str]:
    if spec.position is not None and len(spec.position) not in (2, 3):
        yield f"position has {len(spec.position)} components: two or three are to be given"
    if spec.sigma is not None and spec.covariance is not None:
        yield "has sigma and covariance: one of them is to be used"
    if isinstance(spec.sigma, float) and not spec.sigma > 0:
        yield "sigma is not above 0"


def _travel_time(spec: TravelTimeRole) -> Iterator[str]:
    if spec.range is not None and spec.travel_time is not None:
        yield "has travel_time and range: one of them is measured"
    if spec.range is not None and spec.range_sound_speed is None:
        yield "range needs range_sound_speed, m/s or a field: with what speed the modem made it"
    if spec.range is None and spec.range_sound_speed is not None:
        yield "range_sound_speed without range"
    if spec.range is not None and spec.one_way:
        yield "one_way is of travel_time: a range is one-way always"
    if isinstance(spec.range_sound_speed, float) and not 1000 < spec.range_sound_speed < 2000:
        yield f"range_sound_speed = {spec.range_sound_speed:g} m/s is of no water"
    key, n_slots = "range" if spec.range is not None else "travel_time", slots(spec)
    if n_slots and not (isinstance(spec.beacon_id, tuple) and len(spec.beacon_id) == n_slots):
        yield f"{n_slots} slots of {key} need beacon_id = [...], a number for each"
    if not n_slots and isinstance(spec.beacon_id, tuple):
        yield f"beacon_id is a list: {key} must be a list of as many slots"
    if n_slots and spec.ping_time == "":
        yield "slots need ping_time: each reply was heard at ping time + T"
