# SPDX-License-Identifier: Apache-2.0
"""What a person sees: progress on stderr, tables on stdout, at most 100 columns."""

import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from textwrap import wrap
from time import perf_counter
from typing import TYPE_CHECKING, Final

from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text

from abyssnav.errors import printable
from abyssnav.outputs import presentation
from abyssnav.outputs.palette import level_colour, method_colour
from abyssnav.outputs.presentation import CALM, LEVEL_WORDS, Column, TextTable, duration, metres
from abyssnav.tables import LEVELS, Check, Solution

if TYPE_CHECKING:
    from pathlib import Path

    import pandas as pd

    from abyssnav.batch import Outcome
    from abyssnav.calibrate import CalibrationResult
    from abyssnav.diff import Difference
    from abyssnav.plan import Plan
    from abyssnav.pose import Instants, Poses
    from abyssnav.read import Inspection
    from abyssnav.run import ProgressCallback, Result
    from abyssnav.score import DiveScore, PooledScore, TrackScore

COLUMNS = 100
#: The most findings that are spelt out; the rest is in summary.json.
FINDINGS = 8
#: What findings of damage begin with.
_DAMAGE: Final = ("cut short", "damaged")


def console(*, stderr: bool = False, quiet: bool = False) -> Console:
    """A console that takes text as it stands and is never wider than `COLUMNS`."""
    screen = Console(stderr=stderr, quiet=quiet, highlight=False, markup=False, emoji=False)
    known = screen.is_terminal or "COLUMNS" in os.environ
    screen.width = min(screen.width, COLUMNS) if known else COLUMNS
    return screen


@contextmanager
def stages(*, quiet: bool = False) -> Iterator["ProgressCallback"]:
    """Callback for the stages of a dive: a live line on a terminal, and a line for each."""
    screen = console(stderr=True, quiet=quiet)
    running: dict[str, None] = {}
    with screen.status("") as status:

        def on_progress(stage: str, took_s: float | None, messages: int) -> None:
            if took_s is None:
                running[stage] = None
            else:
                del running[stage]
                rate = messages / max(took_s, 1e-3)
                words = f"   {messages:,} messages, {rate:,.0f} a second" if messages else ""
                screen.print(f"  {stage:<10}{took_s:7.2f} s{words}", style="dim")
            status.update(f"{', '.join(list(running))} ...")

        yield on_progress


@contextmanager
def dives(total: int, *, quiet: bool = False) -> Iterator[Callable[["Outcome"], None]]:
    """Callback for the dives of a batch: a line a dive, and a bar with the time left below.

    Quiet, it says which dives were refused, and why, and nothing else.
    """
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    screen = console(stderr=True)
    columns = (
        BarColumn(bar_width=16),
        TextColumn("{task.completed} of {task.total} dives, {task.fields[refused]} refused,"),
        TextColumn("{task.fields[rate]:.2f} a second,"),
        TimeRemainingColumn(),
        TextColumn("left"),
    )
    began = perf_counter()
    count = {"fresh": 0, "refused": 0}
    with Progress(*columns, console=screen, disable=quiet or not screen.is_terminal) as bar:
        task = bar.add_task("", total=total, refused=0, rate=0.0)

        def on_outcome(outcome: "Outcome") -> None:
            count["fresh"] += outcome.fresh
            count["refused"] += outcome.status == "refused"
            rate = count["fresh"] / (perf_counter() - began)
            bar.update(task, advance=1, refused=count["refused"], rate=rate)
            if outcome.status == "refused" or not quiet:
                screen.print(_dive_line(outcome), soft_wrap=True)

        yield on_outcome


def _dive_line(outcome: "Outcome") -> Text:
    """Verdict, name, radius or reason, in one line."""
    line = Text()
    if outcome.status == "refused":
        line.append(f"{'REFUSED':<9}", style="bold red")
    else:
        line.append(f"{LEVEL_WORDS[outcome.verdict][0]:<9}", style=_level_style(outcome.verdict))
    words = printable(outcome.reason)
    if outcome.uncertainty_95_m is not None:
        words = f"95 % within {metres(outcome.uncertainty_95_m)} m"
    old = "" if outcome.fresh else "  (as it was)"
    line.append(f" {printable(outcome.dive)}  {words}{old}".rstrip())
    return line


def show_batch(outcomes: Sequence["Outcome"], out: str) -> None:
    """Pooled comparison, how many dives have which verdict, and where it is written."""
    import pandas as pd

    from abyssnav.batch import read_record

    screen = console()
    done = [outcome for outcome in outcomes if outcome.status == "done"]
    kept = sum(not outcome.fresh for outcome in done)
    pooled = read_record(out, "comparison.parquet") if done else None
    if pooled is not None:
        show_comparison(pd.read_parquet(BytesIO(pooled)))
    refused = len(outcomes) - len(done)
    dives = "dive" if len(done) == 1 else "dives"
    words = f"{len(done)} {dives} done ({kept} of them before), {refused} refused"
    screen.print(words, style="bold")
    counts = Text()
    for level in LEVELS:
        n = sum(outcome.verdict == level for outcome in done)
        counts.append(f"{LEVEL_WORDS[level][0]} {n}", style=_level_style(level))
        counts.append("  ")
    screen.print(counts)
    written = ["comparison.parquet"] if pooled is not None else []
    for name in ("index.html", "dives.parquet", *written, "batch.json"):
        screen.print(printable(f"  {out}/{name}"), soft_wrap=True)


def show_result(result: "Result") -> None:
    """Headline, verdict with its reasons, errors, checks that failed, and where the outputs are."""
    screen, solution = console(), result.solution
    screen.print()
    screen.print(_headline(solution, result.duration_s), style="bold")
    _show_verdict(screen, solution)
    _show_table(screen, presentation.result_table(solution, result.comparison))
    _show_checks(screen, presentation.failed_checks(solution))
    screen.print("wrote", style="bold")
    for path in sorted(result.folder.iterdir()):
        kept = "  (kept: not of this run)" if path.name in result.kept else ""
        screen.print(printable(f"  {path}{kept}"), soft_wrap=True)


def _show_verdict(screen: Console, solution: Solution) -> None:
    """The verdict in colour and words, and each reason: cause, seen, advice."""
    verdict = presentation.headline(solution)
    radius = f" {verdict.radius}." if verdict.radius else ""
    line = Text(f" {verdict.word} ", style=f"bold white on {level_colour(verdict.level)}")
    screen.print(line.append(f" {verdict.sentence}{radius}", style="not bold default on default"))
    for place, reason in enumerate(solution.verdict.reasons, 1):
        words = f"{place}. {printable(reason.cause)} {printable(reason.seen)}"
        screen.print(_wrapped(screen, words, indent="   "), soft_wrap=True)
        advice = _wrapped(screen, f"   -> {printable(reason.advice)}", indent="      ")
        screen.print(advice, style="bold", soft_wrap=True)


def show_left_out(names: Sequence[str]) -> None:
    """Dives that a pooled table leaves out as they are unusable."""
    if names:
        shown = ", ".join(names[:FINDINGS]) + (" ..." if len(names) > FINDINGS else "")
        words = f"{len(names)} unusable dives left out (--all pools them too): {shown}"
        console().print(words, style="bold", soft_wrap=True)


def show_poses(poses: "Poses", instants: "Instants", paths: Sequence["Path"]) -> None:
    """On stderr, as the poses may go to stdout: what was read, by which track, how many."""
    screen = console(stderr=True)
    n_outside = len(instants) - int(poses.inside.sum())
    screen.print(f"{len(instants):,} instants, {instants.source}", soft_wrap=True)
    outside = f"; {n_outside:,} outside the track are null" if n_outside else ""
    screen.print(f"poses by {poses.method}{outside}", soft_wrap=True)
    for path in paths:
        screen.print(f"wrote {path}", soft_wrap=True)


def show_comparison(table: "pd.DataFrame") -> None:
    """Statistics of the distances in metres, a row as the table has it; a table a voyage."""
    screen = console()
    if "voyage" in table.columns:
        for voyage, rows in table.groupby("voyage", sort=False):
            screen.print(f"\n{printable(str(voyage))}", style="bold")
            show_comparison(rows.drop(columns="voyage"))
        return
    shown = presentation.pooled_table(list(table.columns), table.to_dict("records"))
    _show_table(screen, shown)


def show_gates(table: "pd.DataFrame") -> None:
    """What the gates did, pooled by beacon and method."""
    _show_table(console(), presentation.pooled_gate_table(table.to_dict("records")))


def show_difference(difference: "Difference") -> None:
    """Settings, verdicts and tracks that differ; the first few replies one by one."""
    screen = console()
    for key, before, after in difference.settings:
        screen.print(printable(f"{key}: {before} -> {after}"), soft_wrap=True)
    for words, names in (("before", difference.only_before), ("after", difference.only_after)):
        if names:
            screen.print(printable(f"only {words}: {', '.join(names)}"), soft_wrap=True)
    changes = difference.verdicts.groupby(["method", "before", "after"], sort=False).size()
    rows = tuple((*map(str, names), f"{n:,}") for names, n in changes.items())
    columns = (Column("method", "method"), *(Column(name, "text") for name in ("before", "after")))
    if rows:
        _show_table(screen, TextTable("changes", "", (*columns, Column("replies")), rows))
    else:
        screen.print("no reply changed its verdict")
    for row in difference.verdicts.head(FINDINGS).to_dict("records"):
        reply = f"{row['dive']} {row['method']} ping {row['ping_id']} beacon {row['beacon_id']}"
        screen.print(printable(f"  {reply}: {row['before']} -> {row['after']}"), style="dim")
    if len(difference.verdicts) > FINDINGS:
        screen.print(f"  and {len(difference.verdicts) - FINDINGS:,} more", style="dim")
    if len(difference.tracks):
        show_comparison(difference.tracks)
    else:
        screen.print("no track moved")


def show_plan(plan: "Plan", folder: "Path") -> None:
    """What to expect of a layout, and what would change it."""
    from abyssnav.plan.page import enough, headline

    screen = console()
    screen.print(headline(plan))
    screen.print(enough(plan))
    rows = tuple(
        (change.what, metres(change.radius_95_m), metres(change.filter_radius_95_m))
        for change in plan.changes
    )
    columns = (Column("change", "text"), Column("final m"), Column("real time m"))
    title = "95 % radius along the track, median"
    _show_table(screen, TextTable("changes", title, columns, rows))
    if plan.origin is None:
        screen.print("! no origin: plan.geojson is in local metres", style="yellow")
    screen.print(f"Look at it: {folder}/plan.html")


def dives_of_calibration(*, quiet: bool = False) -> Callable[[str, str], None]:
    """Callback for the dives of a calibration: a line a dive."""
    screen = console(stderr=True, quiet=quiet)

    def on_dive(dive: str, reason: str) -> None:
        words = f"left out: {reason}" if reason else "read"
        screen.print(f"{printable(dive)}  {words}", style="yellow" if reason else "")

    return on_dive


def show_calibration(result: "CalibrationResult", settings: "Path", page: "Path") -> None:
    """What the dives determine, what is odd about them, and where it is written."""
    from abyssnav.calibrate.words import headline, remarks, short_table

    screen = console()
    screen.print(headline(result))
    _show_table(screen, short_table(result.estimates))
    for sentence in remarks(result):
        _look(screen, printable(sentence))
    screen.print(f"Settings: {settings}, a further --config of run and batch")
    screen.print(f"Look at it: {page}")


def show_score(result: "TrackScore") -> None:
    """Errors of a track, what it claimed, and what was left out."""
    screen = console()
    screen.print(
        f"{result.n} positions: rms {metres(result.rms_m)}, median {metres(result.median_m)}, "
        f"95 % within {metres(result.p95_m)}, largest {metres(result.max_m)} m; "
        f"mean {metres(result.mean_m)}, std {metres(result.std_m)} m"
    )
    if result.nees is not None and result.inside_95 is not None:
        screen.print(
            f"NEES {result.nees:.2f} (2 is exact); {100 * result.inside_95:.1f} % within their "
            f"own 95 % ellipse, {metres(result.radius_95_m)} m"
            + (f", {result.sharpness:.2f} of what it must be" if result.sharpness else "")
        )
    if result.x_filter is not None and result.x_smoother is not None:
        screen.print(
            f"{result.x_filter:.2f} times the bound of a filter, {result.x_smoother:.2f} times "
            "that of a smoother"
        )
    if result.outliers_accepted is not None and result.good_rejected is not None:
        screen.print(
            f"{100 * result.outliers_accepted:.1f} % of the wrong replies let in, "
            f"{100 * result.good_rejected:.1f} % of the others thrown out"
        )
    if result.start_s > 0:
        screen.print(f"first position {result.start_s:.0f} s after the reference's", style="dim")
    for remark in result.remarks:
        _look(screen, remark)


def show_scores(rows: Sequence["DiveScore"], pooled: Sequence["PooledScore"]) -> None:
    """A row a kind of dive, and what there is no score of."""
    screen = console()
    _show_table(screen, presentation.score_table([row.plain() for row in pooled]))
    for row in rows:
        if row.reason:
            _look(screen, f"{row.dive}: {row.reason}")


def show_inspection(inspection: "Inspection") -> None:
    """Topics, the roles they play, and what is odd about the log."""
    screen = console()
    _show_topics(screen, inspection)
    for name, extras in inspection.extras:
        for record in extras.metadata:
            pairs = ", ".join(f"{key} = {value}" for key, value in record.pairs.items())
            screen.print(printable(f"metadata of {name}: {record.name}: {pairs:.300}"))
        for file in extras.attachments:
            kind = f"{file.media_type}, {file.size_bytes:,} bytes"
            screen.print(printable(f"attachment of {name}: {file.name} ({kind})"))
    for finding in inspection.findings:
        _look(screen, f"{finding.what}: {finding.where}: {finding.detail}")
    for one in inspection.conventions:
        _look(screen, f"{one['name']}: {one['value']}: {one['seen']} Mend: {one['mend']}")
    for one in inspection.latencies:
        late = f"{one['late_s']:+.1f} +- {one['sigma_s']:.1f} s late against the other sensors"
        screen.print(f"stamps of {one['sensor']}: {late}, by the dive itself", style="dim")
    if any(finding.what.startswith(_DAMAGE) for finding in inspection.findings):
        screen.print(
            "abyssnav run uses all that could be read; above stands what was lost, by file and byte"
        )
    if not inspection.profile_fits and inspection.proposal:
        screen.print(
            "\nA profile that may fit this log (--profile-out FILE writes it):\n", style="bold"
        )
        lines = inspection.proposal.split("\n")
        screen.print("\n".join(map(printable, lines)), soft_wrap=True)


def _show_topics(screen: Console, inspection: "Inspection") -> None:
    """Each topic with its role; of more than a person looks through, those with roles first."""
    role_of: dict[str, str] = {}
    for role, where in inspection.roles.items():
        for topic in where.split(", "):
            role_of[topic] = f"{role_of[topic]}, {role}" if topic in role_of else role
    rows, entries = [], list(inspection.topics)
    if len(entries) > _MOST_TOPICS:
        entries = sorted(entries, key=lambda entry: entry.topic not in role_of)[:_MOST_TOPICS]
    for entry in entries:
        kind = entry.type.replace("/msg/", "/")
        kind += "" if entry.encoding == "cdr" else f" ({entry.encoding})"
        figures = (f"{entry.messages:,}", _figure(entry.rate_hz), _figure(entry.longest_gap_s))
        rows.append((entry.topic, role_of.get(entry.topic, ""), kind, *figures))
    names = tuple(Column(name, "text") for name in ("topic", "role", "type"))
    columns = (*names, *map(Column, ("messages", "Hz", "gap s")))
    _show_table(screen, TextTable("topics", "", columns, tuple(rows)))
    if len(inspection.topics) > len(entries):
        screen.print(f"and {len(inspection.topics) - len(entries):,} topics more: --json lists all")


def _headline(solution: Solution, duration_s: float) -> str:
    dive = solution.dive
    start = solution.starts.get("ekf_gated")
    confirmed = f"start confirmed after {start.t_s / 60:.1f} min" if start else "no start confirmed"
    return (
        f"{printable(dive.name)}: {duration(duration_s)}, {len(dive.replies):,} replies of "
        f"{len(dive.beacons)} beacons, {len(solution.fixes):,} fixes, {confirmed}"
    )


def _show_checks(screen: Console, checks: Sequence[Check]) -> None:
    for check in checks[:FINDINGS]:
        figure = f"{check.value:g} {check.unit}".strip()
        words = f": {check.detail}" if check.detail else ""
        limit = presentation.limit_words(check)
        _look(screen, f"{check.stage}: {check.name} {figure}, limit {limit}{words}")
    if len(checks) > FINDINGS:
        _look(screen, f"{len(checks) - FINDINGS} more in summary.json")


def _look(screen: Console, words: str) -> None:
    """One thing that a person should look at; its further lines are indented."""
    screen.print(_wrapped(screen, f"! {printable(words)}"), style="yellow", soft_wrap=True)


def _wrapped(screen: Console, words: str, indent: str = "  ") -> str:
    """Lines of at most the screen's width; the further ones are indented."""
    lines = wrap(
        words,
        screen.width,
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return "\n".join(lines)


def _show_table(screen: Console, table: TextTable) -> None:
    """A table, its figures in as many parts as the screen's width needs, so that none is cut."""
    widths = [_column_width(table, k) for k in range(len(table.columns))]
    keys = [k for k, column in enumerate(table.columns) if column.kind != "number"]
    left = [k for k in range(len(table.columns)) if k not in keys]
    while True:
        fits = len(left)
        while fits > 1 and _table_width(widths, keys + left[:fits]) > screen.width:
            fits -= 1
        screen.print(_rich_table(table, sorted(keys + left[:fits])))
        left = left[fits:]
        if not left:
            break
    if table.title:
        screen.print(table.title, style="dim")


#: Topics that a person looks through on a screen.
_MOST_TOPICS: Final = 1000
#: What a column of text keeps where the others need room: it folds.
_LEAST_TEXT: Final = 24


def _column_width(table: TextTable, place: int) -> int:
    column = table.columns[place]
    cells = [*column.title.replace(": ", "\n").split("\n"), *(row[place] for row in table.rows)]
    width = max(map(cell_len, cells))
    return min(width, _LEAST_TEXT) if column.kind == "text" else width


def _table_width(widths: Sequence[int], places: Sequence[int]) -> int:
    """Characters of a line: the columns, two blanks between them and one at each end."""
    return sum(widths[k] for k in places) + 2 * len(places)


def _rich_table(table: TextTable, places: Sequence[int]) -> Table:
    """Some columns of a table; texts give way where a line is too long, figures do not."""
    from rich import box

    shown = Table(
        box=box.SIMPLE_HEAD,
        header_style="bold",
        pad_edge=False,
        padding=(0, 1),
        collapse_padding=True,
    )
    columns = [table.columns[k] for k in places]
    for column, place in zip(columns, places, strict=True):
        shown.add_column(
            Text(column.title.replace(": ", "\n")),
            justify="right" if column.kind == "number" else "left",
            no_wrap=column.kind != "text",
            min_width=_column_width(table, place),
            overflow="fold",
        )
    for row in table.rows:
        shown.add_row(*(_cell(c, row[k]) for c, k in zip(columns, places, strict=True)))
    return shown


def _cell(column: Column, cell: str) -> Text:
    if column.kind == "method":
        return Text(cell, style=method_colour(cell))
    return Text(cell, style="yellow" if column.kind == "state" and cell not in CALM else "")


def _level_style(level: str) -> str:
    return f"bold {level_colour(level)}"


def _figure(value: float | None) -> str:
    return "" if value is None or math.isnan(value) else f"{value:,.1f}"
