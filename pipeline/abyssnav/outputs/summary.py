# SPDX-License-Identifier: Apache-2.0
"""The dive in plain values, for `summary.json` and the report."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from abyssnav import __version__
from abyssnav.config import Config, plain
from abyssnav.tables import (
    DECISIONS,
    Check,
    Comparison,
    Innovations,
    Log,
    Solution,
    Start,
    in_order,
)


def summarise_dive(
    solution: Solution,
    comparison: Comparison,
    log: Log,
    config: Config,
    sha256: Mapping[str, str],
) -> dict[str, Any]:
    """The dive in plain values: what went in, which settings, what came out, what looks wrong.

    All keys of `summary.json` but `key`, `timings_s` and `peak_memory_mb`, which `run` knows.  A
    number that is not finite is null, and the text `inf` in the settings, as TOML would have it.
    The length of the dive is that of its velocity.

    Parameters
    ----------
    sha256 : of each input, by its name
    """
    dive = solution.dive
    methods = in_order({*solution.tracks, "fix"})
    inputs = [
        {"name": i.name, "bytes": i.bytes, "sha256": sha256[i.name], "messages": dict(i.messages)}
        for i in log.inputs
    ]
    return {
        "version": __version__,
        "dive": dive.name,
        "settings": plain(config),
        "profile": log.profile,
        "inputs": inputs,
        "duration_s": round(dive.duration_s, 3),
        "starts": {m: _start(start, dive.start_ns) for m, start in solution.starts.items()},
        "methods": {m: _method_summary(m, solution.innovations, comparison) for m in methods},
        "verdict": asdict(solution.verdict),
        "uncertainty_95_m": _median_radius_m(solution),
        "checks": [_check(check) for check in (*dive.checks, *solution.checks)],
        "findings": [{"what": f.what, "where": f.where, "detail": f.detail} for f in log.findings],
    }


def write_summary(summary: Mapping[str, Any], folder: Path) -> None:
    """`summary.json`, strict JSON: no NaN, no infinity."""
    text = json.dumps(summary, indent=2, allow_nan=False, ensure_ascii=False)
    (folder / "summary.json").write_text(text + "\n", encoding="utf-8")


def _method_summary(
    method: str, innovations: Mapping[str, Innovations], comparison: Comparison
) -> dict[str, Any]:
    errors = {}
    for name in ("fix", "truth"):
        row = comparison[(comparison.method == method) & (comparison.reference == name)]
        numbers = {k: v[0].item() for k, v in row.columns().items() if len(row)}
        errors[name] = {k: v for k, v in numbers.items() if k not in ("method", "reference")}
    decision = innovations[method].decision if method in innovations else np.empty(0, np.int64)
    counts = np.bincount(decision, minlength=len(DECISIONS)).tolist()
    return {
        "replies": sum(counts) if method in innovations else None,
        "accepted": counts[0] if method in innovations else None,
        "rejected": {name: n for name, n in zip(DECISIONS[1:], counts[1:], strict=True) if n},
        "errors": {name: numbers or None for name, numbers in errors.items()},
    }


def _median_radius_m(solution: Solution) -> float | None:
    """Median over the legs of the 95 % radius; None without one."""
    if solution.accuracy is None or not np.isfinite(solution.accuracy.uncertainty_95_m).any():
        return None
    return float(np.nanmedian(solution.accuracy.uncertainty_95_m))


def _check(check: Check) -> dict[str, Any]:
    return {
        "stage": check.stage,
        "name": check.name,
        "value": _finite(check.value),
        "limit": _finite(check.limit),
        "bound": check.bound,
        "unit": check.unit,
        "ok": bool(check.ok),
        "detail": check.detail,
    }


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _start(start: Start, start_ns: int) -> dict[str, Any]:
    time_ns = start_ns + round(start.t_s * 1e9)
    return {
        "time": f"{np.datetime64(time_ns, 'ns')}Z",
        "east_m": float(start.east_m),
        "north_m": float(start.north_m),
        "cycles": int(start.cycles),
        "how": start.how,
    }
