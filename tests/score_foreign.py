# SPDX-License-Identifier: Apache-2.0
# ruff: noqa: T201
"""Score logs that have a reference: `python tests/score_foreign.py DIR|LOG...`.

Each log is navigated with the settings of its name (`<dive>.toml` beside it, where there is one).
Errors are horizontal, from 5 min after the start of `ekf` to 60 s before the end; a README.md
beside the logs with a table of bounds (`| dive | ekf / smoother, m |`) is printed beside them.
"""

import argparse
import json
import os
import re
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from scoring import SETTLED_S, radius, reference_truth, score

from abyssnav.align import align, reference
from abyssnav.config import load_config
from abyssnav.diagnose import with_verdict
from abyssnav.navigate import navigate
from abyssnav.profile import load_profile
from abyssnav.read import read

_END_S = 60.0


def measure(path: Path) -> dict[str, Any]:
    """Scores of one log's `ekf` and `smoother`, and the findings of its run."""
    settings = path.with_suffix(".toml")
    config = load_config(settings if settings.exists() else None)
    log = read([path], load_profile())
    dive, truth = align(log, config), reference(log)
    if truth is None:
        raise SystemExit(f"{path.name}: no reference to score against")
    solution = with_verdict(navigate(dive, config), config)
    known = reference_truth(truth, dive.start_ns)
    until_s = float(known[0][-1]) - _END_S
    tracks = solution.tracks
    started = float(tracks["ekf"].t_s[0]) if "ekf" in tracks else float(known[0][0])
    return {
        "dive": path.stem,
        "scores": {
            method: asdict(score(tracks[method], known, started + SETTLED_S, until_s))
            for method in ("ekf", "smoother")
            if method in tracks
        },
        "radius": asdict(radius(solution, known)),
        "verdict": solution.verdict.level,
        "reasons": [reason.name for reason in solution.verdict.reasons],
        "checks": [c.name for c in (*dive.checks, *solution.checks) if not c.ok],
    }


def published_bounds(folder: Path) -> dict[str, tuple[float, float]]:
    """Dive -> bound of `ekf` and `smoother`, from the table of a README.md; none without one."""
    page = folder / "README.md"
    text = page.read_text(encoding="utf-8") if page.exists() else ""
    rows = re.findall(r"^\| `([^`]+)` \| ([\d.]+) / ([\d.]+) \|", text, re.MULTILINE)
    return {dive: (float(live), float(final)) for dive, live, final in rows}


def print_row(row: dict[str, Any], bounds: tuple[float, float]) -> None:
    """One line a dive."""
    parts = [f"{row['dive'][:35]:35}"]
    for method, bound_m in zip(("ekf", "smoother"), bounds, strict=True):
        result = row["scores"].get(method)
        if result is None:
            parts.append(f"{'no track':>37}")
            continue
        parts.append(
            f"{bound_m:6.2f} {result['rms_m']:7.2f} {result['rms_m'] / bound_m:6.2f} "
            f"{result['nees']:7.2f} {result['max_m']:7.1f}"
        )
    reach = row["radius"]
    parts.append(f"{reach['median_m']:6.2f} {100 * reach['held']:5.1f} {reach['over_p95']:5.2f}")
    parts.append(f"{row['verdict']} {','.join(row['reasons'])} | {','.join(row['checks'])}")
    print("  ".join(parts), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("paths", nargs="+", type=Path, metavar="DIR|LOG")
    parser.add_argument("--only", default="", help="part of the dives' names, commas between")
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    parser.add_argument("--json", type=Path, help="write the rows there too")
    arguments = parser.parse_args()
    logs = [
        log
        for path in arguments.paths
        for log in (sorted(path.glob("*.mcap")) if path.is_dir() else [path])
        if any(part in log.stem for part in arguments.only.split(","))
    ]
    columns = f"{'bound':>6} {'rms m':>7} {'x':>6} {'NEES':>7} {'max m':>7}"
    print(
        f"{'':35}  {'ekf':^37}  {'smoother':^37}  {'95 % radius':^18}\n"
        f"{'dive':35}  {columns}  {columns}  {'m':>6} {'held%':>5} {'/p95':>5}  verdict | checks"
    )
    with ProcessPoolExecutor(arguments.jobs, get_context("spawn")) as pool:
        rows = []
        for log, row in zip(logs, pool.map(measure, logs), strict=True):
            rows.append(row)
            print_row(row, published_bounds(log.parent).get(log.stem, (np.nan, np.nan)))
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
