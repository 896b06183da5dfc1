# SPDX-License-Identifier: Apache-2.0
"""What is said in words: events on the timeline, tables and checks as a document."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from abyssnav.outputs import presentation
from abyssnav.outputs.palette import ACCEPTED, BOUND, REJECTED, rgb
from abyssnav.outputs.presentation import Column, TextTable
from abyssnav.outputs.rerun.logger import RerunLogger, drawable
from abyssnav.tables import VERDICTS, Comparison, Float, Solution

#: Level -> sign before its word: the document has no colours of its own.
LEVEL_SIGNS: Final = {"good": "✔", "check": "⚠", "unusable": "⚠ ⚠"}
#: What Markdown would take as more than a letter.
_ESCAPED: Final = str.maketrans({sign: f"\\{sign}" for sign in "\\`*[]|<>~!"})
_LOCKS: Final = {"bottom lock": ACCEPTED, "no bottom lock": REJECTED}
_VERDICT_COLOURS: Final = {
    word: {"healthy": ACCEPTED, "silent": BOUND}.get(word, REJECTED) for word in VERDICTS
}


def log_events(log: RerunLogger, solution: Solution) -> None:
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
    clock = np.datetime_as_string(utc, unit="s")
    lines = [
        f"{when[11:]} {drawable(text)}" for when, (_, _, text) in zip(clock, events, strict=True)
    ]
    levels = [level for _, level, _ in events]
    log.columns(
        "events", t_s, lambda rows: rr.TextLog.columns(text=lines[rows], level=levels[rows])
    )


def log_states(log: RerunLogger, solution: Solution, method: str, parts: Mapping[int, str]) -> None:
    """Bottom lock, and what the gate's self-watch says of each beacon, as states over time."""
    velocity = solution.dive.velocity
    if len(velocity):
        changes = np.append(0, np.flatnonzero(np.diff(velocity.valid.astype(int))) + 1)
        words = np.where(velocity.valid[changes], "bottom lock", "no bottom lock").tolist()
        _log_state(log, "state/DVL", velocity.t_s[changes], words, _LOCKS)
    watches = [solution.watch[method]] if method in solution.watch else []
    for watch, (beacon_id, part) in itertools.product(watches, parts.items()):
        part_watch = watch[watch.beacon_id == beacon_id]
        words = [VERDICTS[k] for k in part_watch.verdict]
        _log_state(log, f"state/gate/{part}", part_watch.t_begin_s, words, _VERDICT_COLOURS)


def _log_state(
    log: RerunLogger, path: str, t_s: Float, words: Sequence[str], colours: Mapping[str, str]
) -> None:
    import rerun as rr

    look = rr.StateConfiguration(
        values=list(colours), colors=[rgb(colour) for colour in colours.values()]
    )
    log.static(path, look)
    log.columns(path, t_s, lambda rows: rr.StateChange.columns(state=words[rows]))


def report_text(solution: Solution, comparison: Comparison, opening: str = "") -> str:
    """Verdict, its reasons, how to read the recording, and the tables, as Markdown."""
    shown = presentation.headline(solution)
    radius = f" **{shown.radius}.**" if shown.radius else ""
    lines = [f"# {LEVEL_SIGNS[shown.level]} {shown.word}", "", f"{shown.sentence}{radius}", ""]
    for place, reason in enumerate(solution.verdict.reasons, 1):
        cause, evidence, advice = map(_plain, (reason.cause, reason.seen, reason.advice))
        lines += [f"{place}. **{cause}** {evidence} *{advice}*", ""]
    lines += [
        "### How to read this",
        "",
        drawable(presentation.reading_guide(solution)),
        opening,
        "",
    ]
    tables = [
        *presentation.comparison_tables(comparison),
        presentation.accuracy_table(solution),
        presentation.learned_table(solution),
        *presentation.gate_tables(solution),
        presentation.position_table(solution),
        presentation.check_table((*solution.dive.checks, *solution.checks)),
    ]
    return "\n".join(lines + [line for table in tables for line in _markdown(table)])


def _markdown(table: TextTable) -> list[str]:
    if not table.rows:
        return []
    head = [_plain(column.title) for column in table.columns]
    sides = ["---:" if column.kind == "number" else ":---" for column in table.columns]
    body = ["| " + " | ".join(map(_cell, table.columns, row)) + " |" for row in table.rows]
    rule = f"|{'|'.join(sides)}|"
    return [f"### {_plain(table.title)}", "", f"| {' | '.join(head)} |", rule, *body, ""]


def _cell(column: Column, cell: str) -> str:
    text = _plain(cell)
    return f"**{text}**" if column.kind == "state" and cell not in presentation.CALM else text


def _plain(text: str) -> str:
    """Text that Markdown takes as text, whatever a log has put into it."""
    return drawable(text).translate(_ESCAPED)
