# SPDX-License-Identifier: Apache-2.0
"""A profile to start from, from the types, names and values in a log."""

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import msgspec

from abyssnav.errors import printable
from abyssnav.profile import (
    REQUIRED,
    ROLES,
    SENSORS,
    HeadingRole,
    Profile,
    Role,
    TravelTimeRole,
    VelocityRole,
    paths_of,
    quantities,
    same_type,
    shipped_profiles,
)
from abyssnav.read.guess_acoustics import (
    guess_beacons,
    guess_sound_speed,
    guess_travel_time,
    with_all_topics,
)
from abyssnav.read.guess_sensors import (
    adapted,
    guess_altitude,
    guess_depth,
    guess_heading,
    guess_position,
    guess_reference,
    guess_velocity,
)
from abyssnav.read.guessing import Guess, columns_of, has_values
from abyssnav.read.samples import TopicSample
from abyssnav.read.velocity_frame import frame_by_definition, frame_by_depth
from abyssnav.tables import Columns

#: Words in topics that tell a role.
_HINTS = {
    "heading": r"imu|ahrs|attitude|compass|heading|gyro|hdg",
    "velocity": r"dvl|velocity|twist|bottom|(^|[/._])bt|ensemble|position_delta",
    "depth": r"depth|press|ctd|baro|paro",
    "travel_time": r"lbl|travel|acoustic|repl|range|ranging|modem|transponder",
    "beacons": r"beacon|transponder|lbl",
    "sound_speed": r"sound|svp|svs|ctd|lbl",
    "position": r"gnss|gps|usbl|navsat",
    "altitude": r"altimeter|altitude|sonar_alt",
    "reference": r"reference|truth",
}
#: Topics that are no sensor: an independent track, or what another navigator made of them.
_NO_SENSOR = r"reference|truth|filter|estimat|solution|(^|[/._])ekf|pose_graph"
#: Types that say nothing of what they hold: the topic must hint at the role.
_ANYTHING = (
    "std_msgs/msg/Float64", "nav_msgs/msg/Odometry", "geometry_msgs/msg/TwistStamped",
    "sensor_msgs/msg/NavSatFix",
)  # fmt: skip
_GUESSES: dict[str, Callable[[TopicSample, bool], Guess | None]] = {
    "heading": guess_heading,
    "velocity": guess_velocity,
    "depth": guess_depth,
    "travel_time": guess_travel_time,
    "sound_speed": guess_sound_speed,
    "position": guess_position,
    "altitude": guess_altitude,
    "reference": guess_reference,
}
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
    "travel_time": """ping_time = "?"    # a time, or { field = "...", unit = "us" }; "": not logged
ping_id = ""       # counts the pings; may stay empty
beacon_id = "?"
travel_time = { field = "?", unit = "s" }  # two-way, turn-around included; or one_way = true""",
}
_MOST_TOPICS, _MOST_FIELDS, _MOST_BEACONS = 20, 16, 16
#: Guesses up to this score rest on names alone.
_BY_NAMES = 4.0
#: Columns of some roles, over all messages of the log.
Reread = Callable[[Mapping[str, Role]], Mapping[str, Columns] | None]


@dataclass(frozen=True)
class Proposal:
    """A profile for a log: as TOML, and what it is made of."""

    text: str
    roles: Mapping[str, Role]


def infer_profile(
    profile: Profile,
    samples: Mapping[str, TopicSample],
    readable: Mapping[str, str],
    places_known: bool,
    reread: Reread,
) -> Proposal:
    """Profile as TOML: `readable` roles as they are, others from known types, names and values.

    What could not be guessed has question marks, and behind it come the fields of the topics left.
    No topic of the reference, none of another navigator's result, and none whose messages are all
    without a value is proposed as a sensor.  Empty when the log holds no message.

    Parameters
    ----------
    samples : by topic
    readable : role -> topic, of the roles of `profile` that the log has
    places_known : whether settings give the beacons
    reread : columns of all messages of some roles; None where they cannot be read
    """
    if not samples:
        return Proposal("", {})
    guesses = {
        role: Guess(spec, (), 9) for role, spec in profile.roles().items() if role in readable
    }
    for role in ROLES:
        if role not in guesses:
            best = _best(role, samples, guesses)
            if best is not None:
                guesses[role] = best
    guesses = _settle_frame(guesses, samples, reread)
    sections = []
    for role in ROLES:
        if role in guesses:
            sections.append(_section(role, guesses[role]))
        elif role in REQUIRED:
            blank = _BLANKS[role]
            sections.append(f'[{role}]\ntopic = "?"  # none looks like it\n{blank}\n')
    head = '# Check topics, fields, units and frames before use.\nname = "my_vehicle"\n\n'
    used = {topic for topic in samples for g in guesses.values() if g.spec.is_on(topic)}
    rest = {topic: sample for topic, sample in samples.items() if topic not in used}
    blocks = [] if "beacons" in guesses or places_known else _beacon_blocks(guesses, samples)
    text = head + "\n".join([*sections, *blocks, *_left(rest)])
    return Proposal(text, {role: guess.spec for role, guess in guesses.items()})


def _best(
    role: str, samples: Mapping[str, TopicSample], others: Mapping[str, Guess]
) -> Guess | None:
    """Most likely topic for a role."""
    guesses = list[Guess | None]()
    for topic, sample in samples.items():
        hinted = re.search(_HINTS[role], topic, re.IGNORECASE) is not None
        if role != "reference" and re.search(_NO_SENSOR, topic, re.IGNORECASE):
            continue
        guesses += _shipped(role, sample, hinted)
        if role == "beacons":
            replies = others["travel_time"].spec if "travel_time" in others else None
            if isinstance(replies, TravelTimeRole):
                guesses.append(guess_beacons(sample, replies))
        elif sample.channel.type not in _ANYTHING or hinted:
            guesses.append(_GUESSES[role](sample, hinted))
    likely = sorted(
        (guess for guess in guesses if guess is not None),
        key=lambda guess: (guess.score, guess.spec.topics),
        reverse=True,
    )
    for guess in likely:
        if has_values(role, guess.spec, samples[guess.spec.topics[0]]):
            return _on_all_topics(guess, samples, others)
    return None


def _on_all_topics(
    guess: Guess, samples: Mapping[str, TopicSample], others: Mapping[str, Guess]
) -> Guess:
    """The guess on every topic of its kind, where a role may have several."""
    spec, replies = guess.spec, others.get("travel_time")
    if isinstance(spec, TravelTimeRole):
        spec = with_all_topics(spec, samples)
    elif replies is not None and replies.spec.is_on(spec.topics[0]):
        spec = msgspec.structs.replace(spec, topic=replies.spec.topic)
    return Guess(spec, guess.why, guess.score)


@cache  # asked for with every topic of a log, which may have tens of thousands
def _shipped_specs(role: str) -> tuple[tuple[str, Role], ...]:
    """What each shipped profile that has a role says of it, by the profile's name."""
    every = ((profile.name, profile.roles().get(role)) for profile in shipped_profiles())
    return tuple((name, spec) for name, spec in every if spec is not None)


def _shipped(role: str, sample: TopicSample, hinted: bool) -> Iterator[Guess]:
    """Specs of shipped profiles for the channel's type; for its topic and fields without one."""
    channel = sample.channel
    for name, spec in _shipped_specs(role):
        if channel.type and spec.type:
            fits = same_type(channel.type, spec.type)
        else:
            fits = spec.is_on(channel.topic) and sample.has(paths_of(spec))
        if fits and (hinted or spec.type not in _ANYTHING):
            own = spec.is_on(channel.topic)
            on_topic = msgspec.structs.replace(spec, topic=channel.topic)
            guess = Guess(on_topic, (f"as in the profile {name}",), 4 + hinted + own)
            yield guess if own else adapted(guess, sample)


# --- up or down ---------------------------------------------------------------------------------


def _settle_frame(
    guesses: dict[str, Guess], samples: Mapping[str, TopicSample], reread: Reread
) -> dict[str, Guess]:
    """Tell `flu` from `frd` by the data, else by the definition, where names alone spoke."""
    guess = guesses.get("velocity")
    if guess is None or guess.score > _BY_NAMES or not isinstance(guess.spec, VelocityRole):
        return guesses
    spec = guess.spec
    if spec.frame not in ("flu", "frd"):
        return guesses
    sample, first = samples[spec.topics[0]], quantities(spec)["velocity[0]"].field
    frame, why = frame_by_definition(sample, first)
    known = frame or spec.frame
    three = dict[str, Role]()
    for role in SENSORS:
        if role in guesses:
            three[role] = guesses[role].spec
    by_depth, said = None, ""
    if len(three) == len(SENSORS):
        three["velocity"] = msgspec.structs.replace(spec, frame=known)
        columns = reread(three)
        by_depth, said = frame_by_depth(columns, known, bool(frame)) if columns else (None, "")
    frame = by_depth or known
    reasons = [f"{frame}: {one}" for one in (why, said) if one] or [f"{frame} by its names"]
    spec = msgspec.structs.replace(spec, frame=frame)
    return {**guesses, "velocity": Guess(spec, (*guess.why, *reasons), guess.score)}


# --- as TOML ------------------------------------------------------------------------------------


def _section(role: str, guess: Guess) -> str:
    """One role as TOML, what is a default left out, but for the frame."""
    spec, lines = guess.spec, [f"[{role}]"]
    lines += [f"# {printable(why)}" for why in guess.why]
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
        return msgspec.json.encode(value).decode().replace("\x7f", "\\u007f")
    return str(value).lower()


def _beacon_blocks(guesses: Mapping[str, Guess], samples: Mapping[str, TopicSample]) -> list[str]:
    """Settings to be filled: one block for each beacon that answers."""
    replies = guesses.get("travel_time")
    if replies is None:
        return []
    ids: set[int] = set()
    for topic, sample in samples.items():
        if replies.spec.is_on(topic):
            columns = columns_of(replies.spec, sample)
            ids |= set(columns["beacon_id"].tolist()) if columns is not None else set()
    lines = [
        "# No topic says where the beacons are: they come from settings (--config), as below,",
        "# or from a table (--beacons FILE).",
    ]
    for number in sorted(ids)[:_MOST_BEACONS]:
        lines += [
            "# [[beacon]]",
            f"# id = {number}",
            "# latitude_deg = ?",
            "# longitude_deg = ?",
            "# depth_m = ?",
            "# turn_around_s = ?",
        ]
    return ["\n".join(lines) + "\n"]


def _left(samples: Mapping[str, TopicSample]) -> list[str]:
    """Topics without a role, and their fields."""
    lines = []
    for topic, sample in list(samples.items())[:_MOST_TOPICS]:
        names = list(dict.fromkeys(re.sub(r"\[\d+\]$", "", path) for path in sample.fields))
        more = " ..." if len(names) > _MOST_FIELDS else ""
        shown = printable(", ".join(names[:_MOST_FIELDS]) + more)
        lines.append(f"#   {printable(topic)}: {shown}\n")
    return (
        ["# Topics that have no role here, and their fields:\n" + "".join(lines)] if lines else []
    )
