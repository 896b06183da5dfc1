# SPDX-License-Identifier: Apache-2.0
"""The bytes of an MCAP file, also of one that rosbag2 packed as a whole (`.mcap.zst`, `.zstd`)."""

import mmap
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Final

from abyssnav.errors import ReadError
from abyssnav.formats.mcap.records import MAGIC

ZSTD_MAGIC: Final = b"\x28\xb5\x2f\xfd"
#: What a packed file may unpack to: logs shrink to a fifth, bombs to a thousandth and less.
_MOST_TIMES, _LEAST_LIMIT_BYTES = 100, 1 << 28
_BLOCK_BYTES: Final = 1 << 22
MAX_ZSTD_WINDOW: Final = 1 << 27  #: bytes that a decompressor may have to remember


@contextmanager
def mapped(path: Path, damage: list[str] | None = None) -> Iterator[memoryview]:
    """Bytes of an MCAP file, read as they are touched; a packed one from a temporary file.

    Parameters
    ----------
    damage : to which is added what is wrong with the packing; what was unpacked before is read

    Raises
    ------
    ReadError
        The file cannot be opened, does not begin as MCAP does, or unpacks to more than a log can.
    """
    try:
        with path.open("rb") as file:
            data = _map(path, file, [] if damage is None else damage)
    except OSError as error:
        raise ReadError(f"{path}: cannot be read: {error.strerror}") from None
    yield data


def _map(path: Path, file: IO[bytes], damage: list[str]) -> memoryview:
    start = file.read(len(MAGIC))
    if not start.startswith(ZSTD_MAGIC):
        return _mapped_mcap(path, file, start)
    file.seek(0)
    with tempfile.TemporaryFile(prefix="abyssnav-") as unpacked:
        problem = _unpack(path, file, unpacked)
        unpacked.seek(0)
        start = unpacked.read(len(MAGIC))
        if problem:
            damage.append(problem)
            if not start:
                raise ReadError(f"{path}: not MCAP: {problem}")
        unpacked.flush()
        return _mapped_mcap(path, unpacked, start)


def _mapped_mcap(path: Path, file: IO[bytes], start: bytes) -> memoryview:
    if start != MAGIC:
        detail = f"it begins with {start!r}, not {MAGIC!r}" if start else "it is empty"
        raise ReadError(f"{path}: not MCAP: {detail}")
    # not closed: it goes with the last array that looks into it
    return memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))


def _unpack(path: Path, packed: IO[bytes], unpacked: IO[bytes]) -> str:
    """Unpack to the end or to damage; what the damage is, '' for none."""
    import zstandard

    limit = max(_LEAST_LIMIT_BYTES, _MOST_TIMES * os.fstat(packed.fileno()).st_size)
    decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_ZSTD_WINDOW)
    size = 0
    with decompressor.stream_reader(packed, read_across_frames=True, closefd=False) as stream:
        try:
            while block := stream.read(_BLOCK_BYTES):
                size += len(block)
                if size > limit:
                    raise ReadError(f"{path}: unpacks to more than {limit} bytes: not read")
                unpacked.write(block)
        except zstandard.ZstdError as error:
            return f"zstd: {error}; read up to there, {size} bytes unpacked"
    return ""  # whether it was cut, the end of the MCAP file inside says
