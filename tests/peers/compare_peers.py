# SPDX-License-Identifier: Apache-2.0
# ruff: noqa: T201
"""Our methods beside what people use, on the benchmark's dives: `make compare-peers`.

Every peer is a program of its own that gets the log, the settings beside it and, where its table
says so, the start beside it; ours is `abyssnav run` with the same three.  The programs of a dive
run one after the other, so that a busy machine is busy for all; processor seconds and memory are
those that the system counts for the program with its children.  The peers' reading is one program,
run once a dive and counted with each of them.  `abyssnav score` judges all tracks alike, from ten
minutes into the dive on.

    python tests/peers/compare_peers.py --out DIR [--set NAME] [--kinds a,b] [--seeds N] [--real]

What lies in DIR is not run again, so a long comparison can be made in parts.
"""

import argparse
import ast
import json
import os
import platform
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from abyssnav import __version__
from abyssnav.errors import ReadError
from abyssnav.score import DiveScore, Options, pool, score_folder
from abyssnav.simulate import benchmark_dives, write_benchmark
from abyssnav.simulate.benchmark import BenchmarkDive

HERE = Path(__file__).parent
#: Seconds of each dive that do not count: all have settled by then.
FROM_S = 600.0
_WRITING = threading.Lock()


@dataclass(frozen=True)
class Peer:
    """One way to a track."""

    name: str
    script: str  #: of this folder; empty: abyssnav itself
    words: tuple[str, ...] = ()
    package: str = ""  #: whose version is said
    start: bool = True  #: whether it is given the start
    method: str = ""  #: of abyssnav's tracks


PEERS = (
    Peer("smoother", "", package="abyssnav", method="smoother"),
    Peer("ekf", "", package="abyssnav", method="ekf"),
    Peer("ekf_gated (the paper's)", "", package="abyssnav", method="ekf_gated", start=False),
    Peer("smoother, own start", "", package="abyssnav", method="smoother", start=False),
    Peer("ekf, own start", "", package="abyssnav", method="ekf", start=False),
    Peer("GTSAM GNC", "gtsam_gnc.py", package="gtsam"),
    Peer("GTSAM GNC, loose motion", "gtsam_gnc.py", ("loose",), package="gtsam"),
    Peer("navlie EKF", "navlie_ekf.py", package="navlie"),
    Peer("FilterPy EKF", "filterpy_ekf.py", package="filterpy"),
    Peer("FilterPy, 5 σ gate", "filterpy_ekf.py", ("wide",), package="filterpy"),
    Peer("FilterPy, loose motion", "filterpy_ekf.py", ("mahalanobis", "loose"), package="filterpy"),
    Peer("FilterPy, fixed 3 σ gate", "filterpy_ekf.py", ("fixed",), package="filterpy"),
    Peer("FilterPy, range gate", "filterpy_ekf.py", ("range",), package="filterpy"),
    Peer("SciPy script", "scipy_script.py", package="scipy", start=False),
)


# --- running ------------------------------------------------------------------------------------


def folder_of(peer: Peer) -> str:
    """Folder of its tracks below the output; ours share one for all methods of a run."""
    if not peer.script:
        return "abyssnav" if peer.start else "abyssnav_own_start"
    return "_".join([Path(peer.script).stem, *peer.words])


def command(peer: Peer, log: Path, out: Path) -> list[str]:
    """What makes its track of a log."""
    if peer.script:
        track = out / f"{log.stem}.csv"
        return [sys.executable, str(HERE / peer.script), str(log), str(track), *peer.words]
    words = [sys.executable, "-P", "-m", "abyssnav", "run", str(log), "-q", "-o", str(out)]
    settings = [".settings.toml", *([".start.toml"] if peer.start else [])]
    for suffix in settings:
        if log.with_suffix(suffix).is_file():
            words += ["--config", str(log.with_suffix(suffix))]
    if log.with_suffix(".profile.toml").is_file():
        words += ["--profile", str(log.with_suffix(".profile.toml"))]
    return [*words, "--config", str(HERE / "abyssnav.toml")]


class Run(NamedTuple):
    """How a program ended, and what it took with its children."""

    status: int
    wall_s: float
    seconds: float  #: of the processor
    memory_mb: float

    def after(self, reading: "Run") -> "Run":
        """This program, had it done the reading itself."""
        return Run(
            self.status or reading.status,
            self.wall_s + reading.wall_s,
            self.seconds + reading.seconds,
            max(self.memory_mb, reading.memory_mb),
        )


def measured(words: Sequence[str]) -> Run:
    """Run a program; one thread for its linear algebra."""
    one = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    began = time.perf_counter()
    with subprocess.Popen(
        words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=os.environ | one
    ) as program:
        assert program.stderr is not None
        said = program.stderr.read()
        _, status, usage = os.wait4(program.pid, 0)
        program.returncode = os.waitstatus_to_exitcode(status)
    if program.returncode not in (0, 3):  # 3: made, and called unusable
        print(f"{words[1]} {words[2]}: {said.strip().splitlines()[-1:]}", file=sys.stderr)
    took_s = time.perf_counter() - began
    seconds = usage.ru_utime + usage.ru_stime
    return Run(program.returncode, took_s, seconds, usage.ru_maxrss / 1024)


def known_costs(folder: Path) -> list[str]:
    """Dives that a program has been measured on."""
    costs = folder / "costs.csv"
    lines = costs.read_text(encoding="utf-8").splitlines() if costs.is_file() else []
    return [line.partition(",")[0] for line in lines]


def run_peers(logs: Sequence[Path], out: Path, peers: Sequence[Peer], jobs: int = 1) -> None:
    """Every program on every log, dive by dive; what was run before is not run again."""
    programs = {folder_of(peer): peer for peer in peers}
    for name in programs:
        (out / name).mkdir(parents=True, exist_ok=True)

    def one_dive(log: Path) -> None:
        waiting = {n: p for n, p in programs.items() if log.stem not in known_costs(out / n)}
        if any(peer.script for peer in waiting.values()):
            reading = measured([sys.executable, str(HERE / "dive_reader.py"), str(log)])
        for name, peer in waiting.items():
            run = measured(command(peer, log, out / name))
            if peer.script:  # a program of its own would have read the log too
                run = run.after(reading)
            with _WRITING, (out / name / "costs.csv").open("a", encoding="utf-8") as stream:
                if not stream.tell():
                    stream.write(f"dive,{','.join(Run._fields)}\n")
                stream.write(",".join([log.stem, *(f"{value:.6g}" for value in run)]) + "\n")
        log.with_suffix(".read").unlink(missing_ok=True)
        print(f"{log.stem} done, load {os.getloadavg()[0]:.1f}", file=sys.stderr, flush=True)

    with ThreadPoolExecutor(jobs) as threads:
        list(threads.map(one_dive, logs))


# --- tables -------------------------------------------------------------------------------------


def scores(logs: Path, out: Path, peer: Peer, from_s: float) -> list[DiveScore]:
    """Score of each dive."""
    tracks, options = out / folder_of(peer), Options(peer.method or None, from_s)
    try:
        return score_folder(logs, tracks, options)
    except ReadError as reason:  # not one track
        return [DiveScore(log.stem, None, str(reason)) for log in sorted(logs.glob("*.mcap"))]


def lines_of(script: Path) -> int:
    """Lines of code: neither blank, nor comment, nor docstring."""
    tree = ast.parse(script.read_text(encoding="utf-8"))
    kept: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.stmt) and not (
            isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        ):
            first = node.body[0].lineno if isinstance(node, ast.ClassDef | ast.FunctionDef) else 0
            kept |= set(range(node.lineno, (first or (node.end_lineno or 0) + 1)))
    docs = {
        line
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        for line in range(node.lineno, (node.end_lineno or 0) + 1)
    }
    source = script.read_text(encoding="utf-8").splitlines()
    return sum(
        1
        for n in kept - docs
        if source[n - 1].strip() and not source[n - 1].strip().startswith("#")
    )


def user_lines(peer: Peer) -> int:
    """Lines that its user writes, what the peers share counted with each."""
    if not peer.script:
        return 1
    shared = ["dive_reader.py", "lbl_model.py", "peer_settings.py"]
    return sum(lines_of(HERE / name) for name in (peer.script, *shared))


def number(value: float | None, digits: int = 2, factor: float = 1.0) -> str:
    return "" if value is None or np.isnan(value) else f"{factor * value:.{digits}f}"


def median(values: Iterable[float | None]) -> float:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else np.nan


def summary_table(results: dict[str, list[DiveScore]], peers: Sequence[Peer]) -> Iterator[str]:
    """One row a peer, over all dives."""
    yield (
        "| | dives with a track | RMS m, median (worst dive) | x filters' bound "
        "| x smoothers' bound | largest m | NEES, median (largest) | in 95 % "
        "| wrong let in % | good thrown out % "
        "| processor s | MB | lines |"
    )
    yield "|---|" + "--:|" * 12
    for peer in peers:
        rows = results[peer.name]
        known = [row.score for row in rows if row.score is not None]

        def column(name: str, known: list[Any] = known) -> list[float]:
            values = (getattr(score, name) for score in known)
            return [value for value in values if value is not None and not np.isnan(value)]

        nees = column("nees")
        cells = [
            f"{len(known)} of {len(rows)}",
            f"{number(median(column('rms_m')))} ({number(max(column('rms_m'), default=None))})",
            number(median(column("x_filter"))),
            number(median(column("x_smoother"))),
            number(max(column("max_m"), default=None), 1),
            f"{number(median(nees))} ({number(max(nees), 0)})" if nees else "",
            number(median(column("inside_95")), 1, 100),
            number(_mean(column("outliers_accepted")), 1, 100),
            number(_mean(column("good_rejected")), 1, 100),
            number(median(row.seconds for row in rows), 1),
            number(median(row.memory_mb for row in rows), 0),
            str(user_lines(peer)),
        ]
        yield f"| {peer.name} | " + " | ".join(cells) + " |"


def _mean(values: list[float]) -> float:
    return float(np.mean(values)) if values else np.nan


def kind_table(
    results: dict[str, list[DiveScore]], peers: Sequence[Peer], worst: bool
) -> Iterator[str]:
    """One row a kind of dive, the RMS of each peer, its median or the worst; the best bold."""
    yield "| dives | " + " | ".join(peer.name for peer in peers) + " |"
    yield "|---|" + "--:|" * len(peers)
    table: dict[str, list[float]] = {}
    for peer in peers:
        for kind in pool(results[peer.name]):
            dives = [row.score.rms_m for row in results[peer.name]
                     if row.score and row.dive.rpartition("_")[0] == kind.kind]  # fmt: skip
            lost = kind.scored < kind.dives
            value = max(dives, default=np.nan) if worst else kind.values["rms_m"]
            table.setdefault(kind.kind, []).append(np.inf if lost and worst else value)
    for kind, values in table.items():
        best = min((v for v in values if np.isfinite(v)), default=np.nan)
        cells = [
            "none" if np.isinf(v) or np.isnan(v) else f"**{v:.2f}**" if v == best else f"{v:.2f}"
            for v in values
        ]
        yield f"| {kind} | " + " | ".join(cells) + " |"


def machine() -> str:
    """Versions and machine, as they stand below each table."""
    names = {peer.package for peer in PEERS} | {"mcap-ros2-support", "numpy", "pandas"}
    known = [f"abyssnav {__version__}"]
    for name in sorted(names - {"abyssnav"}):
        try:
            known.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            known.append(f"{name} not installed")
    processor = next(
        (line.partition(":")[2].strip() for line in _cpuinfo() if line.startswith("model name")),
        platform.processor(),
    )
    return (
        f"{', '.join(known)}; Python {platform.python_version()}, {os.cpu_count()} cores "
        f"({processor}), load {os.getloadavg()[0]:.1f} at the end"
    )


def _cpuinfo() -> list[str]:
    path = Path("/proc/cpuinfo")
    return path.read_text(encoding="utf-8").splitlines() if path.is_file() else []


def report(logs: Path, out: Path, peers: Sequence[Peer], from_s: float) -> Iterator[str]:
    """All tables of what was run, in Markdown; the scores as JSON beside the tracks."""
    results = {peer.name: scores(logs, out, peer, from_s) for peer in peers}
    plain = {name: [row.plain() for row in rows] for name, rows in results.items()}
    (out / f"scores_{logs.name}.json").write_text(json.dumps(plain, indent=1), encoding="utf-8")
    yield from summary_table(results, peers)
    for worst in (False, True):
        yield ""
        yield f"{'Worst' if worst else 'Median'} RMS of the dives of a kind, m:\n"
        yield from kind_table(results, peers, worst)


def shortened(dive: BenchmarkDive, duration_s: float) -> BenchmarkDive:
    """The beginning of a dive."""
    scenario = msgspec.structs.replace(dive.scenario, duration_s=duration_s)
    return replace(dive, scenario=scenario)


def missing_packages(peers: Sequence[Peer]) -> list[str]:
    """Of the peers, those whose package is not installed."""
    missing = set()
    for peer in peers:
        try:
            version(peer.package)
        except PackageNotFoundError:
            missing.add(peer.package)
    return sorted(missing)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="logs, tracks and scores")
    parser.add_argument("--set", default="benchmark_scored", help="or benchmark: the open seeds")
    parser.add_argument("--kinds", default="", help="of the benchmark, commas between")
    parser.add_argument("--seeds", type=int, default=3, help="dives of a kind")
    parser.add_argument("--minutes", type=float, default=0.0, help="shorter dives, to try it")
    parser.add_argument("--peers", default="", help="parts of their names, commas between")
    parser.add_argument("--jobs", type=int, default=2, help="dives at a time")
    parser.add_argument("--real", action="store_true", help="the survey SAGA.1903 in their place")
    arguments = parser.parse_args()
    wanted = [part for part in arguments.peers.split(",") if part] or [""]
    peers = [peer for peer in PEERS if any(part in peer.name for part in wanted)]
    if missing := missing_packages(peers):
        sys.exit(f"not installed: {', '.join(missing)}: pip install --group peers")
    logs = arguments.out / ("saga" if arguments.real else arguments.set)
    if arguments.real:
        from saga import UnavailableError, write_saga

        try:
            write_saga(logs)
        except UnavailableError as reason:
            sys.exit(f"no real log: {reason}")
        paths = sorted(logs.glob("*.mcap"))
    else:
        kinds = [kind for kind in arguments.kinds.split(",") if kind]
        dives = benchmark_dives(arguments.set, kinds)
        seeds = list(dict.fromkeys(d.scenario.seed for d in dives))[: arguments.seeds]
        dives = [d for d in dives if d.scenario.seed in seeds]
        if arguments.minutes:
            dives = [shortened(d, 60.0 * arguments.minutes) for d in dives]
        write_benchmark(logs, [d for d in dives if not (logs / f"{d.name}.mcap").is_file()])
        paths = [logs / f"{dive.name}.mcap" for dive in dives]
    tracks = arguments.out / f"tracks_{logs.name}"
    run_peers(paths, tracks, peers, arguments.jobs)
    for line in report(logs, tracks, peers, 0.0 if arguments.real else FROM_S):
        print(line)
    print(f"\n{machine()}")


if __name__ == "__main__":
    main()
