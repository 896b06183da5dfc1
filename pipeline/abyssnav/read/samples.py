# SPDX-License-Identifier: Apache-2.0
"""Messages of each topic, spread over the log, by field: what names and values say of it."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from abyssnav.errors import ReadError
from abyssnav.formats.columns import Column, Ragged, concatenate
from abyssnav.formats.decoding import decode_payloads, definition_of
from abyssnav.formats.mcap.accumulator import ChannelDecoder, Decoded
from abyssnav.formats.mcap.file_index import Channel
from abyssnav.formats.mcap.reader import read_mcap
from abyssnav.formats.schema import TIMES, Definition, leaves
from abyssnav.profile import Condition, TimeField
from abyssnav.read.fields import holding
from abyssnav.read.parts import Part
from abyssnav.read.stamps import OTHER_CLOCK_NS
from abyssnav.tables import Float, Int

_MOST_FIELDS = 256
_MOST_MESSAGES = 400  #: of each topic whose values are looked at
_LONGEST_ARRAY = 16  #: whose items are looked at one by one
_EARLIEST_S, _LATEST_S = 6e8, 1e10  #: what may be seconds since 1970
_UNITS_OF_TIME = ("s", "ms", "us", "ns")


@dataclass(frozen=True, eq=False)
class SampledField:
    """A field's values in the messages looked at."""

    path: str
    values: NDArray[Any]  #: numbers, text, or nanoseconds of a time
    is_time: bool = False  #: the encoding knows it as a time
    in_array: bool = False  #: of an array, or of messages in one: one value an element

    @property
    def is_number(self) -> bool:
        """Whether it counts or measures."""
        return not self.is_time and self.values.dtype.kind in "iufb"

    @property
    def name(self) -> str:
        """The last part of its path."""
        return self.path.rsplit(".", 1)[-1]

    @cached_property
    def numbers(self) -> Float:
        """Return the finite numbers."""
        values = self.values.astype(np.float64) if self.is_number else np.zeros(0)
        return values[np.isfinite(values)]

    @property
    def is_constant(self) -> bool:
        """Whether it never changes, or holds no number."""
        return len(self.numbers) < 2 or bool(np.ptp(self.numbers) == 0)


@dataclass(frozen=True, eq=False)
class TopicSample:
    """A topic with some of its messages, spread over the log."""

    channel: Channel
    payloads: Ragged
    log_time_ns: Int  #: of those messages
    messages: int  #: of the topic

    @property
    def topic(self) -> str:
        """The topic's name."""
        return self.channel.topic

    @cached_property
    def fields(self) -> Mapping[str, SampledField]:
        """Fields by path; none where the messages cannot be decoded."""
        try:
            return {field.path: field for field in self._decoded()}
        except (ReadError, msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return {}

    def _decoded(self) -> Iterator[SampledField]:
        if self.channel.message_encoding == "json":
            paths, times = _json_paths(self.payloads), set[str]()
        else:
            definition = definition_of(self.channel)
            kinds = dict(islice(leaves(definition), _MOST_FIELDS))
            paths = {path: _in_messages(definition, path) for path in kinds}
            times = {path for path, kind in kinds.items() if kind in TIMES}
        for path, in_messages in paths.items():
            try:
                columns, kept = decode_payloads(self.channel, self.payloads, [path])
            except ReadError:
                continue
            if kept.any():
                yield from _fields_of(path, columns[path], path in times, in_messages)

    # --- asked by the guesses ---

    def numbers(self) -> list[str]:
        """Return the paths of its numbers."""
        return [path for path, field in self.fields.items() if field.is_number]

    def has(self, paths: Iterable[str]) -> bool:
        """Whether it holds all of these fields, and items of their arrays."""
        present, asked = (
            {re.sub(r"\[\d+\]", "", path) for path in every} for every in (self.fields, paths)
        )
        return asked <= present

    def named(self, pattern: str) -> list[str]:
        """Return the paths that a pattern matches somewhere, with letters of any case."""
        return [path for path in self.fields if re.search(pattern, path, re.IGNORECASE)]

    def first_number(self, pattern: str, without: str = "(?!)") -> str:
        """Return the first number whose path matches a pattern and not another; "" if none does."""
        paths = [path for path in self.named(pattern) if self.fields[path].is_number]
        return next((p for p in paths if not re.search(without, p, re.IGNORECASE)), "")

    def when(self, paths: Sequence[str]) -> str | TimeField | None:
        """Return the first that is a time since 1970 near the log's own, with its unit."""
        for path in paths:
            field = self.fields[path]
            if field.is_time:
                if self._is_near(field.values):
                    return path
                continue
            numbers = _as_numbers(field.values)
            for k, unit in enumerate(_UNITS_OF_TIME if len(numbers) else ()):
                since_s = numbers / 10 ** (3 * k)
                if np.all((since_s >= _EARLIEST_S) & (since_s < _LATEST_S)):
                    return TimeField(path, unit)
        return None

    def _is_near(self, stamp_ns: NDArray[Any]) -> bool:
        """Whether a stamp is set, and of the log's own clock."""
        if len(stamp_ns) != len(self.log_time_ns):
            return bool(np.any(stamp_ns))
        away_ns = float(np.median(np.abs(stamp_ns - self.log_time_ns)))
        return away_ns < OTHER_CLOCK_NS or bool(self.log_time_ns.max() < OTHER_CLOCK_NS)

    def holds(self, condition: Condition) -> NDArray[np.bool_]:
        """Return in which of its messages a condition on one of its fields holds."""
        return holding(condition, self.fields[condition.field].values)


def sample_topics(parts: Sequence[Part]) -> dict[str, TopicSample]:
    """Messages of each topic that has any, spread evenly over all files, by topic."""
    total: dict[str, int] = {}
    for part in parts:
        for topic, count in part.totals().items():
            total[topic] = total.get(topic, 0) + count
    pieces: dict[str, list[tuple[Channel, Ragged, Int]]] = {}
    for part in parts:
        takers: dict[int, _Every] = {}

        def select(channel: Channel, takers: dict[int, _Every] = takers) -> ChannelDecoder:
            step = max(1, total.get(channel.topic, 0) // _MOST_MESSAGES)
            taker = takers[channel.id] = _Every(step)
            return ChannelDecoder(taker.decode, lambda _: None)

        for messages in read_mcap(part.path, select).messages:
            payloads = messages.columns.get("payload")
            if isinstance(payloads, Ragged) and len(payloads):
                topic = messages.channel.topic
                piece = (messages.channel, payloads, messages.log_time_ns)
                pieces.setdefault(topic, []).append(piece)
    return {topic: _put_together(pieces[topic], total[topic]) for topic in sorted(pieces)}


def _put_together(pieces: list[tuple[Channel, Ragged, Int]], messages: int) -> TopicSample:
    """One sample of the parts that share the first one's channel definition."""
    first = pieces[0][0]
    alike = [
        piece
        for piece in pieces
        if piece[0].definition == first.definition
        and piece[0].message_encoding == first.message_encoding
    ]
    payloads = concatenate([payloads for _, payloads, _ in alike])
    assert isinstance(payloads, Ragged)
    return TopicSample(first, payloads, np.concatenate([times for *_, times in alike]), messages)


@dataclass
class _Every:
    """Takes every so many messages as they come."""

    step: int
    seen_so_far: int = 0

    def decode(self, payloads: Ragged) -> Decoded:
        number = self.seen_so_far + np.arange(len(payloads))
        kept = number % self.step == 0
        self.seen_so_far += len(payloads)
        return {"payload": payloads[kept]}, kept


def _in_messages(definition: Definition, path: str) -> bool:
    """Whether a field lies in an array of messages."""
    kind, *names = definition.root, *path.split(".")
    for name in names:
        field = next((f for f in definition.types.get(kind, ()) if f.name == name), None)
        if field is None or field.type not in definition.types:
            return False
        if field.count is not None:
            return True
        kind = field.type
    return False


def _fields_of(
    path: str, column: Column, is_time: bool, in_messages: bool
) -> Iterator[SampledField]:
    """The field, or of short arrays of one length each item as a field."""
    if isinstance(column, Ragged):
        content = column.content
        if isinstance(content, Ragged) or content.ndim > 1:
            yield SampledField(path, np.zeros(0), in_array=True)
            return
        lengths = column.lengths
        alike = len(lengths) and (lengths == lengths[0]).all() and lengths[0] <= _LONGEST_ARRAY
        if not alike or in_messages or not lengths[0]:
            yield SampledField(path, np.asarray(content), is_time, in_array=True)
            return
        column = np.asarray(content).reshape(len(lengths), int(lengths[0]))
    if column.ndim == 1:
        yield SampledField(path, column, is_time)
    elif column.ndim == 2 and column.shape[1] <= _LONGEST_ARRAY:
        for k in range(column.shape[1]):
            yield SampledField(f"{path}[{k}]", column[:, k])
    elif column.ndim == 2:  # a long one, such as a covariance: what stands first
        yield SampledField(f"{path}[0]", column[:, 0])


def _json_paths(payloads: Ragged) -> dict[str, bool]:
    """Dotted paths of the members of the first objects, and whether in an array of objects.

    Seconds and nanoseconds of one time are one.
    """
    paths: dict[str, bool] = {}
    for row in payloads.row_bytes()[:8]:
        value = msgspec.json.decode(row)
        for path, inside in _json_leaves("", value, False) if isinstance(value, dict) else ():
            paths.setdefault(path, inside)
    for whole, rest in (("sec", "nanosec"), ("sec", "nsec"), ("seconds", "nanos")):
        for path in [path for path in paths if path.endswith(f".{rest}")]:
            before = path.removesuffix(f".{rest}")
            if f"{before}.{whole}" in paths:
                paths[before] = paths.pop(path)
                del paths[f"{before}.{whole}"]
    return dict(islice(paths.items(), _MOST_FIELDS))


def _json_leaves(path: str, value: Any, inside: bool) -> Iterator[tuple[str, bool]]:
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _json_leaves(f"{path}.{name}" if path else name, inner, inside)
    elif isinstance(value, list) and any(isinstance(item, dict) for item in value):
        for item in value[:1]:
            yield from _json_leaves(path, item, True)
    elif path:
        yield path, inside


def _as_numbers(values: NDArray[Any]) -> Float:
    """Numbers, or the numbers in text; none where one is neither."""
    if values.dtype.kind in "iuf":
        return values.astype(np.float64)
    texts = values.tolist() if values.dtype.kind in "TU" else []
    if not texts or not all(str(text).isdecimal() for text in texts):
        return np.zeros(0)
    return np.array([float(text) for text in texts])
