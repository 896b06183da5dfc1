# SPDX-License-Identifier: Apache-2.0
"""A profile to start from, for a log that the given one does not fit."""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import msgspec

from pipeline.errors import ReadError
from pipeline.formats.decoding import definition_of
from pipeline.formats.definitions import leaves
from pipeline.formats.mcap_layout import Channel
from pipeline.profile import (
    REQUIRED,
    ROLES,
    DepthRole,
    HeadingRole,
    Profile,
    Quantity,
    Role,
    VelocityRole,
    load_profile,
    profile_names,
    same_type,
)
from pipeline.read.parts import Part

#: Words in topics that tell a role.
_HINTS = {
    "heading": r"imu|ahrs|attitude|compass|heading|gyro|hdg",
    "velocity": r"dvl|velocity|twist|bottom",
    "depth": r"depth|pressure|ctd",
    "travel_time": r"lbl|travel|acoustic|repl|range",
    "beacons": r"beacon|transponder",
    "sound_speed": r"sound|svp|ctd/profile",
    "reference": r"reference|truth|gnss|gps",
}
_ANGLE = r"(heading|yaw|hdg)(_deg|_rad)?$"
#: Types that say nothing of what they hold: the topic must hint at the role.
_ANYTHING = ("std_msgs/msg/Float64", "nav_msgs/msg/Odometry", "geometry_msgs/msg/TwistStamped")


def propose(profile: Profile, parts: Sequence[Part], found: Mapping[str, str]) -> str:
    """Profile as TOML: `found` roles as they are, others from topics of known types or fields.

    Empty when no topic could play any of the roles that are missing.
    """
    channels = {
        channel.topic: channel
        for part in parts
        for channel in part.recording.channels
        if channel.id in part.recording.counts
    }
    given = profile.roles()
    sections, guessed = [], False
    for role in ROLES:
        if role in found:
            sections.append(_section(role, given[role], ""))
            continue
        guess = _best(role, channels)
        if guess is not None:
            sections.append(_section(role, *guess))
            guessed = True
        elif role in REQUIRED:
            sections.append(f'[{role}]\ntopic = "?"  # no topic found that looks like it\n')
    head = '# Check topics, fields, units and frames before use.\nname = "my_vehicle"\n\n'
    return head + "\n".join(sections) if guessed else ""


def _best(role: str, channels: Mapping[str, Channel]) -> tuple[Role, str] | None:
    """Most likely topic for a role, and why."""
    guesses = []
    for topic, channel in channels.items():
        hinted = re.search(_HINTS[role], topic, re.IGNORECASE) is not None
        for spec, name in _shipped(role, channel):
            if hinted or spec.type not in _ANYTHING:
                score = 4 + hinted + (spec.topic == topic)
                guesses.append((score, topic, spec, f"as in the profile {name}"))
        by_name = _by_fields(role, channel)
        if by_name is not None:
            guesses.append((1 + 2 * hinted, topic, by_name, "from its fields' names"))
    if not guesses:
        return None
    _, topic, spec, why = max(guesses, key=lambda guess: (guess[0], guess[1]))
    return msgspec.structs.replace(spec, topic=topic), why


def _shipped(role: str, channel: Channel) -> Iterator[tuple[Role, str]]:
    """Specs of shipped profiles for the channel's type, or its topic where it has no type."""
    for name in profile_names():
        spec = load_profile(name).roles().get(role)
        if spec is None:
            continue
        typed = bool(channel.type and spec.type)
        if same_type(channel.type, spec.type) if typed else spec.topic == channel.topic:
            yield spec, name


def _by_fields(role: str, channel: Channel) -> Role | None:
    """A spec from the names of a message's fields, for the roles where names tell much."""
    try:
        paths = [path for path, kind in leaves(definition_of(channel)) if kind != "string"]
    except ReadError:
        return None
    time = _first(r"stamp$|^time$", paths) or "log_time"
    bare = Role(topic=channel.topic, type=channel.type, time=time)
    if role == "velocity":
        x = _first(r"(vel|linear|speed)\w*\.x$", paths)
        y, z = x[:-1] + "y", x[:-1] + "z"
        return _as(VelocityRole, bare, velocity=(x, y, z)) if {x, y, z} <= set(paths) else None
    if role == "depth":
        depth = _first(r"(^|[._])depth(_m)?$", paths)
        return _as(DepthRole, bare, depth=depth) if depth else None
    if role == "heading":
        turn, angle = _first(r"orientation\.x$", paths), _first(_ANGLE, paths)
        if turn:
            return _as(HeadingRole, bare, orientation_xyzw=tuple(turn[:-1] + a for a in "xyzw"))
        unit = "rad" if angle.endswith("rad") else "deg"
        return _as(HeadingRole, bare, heading=Quantity(angle, unit)) if angle else None
    return None


def _as(kind: type[Role], bare: Role, **fields: Any) -> Role:
    return kind(topic=bare.topic, type=bare.type, time=bare.time, **fields)


def _first(pattern: str, paths: Sequence[str]) -> str:
    return next((path for path in paths if re.search(pattern, path, re.IGNORECASE)), "")


def _section(role: str, spec: Role, why: str) -> str:
    """One role as TOML, what is a default left out."""
    lines = [f"[{role}]" + (f"  # {why}" if why else "")]
    for field in msgspec.structs.fields(spec):
        value = getattr(spec, field.name)
        if value != field.default:
            lines.append(f"{field.name} = {_toml(value)}")
    return "\n".join(lines) + "\n"


def _toml(value: Any) -> str:
    if isinstance(value, msgspec.Struct):
        members = [(f, getattr(value, f.name)) for f in msgspec.structs.fields(value)]
        inside = ", ".join(f"{f.name} = {_toml(v)}" for f, v in members if v != f.default)
        return f"{{ {inside} }}"
    if isinstance(value, tuple):
        return "[" + ", ".join(_toml(part) for part in value) + "]"
    if isinstance(value, str):
        return msgspec.json.encode(value).decode()
    return str(value).lower()
