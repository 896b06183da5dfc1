# SPDX-License-Identifier: Apache-2.0
"""One dive in order: seven named steps, and outputs that appear whole or not at all."""

import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

from pipeline.align import align
from pipeline.compare import compare
from pipeline.config import Config
from pipeline.errors import PipelineError
from pipeline.navigate import navigate
from pipeline.profile import Profile
from pipeline.read import read
from pipeline.tables import Comparison, Solution
from pipeline.view import view
from pipeline.write import write, write_summary


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
    tell: Callable[[str], None] = lambda stage: None,
) -> Result:
    """Process one dive into `out`/<dive>, replacing what an earlier run left there.

    Parameters
    ----------
    paths : file, files or directory of one recording
    tell : hears the name of each stage as it begins

    Raises
    ------
    PipelineError
        The dive cannot be read, navigated or written; `out` is as it was before.
    """
    timings_s: dict[str, float] = {}

    @contextmanager
    def stage(name: str) -> Iterator[None]:
        tell(name)
        began = perf_counter()
        yield
        timings_s[name] = round(perf_counter() - began, 4)

    with stage("read"):
        log = read(paths, profile)
    with stage("align"):
        dive = align(log, config)
    with stage("navigate"):
        solution = navigate(dive, config)
    with stage("compare"):
        reference = reference_of(log)
        comparison = compare(solution, reference)
    with appearing(out / dive.name) as folder:
        with stage("write"):
            write(folder, solution, comparison, config)
        with stage("view"):
            view(folder, solution, reference)
        write_summary(folder, log, solution, comparison, config, timings_s, peak_memory_mb())
    return Result(out / dive.name, solution, comparison, timings_s)


def peak_memory_mb() -> float:
    """Largest resident memory of this process so far, in 10⁶ bytes."""
    import resource

    unit = 1 if sys.platform == "darwin" else 1024
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6, 1)


@contextmanager
def appearing(folder: Path) -> Iterator[Path]:
    """Folder to write into that takes the place of `folder` when all went well.

    It lies beside `folder`, is flushed to the disk and then renamed; an older result stays until
    that moment.  Left by an error, `folder` is as it was.  What a killed run left behind goes at
    the next run: it holds no lock any more.

    Raises
    ------
    PipelineError
        `folder` is something else than a result of ours, or cannot be written.
    """
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        restore(folder)
        if folder.exists() and not (folder / "summary.json").is_file():
            raise PipelineError(f"{folder}: exists and is no result of abyssnav; not replaced")
        with locked_folder(folder) as fresh:
            yield fresh
            flush(fresh)
            replace(folder, fresh)
    except OSError as error:
        place = error.filename or folder
        raise PipelineError(f"{place}: cannot be written: {error.strerror or error}") from None


@contextmanager
def locked_folder(folder: Path) -> Iterator[Path]:
    """Temporary folder beside `folder`, locked while this process lives."""
    import fcntl
    import os

    fresh = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", suffix=".part", dir=folder.parent))
    handle = os.open(fresh, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        fresh.chmod(0o777 & ~_umask())
        yield fresh
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
        os.close(handle)
