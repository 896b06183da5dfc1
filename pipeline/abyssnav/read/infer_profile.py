# SPDX-License-Identifier: Apache-2.0
"""A profile to start from, for a log that the given one does not fit."""

import re
from collections.abc import Iterator, Mapping
from typing import Any

import msgspec

from abyssnav.profile import (
    REQUIRED,
    ROLES,
    HeadingRole,
    Profile,
    Role,
    load_profile,
    paths_of,
    profile_names,
    same_type,
)
from abyssnav.read.field_guesses import Example, by_fields

#: Words in topics that tell a role.
_HINTS = {
    "heading": r"imu|ahrs|attitude|compass|heading|gyro|hdg",
    "velocity": r"dvl|velocity|twist|bottom|(^|[/._])bt",
    "depth": r"depth|press|ctd",
    "travel_time": r"lbl|travel|acoustic|repl|range",
    "beacons": r"beacon|transponder",
    "sound_speed": r"sound|svp|ctd/profile",
    "reference": r"reference|truth|gnss|gps|usbl",
}
#: Types that say nothing of what they hold: the topic must hint at the role.
_ANYTHING = ("std_msgs/msg/Float64", "nav_msgs/msg/Odometry", "geometry_msgs/msg/TwistStamped")


#: What there is to choose from, behind a frame.
_FRAMES = {
    "flu": 'forward, port, up; or "frd": forward, starboard, down',
    "frd": 'forward, starboard, down; or "flu": forward, port, up',
    "enu_flu": 'as ROS has it (REP-103); or "ned_frd"',
    "ned_frd": 'or "enu_flu", as ROS has it (REP-103)',
    "enu": 'or "ned"',
    "ned": 'or "enu"',
}
#: Roles to be filled in by hand.
_BLANKS = {
    "heading": """heading = { field = "?", unit = "deg" }  # clockwise from true north""",
    "velocity": """velocity = ["?", "?", "?"]
frame = "flu"  # forward, port, up; or "frd": forward, starboard, down""",
    "depth": """depth = { field = "?", unit = "m" }  # or unit = "Pa", "dbar" ... for a pressure""",
    "travel_time": """ping_time = "?"    # a time, or { field = "...", unit = "us" }
ping_id = ""       # counts the pings; may stay empty
beacon_id = "?"
travel_time = { field = "?", unit = "s" }  # two-way, turn-around included""",
}
_MOST_TOPICS, _MOST_FIELDS = 20, 16


def propose(profile: Profile, examples: Mapping[str, Example], found: Mapping[str, str]) -> str:
    """Profile as TOML: `found` roles as they are, others from topics of known types or fields.

    What could not be guessed has question marks, and behind it come the fields of the topics left.
    Empty when the log holds no message.

    Parameters
    ----------
    examples : by topic
    """
    if not examples:
        return ""
    given = profile.roles()
    sections, used = [], set[str]()
    for role in ROLES:
        guess = (given[role], "") if role in found else _best(role, examples)
        if guess is not None:
            sections.append(_section(role, *guess))
            used.add(guess[0].where)
        elif role in REQUIRED:
            blank = _BLANKS[role]
            sections.append(f'[{role}]\ntopic = "?"  # none found that looks like it\n{blank}\n')
    head = '# Check topics, fields, units and frames before use.\nname = "my_vehicle"\n\n'
    rest = {topic: example for topic, example in examples.items() if topic not in used}
    return head + "\n".join([*sections, *_left(rest)])


def _left(examples: Mapping[str, Example]) -> list[str]:
    """Topics without a role, and their fields."""
    lines = []
    for topic, example in list(examples.items())[:_MOST_TOPICS]:
        names = list(example.values)
        more = " ..." if len(names) > _MOST_FIELDS else ""
        lines.append(f"#   {topic}: {', '.join(names[:_MOST_FIELDS])}{more}\n")
    return (
        ["# Topics that have no role here, and their fields:\n" + "".join(lines)] if lines else []
    )


def _best(role: str, examples: Mapping[str, Example]) -> tuple[Role, str] | None:
    """Most likely topic for a role, and why."""
    guesses = []
    for topic, example in examples.items():
        hinted = re.search(_HINTS.get(role, "(?!)"), topic, re.IGNORECASE) is not None
        for spec, name in _shipped(role, example):
            if hinted or spec.type not in _ANYTHING:
                score = 4 + hinted + (spec.topic == topic)
                guesses.append((score, topic, spec, f"as in the profile {name}"))
        by_name = by_fields(role, example, hinted)
        if by_name is not None:
            guesses.append((1 + 2 * hinted, topic, by_name, "from its fields' names"))
    if not guesses:
        return None
    _, topic, spec, why = max(guesses, key=lambda guess: (guess[0], guess[1]))
    return msgspec.structs.replace(spec, topic=topic), why


def _shipped(role: str, example: Example) -> Iterator[tuple[Role, str]]:
    """Specs of shipped profiles for the channel's type; for its topic and fields without one."""
    channel = example.channel
    for name in profile_names():
        spec = load_profile(name).roles().get(role)
        if spec is None:
            continue
        if channel.type and spec.type:
            fits = same_type(channel.type, spec.type)
        else:
            fits = spec.topic == channel.topic and example.has(paths_of(spec))
        if fits:
            yield spec, name


def _section(role: str, spec: Role, why: str) -> str:
    """One role as TOML, what is a default left out, but for the frame."""
    lines = [f"[{role}]" + (f"  # {why}" if why else "")]
    for field in msgspec.structs.fields(spec):
        value = getattr(spec, field.name)
        if field.name == "frame" and not _is_angle(spec):
            lines.append(f"frame = {_toml(value)}  # {_FRAMES[value]}")
        elif value != field.default:
            lines.append(f"{field.name} = {_toml(value)}")
    return "\n".join(lines) + "\n"


def _is_angle(spec: Role) -> bool:
    """Whether the role is a compass without a frame."""
    return isinstance(spec, HeadingRole) and spec.orientation_xyzw is None


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
