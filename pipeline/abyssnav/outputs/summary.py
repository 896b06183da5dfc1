# SPDX-License-Identifier: Apache-2.0
"""The dive in plain values, for `summary.json` and the report."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from abyssnav.config import Config, plain
from abyssnav.outputs.parquet import Rows, beacon_rows
from abyssnav.outputs.presentation import median_radius_m
from abyssnav.tables import (
    DECISIONS,
    Check,
    Comparison,
    Innovations,
    Log,
    Origin,
    Solution,
    Start,
    in_order,
    to_utc_ns,
    utc_text,
)
from abyssnav.version import __version__


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
    `duration_s` is from the first to the last message of the roles that a dive needs.

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
        "origin": _origin(dive.origin),
        "beacons": _records(beacon_rows(solution)),
        "learned": [_plain_numbers(asdict(parameter)) for parameter in solution.learned],
        "starts": {m: _start(start, dive.start_ns) for m, start in solution.starts.items()},
        "methods": {m: _method_summary(m, solution.innovations, comparison) for m in methods},
        "verdict": asdict(solution.verdict),
        "uncertainty_95_m": median_radius_m(solution),
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


def _origin(origin: Origin | None) -> dict[str, Any] | None:
    if origin is None:
        return None
    place = {"latitude_deg": origin.latitude_deg, "longitude_deg": origin.longitude_deg}
    return {**place, "from": origin.source}


def _records(rows: Rows) -> list[dict[str, Any]]:
    """A dictionary a row."""
    columns = {
        name: [values[1][place] for place in values[0]] if isinstance(values, tuple) else values
        for name, values in rows.items()
    }
    records = (dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True))
    return [_plain_numbers(record) for record in records]


def _plain_numbers(values: Mapping[str, Any]) -> dict[str, Any]:
    """The same with Python's own numbers, and null for what is not finite."""
    plain = {k: v.item() if isinstance(v, np.generic) else v for k, v in values.items()}
    return {k: _finite(v) if isinstance(v, float) else v for k, v in plain.items()}


def _check(check: Check) -> dict[str, Any]:
    return _plain_numbers(asdict(check)) | {"ok": bool(check.ok)}


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _start(start: Start, start_ns: int) -> dict[str, Any]:
    values = _plain_numbers(asdict(start))
    del values["t_s"]
    return {"time": utc_text(to_utc_ns(start_ns, np.array([start.t_s])), "ns")[0], **values}
