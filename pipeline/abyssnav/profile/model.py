# SPDX-License-Identifier: Apache-2.0
"""What a profile can say: one table a role, each key with what it is for."""

import re
from collections.abc import Container, Iterator
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

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
ROLES = (
    "heading", "velocity", "depth", "travel_time", "beacons", "sound_speed", "position",
    "altitude", "reference",
)  # fmt: skip
#: Roles that measure the vehicle itself: of each one message an instant is all there is.
SENSORS = ROLES[:3]
#: Roles without which no dive is navigated; `position` can stand for `travel_time`.
REQUIRED = (*SENSORS, "travel_time")

#: What converts a value; and seconds, degrees, metres and pascals that a vehicle can have.
Number = Annotated[float, Meta(ge=-1e12, le=1e12)]
Latency = Annotated[float, Meta(ge=-86_400, le=86_400)]
Angle = Annotated[float, Meta(ge=-360, le=360)]
Latitude = Annotated[float, Meta(ge=-90, le=90)]
Pressure = Annotated[float, Meta(ge=0, le=1e6)]
Arm = Annotated[float, Meta(ge=-1000, le=1000)]


class _Profile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pass


class Quantity(_Profile, frozen=True):
    """A field with its conversion: ours = (theirs · scale + offset) in `unit`."""

    #: Dotted path; `[k]` picks from an array.
    field: str
    #: Empty: our own unit, SI with radians; degrees for latitude and longitude.
    unit: str = ""
    #: Factor before the offset; -1 turns a sign.
    scale: Number = 1.0
    #: In `unit`: an angle counted from east gets 90 deg, gauge pressure gets 101325 Pa.
    offset: Number = 0.0
    #: Number that stands for "no value", before scaling.
    sentinel: float | None = None


class Condition(_Profile, frozen=True):
    """When a message counts: all that is given must hold."""

    #: Dotted path.
    field: str
    #: The field has this value.
    equals: bool | int | float | str | None = None
    #: The field has another value.
    differs_from: bool | int | float | str | None = None
    #: The field is not below.
    at_least: float | None = None


class TimeField(_Profile, frozen=True):
    """A number as time: `unit` since 1970 UTC."""

    #: Dotted path.
    field: str
    #: s, ms, us or ns.
    unit: str = "ns"


Value = str | Quantity
Values = str | Quantity | tuple[Value, ...]
Triple = tuple[Value, Value, Value]
Validity = str | Condition | tuple[Condition, ...]


class Role(_Profile, frozen=True):
    """What every role has.

    A path through an array of messages (`replies.range`) gives one row an element.
    """

    #: A topic, a list of topics, or a pattern in which `*` stands for anything.
    topic: str | tuple[str, ...]
    #: Expected message type; empty: any that has the fields.
    type: str = ""
    #: `log_time`, a stamp's path, or a number's path and unit.
    time: str | TimeField = "header.stamp"
    #: The message's time is this much later than what it measures; subtracted.
    latency_s: Latency = 0.0
    #: Messages for which this does not hold have no value; a path alone means that it is true.
    valid: Validity = ()

    @property
    def topics(self) -> tuple[str, ...]:
        """Topics and patterns."""
        return (self.topic,) if isinstance(self.topic, str) else self.topic

    @property
    def where(self) -> str:
        """The topics as people read them."""
        return ", ".join(self.topics)

    def is_on(self, topic: str) -> bool:
        """Whether messages of a topic are of this role."""
        return any(
            topic == one or ("*" in one and re.fullmatch(_pattern(one), topic) is not None)
            for one in self.topics
        )


def _pattern(topic: str) -> str:
    return ".*".join(re.escape(part) for part in topic.split("*"))


class HeadingRole(Role, frozen=True):
    """Attitude: a quaternion, or angles clockwise from true north."""

    #: Body to local, in the convention of `frame`.
    orientation_xyzw: tuple[str, str, str, str] | None = None
    #: Of the quaternion: `enu_flu` is REP-103; `ned_frd`.
    frame: Literal["enu_flu", "ned_frd"] = "enu_flu"
    #: Clockwise from north.
    heading: Value | None = None
    #: Positive starboard down.
    roll: Value | None = None
    #: Positive bow up.
    pitch: Value | None = None
    #: Added to a magnetic heading, positive east.
    declination_deg: Angle = 0.0


class VelocityRole(Role, frozen=True):
    """Velocity over ground."""

    #: Three components along the axes of `frame`.
    velocity: Triple = ("", "", "")
    #: Above the floor; bottom bounces are recognised by it.
    altitude: Value | None = None
    #: `flu` is REP-103: x forward, y port, z up; `frd` is forward, starboard, down; `enu` and `ned`
    #: are of the earth.
    frame: Literal["flu", "frd", "enu", "ned"] = "flu"
    #: How the instrument is turned on the vehicle: roll, pitch, yaw about forward, starboard, down;
    #: R = Rz Ry Rx takes its vectors to the vehicle's.
    mount_rpy_deg: tuple[Angle, Angle, Angle] = (0.0, 0.0, 0.0)
    #: The instrument from the navigated point: forward, starboard, down.
    offset_m: tuple[Arm, Arm, Arm] = (0.0, 0.0, 0.0)
    #: Interval that ends at the stamp, of which `velocity` is then the increment, a length.
    per: Value | None = None
    #: Holds for bottom track; other messages are of water track and do not count.
    bottom_track: Validity = ()


class DepthRole(Role, frozen=True):
    """Depth, positive down; in a pressure unit it is absolute pressure, and TEOS-10 follows."""

    #: A length or a pressure.
    depth: Value = "depth"
    #: Where pressure is turned into depth: 15 m in 6,000 m from equator to 45 degrees.  None: at
    #: the origin.
    latitude_deg: Latitude | None = None
    #: The air's, taken off a pressure.
    atmosphere_pa: Pressure = 101_325.0


class TravelTimeRole(Role, frozen=True):
    """Replies: one or several a message.

    Of several a message, each was heard at ping time + T, unless each has its own time.
    """

    #: Empty where the vehicle does not log it: reply - T.
    ping_time: str | TimeField = "ping_time"
    #: Empty where the vehicle does not count: pings are then numbered by their times.
    ping_id: str = "ping_id"
    #: A number, or text with one number in it: `B4` is 4; a number for each slot.
    beacon_id: str | tuple[int, ...] = "beacon_id"
    #: Two-way time T, turn-around included; a list for the slots of a message.  Default:
    #: `travel_time`.
    travel_time: Values | None = None
    #: `removed`: the modem took the turn-around off, T = travel_time + turn-around.
    turn_around: Literal["included", "removed"] = "included"
    #: Half a round trip, turn-around taken off: T = 2 travel_time + turn-around.
    one_way: bool = False
    #: In place of `travel_time`: T = 2 range / range_sound_speed + turn-around.
    range: Values | None = None
    #: The speed with which the modem made the range: m/s, or a field.
    range_sound_speed: Annotated[float, Meta(ge=100, le=10_000)] | Value | None = None
    #: Turn-around time of this very reply, in place of the beacon's.
    turn_around_field: Value | None = None
    #: Signal to noise ratio, dB.
    snr: Value | None = None

    def __post_init__(self) -> None:
        if self.travel_time is None and self.range is None:
            msgspec.structs.force_setattr(self, "travel_time", "travel_time")


class BeaconsRole(Role, frozen=True):
    """Transponders: an array a message, or one in each message."""

    #: As the replies have it.
    id: str = "beacons.id"
    #: As people know it.
    name: str | None = None
    #: East, north, up.
    position: Triple | None = None
    #: In place of `position`, with `longitude` and `depth`; degrees.
    latitude: Value | None = None
    #: Degrees.
    longitude: Value | None = None
    #: Positive down.
    depth: Value | None = None
    #: A field, or one number of seconds for all.
    turn_around: Value | Annotated[float, Meta(ge=0, le=1e4)] = "beacons.turn_around_time"
    #: Of each axis; 0: not stated.
    position_sigma: Value | None = None
    #: Degrees.
    origin_latitude: str | None = None
    #: Degrees.
    origin_longitude: str | None = None

    def __post_init__(self) -> None:
        if self.position is None and self.latitude is None:
            place = tuple(f"beacons.position.{axis}" for axis in "xyz")
            msgspec.structs.force_setattr(self, "position", place)


class SoundSpeedRole(Role, frozen=True):
    """Sound speed: a profile a message, the vehicle's own series, or means over the water."""

    #: `profile`; `samples`: the vehicle's own series, made into a profile; `mean`: one number for
    #: the water between.
    kind: Literal["profile", "samples", "mean"] = "profile"
    #: Of each level or sample; samples without one get the vehicle's depth.  Default of a profile:
    #: `depth`.
    depth: Value | None = None
    #: Metres a second.
    sound_speed: Value = "sound_speed"

    def __post_init__(self) -> None:
        if self.depth is None and self.kind == "profile":
            msgspec.structs.force_setattr(self, "depth", "depth")


class PositionRole(Role, frozen=True):
    """Fixes of another kind: GNSS at the surface, USBL.  For `ekf` and `smoother`."""

    #: Degrees, WGS 84, with `longitude`.
    latitude: Value | None = None
    #: Degrees.
    longitude: Value | None = None
    #: Above the ellipsoid or the sea.
    altitude: Value | None = None
    #: In place of latitude and longitude, two or three along the axes of `frame`, from the origin.
    position: tuple[Value, ...] | None = None
    #: Of `position`.
    frame: Literal["enu", "ned"] = "enu"
    #: Standard deviation of each horizontal axis, metres: a number or a field.
    sigma: Annotated[float, Meta(ge=0, le=1e7)] | Value | None = None
    #: In place of `sigma`: array of 2 x 2, 3 x 3 or 6 x 6, m², in the order of `frame`.
    covariance: str | None = None
    #: Antenna or transponder from the navigated point: forward, starboard, down.
    offset_m: tuple[Arm, Arm, Arm] = (0.0, 0.0, 0.0)


class AltitudeRole(Role, frozen=True):
    """Height above the floor, where the DVL's message has none."""

    #: Metres.
    altitude: Value = "altitude"


class ReferenceRole(Role, frozen=True):
    """Independent position, for evaluation only."""

    #: Along the axes of `frame`.
    position: Triple = ("pose.pose.position.x", "pose.pose.position.y", "pose.pose.position.z")
    #: `enu` or `ned`.
    frame: Literal["enu", "ned"] = "enu"


class Profile(_Profile, frozen=True):
    """One vehicle's log."""

    #: Roll, pitch, heading.
    heading: HeadingRole
    #: Velocity over ground.
    velocity: VelocityRole
    #: Depth or pressure.
    depth: DepthRole
    #: Replies of the beacons; required unless there is `position`.
    travel_time: TravelTimeRole | None = None
    #: Where the beacons are, if not in the settings.
    beacons: BeaconsRole | None = None
    #: Sound speed, if not in the settings.
    sound_speed: SoundSpeedRole | None = None
    #: GNSS or USBL.
    position: PositionRole | None = None
    #: Height above the floor.
    altitude: AltitudeRole | None = None
    #: For evaluation only.
    reference: ReferenceRole | None = None
    #: The profile's name; default: the file's.
    name: str = ""
    #: What vehicle this is for.
    about: str = ""

    def roles(self) -> dict[str, Role]:
        """Roles that this profile maps."""
        by_name = {role: getattr(self, role) for role in ROLES}
        return {role: spec for role, spec in by_name.items() if spec is not None}

    def required(self) -> tuple[str, ...]:
        """Roles whose messages the log must hold."""
        acoustic = self.travel_time is not None
        return REQUIRED if acoustic else (*SENSORS, "position")


class Topics(Container[str]):
    """The topics of a profile's roles, patterns included."""

    def __init__(self, profile: Profile) -> None:
        self.roles = tuple(profile.roles().values())

    def __contains__(self, topic: object) -> bool:
        return isinstance(topic, str) and any(role.is_on(topic) for role in self.roles)


#: Keys that hold no field with a conversion.
_NOT_QUANTITIES = frozenset(
    {
        "topic", "type", "time", "latency_s", "valid", "frame", "ping_time", "kind",
        "mount_rpy_deg", "offset_m", "bottom_track", "declination_deg", "latitude_deg",
        "atmosphere_pa", "covariance", "one_way",
    }
)  # fmt: skip


def quantities(role: Role) -> dict[str, Quantity]:
    """Fields of a role with a conversion, by our name; `name[i]` for the parts of a list."""
    by_name: dict[str, Quantity] = {}
    for key, value in _values(role):
        if isinstance(value, Quantity):
            by_name[key] = value
        elif value:
            by_name[key] = Quantity(value)
    return by_name


def _values(role: Role) -> Iterator[tuple[str, Value]]:
    for key in role.__struct_fields__:
        value = getattr(role, key)
        if key in _NOT_QUANTITIES or (key == "turn_around" and isinstance(role, TravelTimeRole)):
            continue
        parts = (
            {f"{key}[{i}]": part for i, part in enumerate(value)}
            if isinstance(value, tuple)
            else {key: value}
        )
        yield from ((k, part) for k, part in parts.items() if isinstance(part, str | Quantity))


def conditions(valid: Validity) -> tuple[Condition, ...]:
    """The conditions in a `valid` or `bottom_track`; all must hold."""
    if isinstance(valid, str):
        return (Condition(valid, differs_from=0),)
    return (valid,) if isinstance(valid, Condition) else valid


def slots(role: TravelTimeRole) -> int:
    """Number of fixed slots for replies in a message; 0: its fields are of one reply each."""
    measured = role.range if role.range is not None else role.travel_time
    return len(measured) if isinstance(measured, tuple) else 0


def paths_of(role: Role) -> list[str]:
    """Fields that a role needs, each once."""
    paths = [quantity.field for quantity in quantities(role).values()]
    times = (role.time, getattr(role, "ping_time", ""))
    paths += [time.field if isinstance(time, TimeField) else time for time in times]
    paths += [one.field for one in conditions(role.valid)]
    paths += [one.field for one in conditions(getattr(role, "bottom_track", ()))]
    paths.append(getattr(role, "covariance", None) or "")
    return list(dict.fromkeys(path for path in paths if path not in ("", "log_time")))
