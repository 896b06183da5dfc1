# SPDX-License-Identifier: Apache-2.0
"""Our reading beside every other reader of MCAP in Python: `make compare-readers`.

Each is run as a program of its own (some are GPL), imports first, then everything is decoded once:
the others to an object a message, Rerun's to Arrow, ours to the columns that a dive needs and, in
the second line, to every field there is.
"""

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))
from bench_read import chunks, decompress, seconds, simulated, written
from rich.console import Console
from rich.table import Table
from test_vehicles import twins

from abyssnav.formats.mcap.writer import write_mcap

_OURS = """
from abyssnav.formats.decoding import definition_of, field_decoder
from abyssnav.formats.schema import leaves
from abyssnav.formats.mcap.reader import read_mcap
from abyssnav.profile import load_profile
from abyssnav.read.parts import read_part
from pathlib import Path
"""
_EVERY = "lambda c: field_decoder(c, [path for path, _ in leaves(definition_of(c))])"
_OFFICIAL = (
    """
from mcap.reader import make_reader
from {0}.decoder import DecoderFactory
""",
    "make_reader(open(path, 'rb'), decoder_factories=[DecoderFactory()]).iter_decoded_messages()",
)
_SMALL = "from small_mcap import read_message, read_message_decoded\n"
#: Package whose version is told, what is imported, and an iterable of all messages or an action.
READERS = {
    "abyssnav, what a dive needs": (
        "", _OURS, "[read_part(Path(path), load_profile(), None)]",
    ),
    "abyssnav, every field": ("", _OURS, f"[read_mcap(Path(path), {_EVERY})]"),
    "small-mcap, nothing decoded": ("small-mcap", _SMALL, "read_message(open(path, 'rb'))"),
    "small-mcap with mcap-ros2-support-fast": (
        "mcap-ros2-support-fast",
        _SMALL + "from mcap_ros2_support_fast.decoder import DecoderFactory\n",
        "(m.decoded_message for m in read_message_decoded("
        "open(path, 'rb'), decoder_factories=[DecoderFactory()]))",
    ),
    "rerun-sdk, to Arrow": (
        "rerun-sdk", "from rerun.chunk import McapReader\n", "McapReader(path).stream()",
    ),
    "pybag-sdk": (
        "pybag-sdk",
        "from pybag.mcap_reader import McapFileReader\n",
        "(m.data for m in McapFileReader.from_file(path).messages('/*'))",
    ),
    "rosbags": (
        "rosbags",
        "from pathlib import Path\nfrom rosbags.highlevel import AnyReader\n"
        "def every(path):\n"
        "    with AnyReader([Path(path)]) as reader:\n"
        "        for c, _, raw in reader.messages(): yield reader.deserialize(raw, c.msgtype)\n",
        "every(path)",
    ),
    "mcap with mcap-ros2-support": (
        "mcap-ros2-support", _OFFICIAL[0].format("mcap_ros2"), _OFFICIAL[1],
    ),
}  # fmt: skip
PROTOBUF_READERS = {
    name: READERS[name]
    for name in ("abyssnav, what a dive needs", "abyssnav, every field", "rerun-sdk, to Arrow")
} | {
    "mcap with mcap-protobuf-support": (
        "mcap-protobuf-support", _OFFICIAL[0].format("mcap_protobuf"), _OFFICIAL[1],
    ),
}  # fmt: skip


def took_s(imports: str, messages: str, path: Path) -> float:
    """Best of three runs of a program that reads all messages, its imports not counted."""
    program = (
        f"import sys, time\npath = sys.argv[1]\n{imports}\nbegan = time.perf_counter()\n"
        f"for message in {messages}: pass\nprint(time.perf_counter() - began)"
    )
    runs = (
        subprocess.run(
            [sys.executable, "-c", program, path], check=True, capture_output=True, text=True
        )
        for _ in range(3)
    )
    return min(float(run.stdout) for run in runs)


def version(package: str) -> str:
    from importlib.metadata import version as of

    return of(package) if package else ""


def compared(path: Path, readers: dict[str, tuple[str, str, str]], n: int) -> Iterator[list[str]]:
    """A row a reader: name, seconds, messages a second, and how often ours goes into it."""
    ours = None
    for name, (package, imports, messages) in readers.items():
        took = took_s(imports, messages, path)
        ours = ours or took
        told = f"{name} {version(package)}".strip()
        yield [told, f"{took:.3f}", f"{n / took / 1e3:,.0f} k", f"{took / ours:.1f}"]


def main() -> None:
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        log = simulated(folder / "hours.mcap", 4)
        channels = written(log)
        n = sum(len(channel.log_time_ns) for channel in channels)
        write_mcap(folder / "protobuf.mcap", [twins(channel)[0] for channel in channels])
        for path, readers in (
            (log, READERS), (folder / "protobuf.mcap", PROTOBUF_READERS),
        ):  # fmt: skip
            packed = chunks(path)
            bare = seconds(lambda packed=packed: decompress(packed))
            title = f"{path.stem}: {n:,} messages; bare decompression {bare:.3f} s"
            table = Table("reader", "seconds", "messages/s", "over ours", title=title)
            for row in compared(path, readers, n):
                table.add_row(*row)
            Console(width=110).print(table)


if __name__ == "__main__":
    main()
