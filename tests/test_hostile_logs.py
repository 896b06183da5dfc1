# SPDX-License-Identifier: Apache-2.0
"""Logs made to exhaust a machine: below 1 GB, and no ten times the effort of the sound log."""

import json
import re
import struct
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest
import zstandard
from vehicles import ros_roles

from abyssnav.align import align
from abyssnav.align.beacons import MOST_BEACONS
from abyssnav.config import Config
from abyssnav.errors import ClockError
from abyssnav.formats.columns import Ragged
from abyssnav.formats.mcap.records import CHUNK, DATA_END, MESSAGE, record
from abyssnav.formats.mcap.writer import Channel, write_mcap
from abyssnav.navigate import navigate
from abyssnav.simulate import load_scenario, simulate, to_log
from abyssnav.tables import Log

MOST_MB, MOST_TIMES = 1000.0, 10.0


class Cost(NamedTuple):
    """What a command took, and what it said."""

    seconds: float  #: of processors, both processes'
    memory_mb: float
    status: int
    err: str


#: Between the tests and the command, for a new process counts the memory of the one it came from.
_MEASURED = """
import json, resource, subprocess, sys
ended = subprocess.run(sys.argv[1:], stderr=subprocess.PIPE, text=True)
used = resource.getrusage(resource.RUSAGE_CHILDREN)
seconds, memory_mb = used.ru_utime + used.ru_stime, used.ru_maxrss * 1024 / 1e6
print(json.dumps([seconds, memory_mb, ended.returncode, ended.stderr]))
"""


def cost(path: Path, out: Path) -> Cost:
    """A whole `abyssnav run`, as a person types it."""
    command = [sys.executable, "-P", "-m", "abyssnav", "run", str(path), "-o", str(out), "-q"]
    measuring = [sys.executable, "-c", _MEASURED, *command]
    took = Cost(*json.loads(subprocess.run(measuring, stdout=subprocess.PIPE, check=True).stdout))
    for summary in out.glob("*/summary.json"):  # of both processes
        took = took._replace(memory_mb=json.loads(summary.read_text())["peak_memory_mb"])
    return took


@pytest.fixture(scope="module")
def sound() -> Log:
    scenario = msgspec.structs.replace(load_scenario("clean"), duration_s=600.0)
    return to_log(simulate(scenario))


@pytest.fixture(scope="module")
def usual(sound: Log, tmp_path_factory: pytest.TempPathFactory) -> Cost:
    """What the sound log takes."""
    folder = tmp_path_factory.mktemp("usual")
    write_mcap(folder / "sound.mcap", list(ros_roles(sound).values()))
    return cost(folder / "sound.mcap", folder / "out")


def with_columns(log: Log, role: str, columns: dict[str, Any]) -> Log:
    return replace(log, roles={**log.roles, role: {**log.roles[role], **columns}})


def many_beacons(log: Log, total: int) -> Log:
    """A catalogue of beacons behind the four that answer."""
    rows = log.roles["beacons"]
    known = len(rows["id"])
    catalogue = {
        name: np.concatenate([column, np.repeat(column[:1], total - known, axis=0)])
        for name, column in rows.items()
    }
    catalogue["id"] = np.append(rows["id"], 1000 + np.arange(known, total))
    catalogue["name"] = np.array([f"B{number}" for number in catalogue["id"]])
    away_m = np.random.default_rng(1).normal(0, 3000, (total - known, 3)) * [1, 1, 0.01]
    catalogue["position_enu_m"][known:] += away_m
    return with_columns(log, "beacons", catalogue)


def repeated(log: Log, role: str, times: int) -> Log:
    """Every message of a role several times."""
    rows = {name: np.repeat(column, times, axis=0) for name, column in log.roles[role].items()}
    return with_columns(log, role, rows)


def stretched(log: Log, factor: int) -> Log:
    """The same messages over a far longer time."""
    start_ns = log.roles["heading"]["time_ns"][0]
    for role, columns in log.roles.items():
        stamps = [name for name in columns if name in {"time_ns", "ping_time_ns"}]
        later = {name: start_ns + factor * (columns[name] - start_ns) for name in stamps}
        log = with_columns(log, role, later)
    return log


def write_with(log: Log, path: Path, *extra: Channel) -> None:
    write_mcap(path, [*ros_roles(log).values(), *extra])


def of_a_stranger(log: Log, kind: str, definition: bytes, payloads: list[bytes]) -> Channel:
    """A topic that plays no role: JSON, or ROS messages by a definition."""
    time_ns = np.full(len(payloads), log.roles["heading"]["time_ns"][0])
    encodings = ("json", "jsonschema") if kind == "json" else ("cdr", "ros2msg")
    rows = Ragged.from_bytes(payloads)
    return Channel("/strange", "a/msg/A", time_ns, rows, definition, *encodings)


def with_chunk(log: Log, path: Path, size: int, packed: bytes) -> None:
    """The log with one more chunk, and without its summary."""
    write_with(log, path)
    content = path.read_bytes()
    end = content.rindex(struct.pack("<BQ", DATA_END, 4))
    head = struct.pack("<QQQI", 0, 1, size, 0) + struct.pack("<I", 4) + b"zstd"
    chunk = record(CHUNK, head + struct.pack("<Q", len(packed)) + packed)
    path.write_bytes(content[:end] + chunk + content[end:])


def empty_messages(log: Log, path: Path, channel: int, count: int = 8_000_000) -> None:
    """Millions of messages without content, in a few kilobytes."""
    stamp = int(log.roles["heading"]["time_ns"][0])
    one = record(MESSAGE, struct.pack("<HIQQ", channel, 0, stamp, stamp))
    with_chunk(log, path, len(one) * count, zstandard.ZstdCompressor(3).compress(one * count))


def zeros(log: Log, path: Path) -> None:
    """A chunk that unpacks to 3 GB."""
    packer = zstandard.ZstdCompressor(level=1).compressobj(size=3 << 30)
    packed = b"".join(packer.compress(bytes(1 << 26)) for _ in range(48)) + packer.flush()
    with_chunk(log, path, 3 << 30, packed)


def nested(depth: int, width: int) -> bytes:
    """A definition whose types each hold many of the next: 10^9 fields."""
    rule = "=" * 80
    parts = [f"{rule}\nMSG: a/L{d}\n" + "".join(
        f"a/L{d + 1} f{i}\n" for i in range(width)) for d in range(depth)]  # fmt: skip
    return ("a/L0 x\n" + "".join(parts) + f"{rule}\nMSG: a/L{depth}\nfloat64 x\n").encode()


HOSTILE: dict[str, Callable[[Log, Path], None]] = {
    "two thousand beacons": lambda log, path: write_with(many_beacons(log, 2000), path),
    "eight million empty messages": lambda log, path: empty_messages(log, path, 1),
    "eight million empty replies": lambda log, path: empty_messages(log, path, 4),
    "each reply a hundred times": lambda log, path: write_with(
        repeated(log, "travel_time", 100), path
    ),
    "the same heading a hundred times": lambda log, path: write_with(
        repeated(log, "heading", 100), path
    ),
    "four million headings": lambda log, path: write_with(repeated(log, "heading", 666), path),
    "ten minutes over seventy days": lambda log, path: write_with(stretched(log, 10_000), path),
    "a chunk of 3 GB": zeros,
    "types within types": lambda log, path: write_with(
        log, path, of_a_stranger(log, "ros", nested(9, 10), [bytes(100)])
    ),
    "a type that holds itself": lambda log, path: write_with(
        log, path, of_a_stranger(log, "ros", b"a/A x\n" + b"=" * 80 + b"\nMSG: a/A\na/A y\n",
                                 [bytes(100)])
    ),
    "arrays of arrays": lambda log, path: write_with(
        log, path, of_a_stranger(log, "ros", b"float64[2000000000] f\n", [bytes(100)])
    ),
    "lengths that are none": lambda log, path: write_with(
        log, path, of_a_stranger(log, "ros", b"float64[] f\n",
                                 [b"\0\1\0\0\xff\xff\xff\x7f" + bytes(100)] * 100)
    ),
    "deep JSON": lambda log, path: write_with(
        log, path, of_a_stranger(log, "json", b"{}", [b'{"a":' * 100_000 + b"1" + b"}" * 100_000])
    ),
    "JSON of a million keys": lambda log, path: write_with(
        log, path, of_a_stranger(log, "json", b"{}", [
            b"{" + b",".join(b'"%d":1' % i for i in range(300_000)) + b"}"] * 3)
    ),
}  # fmt: skip
IN_SHORT = {"two thousand beacons", "eight million empty replies"}


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=() if n in IN_SHORT else pytest.mark.slow) for n in HOSTILE],
)
def test_no_log_costs_more_than_a_gigabyte_or_ten_times_its_sound_twin(
    sound: Log, usual: Cost, tmp_path: Path, name: str
) -> None:
    HOSTILE[name](sound, tmp_path / "hostile.mcap")
    took = cost(tmp_path / "hostile.mcap", tmp_path / "out")
    assert took.status in {0, 1, 3}
    assert len(took.err.splitlines()) == (took.status == 1)
    assert took.memory_mb < MOST_MB
    assert took.seconds < MOST_TIMES * usual.seconds


def test_of_a_catalogue_of_beacons_only_those_that_answer_matter(sound: Log) -> None:
    dive, other = align(sound, Config()), align(many_beacons(sound, 2000), Config())
    assert other.beacons.id.tolist() == dive.beacons.id.tolist()
    np.testing.assert_array_equal(other.replies.beacon_enu_m, dive.replies.beacon_enu_m)
    (check,) = [check for check in other.checks if check.name == "beacons_left_out"]
    assert (check.value, check.ok) == (2000 - len(dive.beacons), True)
    tracks = [navigate(one, Config()).tracks["smoother"] for one in (dive, other)]
    np.testing.assert_array_equal(tracks[0].position_enu_m, tracks[1].position_enu_m)


def test_of_more_beacons_than_a_dive_can_have_those_heard_most_are_taken(sound: Log) -> None:
    """Each of two thousand is heard once, in turn, and the real ones as before."""
    log = many_beacons(sound, 2000)
    real, strange = sound.roles["travel_time"], log.roles["beacons"]["id"][4:]
    rows = np.arange(len(strange)) % len(real["beacon_id"])
    replies = {name: np.concatenate([column, column[rows]]) for name, column in real.items()}
    replies["beacon_id"] = np.append(real["beacon_id"], strange)
    dive = align(with_columns(log, "travel_time", replies), Config())
    assert len(dive.beacons) == MOST_BEACONS
    assert set(real["beacon_id"]) <= set(dive.beacons.id)
    (check,) = [check for check in dive.checks if check.name == "beacons_left_out"]
    assert not check.ok
    assert re.search(r"of 2,000 beacons; 1,936 replies", check.detail)


def test_when_none_of_a_catalogue_is_heard_a_few_of_each_are_named(sound: Log) -> None:
    from abyssnav.errors import SolveError

    replies = sound.roles["travel_time"]
    log = with_columns(many_beacons(sound, 2000), "travel_time",
                       {"beacon_id": replies["beacon_id"] + 50_000})  # fmt: skip
    with pytest.raises(SolveError, match=r"is from a known beacon: heard 50001, .*; known") as said:
        align(log, Config())
    assert len(str(said.value)) < 300


def test_days_of_hardly_any_readings_are_refused(sound: Log) -> None:
    with pytest.raises(ClockError, match=r"69\.4 days from [\d,]+ readings of heading"):
        align(stretched(sound, 10_000), Config())
    assert len(align(stretched(sound, 100), Config()).velocity) == len(
        align(sound, Config()).velocity
    )


def test_of_a_log_of_thousands_of_topics_a_person_gets_those_with_roles_and_the_number(
    abyssnav: Any, sound: Log, tmp_path: Path
) -> None:
    stamp = sound.roles["heading"]["time_ns"][:1]
    one = Ragged.from_bytes([b"\0\1\0\0" + bytes(8)])
    strange = [Channel(f"/a{k}", "x/msg/X", stamp, one, b"float64 a") for k in range(1200)]
    write_with(sound, tmp_path / "wide.mcap", *strange)
    ended = abyssnav("inspect", tmp_path / "wide.mcap")
    assert ended.status == 0
    assert "/lbl/travel_time" in ended.out
    assert "topics more: --json lists all" in ended.out
    assert "/a999" not in ended.out
