# SPDX-License-Identifier: Apache-2.0
"""Stage write, and which files of a dive are wanted."""

from collections.abc import Collection
from pathlib import Path
from typing import Final

from abyssnav.config import Output
from abyssnav.errors import ConfigError, nearest_hint
from abyssnav.outputs.mcap import write_mcap_file
from abyssnav.outputs.parquet import FILES, ErrorTables, write_csv, write_parquet
from abyssnav.tables import Comparison, Reference, Solution

#: Every file of OUT/<dive>/ but `summary.json`, which is always made.
NAMES: Final = (
    *(f"{name}.parquet" for name in FILES),
    "comparison.csv",
    "solution.mcap",
    "dive.rrd",
    "report.html",
)


def wanted_files(output: Output) -> frozenset[str]:
    """Names of the files that the settings ask for.

    Raises
    ------
    ConfigError
        A name in `output.files` that is no file of ours.
    """
    known = ("all", *NAMES, "summary.json")
    for name in output.files:
        if name not in known:
            raise ConfigError(f"[output] files: no {name!r}{nearest_hint(name, known)}")
    return frozenset(NAMES if "all" in output.files else output.files)


def write(
    solution: Solution,
    comparison: Comparison,
    errors: ErrorTables,
    reference: Reference | None,
    folder: Path,
    files: Collection[str] = NAMES,
) -> None:
    """Parquet files, `comparison.csv` and `solution.mcap`, into a folder that exists.

    Parameters
    ----------
    errors : (method, reference) -> distances over time, for `errors.parquet`
    reference : for `reference.parquet` and as a path for viewers
    files : names of those to make
    """
    write_parquet(solution, comparison, errors, reference, folder, files)
    if "comparison.csv" in files:
        write_csv(comparison, solution.dive, folder / "comparison.csv")
    if "solution.mcap" in files:
        write_mcap_file(solution, reference, folder / "solution.mcap")
