# SPDX-License-Identifier: Apache-2.0
"""One dive in order: named steps, each from the one before."""

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Final

from abyssnav import __version__
from abyssnav.align import align, reference
from abyssnav.atomic import appearing
from abyssnav.compare import error_over_time, summarise
from abyssnav.config import Config, plain
from abyssnav.navigate import navigate
from abyssnav.outputs.html import report
from abyssnav.outputs.rerun import shown, view
from abyssnav.outputs.summary import summarise_dive, write_summary
from abyssnav.outputs.write import write
from abyssnav.profile import Profile
from abyssnav.read import read
from abyssnav.read.parts import mcap_files
from abyssnav.second_process import Beside, later, peak_memory_mb
from abyssnav.tables import Comparison, Solution

STAGES: Final = ("read", "align", "navigate", "compare", "write", "view", "report")
#: Hears of a stage as it begins (None) and as it ends: its seconds, and the messages that it read.
Listener = Callable[[str, float | None, int], None]


@dataclass(frozen=True)
class Label:
    """By what a dive is known, where that is not its file's name and its content."""

    name: str = ""
    key: str = ""


@dataclass(frozen=True)
class Result:
    """What became of one dive."""

    folder: Path  #: where its outputs are
    solution: Solution
    comparison: Comparison
    duration_s: float  #: of the dive
    timings_s: dict[str, float]  #: stage -> seconds; the last three go side by side


def run_dive(
    paths: Sequence[Path],
    config: Config,
    profile: Profile,
    out: Path,
    tell: Listener = lambda *_: None,
    label: Label = Label(),
    beside: Beside | None = None,
) -> Result:
    """Process one dive into `out`/<dive>, in the place of what an earlier run left there.

    Parameters
    ----------
    paths : the file, files or directory of one recording
    tell : hears of each stage as it begins and as it ends
    label : name and key of the dive; empty, its file's stem and the hash of its content
    beside : another process, for the recording and what else need not be made in this one

    Raises
    ------
    PipelineError
        The dive cannot be read, navigated or written; `out`/<dive> is as it was before.
    """
    clock = _Clock(tell)
    with clock.stage("read") as read_so_far:
        log = read(paths, profile)
        log = replace(log, name=label.name or log.name)
        read_so_far += [sum(file.messages.values()) for file in log.inputs]
    with ThreadPoolExecutor(1) as thread:
        hashing = thread.submit(hashed, paths)
        with clock.stage("align"):
            dive, truth = align(log, config), reference(log)
            log = replace(log, roles={})  # a third of all memory
        with clock.stage("navigate"):
            solution = navigate(dive, config, beside)
        with clock.stage("compare"):
            errors = error_over_time(solution, truth)
            comparison = summarise(errors)
    inputs = hashing.result()
    summary = summarise_dive(solution, comparison, log, config, dict(inputs))
    summary["key"] = label.key or dive_key(inputs, config, profile)
    told = (solution, comparison, errors)
    with appearing(out / dive.name) as folder:
        writers = {
            "write": lambda: write(*told, folder),
            "view": lambda: later(
                beside, view, shown(solution), comparison, errors, truth, folder / "dive.rrd"
            ).result(),
            "report": lambda: report(*told, truth, summary, folder / "report.html"),
        }
        clock.side_by_side(writers)
        timings_s = {name: clock.took_s[name] for name in STAGES}
        memory_mb = peak_memory_mb() + (beside.peak_memory_mb if beside else 0.0)
        write_summary(
            summary | {"timings_s": timings_s, "peak_memory_mb": round(memory_mb, 1)}, folder
        )
    return Result(out / dive.name, solution, comparison, summary["duration_s"], timings_s)


@dataclass(frozen=True)
class _Clock:
    """Tells of the stages and takes their time."""

    tell: Listener
    took_s: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[list[int]]:
        self.tell(name, None, 0)
        began, messages = perf_counter(), list[int]()
        yield messages
        self.took_s[name] = round(perf_counter() - began, 4)
        self.tell(name, self.took_s[name], sum(messages))

    def side_by_side(self, work: Mapping[str, Callable[[], None]]) -> None:
        """Run stages that do not need each other; all have ended when the first's error rises."""

        def do(name: str) -> None:
            with self.stage(name):
                work[name]()

        with ThreadPoolExecutor(len(work)) as threads:
            for done in [threads.submit(do, name) for name in work]:
                done.result()


def dive_key(inputs: Sequence[tuple[str, str]], config: Config, profile: Profile) -> str:
    """SHA-256 by which a result is known: of its inputs, settings, profile and version.

    Parameters
    ----------
    inputs : (name, SHA-256 of the content) of each file
    """
    told = {
        "version": __version__,
        "settings": plain(config),
        "profile": plain(profile),
        "inputs": sorted(inputs),
    }
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()


def hashed(paths: Sequence[Path]) -> list[tuple[str, str]]:
    """Name and SHA-256 of each file of a recording, without reading it as a log.

    Raises
    ------
    ReadError
        A path that is not there.
    OSError
        A file that cannot be read.
    """
    found = []
    for path in mcap_files(paths):
        with path.open("rb") as file:
            found.append((path.name, hashlib.file_digest(file, "sha256").hexdigest()))
    return found
