# SPDX-License-Identifier: Apache-2.0
"""Stage write, and which files of a dive are wanted."""

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Final

from abyssnav.compare import error_over_time, summarise
from abyssnav.config import Output
from abyssnav.errors import ConfigError, nearest_hint
from abyssnav.outputs.mcap import write_mcap_file
from abyssnav.outputs.parquet import FILES, write_csv, write_parquet
from abyssnav.outputs.rerun import NO_VIEWER, has_viewer, trim_for_view, view
from abyssnav.startup import give_back_memory
from abyssnav.tables import Check, Evaluation, Reference, Solution

#: Every file of OUT/<dive>/ but `summary.json`, which is always made.
NAMES: Final = (
    *(f"{name}.parquet" for name in FILES),
    "comparison.csv",
    "solution.mcap",
    "dive.rrd",
    "report.html",
)
#: What is made of log and settings too, so by a run only.
_OF_A_RUN: Final = ("report.html", "summary.json")


def wanted_files(output: Output) -> frozenset[str]:
    """Names of the files that the settings ask for.

    Raises
    ------
    ConfigError
        A name in `output.files` that is no file of ours, or the recording where no viewer is
        installed; among `all`, it is then left out.
    """
    known = ("all", *NAMES, "summary.json")
    for name in output.files:
        if name not in known:
            raise ConfigError(f"[output] files: no {name!r}{nearest_hint(name, known)}")
    wanted = frozenset(NAMES if "all" in output.files else output.files)
    if has_viewer():
        return wanted
    if "dive.rrd" in output.files:
        raise ConfigError(f"[output] files: dive.rrd: {NO_VIEWER}")
    return wanted - {"dive.rrd"}


def with_missing_files(solution: Solution, output: Output) -> Solution:
    """The solution with a check that says so where no viewer is installed for the recording."""
    if has_viewer() or "all" not in output.files:
        return solution
    check = Check("view", "recording_left_out", 1, 0, "", False, f"dive.rrd: {NO_VIEWER}")
    return replace(solution, checks=(*solution.checks, check))


def write(evaluation: Evaluation, folder: Path, files: Collection[str] = NAMES) -> None:
    """Parquet files, `comparison.csv` and `solution.mcap`, into a folder that exists.

    Parameters
    ----------
    files : names of those to make
    """
    solution = evaluation.solution
    if "solution.mcap" in files:  # before pyarrow, whose import keeps 40 MB: it takes the most
        write_mcap_file(solution, evaluation.reference, folder / "solution.mcap")
        give_back_memory()
    write_parquet(evaluation, folder, files)
    if "comparison.csv" in files:
        write_csv(evaluation.comparison, solution.dive, folder / "comparison.csv")


def write_solution(
    solution: Solution, reference: Reference | None, folder: Path, files: Collection[str]
) -> list[Path]:
    """Make what needs a solution only, in a folder that is made if need be; paths, sorted.

    Raises
    ------
    ConfigError
        As of `wanted_files`, and the name of a file that a run alone makes.
    """
    for name in _OF_A_RUN:
        if name in files:
            raise ConfigError(f"{name}: is made of log and settings too: run_dive makes it")
    wanted = wanted_files(Output(files=tuple(files))).difference(_OF_A_RUN)
    errors = error_over_time(solution, reference)
    evaluation = Evaluation(solution, summarise(errors), errors, reference)
    folder.mkdir(parents=True, exist_ok=True)
    write(evaluation, folder, wanted)
    if "dive.rrd" in wanted:
        view(trim_for_view(evaluation), folder / "dive.rrd")
    return sorted(folder / name for name in wanted if (folder / name).is_file())
