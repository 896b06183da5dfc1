# SPDX-License-Identifier: Apache-2.0
"""Speed and memory on this machine: `make bench`.  Figures, not verdicts: nothing here can fail.

A number of a busy machine is worth little; the first line says how busy it is.
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import bench_batch
import bench_read
import msgspec
from rich.console import Console
from rich.table import Table

from abyssnav.simulate import load_scenario, simulate, write_log

COMMAND = [sys.executable, "-m", "abyssnav"]


def timed(*words: object) -> float:
    """Seconds that a command takes, its imports included; the better of two."""
    took = []
    for _ in range(2):
        began = time.perf_counter()
        subprocess.run([*COMMAND, *map(str, words)], check=True, capture_output=True)
        took.append(time.perf_counter() - began)
    return min(took)


def peak_mb(out: Path) -> float:
    """Largest memory that a dive of this output took."""
    summaries = out.glob("*/summary.json")
    return max(msgspec.json.decode(path.read_bytes())["peak_memory_mb"] for path in summaries)


def log(folder: Path, name: str, hours: float, seed: int = 1) -> Path:
    scenario: Any = load_scenario("voyage_2")
    scenario = msgspec.structs.replace(scenario, duration_s=hours * 3600.0, seed=seed)
    write_log(simulate(scenario), folder / f"{name}.mcap")
    return folder / f"{name}.mcap"


def rows(folder: Path) -> Iterator[tuple[str, str]]:
    """What is measured, and what came out."""
    yield "abyssnav --help", f"{timed('--help'):.2f} s"
    for hours in (1, 3, 24):
        path = log(folder, f"dive_{hours}", hours)
        seconds = timed("run", path, "-o", folder / f"out_{hours}")
        memory, size = peak_mb(folder / f"out_{hours}"), path.stat().st_size / 1e6
        yield (
            f"abyssnav run, {hours} h ({size:.1f} MB)",
            f"{seconds:.2f} s, {memory:.0f} MB",
        )


def main() -> None:
    load = os.getloadavg()[0]
    table = Table("measured", "came out", title=f"{os.cpu_count()} cores, load {load:.1f} before")
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        batches = bench_batch.rows(folder, bench_batch.DIVES)
        for measured, came_out in chain(rows(folder), batches, bench_read.rows(folder)):
            table.add_row(measured, came_out)
    Console().print(table)


if __name__ == "__main__":
    main()
