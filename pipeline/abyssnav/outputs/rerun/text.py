# SPDX-License-Identifier: Apache-2.0
"""What is said in words: events on the timeline, tables and checks as a document."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from abyssnav.outputs.palette import ACCEPTED, BOUND, REJECTED, rgb
from abyssnav.outputs.rerun.logger import Sender
from abyssnav.tables import VERDICTS, Comparison, Float, Solution

_LOCKS: Final = {"bottom lock": ACCEPTED, "no bottom lock": REJECTED}
_VERDICT_COLOURS: Final = {
    word: {"healthy": ACCEPTED, "silent": BOUND}.get(word, REJECTED) for word in VERDICTS
}


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


def log_states(log: Sender, solution: Solution, method: str, parts: Mapping[int, str]) -> None:
    """Bottom lock, and what the gate's self-watch says of each beacon, as states over time."""
    velocity = solution.dive.velocity
    if len(velocity):
        changes = np.append(0, np.flatnonzero(np.diff(velocity.valid.astype(int))) + 1)
        words = np.where(velocity.valid[changes], "bottom lock", "no bottom lock").tolist()
        _log_state(log, "state/DVL", velocity.t_s[changes], words, _LOCKS)
    watches = [solution.watch[method]] if method in solution.watch else []
    for watch, (beacon_id, part) in itertools.product(watches, parts.items()):
        mine = watch[watch.beacon_id == beacon_id]
        words = [VERDICTS[k] for k in mine.verdict]
        _log_state(log, f"state/gate/{part}", mine.t_begin_s, words, _VERDICT_COLOURS)


def _log_state(
    log: Sender, path: str, t_s: Float, words: Sequence[str], colours: Mapping[str, str]
) -> None:
    import rerun as rr

    look = rr.StateConfiguration(
        values=list(colours), colors=[rgb(colour) for colour in colours.values()]
    )
    log.static(path, look)
    log.columns(path, t_s, lambda rows: rr.StateChange.columns(state=words[rows]))


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
    if solution.accuracy is not None:
        legs = solution.accuracy
        hours = zip(legs.t_begin_s / 3600, legs.t_end_s / 3600, strict=True)
        told = zip(hours, legs.length_m, legs.uncertainty_95_m, strict=True)
        lines += _table(
            "Accuracy of the smoothed track, without truth",
            ("dive time [h]", "length [m]", "95 % radius [m]"),
            [(f"{a:.2f} - {b:.2f}", f"{m:,.0f}", f"{r:.2f}") for (a, b), m, r in told],
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
