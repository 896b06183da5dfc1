# SPDX-License-Identifier: Apache-2.0
"""What is said in words: events on the timeline, tables and checks as a document."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.tables import Comparison, Solution
from pipeline.view.sender import Sender


def log_events(log: Sender, solution: Solution) -> None:
    """Starts, what the methods met, and stretches without bottom lock, as a text log."""
    import rerun as rr

    velocity = solution.dive.velocity
    events = [
        (start.t_s, "INFO", f"{method}: start confirmed ({start.how}, {start.cycles} cycles)")
        for method, start in solution.starts.items()
        if (start.t_s, method) not in {(e.t_s, e.method) for e in solution.events}
    ]
    events += [
        (e.t_s, "INFO" if e.what.startswith("start") else "WARN", f"{e.method}: {e.what}")
        for e in solution.events
    ]
    changes = np.flatnonzero(np.diff(velocity.valid.astype(int))) + 1
    for k in changes.tolist():
        locked = bool(velocity.valid[k])
        text = "DVL: bottom lock again" if locked else "DVL: bottom lock lost"
        events.append((float(velocity.t_s[k]), "INFO" if locked else "WARN", text))
    events.sort()
    t_s = np.array([t for t, _, _ in events])
    utc = np.datetime64(solution.dive.start_ns, "ns") + np.rint(t_s * 1e9).astype("m8[ns]")
    at = np.datetime_as_string(utc, unit="s")
    lines = [f"{when[11:]} {text}" for when, (_, _, text) in zip(at, events, strict=True)]
    levels = [level for _, level, _ in events]
    log.columns(
        "events", t_s, lambda rows: rr.TextLog.columns(text=lines[rows], level=levels[rows])
    )


def report_text(solution: Solution, comparison: Comparison) -> str:
    """Comparison, gate statistics and checks as Markdown."""
    dive = solution.dive
    lines: list[str] = []
    for name, title in (("truth", "Error against truth [m]"), ("fix", "Distance to the fixes [m]")):
        rows = comparison[comparison.reference == name]
        numbers = (rows.mean_m, rows.std_m, rows.rms_m, rows.median_m, rows.p95_m, rows.max_m)
        cells = [
            (method, n, *(f"{x:.2f}" for x in row))
            for method, n, *row in zip(rows.method, rows.n, *numbers, strict=True)
        ]
        lines += _table(
            title, ("method", "n", "mean", "std", "rms", "median", "95 %", "max"), cells
        )
    names = {int(k): name for k, name in zip(dive.beacons.id, dive.beacons.name, strict=True)}
    for method, s in solution.statistics.items():
        gate = zip(s.beacon_id, s.replies, s.accepted, s.gated, s.mean_nis, strict=True)
        lines += _table(
            f"Gate of {method}",
            ("beacon", "replies", "accepted", "gated", "mean NIS"),
            [(names.get(int(i), "") or i, n, a, g, f"{nis:.2f}") for i, n, a, g, nis in gate],
        )
    checks = [
        ("ok" if c.ok else "**look**", c.stage, c.name, f"{c.value:g} {c.unit}", c.detail)
        for c in sorted((*dive.checks, *solution.checks), key=lambda c: c.ok)
    ]
    return "\n".join(lines + _table("Checks", ("", "stage", "check", "value", "where"), checks))


def _table(title: str, head: Sequence[str], rows: Sequence[Sequence[Any]]) -> list[str]:
    if not rows:
        return []
    body = ["| " + " | ".join(_plain(cell) for cell in row) + " |" for row in rows]
    return [f"### {title}", "", f"| {' | '.join(head)} |", "|" + "---|" * len(head), *body, ""]


def _plain(value: Any) -> str:
    """Text that Markdown takes as text."""
    return str(value).replace("|", "\\|").replace("\n", " ").replace("<", "&lt;")
