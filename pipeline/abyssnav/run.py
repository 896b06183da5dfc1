# SPDX-License-Identifier: Apache-2.0
"""One dive in order: named steps, each from the one before."""

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Final, NamedTuple

from abyssnav.align import align, reference
from abyssnav.atomic import atomic_directory, folder_name, keep_foreign_files
from abyssnav.compare import error_over_time, summarise
from abyssnav.config import Config, plain
from abyssnav.diagnose import with_verdict
from abyssnav.errors import ReadError, printable
from abyssnav.navigate import navigate
from abyssnav.outputs.files import wanted_files, with_missing_files, write
from abyssnav.outputs.html import report
from abyssnav.outputs.rerun import trim_for_view, view
from abyssnav.outputs.summary import summarise_dive, write_summary
from abyssnav.profile import Profile
from abyssnav.read import read
from abyssnav.read.parts import mcap_files
from abyssnav.second_process import InlineExecutor, SecondProcessExecutor, peak_memory_mb
from abyssnav.startup import give_back_memory
from abyssnav.tables import Comparison, Evaluation, Solution
from abyssnav.version import __version__

STAGES: Final = ("read", "align", "navigate", "compare", "diagnose", "write", "view", "report")
#: Stages that leave much memory behind, on which the next one's peak shall not stand.  The little
#: of the others is not worth the time: what is given back and needed again comes page by page.
_LEAVE_MUCH: Final = ("align", "navigate")
#: Called as a stage begins (None) and as it ends: its seconds, and the messages that it read.
ProgressCallback = Callable[[str, float | None, int], None]


class Setup(NamedTuple):
    """How dives are processed: settings, and the profile of the vehicle that logged them."""

    config: Config
    profile: Profile


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
    timings_s: dict[str, float]  #: stage -> seconds; the view goes beside files and report
    kept: tuple[str, ...] = ()  #: files in the folder that an earlier result or a person left


def run_dive(
    paths: Sequence[Path],
    setup: Setup,
    out: Path,
    on_progress: ProgressCallback = lambda *_: None,
    label: Label = Label(),
    executor: Executor | None = None,
) -> Result:
    """Process one dive into `out`/<dive>, in the place of what an earlier run left there.

    Parameters
    ----------
    paths : the file, files or directory of one recording
    on_progress : called as each stage begins and ends
    label : name and key of the dive; empty, its file's stem and the hash of its content
    executor : for the recording and what else need not be made in this process

    Raises
    ------
    PipelineError
        The dive cannot be read, navigated or written, or its file changed meanwhile; `out`/<dive>
        is as it was before.
    """
    executor, config = executor or InlineExecutor(), setup.config
    files = wanted_files(config.output)  # a wrong name is refused before anything is read
    clock, states = _Clock(on_progress), file_states(paths)
    with clock.stage("read") as read_so_far:
        log = read(paths, setup.profile)
        log = replace(log, name=folder_name(label.name or log.name))
        read_so_far += [sum(file.messages.values()) for file in log.inputs]
    with ThreadPoolExecutor(1) as thread:
        hashing = thread.submit(hash_files, paths)
        with clock.stage("align"):
            dive, truth = align(log, config), reference(log)
            log = replace(log, roles={})  # a third of all memory
        with clock.stage("navigate"):
            solution = navigate(dive, config, executor)
        with clock.stage("compare"):
            errors = error_over_time(solution, truth)
            comparison = summarise(errors)
        with clock.stage("diagnose"):
            solution = with_missing_files(with_verdict(solution, config), config.output)
    inputs = hashing.result()
    refuse_changed(states, file_states(paths))
    summary = summarise_dive(solution, comparison, log, config, dict(inputs))
    summary["key"] = label.key or dive_key(inputs, setup)
    evaluation = Evaluation(solution, comparison, errors, truth)
    with atomic_directory(out / dive.name) as folder:
        writers = {"write": lambda: write(evaluation, folder, files)}
        if "report.html" in files:
            writers["report"] = lambda: report(evaluation, summary, folder / "report.html")
        viewer = {}
        if "dive.rrd" in files:
            viewer["view"] = lambda: executor.submit(
                view, trim_for_view(evaluation), folder / "dive.rrd"
            ).result()
        clock.side_by_side([writers, viewer])
        timings_s = {str(name): clock.seconds[name] for name in STAGES if name in clock.seconds}
        second_mb = executor.peak_memory_mb if isinstance(executor, SecondProcessExecutor) else 0.0
        memory_mb = round(peak_memory_mb() + second_mb, 1)
        write_summary(summary | {"timings_s": timings_s, "peak_memory_mb": memory_mb}, folder)
        kept = keep_foreign_files(out / dive.name, folder)
    duration_s = summary["duration_s"]
    return Result(out / dive.name, solution, comparison, duration_s, timings_s, tuple(kept))


@dataclass(frozen=True)
class _Clock:
    """Reports the stages and takes their time."""

    on_progress: ProgressCallback
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[list[int]]:
        self.on_progress(name, None, 0)
        began, messages = perf_counter(), list[int]()
        yield messages
        if name in _LEAVE_MUCH:
            give_back_memory()
        self.seconds[name] = round(perf_counter() - began, 4)
        self.on_progress(name, self.seconds[name], sum(messages))

    def side_by_side(self, rows: Sequence[Mapping[str, Callable[[], None]]]) -> None:
        """Run rows of stages beside each other; all have ended when the first's error rises."""

        def do(row: Mapping[str, Callable[[], None]]) -> None:
            for name, work in row.items():
                with self.stage(name):
                    work()

        with ThreadPoolExecutor(len(rows)) as threads:
            for done in [threads.submit(do, row) for row in rows]:
                done.result()


def dive_key(inputs: Sequence[tuple[str, str]], setup: Setup) -> str:
    """SHA-256 by which a result is known: of its inputs, settings, profile and version.

    Parameters
    ----------
    inputs : (name, SHA-256 of the content) of each file
    """
    identity = {
        "version": __version__,
        "settings": plain(setup.config),
        "profile": plain(setup.profile),
        "inputs": sorted(inputs),
    }
    return hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()


def hash_files(paths: Sequence[Path]) -> list[tuple[str, str]]:
    """Name and SHA-256 of each file of a recording, without reading it as a log.

    Raises
    ------
    ReadError
        A path that is not there.
    OSError
        A file that cannot be read.
    """
    hashes = []
    for path in mcap_files(paths):
        with path.open("rb") as file:
            hashes.append((printable(path.name), hashlib.file_digest(file, "sha256").hexdigest()))
    return hashes


def file_states(paths: Sequence[Path]) -> dict[Path, tuple[int, int]]:
    """Size and time of the last change, in ns, of each file of a recording."""
    states = {path: path.stat() for path in mcap_files(paths)}
    return {path: (state.st_size, state.st_mtime_ns) for path, state in states.items()}


def refuse_changed(
    before: Mapping[Path, tuple[int, int]], after: Mapping[Path, tuple[int, int]]
) -> None:
    """Refuse a recording that was still being written or copied while it was processed.

    Its hash would be that of other bytes than those that were navigated.

    Raises
    ------
    ReadError
        A file is another than before, or is gone or new.
    """
    for path in sorted(before.keys() | after.keys()):
        if before.get(path) != after.get(path):
            raise ReadError(f"{path}: changed while it was read; is it still being copied?")
