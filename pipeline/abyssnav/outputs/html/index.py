# SPDX-License-Identifier: Apache-2.0
"""The page over all dives of a batch: plans, errors, what to look at, links to the reports."""

import json
import math
from collections.abc import Sequence
from html import escape
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any
from urllib.parse import quote

import numpy as np

from abyssnav import __version__
from abyssnav.outputs.html.data import keep_corners
from abyssnav.outputs.html.words import BEST, duration
from abyssnav.outputs.palette import BEACON, method_colour
from abyssnav.tables import Float

_PLAN_PX = 120
_PLAN_POINTS = 300


def write_index(outcomes: Sequence[tuple[str, str, str]], out: Path, path: Path) -> None:
    """Write `index.html` over the dives below `out`.

    Parameters
    ----------
    outcomes : (dive, status, reason), status `done` or `refused`
    """
    rows = [
        _done_row(dive, out / dive) if status == "done" else _refused_row(dive, reason)
        for dive, status, reason in outcomes
    ]
    n_done = sum(status == "done" for _, status, _ in outcomes)
    page = Template((resources.files("abyssnav.outputs.html") / "index.html").read_text("utf-8"))
    text = page.substitute(
        version=escape(__version__),
        done=n_done,
        refused=len(outcomes) - n_done,
        rows="".join(rows),
        methods="".join(f"<th>{escape(method)}</th>" for method in _SHOWN),
    )
    path.write_text(text, encoding="utf-8")


_SHOWN = ("dead_reckoning", "kf_fix", "ekf_ungated", "ekf_gated", "ekf", "smoother")


def _done_row(dive: str, folder: Path) -> str:
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    looks = [check["name"].replace("_", " ") for check in summary["checks"] if not check["ok"]]
    said = ", ".join(looks) if looks else "good"
    span = duration(summary["duration_s"])
    link = f"{quote(dive)}/report.html"
    errors = "".join(f"<td>{_rms(summary['methods'].get(method))}</td>" for method in _SHOWN)
    return (
        f'<tr><td><a href="{link}">{_plan(folder)}</a></td>'
        f'<td><a href="{link}">{escape(dive)}</a><span>{span}</span></td>'
        f'<td class="{"bad" if looks else "good"}">{escape(said)}</td>{errors}</tr>'
    )


def _refused_row(dive: str, reason: str) -> str:
    return (
        f'<tr><td></td><td>{escape(dive)}</td><td class="bad" colspan="{1 + len(_SHOWN)}">'
        f"refused: {escape(reason)}</td></tr>"
    )


def _rms(method: dict[str, Any] | None) -> str:
    """RMS to truth, or in brackets to the fixes."""
    errors = (method or {}).get("errors") or {}
    if errors.get("truth"):
        return f"{errors['truth']['rms_m']:,.2f}"
    if errors.get("fix"):
        return f"({errors['fix']['rms_m']:,.2f})"
    return "–"


def _plan(folder: Path) -> str:
    """Small drawing of the best method's track."""
    import pyarrow.parquet as pq

    for method in BEST:
        wanted = ["east_m", "north_m"]
        rows = pq.read_table(
            folder / "tracks.parquet", columns=wanted, filters=[("method", "==", method)]
        )
        if len(rows):
            enu_m = np.column_stack([rows["east_m"].to_numpy(), rows["north_m"].to_numpy()])
            return _drawing(enu_m[keep_corners(enu_m, _PLAN_POINTS)], method)
    return ""


def _drawing(enu_m: Float, method: str) -> str:
    low, high = enu_m.min(axis=0), enu_m.max(axis=0)
    scale = (_PLAN_PX - 12) / max(float((high - low).max()), 1.0)
    at = (enu_m - 0.5 * (low + high)) * [scale, -scale] + _PLAN_PX / 2
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in at)
    x, y = at[0]
    bar_m = 10.0 ** math.floor(math.log10(max(60.0 / scale, 1e-3)))
    return (
        f'<svg width="{_PLAN_PX}" height="{_PLAN_PX}" role="img" aria-label="plan, north up">'
        f'<polyline points="{points}" fill="none" stroke="{method_colour(method)}" '
        f'stroke-width="1.4"/><circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{BEACON}"/>'
        f'<path d="M4 {_PLAN_PX - 4} h{bar_m * scale:.1f}" stroke="currentColor"/>'
        f'<text x="4" y="{_PLAN_PX - 8}">{bar_m:g} m</text></svg>'
    )
