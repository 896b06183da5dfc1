# SPDX-License-Identifier: Apache-2.0
"""Speed of reading on this machine, as ratios of one run; `make bench` shows it with the rest.

Alone: `python tests/bench_read.py`, which also takes the path of another log.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import mcap
import mcap_ros2
import msgspec
import numpy as np
import zstandard
from mcap.reader import NonSeekingReader, make_reader
from mcap_ros2.decoder import DecoderFactory
from rich.console import Console
from rich.table import Table
from rosbags.highlevel import AnyReader
from test_vehicles import twins

from abyssnav.formats.mcap.accumulator import PAYLOADS
from abyssnav.formats.mcap.chunks import Chunk, room_for, unpack
from abyssnav.formats.mcap.container import mapped
from abyssnav.formats.mcap.file_index import index_file
from abyssnav.formats.mcap.reader import read_mcap
from abyssnav.formats.mcap.writer import Channel as Written
from abyssnav.formats.mcap.writer import write_mcap
from abyssnav.profile import load_profile
from abyssnav.read import read
from abyssnav.read.parts import read_part
from abyssnav.simulate import load_scenario, simulate, write_log

PROFILE = load_profile()
#: Columns of the roles that a log's size lies in, as the stage read asks for them.
ROLES = msgspec.structs.replace(PROFILE, reference=None, beacons=None, sound_speed=None)


def seconds(work: Callable[[], object], times: int = 5) -> float:
    """Best of some runs: what else the machine does only ever adds."""
    return best({"": work}, times)[""]


def best(works: Mapping[str, Callable[[], object]], times: int = 7) -> dict[str, float]:
    """Best of some runs of each, in turns, so that all meet the machine in the same state."""
    took = dict.fromkeys(works, float("inf"))
    for _ in range(times):
        for name, work in works.items():
            began = time.perf_counter()
            work()
            took[name] = min(took[name], time.perf_counter() - began)
    return took


def chunks(path: Path) -> list[Chunk]:
    with mapped(path) as buffer:
        return [item for item in index_file(path.name, buffer).plan if isinstance(item, Chunk)]


def decompress(packed: list[Chunk]) -> None:
    """What any reader of the file has to do at least, in the fastest way the library has."""
    for chunk in packed:
        zstandard.ZstdDecompressor().decompress(chunk.packed)


def unpack_all(packed: list[Chunk]) -> None:
    """The same with bounds and checksums."""
    room = np.empty(max(map(room_for, packed)), np.uint8)
    for chunk in packed:
        unpack(chunk, room.data)


def iterate(path: Path, **options: Any) -> int:
    with path.open("rb") as file:
        return sum(1 for _ in make_reader(file).iter_messages(**options))


def iterate_streamed(path: Path) -> int:
    with path.open("rb") as file:
        return sum(1 for _ in NonSeekingReader(file).iter_messages(log_time_order=False))


def decode_officially(path: Path) -> int:
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return sum(1 for _ in reader.iter_decoded_messages())


def decode_with_rosbags(path: Path) -> int:
    with AnyReader([path]) as reader:
        return sum(1 for c, _, raw in reader.messages() if reader.deserialize(raw, c.msgtype))


def simulated(path: Path, hours: float) -> Path:
    scenario = msgspec.structs.replace(load_scenario("voyage_2"), duration_s=hours * 3600)
    write_log(simulate(scenario), path)
    return path


def day(path: Path) -> Iterator[tuple[str, str]]:
    """A whole day against decompression and the official library's raw iteration."""
    packed = chunks(path)
    recording = read_mcap(path, lambda _: None)
    n = sum(count.messages for count in recording.counts.values())
    size, inside = path.stat().st_size / 1e6, sum(chunk.size for chunk in packed) / 1e6
    yield "the log", f"{n:,} messages, {size:.0f} MB, {inside:.0f} MB unpacked"
    took = best(
        {
            "bare decompression": lambda: decompress(packed),
            "decompression within bounds, and checksums": lambda: unpack_all(packed),
            "our columns of the four required roles": lambda: read_part(path, ROLES, None),
            "our columns of all roles": lambda: read_part(path, PROFILE, None),
            "stage read: also units and frames": lambda: read([path], PROFILE),
        }
    )
    bare, _, columns, _, whole = took.values()

    def told(seconds_taken: float) -> str:
        ratio, speed = seconds_taken / bare, n / seconds_taken / 1e6
        return f"{seconds_taken:.3f} s, {ratio:.2f} x decompression, {speed:.2f} M/s"

    yield from ((name, told(value)) for name, value in took.items())
    official = seconds(lambda: iterate(path), times=1)
    yield "mcap, raw iteration, log order", told(official)
    yield "the same over our columns", f"{official / columns:.0f} times as long"
    yield "the same over stage read", f"{official / whole:.0f} times as long"
    with tempfile.TemporaryDirectory() as out:
        command = [sys.executable, "-m", "abyssnav", "run", path, "-o", out, "--quiet"]
        run = seconds(lambda: subprocess.run(command, check=True), times=3)
    yield "abyssnav run, everything", f"{run:.2f} s, {run / official:.2f} x raw iteration"
    unordered = seconds(lambda: iterate(path, log_time_order=False), times=1)
    yield "mcap, raw iteration, any order", told(unordered)
    yield "mcap, raw iteration, streamed", told(seconds(lambda: iterate_streamed(path), times=1))


def hour(path: Path) -> Iterator[tuple[str, str]]:
    """An hour decoded by others, which would take minutes of a day."""
    n = sum(count.messages for count in read_mcap(path, lambda _: None).counts.values())
    ours = seconds(lambda: read([path], PROFILE))
    yield "an hour: stage read", f"{ours:.3f} s, {n / ours / 1e3:.0f} k messages/s"
    others = {
        f"mcap-ros2-support {mcap_ros2.__version__}, decoded": decode_officially,
        "rosbags, decoded": decode_with_rosbags,
    }
    for name, work in others.items():
        took = seconds(partial(work, path), times=1)
        yield name, f"{took:.2f} s, {n / took / 1e3:.0f} k messages/s, {took / ours:.0f} x ours"


def encodings(folder: Path) -> Iterator[tuple[str, str]]:
    """An hour in the other two encodings."""
    pairs = [twins(channel) for channel in written(folder / "hour.mcap")]
    for number, name in enumerate(("Protobuf", "JSON")):
        path = folder / f"{name}.mcap"
        write_mcap(path, [pair[number] for pair in pairs])
        n, packed = sum(len(pair[number].log_time_ns) for pair in pairs), chunks(path)
        took = seconds(partial(read_part, path, PROFILE, None))
        ratio = took / seconds(partial(decompress, packed))
        speed = f"{n / took / 1e3:.0f} k messages/s"
        yield f"an hour in {name}", f"{took:.3f} s, {ratio:.1f} x decompression, {speed}"


def written(path: Path) -> list[Written]:
    """Channels of a log, to be written again in another encoding."""
    recording = read_mcap(path, lambda _: PAYLOADS)
    return [
        Written(m.channel.topic, m.channel.type, m.log_time_ns, m.columns["payload"],
                m.channel.definition)
        for m in recording.messages
    ]  # fmt: skip


def rows(folder: Path, log: Path | None = None) -> Iterator[tuple[str, str]]:
    """What is measured, and what came out."""
    yield from day(log or simulated(folder / "day.mcap", 24))
    yield from hour(simulated(folder / "hour.mcap", 1))
    yield from encodings(folder)


def main() -> None:
    versions = f"mcap {mcap.__version__}, zstandard {zstandard.__version__}"
    table = Table("measured", "came out", title=versions)
    with tempfile.TemporaryDirectory() as place:
        for measured, came_out in rows(Path(place), *map(Path, sys.argv[1:2])):
            table.add_row(measured, came_out)
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
