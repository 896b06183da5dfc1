# SPDX-License-Identifier: Apache-2.0
"""The official `mcap` library: what it lists beside the messages, and its opinion of a sound file.

Our reader knows messages alone.  Metadata and attachments come through the library, which is also
a second road to the messages: slow, and written by others.
"""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from abyssnav.errors import ReadError
from abyssnav.formats.columns import Ragged
from abyssnav.formats.mcap.accumulator import ChannelDecoder, Decoded
from abyssnav.formats.mcap.container import mapped
from abyssnav.formats.mcap.file_index import Channel
from abyssnav.formats.mcap.reader import Recording, read_mcap
from abyssnav.formats.mcap.records import METADATA
from abyssnav.tables import Finding

#: A longer record than this is refused, as nobody's metadata is; an attachment may be a film.
_MOST_BYTES: Final = 1 << 28
#: Findings that say nothing against the messages.
_HARMLESS: Final = ("unknown records", "conflicting schema", "conflicting channel", "no checksums")
#: What the library raises on damage beside its own errors: `bytes.decode`, a short read, an unknown
#: channel, a wrong offset, lz4's own error.
_DAMAGE: Final = (struct.error, ValueError, LookupError, OSError, RuntimeError, MemoryError)


@dataclass(frozen=True)
class Metadata:
    """A metadata record: a name and pairs of text."""

    name: str
    pairs: dict[str, str]


@dataclass(frozen=True)
class Attachment:
    """An attachment, without its bytes."""

    name: str
    media_type: str
    size_bytes: int
    log_time_ns: int


@dataclass(frozen=True)
class Extras:
    """What a file holds beside channels and messages."""

    metadata: tuple[Metadata, ...] = ()
    attachments: tuple[Attachment, ...] = ()
    findings: tuple[Finding, ...] = ()  #: why the library could not read on


@dataclass(frozen=True)
class SecondOpinion:
    """What the official library reads of a file, beside what we do."""

    library: str  #: its name and version
    messages: int  #: that it read
    differences: tuple[Finding, ...]  #: none when both readers agree


def list_extras(path: Path) -> Extras:
    """Metadata and attachments of a file, by the official library.

    Chunks are passed over, not unpacked.  What is damaged ends the list, with a finding.

    Raises
    ------
    ReadError
        The file cannot be opened, or does not begin as MCAP does.
    """
    from mcap import records

    try:
        listed = _list_by_summary(path)
    except _library_errors():  # the walk finds the damage, or reads around it
        listed = None
    if listed:
        return listed
    metadata: list[Metadata] = []
    attachments: list[Attachment] = []
    findings: list[Finding] = []
    try:
        for record in _records(path, emit_chunks=True):
            if isinstance(record, records.Metadata):
                metadata.append(Metadata(record.name, dict(record.metadata)))
            elif isinstance(record, records.Attachment):
                size = len(record.data)
                one = Attachment(record.name, record.media_type, size, record.log_time)
                attachments.append(one)
    except _library_errors() as error:
        findings.append(_unread(path, error))
    return Extras(tuple(metadata), tuple(attachments), tuple(findings))


def _list_by_summary(path: Path) -> Extras | None:
    """As `list_extras`, by the summary alone; None where that does not name all that it counts."""
    from mcap.reader import SeekingReader

    with mapped(path) as buffer:
        stream: Any = buffer.obj
        reader = SeekingReader(stream, record_size_limit=_MOST_BYTES)
        summary = reader.get_summary()
        counts = summary and summary.statistics
        if not (
            summary
            and counts
            and counts.metadata_count == len(summary.metadata_indexes)
            and counts.attachment_count == len(summary.attachment_indexes)
            # where the library would unpack a chunk, however large, if an index led to one
            and all(buffer[one.offset] == METADATA for one in summary.metadata_indexes)
        ):
            return None
        attachments = [
            Attachment(one.name, one.media_type, one.data_size, one.log_time)
            for one in sorted(summary.attachment_indexes, key=lambda one: one.offset)
        ]
        metadata = [Metadata(one.name, dict(one.metadata)) for one in reader.iter_metadata()]
    return Extras(tuple(metadata), tuple(attachments))


def compare_with_library(path: Path) -> SecondOpinion:
    """Read a sound file with the official library too, and say where the two readers differ.

    Compared are, channel by channel: topic, encodings, type and definition, the number of
    messages, every log time and every byte of every payload, in the file's order.  A file in which
    we found damage is not given to the library, which holds to no limits; that is the difference.

    Raises
    ------
    ReadError
        The file cannot be opened, or does not begin as MCAP does.
    """
    import mcap

    library = f"mcap {mcap.__version__}"
    digests: dict[int, _Digest] = {}

    def select(channel: Channel) -> ChannelDecoder:
        digests[channel.id] = _Digest()
        return ChannelDecoder(digests[channel.id].add_payloads)

    ours = read_mcap(path, select)
    damage = [finding for finding in ours.findings if finding.what not in _HARMLESS]
    if damage:
        detail = f"{library} was not asked, as the file is damaged: {damage[0].what}"
        return SecondOpinion(library, 0, (Finding("not compared", path.name, detail),))
    for messages in ours.messages:
        digests[messages.channel.id].add_times(messages.log_time_ns.astype("<i8").tobytes())
    theirs = _Library()
    try:
        for record in _records(path, emit_chunks=False):
            theirs.add(record)
    except _library_errors() as error:
        return SecondOpinion(library, theirs.messages, (_unread(path, error),))
    where = f"{path.name}, by {library}"
    differences = tuple(_differences(where, ours, digests, theirs))
    return SecondOpinion(library, theirs.messages, differences)


def _records(path: Path, emit_chunks: bool) -> Iterator[Any]:
    from mcap.stream_reader import StreamReader

    with mapped(path) as buffer:
        stream: Any = buffer.obj  # the map itself, which reads like a file
        reader = StreamReader(
            stream,
            emit_chunks=emit_chunks,
            validate_crcs=not emit_chunks,
            record_size_limit=_MOST_BYTES,
        )
        yield from reader.records


def _library_errors() -> tuple[type[Exception], ...]:
    import zstandard
    from mcap.exceptions import McapError

    return (McapError, zstandard.ZstdError, *_DAMAGE)


def _unread(path: Path, error: Exception) -> Finding:
    import mcap

    said = f"{type(error).__name__}: {error}".rstrip(": ")
    detail = f"mcap {mcap.__version__} stops at damage: {said:.200}"
    return Finding("not read by the official library", path.name, detail)


@dataclass
class _Digest:
    """Number, lengths, bytes and times of a channel's messages, as four numbers."""

    messages: int = 0
    lengths: int = 0
    payloads: int = 0
    times: int = 0

    def add_payloads(self, payloads: Ragged) -> Decoded:
        self.messages += len(payloads)
        self.lengths = zlib.crc32(payloads.lengths.astype("<i8").tobytes(), self.lengths)
        self.payloads = zlib.crc32(np.asarray(payloads.content).tobytes(), self.payloads)
        return {}, np.ones(len(payloads), bool)

    def add_message(self, payload: bytes, log_time_ns: int) -> None:
        self.messages += 1
        self.lengths = zlib.crc32(struct.pack("<q", len(payload)), self.lengths)
        self.payloads = zlib.crc32(payload, self.payloads)
        self.add_times(struct.pack("<Q", log_time_ns))

    def add_times(self, times: bytes) -> None:
        self.times = zlib.crc32(times, self.times)


@dataclass
class _Library:
    """What the library's records say, channel by channel."""

    schemas: dict[int, tuple[str, str, bytes]] = field(default_factory=dict)
    channels: dict[int, tuple[int, str, str]] = field(default_factory=dict)
    digests: dict[int, _Digest] = field(default_factory=dict)
    messages: int = 0

    def add(self, record: Any) -> None:
        from mcap import records

        if isinstance(record, records.Message):
            self.messages += 1
            digest = self.digests.setdefault(record.channel_id, _Digest())
            digest.add_message(record.data, record.log_time)
        elif isinstance(record, records.Channel):
            channel = (record.schema_id, record.topic, record.message_encoding)
            self.channels.setdefault(record.id, channel)
        elif isinstance(record, records.Schema):
            self.schemas.setdefault(record.id, (record.name, record.encoding, record.data))

    def channel(self, number: int) -> Channel | None:
        if number not in self.channels:
            return None
        schema_id, topic, encoding = self.channels[number]
        return Channel(number, topic, encoding, *self.schemas.get(schema_id, ()))


def _differences(
    where: str, ours: Recording, digests: dict[int, _Digest], theirs: _Library
) -> Iterator[Finding]:
    """One finding a channel that the two readers see otherwise."""
    known = {channel.id: channel for channel in ours.channels}
    for number in sorted(known.keys() | theirs.channels.keys() | theirs.digests.keys()):
        channel, other = known.get(number), theirs.channel(number)
        topic = (channel or other or Channel(number, f"channel {number}", "")).topic
        ours_here, its = digests.get(number, _Digest()), theirs.digests.get(number, _Digest())
        if channel != other:
            detail = "its topic, encoding, type or definition differs"
        elif ours_here.messages != its.messages:
            detail = f"{its.messages} messages, where we read {ours_here.messages}"
        elif ours_here.times != its.times:
            detail = "other log times than ours"
        elif ours_here != its:
            detail = "other bytes in its messages than ours"
        else:
            continue
        yield Finding("readers differ", f"{where}, topic {topic!r}", detail)


def topic_counts(path: Path) -> tuple[list[tuple[str, str, int]], int, int]:
    """Topic, type and number of messages of each channel, first and last log time in ns.

    Raises
    ------
    ReadError
        The file has no summary with statistics, or none that can be read.
    """
    from mcap.exceptions import McapError
    from mcap.reader import make_reader

    try:
        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
    except (McapError, *_DAMAGE) as error:
        raise ReadError(f"{path}: no summary: {error}") from None
    if summary is None or summary.statistics is None:
        raise ReadError(f"{path}: its summary counts no messages")
    counted = summary.statistics
    topics = sorted(
        (
            channel.topic,
            summary.schemas[channel.schema_id].name,
            counted.channel_message_counts.get(k, 0),
        )
        for k, channel in summary.channels.items()
    )
    return topics, counted.message_start_time, counted.message_end_time
