# SPDX-License-Identifier: Apache-2.0
"""Which topics may hold replies, and what they measure; beacons and sound speed beside them."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from abyssnav.profile import (
    BeaconsRole,
    Quantity,
    SoundSpeedRole,
    TimeField,
    TravelTimeRole,
    Value,
)
from abyssnav.read.guessing import Guess, head_of, quantity, unit_of_name
from abyssnav.read.samples import TopicSample
from abyssnav.tables import Float

_ONE_WAY = r"owtt|one_?way|(^|[._])propagation|arrival_time"
_TWO_WAY = r"twt|tof|travel|flight|two_?way|round_?trip|(^|[._])tt(_|$)"
_RANGE = r"(^|[._])(slant_?)?(range|distance|dist)(_?(m|cm|mm|km))?$"
_BEACON = r"beacon|transponder|addr|target|remote|responder|source|src|bou?y|buoy|station"
_PLACE = r"[._](x|y|z|lat\w*|lon\w*|depth\w*|pos\w*|sigma|time\w*)$"
_SENT = r"ping|tx|sent|asked|emit|transmit|interrog"
_RECEIVED = r"rx|heard|recei|reply|arriv"
_COUNTED = r"ping|seq|cycle|interrog|count"
_SOUND = r"sound_?speed|speed_?of_?sound|sound_?vel\w*|(^|[._])(vos|sos|svel|sv)(_|$)"
_MEAN = r"(average|mean|avg)"
#: Sound in sea water, m/s, with a margin.
_SLOWEST_MPS, _FASTEST_MPS = 1380.0, 1650.0
#: Longest travel time in seconds; larger numbers are of a smaller unit.
_LONGEST_S = 100.0
#: Stamps and times that agree are this near, seconds.
_AGREE_S, _LEAST_TURN_AROUND_S = 0.02, 0.004


@dataclass(frozen=True)
class _Measured:
    """The fields of a reply's time or range, and how it counts."""

    paths: tuple[str, ...]
    kind: str  #: two_way, one_way or range


def guess_travel_time(sample: TopicSample, hinted: bool) -> Guess | None:
    """Replies: how long each took or how far it came, whose it is, and when it was asked for."""
    measured = _measured(sample, hinted)
    if measured is None:
        return None
    sent = sample.when([p for p in sample.named(_SENT) if p not in measured.paths])
    if len(measured.paths) > 1:
        beacon: str | tuple[int, ...] = tuple(range(1, len(measured.paths) + 1))
        if sent is None:
            return None
    else:
        beacon = _beacon(sample, measured.paths)
        if not beacon or (sent is None and not hinted):
            return None
    head = head_of(sample)
    of_sent = sent.field if isinstance(sent, TimeField) else sent or ""
    taken = {*measured.paths, of_sent, beacon if isinstance(beacon, str) else ""}
    received = sample.when([p for p in sample.named(_RECEIVED) if p not in taken])
    if received and of_sent and len(measured.paths) == 1:
        head["time"] = received
    more, why = _conversion(sample, measured, head["time"], sent)
    spec = TravelTimeRole(
        **head, ping_time=sent or "", ping_id=_count(sample, taken), beacon_id=beacon,
        snr=_snr(sample), **more,
    )  # fmt: skip
    return Guess(spec, tuple(why), 1 + 2 * hinted + (sent is not None))


def _measured(sample: TopicSample, hinted: bool) -> _Measured | None:
    """What a reply measures: one field, or the slots of several replies."""
    patterns = [("one_way", _ONE_WAY), ("two_way", _TWO_WAY)]
    patterns += [("range", _RANGE)] if hinted else []
    for kind, pattern in patterns:
        paths = [p for p in sample.named(pattern) if sample.fields[p].is_number]
        if not paths:
            continue
        slots = _slots(paths)
        return _Measured(tuple(slots) if slots else (paths[0],), kind)
    return None


def _slots(paths: Sequence[str]) -> list[str]:
    """Fields of one name that only a letter or digit at the end tells apart, in its order."""
    stems: dict[str, list[str]] = {}
    for path in paths:
        match = re.fullmatch(r"(.*_)([a-h]|\d)", path, re.IGNORECASE)
        if match:
            stems.setdefault(match[1], []).append(path)
    most = max(stems.values(), key=len, default=[])
    return sorted(most) if len(most) > 1 else []


def _beacon(sample: TopicSample, taken: Sequence[str]) -> str:
    """The field that says whose a reply is; numbers named `id` first."""
    paths = [
        path
        for path in sample.named(_BEACON)
        if path not in taken and not re.search(_PLACE, path, re.IGNORECASE)
    ]
    paths += [p for p in sample.named(r"(^|[._])id$") if sample.fields[p].is_number]
    element = taken[0].rpartition(".")[0]  # of an array's elements, those of the same element
    in_array = sample.fields[taken[0]].in_array
    paths = [path for path in paths if path.startswith(element) or not in_array]
    paths.sort(key=lambda path: not re.search(r"id$", path, re.IGNORECASE))
    return paths[0] if paths else ""


def _count(sample: TopicSample, taken: set[str]) -> str:
    """The field that counts the pings, if there is one."""
    for path in sample.named(_COUNTED):
        field = sample.fields[path]
        counts = field.is_number and field.values.dtype.kind in "iu"
        if (
            path not in taken
            and counts
            and not path.startswith("header.")
            and not sample.when([path])
        ):
            return path
    return ""


def _snr(sample: TopicSample) -> Value | None:
    return sample.first_number(r"(^|[._])snr(_db)?$") or None


def _conversion(
    sample: TopicSample, measured: _Measured, time: str | TimeField, sent: str | TimeField | None
) -> tuple[dict[str, Any], list[str]]:
    """Keys that make two-way times of what is measured, and on what each rests."""
    numbers = np.concatenate([sample.fields[path].numbers for path in measured.paths])
    sentinel = next((s for s in (-1.0, 0.0) if np.any(numbers == s) and np.any(numbers > 0)), None)
    good = numbers[numbers > 0]
    if measured.kind == "range":
        return _of_range(sample, measured.paths, sentinel)
    unit, why = _time_unit(measured.paths[0], good)
    parts = tuple(quantity(path, unit, sentinel=sentinel) for path in measured.paths)
    more: dict[str, Any] = {"travel_time": parts if len(parts) > 1 else parts[0]}
    reasons = [why]
    if sentinel is not None:
        reasons.append(f"{sentinel:g} is no reply")
    if measured.kind == "one_way":
        more["one_way"] = True
        reasons.append("one-way by its name: half a round trip without the turn-around")
    elif len(parts) == 1 and sent is not None:
        factor = Quantity("", unit)
        key, said = _by_stamps(sample, measured.paths[0], factor, (time, sent))
        more |= key
        reasons += [said] if said else []
    return more, reasons


def _time_unit(path: str, good: Float) -> tuple[str, str]:
    named = unit_of_name(path, "time")
    if named is not None:
        return named, f"{path}: {named or 's'} by its name"
    middle = float(np.median(good)) if len(good) else 0.0
    for unit, factor in (("", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9)):
        if middle < _LONGEST_S * factor:
            return unit, f"{path}: about {middle:.3g}, {unit or 's'} by its values"
    return "ns", f"{path}: ns by its values"


def _by_stamps(
    sample: TopicSample, path: str, factor: Quantity, stamps: tuple[Any, Any]
) -> tuple[dict[str, Any], str]:
    """Whether a time is all that passes between its stamps, half of it, or without turn-around."""
    seconds = [_seconds(sample, time) for time in stamps]
    values = sample.fields[path].values.astype(np.float64)
    if any(s is None or len(s) != len(values) for s in seconds):
        return {}, ""
    elapsed_s = seconds[0] - seconds[1]  # type: ignore[operator]
    time_s = values * {"": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[factor.unit]
    good = np.isfinite(time_s) & (time_s > 0) & (elapsed_s > 0)
    if good.sum() < 8:
        return {}, ""
    rest_s, half_s = (elapsed_s - time_s)[good], (elapsed_s - 2 * time_s)[good]
    if abs(np.median(rest_s)) < _LEAST_TURN_AROUND_S:
        return {}, "two-way: all that passes between ping and reply"
    if np.median(half_s) > -_AGREE_S and np.std(half_s) < 0.2 * np.std(rest_s):
        return {"one_way": True}, "one-way: half of what passes between ping and reply"
    if np.median(rest_s) > 0 and np.std(rest_s) < 0.2 * np.std(time_s[good]):
        gone_s = float(np.median(rest_s))
        said = f"{gone_s:.3f} s less than passes between ping and reply: without the turn-around"
        return {"turn_around": "removed"}, said
    return {}, "two-way, although the stamps are farther apart"


def _seconds(sample: TopicSample, time: str | TimeField) -> Float | None:
    if time == "log_time":
        return sample.log_time_ns / 1e9
    path = time.field if isinstance(time, TimeField) else time
    field = sample.fields[path]
    if field.values.dtype.kind not in "iuf":
        return None
    unit = time.unit if isinstance(time, TimeField) else "ns"
    factor = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[unit]
    first = field.values[0] if len(field.values) else 0
    zero = float(first) * factor if len(field.values) else 0.0
    return (field.values - first).astype(np.float64) * factor + zero


def _of_range(
    sample: TopicSample, paths: tuple[str, ...], sentinel: float | None
) -> tuple[dict[str, Any], list[str]]:
    unit = unit_of_name(paths[0], "length") or ""
    parts = tuple(quantity(path, unit, sentinel=sentinel) for path in paths)
    more: dict[str, Any] = {"range": parts if len(parts) > 1 else parts[0]}
    why = [f"{paths[0]}: a range, in {unit or 'm'}"]
    speed = sample.first_number(_SOUND)
    middle = float(np.median(sample.fields[speed].numbers)) if speed else 0.0
    for scale in (1.0, 0.1, 0.01):
        if _SLOWEST_MPS < middle * scale < _FASTEST_MPS:
            named = quantity(speed, scale=scale if scale != 1 else None)
            return more | {"range_sound_speed": named}, [*why, f"made with {speed}"]
    return more | {"range_sound_speed": 1500.0}, [*why, "made with 1500 m/s, which nothing says"]


def with_all_topics(spec: TravelTimeRole, samples: Mapping[str, TopicSample]) -> TravelTimeRole:
    """The same role on every topic of the same messages: a pattern, or a list."""
    topic = spec.topics[0]
    own = samples[topic].channel
    alike = [
        other
        for other, sample in samples.items()
        if sample.channel.type == own.type
        and sample.channel.definition == own.definition
        and (own.type or set(sample.fields) == set(samples[topic].fields))
        and re.sub(r"\d+", "#", other) == re.sub(r"\d+", "#", topic)
    ]
    if len(alike) < 2:
        return spec
    pattern = re.sub(r"\d+(?=\D*$)", "*", topic)
    fits = [other for other in samples if msgspec.structs.replace(spec, topic=pattern).is_on(other)]
    chosen = pattern if sorted(fits) == sorted(alike) else tuple(sorted(alike))
    return msgspec.structs.replace(spec, topic=chosen)


def guess_beacons(sample: TopicSample, replies: TravelTimeRole) -> Guess | None:
    """Beacons in the replies' own messages, a place beside the number, or in an array."""
    if not replies.is_on(sample.topic):
        return _array_of_beacons(sample)
    if not isinstance(replies.beacon_id, str):
        return None
    stem = re.sub(r"_?(id|no|num|number|name|addr\w*)$", "", replies.beacon_id, flags=re.IGNORECASE)
    place = _place_of(sample, rf"^{re.escape(stem)}\w*[._]")
    if place is None:
        return None
    turn_around, why = _turn_around(sample, "")
    spec = BeaconsRole(
        topic=sample.topic, type=replies.type, time=replies.time,
        id=replies.beacon_id, turn_around=turn_around, **place,
    )  # fmt: skip
    return Guess(spec, ("where each reply says", *why), 2)


def _place_of(sample: TopicSample, before: str) -> dict[str, Any] | None:
    """The keys of a place whose fields' names begin so; None where there is none."""
    for axes in (("x", "y", "z"), ("east", "north", "up"), ("lat", "lon", "depth"),
                 ("latitude", "longitude", "depth")):  # fmt: skip
        paths = [sample.first_number(rf"{before}(\w+[._])*{axis}(_?(m|deg))?$") for axis in axes]
        if all(paths):
            first, second, third = paths
            if axes[0].startswith("lat"):
                return {"latitude": first, "longitude": second, "depth": third}
            return {"position": (first, second, third)}
    return None


def _turn_around(sample: TopicSample, parent: str) -> tuple[Value | float, tuple[str, ...]]:
    """The field of a turn-around below a path, else 0 and that nothing states it."""
    paths = sample.named(r"turn_?around|(^|[._])tat(_|$)|delay")
    path = next((p for p in paths if p.startswith(parent) and sample.fields[p].is_number), "")
    if not path:
        return 0.0, ("no turn-around is stated: taken as 0",)
    return quantity(path, unit_of_name(path, "time") or ""), ()


def _array_of_beacons(sample: TopicSample) -> Guess | None:
    """An array of messages each of which has a number or name, and a place."""
    parents = {path.rpartition(".")[0] for path, f in sample.fields.items() if f.in_array}
    for parent in sorted(parents - {""}):
        before = rf"^{re.escape(parent)}\."
        numbers = sample.named(rf"{before}(\w*_)?(id|no|num|number|code|addr\w*)$")
        names = [
            path
            for path in sample.named(rf"{before}(\w*_)?(name|label|beacon|transponder)$")
            if sample.fields[path].values.dtype.kind == "T"
        ]
        place = _place_of(sample, before)
        if place is None or not (numbers or names):
            continue
        turn_around, why = _turn_around(sample, f"{parent}.")
        spec = BeaconsRole(
            **head_of(sample), id=(numbers or names)[0], name=names[0] if names else None,
            turn_around=turn_around, **place,
        )  # fmt: skip
        return Guess(spec, (f"the array {parent}", *why), 2)
    return None


def guess_sound_speed(sample: TopicSample, hinted: bool) -> Guess | None:
    """Means in the replies' messages, or the vehicle's own series on a topic of its own."""
    path = sample.first_number(_SOUND)
    if not path:
        return None
    field = sample.fields[path]
    middle = float(np.median(field.numbers)) if len(field.numbers) else 0.0
    if field.in_array or not _SLOWEST_MPS < middle < _FASTEST_MPS:
        return None
    head = head_of(sample)
    if re.search(_MEAN, path, re.IGNORECASE):
        spec = SoundSpeedRole(**head, kind="mean", sound_speed=path)
        return Guess(spec, (f"{path}: a mean",), 1)
    if not hinted or field.is_constant:
        return None
    depth = sample.first_number(r"(^|[._])depth(_?m)?$")
    spec = SoundSpeedRole(**head, kind="samples", sound_speed=path, depth=depth or None)
    return Guess(spec, (f"{path}: the vehicle's own series",), 2)
