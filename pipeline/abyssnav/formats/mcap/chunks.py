# SPDX-License-Identifier: Apache-2.0
"""What lies inside a chunk: bytes unpacked within bounds, and where each message begins."""

from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate, pairwise
from threading import local
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from abyssnav.formats.columns import gather_fixed
from abyssnav.formats.mcap.container import MAX_ZSTD_WINDOW
from abyssnav.formats.mcap.records import (
    CHANNEL,
    INDEX_ENTRY,
    MESSAGE,
    MESSAGE_FIELDS,
    MESSAGE_HEAD,
    PREFIX,
    SCHEMA,
    CorruptRecordError,
    Fields,
    checksum,
)
from abyssnav.tables import Int

#: A chunk that says it is larger is refused; recorders write 1 MB, cameras some tens.
MAX_CHUNK_BYTES = 1 << 28
_per_thread = local()  #: a decompressor for each thread: to make one for each chunk takes its time
#: Messages of one length in a row, from which on their heads are compared instead of walked over.
_ALIKE_MESSAGES = 64
_BLOCK_MESSAGES = 1 << 18  #: that are looked at together, so that their heads take little memory
_EXTREMES = (np.minimum, np.maximum)
_NAMING = (SCHEMA, CHANNEL)  #: records that say what messages are


@dataclass
class Chunk:
    """A chunk as it lies in the file."""

    start: int  #: of the record, for findings
    size: int  #: declared, uncompressed
    crc: int  #: of the uncompressed bytes, 0: none
    compression: str
    packed: memoryview
    cut: bool = False  #: the file ends inside it
    padding: int = 0  #: bytes of the record behind the known fields
    #: Entries of its message indexes, by channel.
    index: dict[int, list[memoryview]] = field(default_factory=dict)

    @classmethod
    def parse(cls, start: int, body: memoryview, cut: bool) -> "Chunk":
        """Read a chunk's head; `cut` allows its records to end with the file."""
        fields = Fields(body)
        _, _, size, crc = fields.numbers("QQQI")
        compression = fields.text()
        length = fields.number("Q")
        if cut := cut and length > len(body) - fields.pos:
            length = len(body) - fields.pos
        packed = fields.raw(length)
        padding = len(body) - fields.pos
        if padding and not length:
            raise CorruptRecordError(f"declares no records, but holds {padding} bytes more")
        return cls(start, size, crc, compression, packed, cut, padding)


class Rows(NamedTuple):
    """Messages of one channel."""

    starts: Int  #: of their payloads
    lengths: Int
    log_time_ns: Int
    shortest: int  #: of the lengths
    longest: int

    def behind(self, begin: int) -> "Rows":
        """Return the same messages in a content with `begin` more bytes before it."""
        return self._replace(starts=self.starts + begin)


@dataclass
class Contents:
    """Bytes with message records in them."""

    content: NDArray[np.uint8]
    messages: list[tuple[int, Rows]] = field(default_factory=list)  #: by channel, in their order
    #: Schemas and channels: opcode, place in `content`, body.
    records: list[tuple[int, int, bytes]] = field(default_factory=list)
    damage: list[tuple[int, str]] = field(default_factory=list)  #: which chunk, what

    @classmethod
    def from_begins(cls, content: NDArray[np.uint8], begins: Int) -> "Contents":
        """Messages whose records begin at `begins`, rising."""
        contents = cls(content)
        for first in range(0, len(begins), _BLOCK_MESSAGES):
            block = begins[first : first + _BLOCK_MESSAGES]
            channels = _heads(content, block)["channel"]
            names, counts = np.unique(channels, return_counts=True)
            block = block[np.argsort(channels, kind="stable")]
            heads = _heads(content, block)
            contents.messages += _by_channel(names.tolist(), counts.tolist(), block, heads)
        return contents


def _heads(content: NDArray[np.uint8], begins: Int) -> NDArray[np.void]:
    return gather_fixed(content, begins, MESSAGE_HEAD.itemsize).view(MESSAGE_HEAD)[:, 0]


def _by_channel(
    channels: Sequence[int], counts: Sequence[int], begins: Int, heads: NDArray[np.void]
) -> list[tuple[int, Rows]]:
    """Messages that lie in order of `channels`, `counts` of each, all more than 0."""
    starts = begins + MESSAGE_HEAD.itemsize
    lengths = heads["length"].astype(np.int64)
    lengths -= MESSAGE_FIELDS
    log_time_ns = heads["log_time"].astype(np.int64)
    shortest, longest = (_extremes(lengths, counts, ufunc) for ufunc in _EXTREMES)
    cuts = pairwise(accumulate(counts, initial=0))
    return [
        (channel, Rows(starts[a:b], lengths[a:b], log_time_ns[a:b], least, most))
        for channel, (a, b), least, most in zip(channels, cuts, shortest, longest, strict=True)
    ]


def _extremes(values: NDArray[Any], counts: Sequence[int], ufunc: np.ufunc) -> list[int]:
    """Return the least or the largest value of each channel."""
    extremes: list[int] = ufunc.reduceat(values, [0, *accumulate(counts[:-1])]).tolist()
    return extremes


def walk(
    buffer: memoryview, pos: int, end: int, begins: "array[int] | None" = None
) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and end of each record.

    Parameters
    ----------
    begins : where given, of messages in a row only the first is yielded; the starts of the others
        are added to it

    Raises
    ------
    CorruptRecordError
        A record reaches beyond `end`, or has the opcode 0.
    """
    unpack, head = PREFIX.unpack_from, PREFIX.size
    while pos < end:
        if pos + head > end:
            raise CorruptRecordError(
                f"{end - pos} bytes where a record of at least {head} begins", pos
            )
        opcode, length = unpack(buffer, pos)
        stop = pos + head + length
        if stop > end or opcode == 0:
            message = f"a record of {length} bytes, opcode {opcode}, with {end - pos} left"
            raise CorruptRecordError(message, pos)
        yield opcode, pos, stop
        pos = stop
        if opcode == MESSAGE and begins is not None:
            pos = _pass_messages(buffer, pos, end, begins)


def _pass_messages(buffer: memoryview, pos: int, end: int, begins: "array[int]") -> int:
    """Note where the messages from `pos` on begin; return where something else does."""
    unpack, head, least = PREFIX.unpack_from, PREFIX.size, MESSAGE_FIELDS
    before, n_alike = 0, 0
    while end - pos >= head:
        opcode, length = unpack(buffer, pos)
        if opcode != MESSAGE or length < least or length > end - pos - head:
            break
        begins.append(pos)
        n_alike = n_alike + 1 if length == before else 0
        before, pos = length, pos + head + length
        if n_alike >= _ALIKE_MESSAGES:
            pos = _pass_alike(buffer, pos, end, head + length, begins)
            n_alike = 0
    return pos


def _pass_alike(buffer: memoryview, pos: int, end: int, stride: int, begins: "array[int]") -> int:
    """As `_pass_messages`, of messages as long as those before, many at a time."""
    content = np.frombuffer(buffer, np.uint8)
    first = content[pos - stride : pos - stride + PREFIX.size]
    while (n := min((end - pos) // stride, _BLOCK_MESSAGES)) > 0:
        heads = content[pos : pos + n * stride].reshape(n, stride)[:, : PREFIX.size]
        alike = (heads == first).all(axis=1)
        n_alike = n if alike.all() else int(np.argmin(alike))
        begins.frombytes((pos + stride * np.arange(n_alike, dtype=np.int64)).tobytes())
        pos += n_alike * stride
        if n_alike < n:
            break
    return pos


def room_for(chunk: Chunk) -> int:
    """Bytes that `unpack` needs; none when it will refuse the chunk."""
    return chunk.size + 1 if chunk.size <= MAX_CHUNK_BYTES else 0


def unpack(chunk: Chunk, room: memoryview) -> int:
    """Uncompressed bytes of a chunk into `room`, never more than it declares; how many.

    Parameters
    ----------
    room : `room_for(chunk)` bytes or more

    Raises
    ------
    CorruptRecordError
        Larger than any chunk should be, another size than declared, or a wrong CRC.
    """
    if chunk.size > MAX_CHUNK_BYTES:
        raise CorruptRecordError(f"declares {chunk.size} bytes; at most {MAX_CHUNK_BYTES} are read")
    size = _decompress(chunk, room[: chunk.size + 1])
    if not chunk.cut and size != chunk.size:
        more = "more" if size > chunk.size else f"{size}"
        raise CorruptRecordError(f"declares {chunk.size} bytes, unpacks to {more}")
    if chunk.crc and size == chunk.size and checksum(room[:size]) != chunk.crc:
        raise CorruptRecordError("CRC is wrong")
    return size


def _decompress(chunk: Chunk, room: memoryview) -> int:
    if chunk.compression == "zstd":
        import zstandard

        if not isinstance(
            decompressor := getattr(_per_thread, "zstd", None), zstandard.ZstdDecompressor
        ):
            decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_ZSTD_WINDOW)
            _per_thread.zstd = decompressor
        try:
            return decompressor.stream_reader(chunk.packed).readinto(room)
        except zstandard.ZstdError as error:
            raise CorruptRecordError(f"zstd: {error}") from None
    data: bytes | memoryview = chunk.packed
    if chunk.compression == "lz4":
        import lz4.frame

        try:
            data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=len(room))
        except RuntimeError as error:
            raise CorruptRecordError(f"lz4: {error}") from None
    elif chunk.compression:
        raise CorruptRecordError(
            f"compression {chunk.compression!r} is not known; zstd, lz4 or none are"
        )
    size = min(len(data), len(room))
    room[:size] = data[:size]
    return size


def locate(chunks: Sequence[Chunk], ends: Sequence[int], content: NDArray[np.uint8]) -> Contents:
    """Where each channel's messages begin: by the message indexes where they hold, else by walking.

    Parameters
    ----------
    chunks : that lie one behind the other in `content`, each up to one of the `ends`
    """
    contents = _by_index(chunks, ends, content)
    if contents is not None:
        return contents
    if len(chunks) == 1:
        return _by_walking(content)
    contents = Contents(content)
    for number, (chunk, begin, end) in enumerate(zip(chunks, (0, *ends), ends, strict=False)):
        one = locate([chunk], [end - begin], content[begin:end])
        contents.messages += [(channel, rows.behind(begin)) for channel, rows in one.messages]
        contents.records += [(opcode, begin + pos, body) for opcode, pos, body in one.records]
        contents.damage += [(number, damage) for _, damage in one.damage]
    return contents


def _by_index(
    chunks: Sequence[Chunk], ends: Sequence[int], content: NDArray[np.uint8]
) -> Contents | None:
    """Messages where the indexes say, if they are of their channels and nothing is hidden between.

    The check is one pass over the heads of all messages of all channels together.
    """
    parts: dict[int, list[NDArray[np.uint64]]] = {}
    for chunk, begin in zip(chunks, (0, *ends), strict=False):
        named = [
            (channel, part) for channel, entries in chunk.index.items() for part in entries if part
        ]
        if chunk.cut or not named:
            return None
        for channel, part in named:
            parts.setdefault(channel, []).append(np.frombuffer(part, INDEX_ENTRY)["offset"] + begin)
    channels, counts = list(parts), [sum(map(len, entries)) for entries in parts.values()]
    unsafe = np.concatenate([part for entries in parts.values() for part in entries])
    last = len(content) - MESSAGE_HEAD.itemsize
    if last < 0 or unsafe.max() > last:
        return None
    begins = _rising(unsafe.view(np.int64), counts)
    heads = _heads(content, begins)
    messages = _by_channel(channels, counts, begins, heads)
    if (
        (heads["opcode"] != MESSAGE).any()
        or any(_extremes(heads["channel"], counts, ufunc) != channels for ufunc in _EXTREMES)
        or any(rows.shortest < 0 or rows.longest > len(content) for _, rows in messages)
    ):
        return None
    lengths = np.concatenate([rows.lengths for _, rows in messages])
    try:
        between = list(_between(content.data, begins, lengths, ends))
    except CorruptRecordError:
        return None
    return Contents(content, messages, [contents for contents in between if contents[0] in _NAMING])


def _rising(begins: Int, counts: Sequence[int]) -> Int:
    """Places of each channel in rising order, as they are but where an index is sorted by time."""
    falls = begins[1:] < begins[:-1]
    falls[np.cumsum(counts)[:-1] - 1] = False  # between channels
    if not falls.any():
        return begins
    return begins[np.lexsort((begins, np.repeat(np.arange(len(counts)), counts)))]


def _between(
    buffer: memoryview, begins: Int, lengths: Int, ends: Sequence[int]
) -> Iterator[tuple[int, int, bytes]]:
    """Records between messages that begin at `begins` and have payloads of `lengths`.

    Messages that begin where others end leave no room for one that no index names.

    Raises
    ------
    CorruptRecordError
        Messages overlap, or what lies between them are no records, or messages too.
    """
    # One number each, as both are below 2³²; in as many rising runs as there are channels, which
    # are merged ten times as fast as others are sorted.
    both = np.sort((begins << 32) + lengths, kind="stable")
    begins = both >> 32
    lasts = begins + (both & 0xFFFFFFFF)
    lasts += MESSAGE_HEAD.itemsize
    if (lasts[np.searchsorted(begins, ends) - 1] > ends).any():
        raise CorruptRecordError("a message reaches into the next chunk")
    gaps = np.flatnonzero(begins[1:] != lasts[:-1])
    places = [(0, int(begins[0])), *((int(lasts[k]), int(begins[k + 1])) for k in gaps)]
    for low, high in [*places, (int(lasts[-1]), len(buffer))]:
        if low > high:
            raise CorruptRecordError("messages overlap")
        edges = [low, *(end for end in ends if low < end < high), high]
        for begin, stop in pairwise(edges):
            for opcode, pos, end in walk(buffer, begin, stop):
                if opcode == MESSAGE:
                    raise CorruptRecordError("a message that no index names")
                yield opcode, pos, bytes(buffer[pos + PREFIX.size : end])


def _by_walking(content: NDArray[np.uint8]) -> Contents:
    """Every record in turn, up to the first that cannot be."""
    buffer, damage = content.data, list[tuple[int, str]]()
    begins = array("q")
    records: list[tuple[int, int, bytes]] = []
    try:
        for opcode, pos, stop in walk(buffer, 0, len(buffer), begins):
            if opcode == MESSAGE:
                if stop - pos < MESSAGE_HEAD.itemsize:
                    raise CorruptRecordError(f"a message of {stop - pos} bytes")
                begins.append(pos)
            elif opcode in _NAMING:
                records.append((opcode, pos, bytes(buffer[pos + PREFIX.size : stop])))
    except CorruptRecordError as error:
        damage.append((0, str(error)))
    contents = Contents.from_begins(content, np.frombuffer(begins, np.int64))
    return replace(contents, records=records, damage=damage)
