# SPDX-License-Identifier: Apache-2.0
"""One dive in order: named steps, each from the one before."""

import hashlib
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

from pipeline import __version__
from pipeline.align import align, reference
from pipeline.compare import error_over_time, summarise
from pipeline.config import Config, plain
from pipeline.navigate import navigate
from pipeline.profile import Profile
from pipeline.publish import appearing
from pipeline.read import read
from pipeline.read.parts import mcap_files
from pipeline.report import report
from pipeline.summary import summarise_dive, write_summary
from pipeline.tables import Comparison, Solution
from pipeline.view import view
from pipeline.write import write


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
    timings_s: dict[str, float]  #: stage -> seconds


def run_dive(
    paths: Sequence[Path],
    config: Config,
    profile: Profile,
    out: Path,
    tell: Callable[[str], None] = lambda _: None,
    label: Label = Label(),
) -> Result:
    """Process one dive into `out`/<dive>, in the place of what an earlier run left there.

    Parameters
    ----------
    paths : the file, files or directory of one recording
    tell : hears the name of each stage as it begins
    label : name and key of the dive; empty, its file's stem and the hash of its content

    Raises
    ------
    PipelineError
        The dive cannot be read, navigated or written; `out`/<dive> is as it was before.
    """
    timings_s: dict[str, float] = {}

    @contextmanager
    def stage(name: str) -> Iterator[None]:
        tell(name)
        began = perf_counter()
        yield
        timings_s[name] = round(perf_counter() - began, 4)

    with stage("read"):
        recorded = read(paths, profile)
        log = replace(recorded, name=label.name or recorded.name)
    with stage("align"):
        dive, truth = align(log, config), reference(log)
    with stage("navigate"):
        solution = navigate(dive, config)
    with stage("compare"):
        errors = error_over_time(solution, truth)
        comparison = summarise(errors)
    with appearing(out / dive.name) as folder:
        with stage("write"):
            write(solution, comparison, errors, folder)
        with stage("view"):
            view(solution, comparison, errors, truth, folder / "dive.rrd")
        summary = summarise_dive(solution, comparison, log, config)
        inputs = [(file.name, file.sha256) for file in log.inputs]
        known_by = {
            "key": label.key or dive_key(inputs, config, profile),
            "duration_s": round(float(dive.velocity.t_s[-1] - dive.velocity.t_s[0]), 3),
        }
        with stage("report"):
            report(solution, comparison, errors, truth, summary | known_by, folder / "report.html")
        effort = {"timings_s": timings_s, "peak_memory_mb": peak_memory_mb()}
        write_summary(summary | known_by | effort, folder)
    return Result(out / dive.name, solution, comparison, timings_s)


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


def peak_memory_mb() -> float:
    """Largest resident memory of this process so far, in 10⁶ bytes."""
    import resource

    unit_bytes = 1 if sys.platform == "darwin" else 1024
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit_bytes / 1e6, 1)
