# SPDX-License-Identifier: Apache-2.0
"""Many dives: a process each, resumed, never stopped by a bad one.

A dive is done when its result carries the key of its inputs, settings, profile and version; what is
missing, changed or was refused is run.  Every result appears whole or not at all, so a batch may be
killed at any instant and started again.  Results for an object store are made here and sent.
"""

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from glob import glob
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Final

from abyssnav.atomic import (
    COMPLETION_MARKER,
    atomic_file,
    clear_leftovers,
    folder_name,
    locked_folder_beside,
)
from abyssnav.compare import compare_dives
from abyssnav.config import plain
from abyssnav.errors import PipelineError, ReadError, printable, refusal_reason
from abyssnav.outputs.html.index import write_index
from abyssnav.outputs.presentation import median_radius_m
from abyssnav.read.parts import SUFFIXES, is_mcap, mcap_files
from abyssnav.remote import (
    content,
    download,
    fetch,
    identity,
    is_url,
    logs_at,
    try_to_write,
    upload,
)
from abyssnav.results import is_unusable
from abyssnav.run import Label, Result, Setup, dive_key, hash_files, run_dive
from abyssnav.tables import METHODS
from abyssnav.version import __version__
from abyssnav.workers import jobs_for, run_in_processes, run_on_dask

if TYPE_CHECKING:
    import pandas as pd

_STATISTICS: Final = ("mean_m", "std_m", "rms_m")
#: Files of a dive that the record over all dives is made of.
_RECORDED: Final = (COMPLETION_MARKER, "errors.parquet", "tracks.parquet")


@dataclass(frozen=True)
class Recording:
    """One dive to be processed: the name of its result, and its file, directory or URL."""

    name: str
    place: str


@dataclass(frozen=True)
class Task:
    """All that a worker needs to know."""

    recording: Recording
    setup: Setup
    out: str  #: directory or URL of the results


@dataclass(frozen=True)
class Outcome:
    """What became of one dive."""

    dive: str
    status: str  #: `done` or `refused`
    reason: str = ""  #: why it was refused, one line
    verdict: str = ""  #: level of its verdict, where it is done
    uncertainty_95_m: float | None = None  #: 95 % radius, median of its legs, where it has one
    fresh: bool = True  #: False: an earlier batch had done it


def find_recordings(places: Sequence[str], out: str = "") -> list[Recording]:
    """Dives in files, directories, patterns and URLs, by rising name.

    A file is a dive.  In a directory every MCAP file is one, and every directory below it that
    holds MCAP files is one split recording; results of ours, and all below `out`, are none.  At a
    URL every file is a dive.  Dives of one name get the directory above in front.

    Parameters
    ----------
    out : where the results go, which may lie inside a directory of logs

    Raises
    ------
    PipelineError
        A directory or pattern without MCAP files, a URL that cannot be reached.
    """
    results = None if is_url(out) or not out else Path(out).absolute()
    logs: set[str] = set()
    for place in places:
        if is_url(place):
            logs.update(logs_at(place))
        elif any(sign in place for sign in "*?[") and not Path(place).exists():
            matches = [Path(match) for match in glob(place, recursive=True)]
            if not matches:
                raise PipelineError(f"{place}: nothing matches this pattern")
            for match in matches:
                logs |= _logs_in(match, results)
        else:
            logs |= _logs_in(Path(place), results)
    names = _names(sorted(logs))
    return sorted((Recording(names[place], place) for place in logs), key=lambda r: r.name)


def _logs_in(place: Path, results: Path | None) -> set[str]:
    top = place.absolute()
    if not top.is_dir():
        return {str(top)}
    files = [
        path
        for path in top.rglob("*.mcap*")
        if is_mcap(path) and path.is_file() and not _is_result(path.parent, top, results)
    ]
    if not files:
        raise PipelineError(f"{place}: no .mcap file in or below this directory")
    return {str(path if path.parent == top else path.parent) for path in files}


def _is_result(folder: Path, top: Path, results: Path | None) -> bool:
    """Whether a folder below `top` is a result of ours, finished or not, or lies in one."""
    inner = folder.relative_to(top).parts
    below = [top.joinpath(*inner[: depth + 1]) for depth in range(len(inner))]
    return any(
        part == results or part.name.startswith(".") or (part / COMPLETION_MARKER).is_file()
        for part in below
    )


def local_places(recordings: Iterable[Recording]) -> list[str]:
    """Files and folders of the recordings, which every worker must see."""
    places = [recording.place for recording in recordings]
    return [place for place in places if not is_url(place) and Path(place).exists()]


def jobs_that_fit(recordings: Sequence[Recording]) -> int:
    """Processes that this machine's cores and free memory bear, for the largest of the dives."""
    return jobs_for(max((_bytes_of(recording) for recording in recordings), default=0))


def _bytes_of(recording: Recording) -> int:
    if is_url(recording.place):
        return 0  # the part of it that is needed is not known yet
    try:
        return sum(file.stat().st_size for file in mcap_files([Path(recording.place)]))
    except (OSError, PipelineError):
        return 0  # whatever is wrong with it, running the dive says


def batch(
    recordings: Sequence[Recording],
    setup: Setup,
    out: Path | str,
    jobs: int,
    on_outcome: Callable[[Outcome], None] = lambda _: None,
    scheduler: str | None = None,
) -> list[Outcome]:
    """Process what is not done yet, then say what became of all of them.

    Parameters
    ----------
    out : directory or URL of the results
    jobs : worker processes at a time
    on_outcome : called with each dive when it is done or refused
    scheduler : address of a Dask scheduler whose workers see the same files; empty for a cluster of
        `jobs` workers on this machine; None for plain processes

    Returns
    -------
    outcomes : by rising name, as in `dives.parquet`

    Raises
    ------
    PipelineError
        The record of all dives cannot be written, or at a URL nothing.
    """
    out = str(out).rstrip("/")
    if is_url(out):
        try_to_write(out)
    tasks = [Task(recording, setup, out) for recording in recordings]
    outcomes = {}
    waiting = []
    with ThreadPoolExecutor(jobs) as threads:
        for task, done in zip(tasks, threads.map(is_done, tasks), strict=True):
            if done:
                outcomes[task.recording.name] = done
                on_outcome(outcomes[task.recording.name])
            else:
                waiting.append(task)
    for outcome in _processed(waiting, jobs, scheduler):
        outcomes[outcome.dive] = outcome
        on_outcome(outcome)
    ordered = [outcomes[name] for name in sorted(outcomes)]
    _publish_record(tasks, outcomes, out)
    return ordered


def is_done(task: Task) -> Outcome | None:
    """The outcome of an earlier run on these inputs, settings, profile and version, if any."""
    name = task.recording.name
    try:
        if is_url(task.out):
            record = content(f"{task.out}/{name}/{COMPLETION_MARKER}")
        else:
            clear_leftovers(Path(task.out) / name)
            record = (Path(task.out) / name / COMPLETION_MARKER).read_bytes()
        summary = json.loads(record)
        if summary["key"] != _key(task):
            return None
        level, radius_m = str(summary["verdict"]["level"]), summary["uncertainty_95_m"]
        return Outcome(name, "done", verdict=level, uncertainty_95_m=radius_m, fresh=False)
    except (OSError, ValueError, LookupError, TypeError, PipelineError):
        return None  # whatever is wrong with it, running the dive says


def process(task: Task) -> Outcome:
    """Run one dive; a refusal is an outcome."""
    name = task.recording.name
    try:
        result = _run(task)
    except Exception as fault:
        return Outcome(name, "refused", refusal_reason(fault))
    level, radius_m = result.solution.verdict.level, median_radius_m(result.solution)
    return Outcome(name, "done", verdict=level, uncertainty_95_m=radius_m)


def _run(task: Task) -> Result:
    """Make and publish one result."""
    if not is_url(task.out):
        return _run_into(Path(task.out), task)
    with TemporaryDirectory(prefix="abyssnav-") as folder:
        result = _run_into(Path(folder), task)
        upload(Path(folder) / task.recording.name, f"{task.out}/{task.recording.name}")
    return result


def _run_into(out: Path, task: Task) -> Result:
    name, place = task.recording.name, task.recording.place
    if not is_url(place):
        return run_dive([Path(place)], task.setup, out, label=Label(name))
    label = Label(name, _key(task))
    out.mkdir(parents=True, exist_ok=True)
    with locked_folder_beside(out / name) as folder:
        log = folder / PurePosixPath(place).name
        fetch(place, task.setup.profile, log)
        try:
            return run_dive([log], task.setup, out, label=label)
        except PipelineError as refusal:  # whoever reads it knows the log by its URL
            raise PipelineError(str(refusal).replace(str(log), place)) from refusal


def _key(task: Task) -> str:
    place = task.recording.place
    inputs = [(place, identity(place))] if is_url(place) else hash_files([Path(place)])
    return dive_key(inputs, task.setup)


def _processed(tasks: Sequence[Task], jobs: int, scheduler: str | None) -> Iterator[Outcome]:
    """Outcomes as they come; a worker that died is the reason for its dive."""
    if scheduler is None or not tasks:
        recordings = any({"all", "dive.rrd"} & {*task.setup.config.output.files} for task in tasks)
        results = run_in_processes(process, tasks, jobs, recordings=recordings)
    else:
        paths = local_places(task.recording for task in tasks)
        results = run_on_dask(process, tasks, scheduler, jobs, paths)
    for task, outcome in results:
        yield (
            outcome
            if isinstance(outcome, Outcome)
            else Outcome(task.recording.name, "refused", outcome)
        )


def _names(places: Sequence[str]) -> dict[str, str]:
    """A name for each place: its stem, with directories in front until it is the only one."""
    parts = {place: _parts(place) for place in places}
    depth = dict.fromkeys(places, 1)
    while True:
        names = {place: "_".join(parts[place][-depth[place] :]) for place in places}
        count = Counter(names.values())
        twins = [place for place in places if count[names[place]] > 1]
        if not twins or all(depth[place] >= len(parts[place]) for place in twins):
            return names
        for place in twins:
            depth[place] += 1


def _parts(place: str) -> list[str]:
    parts = [part for part in place.rsplit("://", maxsplit=1)[-1].split("/") if part]
    suffix = next((suffix for suffix in SUFFIXES if parts[-1].endswith(suffix)), "")
    return [*map(folder_name, parts[:-1]), folder_name(parts[-1].removesuffix(suffix))]


# --- what is said of all dives ----------------------------------------------------------------


def read_record(out: str, name: str) -> bytes | None:
    """A file that a batch wrote about all dives; None where it made none."""
    try:
        return content(f"{out}/{name}") if is_url(out) else (Path(out) / name).read_bytes()
    except (FileNotFoundError, ReadError):
        return None


def _publish_record(tasks: Sequence[Task], outcomes: Mapping[str, Outcome], out: str) -> None:
    if not is_url(out):
        _write_record(tasks, outcomes, Path(out))
        return
    done = [name for name, outcome in outcomes.items() if outcome.status == "done"]
    with TemporaryDirectory(prefix="abyssnav-") as folder:
        download(out, [f"{name}/{file}" for name in done for file in _RECORDED], Path(folder))
        _write_record(tasks, outcomes, Path(folder))
        upload(Path(folder), out)


def _write_record(tasks: Sequence[Task], outcomes: Mapping[str, Outcome], out: Path) -> None:
    """What is said of all dives, each file whole or not at all."""
    done = [out / name for name in sorted(outcomes) if outcomes[name].status == "done"]
    with atomic_file(out / "dives.parquet") as fresh:
        dives_table(outcomes, out).to_parquet(fresh, index=False, compression="zstd")
    measured = [folder for folder in done if (folder / "errors.parquet").is_file()]
    pooled = [folder for folder in measured if not is_unusable(folder)] or measured
    if pooled:
        with atomic_file(out / "comparison.parquet") as fresh:
            compare_dives(pooled, "method").to_parquet(fresh, index=False, compression="zstd")
    with atomic_file(out / "index.html") as fresh:
        rows = [(o.dive, o.status, o.reason) for _, o in sorted(outcomes.items())]
        write_index(rows, out, fresh)
    with atomic_file(out / "batch.json") as fresh:
        record = _provenance(tasks, outcomes, out)
        fresh.write_text(json.dumps(record, indent=2, ensure_ascii=False) + "\n", "utf-8")


def dives_table(outcomes: Mapping[str, Outcome], out: Path) -> "pd.DataFrame":
    """One row a dive: status, reason, seconds, verdict, radius, replies and errors by method.

    The length of a dive, not of its processing, so that the same dives give the same bytes.
    """
    import pandas as pd

    kinds = {"dive": "str", "status": "str", "reason": "str", "seconds": "float64"}
    kinds |= {"verdict": "str", "cause": "str", "uncertainty_95_m": "float64"}
    kinds |= {"replies": "Int64"} | {f"{method}_accepted": "Int64" for method in METHODS}
    kinds |= {
        f"{method}_{reference}_{name}": "float64"
        for method in METHODS
        for reference in ("fix", "truth")
        for name in _STATISTICS
    }
    rows = [_row(outcomes[name], out) for name in sorted(outcomes)]
    return pd.DataFrame(rows, columns=list(kinds)).astype(kinds)


def _row(outcome: Outcome, out: Path) -> dict[str, Any]:
    row: dict[str, Any] = {
        "dive": outcome.dive, "status": outcome.status, "reason": outcome.reason,
    }  # fmt: skip
    if outcome.status != "done":
        return row
    summary = _summary(out / outcome.dive)
    row["seconds"] = summary["duration_s"]
    verdict = summary["verdict"]
    row["verdict"] = verdict["level"]
    row["cause"] = verdict["reasons"][0]["name"] if verdict["reasons"] else ""
    row["uncertainty_95_m"] = summary["uncertainty_95_m"]
    for method, counts in summary["methods"].items():
        if counts["replies"] is not None:
            row["replies"] = counts["replies"]
            row[f"{method}_accepted"] = counts["accepted"]
        for reference, errors in counts["errors"].items():
            for name in _STATISTICS if errors else ():
                row[f"{method}_{reference}_{name}"] = errors[name]
    return row


def _provenance(
    tasks: Sequence[Task], outcomes: Mapping[str, Outcome], out: Path
) -> dict[str, Any]:
    """What was run, with what, from which inputs, by which version."""
    dives = []
    for task in tasks:
        name = task.recording.name
        entry: dict[str, Any] = {"dive": name, "place": printable(task.recording.place)}
        entry["status"] = outcomes[name].status
        if outcomes[name].status == "done":
            summary = _summary(out / name)
            entry |= {"key": summary["key"], "inputs": summary["inputs"]}
        else:
            entry |= {"reason": outcomes[name].reason}
        dives.append(entry)
    return {
        "version": __version__,
        "settings": plain(tasks[0].setup.config) if tasks else {},
        "profile": plain(tasks[0].setup.profile) if tasks else {},
        "dives": dives,
    }


def _summary(folder: Path) -> dict[str, Any]:
    summary = json.loads((folder / COMPLETION_MARKER).read_text(encoding="utf-8"))
    assert isinstance(summary, dict)
    return summary
