# SPDX-License-Identifier: Apache-2.0
"""The page over all dives of a batch: verdicts, radii, plans, errors, links to the reports."""

import json
from collections import Counter
from collections.abc import Sequence
from html import escape
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any, Final
from urllib.parse import quote

import numpy as np

from abyssnav.errors import printable
from abyssnav.outputs.html.plan import drawing
from abyssnav.outputs.html.render import head, level_mark
from abyssnav.outputs.presentation import BEST, LEVEL_WORDS, MISSING, duration, metres
from abyssnav.tables import LEVELS
from abyssnav.version import __version__

_PLAN_PX: Final = 110
#: Methods whose errors have a column, as far as any dive has them.
_COMPARED: Final = ("dead_reckoning", "kf_fix", "ekf_ungated", "ekf_gated", "ekf", "smoother")


def write_index(outcomes: Sequence[tuple[str, str, str]], out: Path, path: Path) -> None:
    """Write `index.html` over the dives below `out`.

    Parameters
    ----------
    outcomes : (dive, status, reason), status `done` or `refused`
    """
    summaries = {
        dive: json.loads((out / dive / "summary.json").read_text(encoding="utf-8"))
        for dive, status, _ in outcomes
        if status == "done"
    }
    rows = [
        _done_row(dive, out / dive, summaries[dive])
        if dive in summaries
        else _refused_row(dive, reason)
        for dive, _, reason in outcomes
    ]
    files = resources.files("abyssnav.outputs.html")
    page = Template((files / "index.html").read_text("utf-8"))
    text = page.substitute(
        head=head("Dives", scripts=True),
        version=escape(__version__),
        counts=_counts(summaries, len(outcomes) - len(summaries)),
        rows="".join(rows),
        methods="".join(f'<th data-sort="number">{escape(name)}</th>' for name in _COMPARED),
        script=(files / "index.js").read_text("utf-8"),
    )
    path.write_text(text, encoding="utf-8")


def _counts(summaries: dict[str, Any], refused: int) -> str:
    """How many dives have which verdict, in colour and words."""
    count = Counter(_level(summary) for summary in summaries.values())
    marks = [f"{level_mark(level, LEVEL_WORDS[level][0])} {count[level]}" for level in LEVELS]
    marks.append(f"{level_mark('refused', 'REFUSED')} {refused}")
    return " ".join(f"<span>{mark}</span>" for mark in marks)


def _done_row(dive: str, folder: Path, summary: dict[str, Any]) -> str:
    level, reasons = _level(summary), summary["verdict"]["reasons"]
    cause = escape(printable(reasons[0]["cause"])) if reasons else ""
    radius_m = summary.get("uncertainty_95_m")
    link, span = f"{quote(dive)}/report.html", duration(summary["duration_s"])
    errors = "".join(_error_cell(method, summary["methods"].get(method)) for method in _COMPARED)
    return (
        f'<tr><td class="plan"><a href="{link}" aria-label="report">{_plan(folder)}</a></td>'
        f'<td data-value="{escape(dive)}"><a href="{link}">{escape(printable(dive))}</a>'
        f"<small>{span}</small></td>"
        f'<td data-value="{LEVELS.index(level)}">{level_mark(level, LEVEL_WORDS[level][0])}'
        f"<small>{cause}</small></td>{_number_cell(radius_m, '95 %')}{errors}</tr>"
    )


def _refused_row(dive: str, reason: str) -> str:
    return (
        f'<tr><td></td><td data-value="{escape(dive)}">{escape(printable(dive))}</td>'
        f'<td data-value="{len(LEVELS)}" colspan="{2 + len(_COMPARED)}">'
        f"{level_mark('refused', 'REFUSED')} <small>{escape(printable(reason))}</small></td></tr>"
    )


def _level(summary: dict[str, Any]) -> str:
    return str(summary["verdict"]["level"])


def _number_cell(value: float | None, name: str, brackets: bool = False) -> str:
    if value is None:
        return f'<td data-name="{name}">{MISSING}</td>'
    words = f"({metres(value)})" if brackets else metres(value)
    return f'<td data-name="{name}" data-value="{value:.6g}">{words}</td>'


def _error_cell(name: str, method: dict[str, Any] | None) -> str:
    """RMS to truth, or in brackets to the fixes."""
    errors = (method or {}).get("errors") or {}
    for reference in ("truth", "fix"):
        if errors.get(reference):
            return _number_cell(errors[reference]["rms_m"], name, brackets=reference == "fix")
    return _number_cell(None, name)


def _plan(folder: Path) -> str:
    """Small drawing of the track that stands for the dive; nothing of mere dead reckoning."""
    import pyarrow.parquet as pq

    if not (folder / "tracks.parquet").is_file():  # not among output.files
        return ""
    for method in BEST[:-1]:
        wanted = ["east_m", "north_m"]
        rows = pq.read_table(
            folder / "tracks.parquet", columns=wanted, filters=[("method", "==", method)]
        )
        if len(rows):
            enu_m = np.column_stack([rows["east_m"].to_numpy(), rows["north_m"].to_numpy()])
            return drawing(enu_m, method, _PLAN_PX)
    return "<small>no acoustic track</small>"
