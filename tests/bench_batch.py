# SPDX-License-Identifier: Apache-2.0
"""How a cruise grows: 2 h dives, five of them broken, by one worker and by two.

`python tests/bench_batch.py --dives 200`.  Figures, not verdicts: nothing here can fail.  The logs
are simulated once, into a cache outside the checkout.
"""

import argparse
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec
from rich.console import Console

from abyssnav import __version__
from abyssnav.atomic import atomic_file
from abyssnav.simulate import load_scenario, simulate, write_log
from abyssnav.workers import run_in_processes

DIVES = 40
HOURS = 2.0
#: What a recorder leaves behind on a bad day.
BROKEN = {
    "broken_empty": b"",
    "broken_text": b"no log at all",
    "broken_magic": b"\x89MCAP0\r\n",
    "broken_zeros": bytes(1 << 20),
    "broken_record": b"\x89MCAP0\r\n\x01" + b"\xff" * 64,
}
#: Verdict or refusal, and a dive's name, in the columns of `batch`.
_A_DIVE = re.compile(r"[A-Z]+ {2,}\S")


@dataclass(frozen=True)
class Batch:
    """What one batch took."""

    seconds: float
    done: int
    refused: int
    parent_mb: list[float]  #: memory of the command itself as each dive ended
    parent_peak_mb: float  #: the pooling included
    workers_mb: list[float]  #: peak of each dive's process, in the order of processing
    processor_s: float  #: of the command and all its processes
    load: float  #: of the machine when it began


def make(path: Path) -> None:
    number = int(path.stem.removeprefix("dive_"))
    scenario = load_scenario(f"voyage_{1 + number % 2}")
    scenario = msgspec.structs.replace(scenario, duration_s=HOURS * 3600.0, seed=number)
    with atomic_file(path) as fresh:
        write_log(simulate(scenario), fresh)


def cruise(folder: Path, dives: int) -> Path:
    """`folder`, with `dives` logs: the broken ones and links to those in the cache."""
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    cache = home / "abyssnav" / f"bench_{__version__}"
    names = [f"dive_{number:04d}" for number in range(dives - len(BROKEN))]
    wanted = [cache / f"{name}.mcap" for name in names]
    missing = [path for path in wanted if not path.exists()]
    for _, failure in run_in_processes(make, missing, os.cpu_count() or 1):
        if failure:
            raise SystemExit(failure)
    folder.mkdir()
    for path in wanted:
        (folder / path.name).symlink_to(path)
    for name, content in BROKEN.items():
        (folder / f"{name}.mcap").write_bytes(content)
    return folder


def memory_mb(pid: int, kind: str) -> float:
    """`VmRSS` or `VmHWM` of a process."""
    told = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    found = re.search(rf"{kind}:\s+(\d+) kB", told)
    return int(found[1]) * 1024 / 1e6 if found else float("nan")


def processor_s(pid: int) -> float:
    """Processor time of a process and its children, with those that these have outlived."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii").split()
    ticks = 0
    for number in (str(pid), *children):
        fields = Path(f"/proc/{number}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
        ticks += sum(int(field) for field in fields[11:15])
    return ticks / os.sysconf("SC_CLK_TCK")


def measured(logs: Path, out: Path, jobs: int) -> Batch:
    command = [sys.executable, "-m", "abyssnav", "batch", str(logs), "-o", str(out)]
    load, began = os.getloadavg()[0], time.perf_counter()
    parent_mb, peak_mb, effort_s, last = [], 0.0, 0.0, ""
    with subprocess.Popen(
        [*command, "--jobs", str(jobs)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if _A_DIVE.match(line):
                parent_mb.append(memory_mb(process.pid, "VmRSS"))
                effort_s = processor_s(process.pid)
            peak_mb = max(peak_mb, memory_mb(process.pid, "VmHWM"))
            last = line if "dives done" in line else last
    seconds = time.perf_counter() - began
    done, refused = (int(n) for n in re.findall(r"(\d+) (?:dives done|refused)", last))
    summaries = sorted(out.glob("*/summary.json"))
    workers_mb = [msgspec.json.decode(path.read_bytes())["peak_memory_mb"] for path in summaries]
    return Batch(seconds, done, refused, parent_mb, peak_mb, workers_mb, effort_s, load)


def early_and_late(values_mb: list[float]) -> str:
    """Medians of the first and of the last quarter."""
    quarter = max(1, len(values_mb) // 4)
    early, late = (statistics.median(part) for part in (values_mb[:quarter], values_mb[-quarter:]))
    return f"{early:.0f} MB early, {late:.0f} MB late"


def rows(folder: Path, dives: int) -> Iterator[tuple[str, str]]:
    """What is measured, and what came out."""
    logs = cruise(folder / "cruise", dives)
    alone_s = 0.0
    for jobs in (1, 2):
        found = measured(logs, folder / f"cruise_{jobs}", jobs)
        alone_s = alone_s or found.seconds
        rate = dives / found.seconds
        what = f"{dives} dives of {HOURS:g} h, {jobs} worker{'s' if jobs > 1 else ''}"
        yield (
            what,
            f"{found.seconds:.1f} s, {found.done} done, {found.refused} refused; "
            f"{rate:.2f} dives a second, {rate / jobs:.2f} a worker; "
            f"{alone_s / found.seconds:.2f} of one worker; "
            f"{found.processor_s / max(found.done, 1):.2f} s of processor a dive; "
            f"load {found.load:.1f} before",
        )
        yield f"{what}: a dive's process", early_and_late(found.workers_mb)
        yield (
            f"{what}: the command itself",
            f"{early_and_late(found.parent_mb)}; {found.parent_peak_mb:.0f} MB at most",
        )
    again = measured(logs, folder / "cruise_2", 2)
    yield f"{dives} dives, all done before", f"{again.seconds:.1f} s"


def main() -> None:
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("--dives", type=int, default=DIVES)
    dives = max(words.parse_args().dives, 2 * len(BROKEN))
    screen = Console(soft_wrap=True, highlight=False)
    screen.print(f"{os.cpu_count()} cores")
    with tempfile.TemporaryDirectory() as place:
        for what, came_out in rows(Path(place), dives):
            screen.print(f"{what}: {came_out}")


if __name__ == "__main__":
    main()
