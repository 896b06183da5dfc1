# SPDX-License-Identifier: Apache-2.0
"""What a person sees: progress on stderr, tables on stdout, at most 100 columns."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from statistics import median
from textwrap import wrap
from time import perf_counter
from typing import TYPE_CHECKING, Final

from rich.console import Console
from rich.table import Table
from rich.text import Text

from abyssnav.errors import printable
from abyssnav.outputs.html.words import duration
from abyssnav.outputs.palette import method_colour
from abyssnav.tables import METHODS, OPTIONAL_METHODS, Check, Comparison, Solution

if TYPE_CHECKING:
    from pathlib import Path

    import pandas as pd

    from abyssnav.batch import Outcome
    from abyssnav.diff import Difference
    from abyssnav.plan import Plan
    from abyssnav.pose import Instants, Poses
    from abyssnav.read import Inspection
    from abyssnav.run import ProgressCallback, Result
    from abyssnav.score import TrackScore

COLUMNS = 100
#: The most findings that are spelt out; the rest is in summary.json.
FINDINGS = 8
#: What findings of damage begin with.
_DAMAGE: Final = ("cut short", "damaged")


def console(*, stderr: bool = False, quiet: bool = False) -> Console:
    """A console that takes text as it stands and is never wider than `COLUMNS`."""
    found = Console(stderr=stderr, quiet=quiet, highlight=False, markup=False, emoji=False)
    found.width = min(found.width, COLUMNS) if found.is_terminal else COLUMNS
    return found


@contextmanager
def stages(*, quiet: bool = False) -> Iterator["ProgressCallback"]:
    """Function that hears of stages: a live line on a terminal, and a line for each that ended."""
    screen = console(stderr=True, quiet=quiet)
    going: dict[str, None] = {}
    with screen.status("") as status:

        def tell(stage: str, took_s: float | None, messages: int) -> None:
            if took_s is None:
                going[stage] = None
            else:
                del going[stage]
                rate = messages / max(took_s, 1e-3)
                words = f"   {messages:,} messages, {rate:,.0f} a second" if messages else ""
                screen.print(f"  {stage:<10}{took_s:7.2f} s{words}", style="dim")
            status.update(f"{', '.join(list(going))} ...")

        yield tell


@contextmanager
def dives(total: int, *, quiet: bool = False) -> Iterator[Callable[["Outcome"], None]]:
    """Function that hears of each dive: a bar on a terminal, else a line a dive."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    screen = console(stderr=True, quiet=quiet)
    columns = (
        BarColumn(),
        TextColumn("{task.completed} of {task.total} dives, {task.fields[refused]} refused,"),
        TextColumn("{task.fields[rate]:.2f} a second,"),
        TimeRemainingColumn(),
        TextColumn("left"),
    )
    began = perf_counter()
    count = {"fresh": 0, "refused": 0}
    with Progress(*columns, console=screen, disable=not screen.is_terminal) as bar:
        task = bar.add_task("", total=total, refused=0, rate=0.0)

        def tell(outcome: "Outcome") -> None:
            count["fresh"] += outcome.fresh
            count["refused"] += outcome.status == "refused"
            rate = count["fresh"] / (perf_counter() - began)
            bar.update(task, advance=1, refused=count["refused"], rate=rate)
            words = outcome.reason or ("" if outcome.fresh else "as it was")
            if outcome.reason or not screen.is_terminal:
                screen.print(f"{outcome.status:<8} {outcome.dive}  {words}", soft_wrap=True)

        yield tell


def show_batch(outcomes: Sequence["Outcome"], out: str) -> None:
    """Pooled comparison, how many dives were done, and where it is written."""
    import pandas as pd

    from abyssnav.remote import content, is_url

    screen = console()
    refused = sum(outcome.status == "refused" for outcome in outcomes)
    kept = sum(not outcome.fresh for outcome in outcomes)
    done = len(outcomes) - refused
    pooled = f"{out}/comparison.parquet"
    if done:
        source = BytesIO(content(pooled)) if is_url(out) else pooled
        show_comparison(pd.read_parquet(source))
    screen.print(f"{done} dives done ({kept} of them before), {refused} refused", style="bold")
    for name in ("index.html", "dives.parquet", "comparison.parquet", "batch.json"):
        screen.print(f"  {out}/{name}", soft_wrap=True)


def show_result(result: "Result") -> None:
    """Headline, comparison table, what a person should look at, and where the outputs are."""
    screen, solution = console(), result.solution
    screen.print()
    screen.print(_headline(solution, result.duration_s), style="bold")
    screen.print(_by_reference(result.comparison, solution))
    if solution.accuracy is not None and solution.verdict.level != "unusable":
        radius_m = solution.accuracy.uncertainty_95_m.tolist()
        screen.print(
            f"smoother, judged without truth: 95 % within {median(radius_m):.1f} m, "
            f"worst leg {max(radius_m):.1f} m"
        )
    checks = [check for check in (*solution.dive.checks, *solution.checks) if not check.ok]
    _show_checks(screen, checks)
    screen.print("wrote", style="bold")
    for path in sorted(result.folder.iterdir()):
        screen.print(f"  {path}", soft_wrap=True)


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
            screen.print(f"\n{voyage}", style="bold")
            show_comparison(rows.drop(columns="voyage"))
        return
    names = [name for name in table.columns if not name.endswith("_m")]
    interval = "mean_low_m" in table.columns
    bounds = ("mean_low_m", "mean_high_m")
    figures = [name for name in table.columns if name.endswith("_m") and name not in bounds]
    shown = _table()
    for name in names:
        shown.add_column(
            "to" if name == "reference" else name,
            justify="right" if table[name].dtype.kind in "iuf" else "left",
            no_wrap=name != "dive",  # that gives way where a row is too long
            overflow="fold",
        )
    for name in figures:
        shown.add_column(name.removesuffix("_m"), justify="right", no_wrap=True)
    if interval:
        shown.add_column("mean, 95 %", justify="right", no_wrap=True)
    for row in table.to_dict("records"):
        cells = [_method(str(row[n])) if n == "method" else Text(str(row[n])) for n in names]
        low, high = (_metres(row[name]) if interval else "" for name in bounds)
        numbers = [_metres(row[name]) for name in figures]
        shown.add_row(*cells, *numbers, *([f"{low} - {high}" if low else ""] if interval else []))
    screen.print(shown)
    screen.print("horizontal distances in metres", style="dim")


def show_gates(table: "pd.DataFrame") -> None:
    """What the gates did, pooled by beacon and method."""
    screen, shown = console(), _table()
    for name in ("beacon", "dives", "method", "replies", "accepted", "95 %", "mean NIS", "sees, m"):
        shown.add_column(name, justify="left" if name == "method" else "right", no_wrap=True)
    for row in table.to_dict("records"):
        low, high = (100 * row[name] for name in ("accepted_low", "accepted_high"))
        shown.add_row(
            str(row["beacon_id"]),
            str(row["dives"]),
            _method(row["method"]),
            f"{row['replies']:,}",
            f"{100 * row['accepted']:.1f} %",
            "" if math.isnan(low) else f"{low:.1f} - {high:.1f}",
            _metres(row["mean_nis"]),
            _metres(row["smallest_visible_outlier_m"]),
        )
    screen.print(shown)
    screen.print("sees: the smallest outlier of one-way range that the gate rejects", style="dim")


def show_difference(found: "Difference") -> None:
    """Settings, verdicts and tracks that differ; the first few replies one by one."""
    screen = console()
    for key, before, after in found.settings:
        screen.print(f"{key}: {before} -> {after}", soft_wrap=True)
    for words, dives in (("before", found.only_before), ("after", found.only_after)):
        if dives:
            screen.print(f"only {words}: {', '.join(dives)}", soft_wrap=True)
    changes = found.verdicts.groupby(["method", "before", "after"], sort=False).size()
    shown = _table()
    for name in ("method", "before", "after"):
        shown.add_column(name)
    shown.add_column("replies", justify="right")
    for (method, before, after), n in changes.items():
        shown.add_row(_method(method), before, after, f"{n:,}")
    screen.print(shown if len(changes) else "no reply changed its verdict")
    for row in found.verdicts.head(FINDINGS).to_dict("records"):
        reply = f"{row['dive']} {row['method']} ping {row['ping_id']} beacon {row['beacon_id']}"
        screen.print(f"  {reply}: {row['before']} -> {row['after']}", style="dim")
    if len(found.verdicts) > FINDINGS:
        screen.print(f"  and {len(found.verdicts) - FINDINGS:,} more", style="dim")
    if len(found.tracks):
        show_comparison(found.tracks)
    else:
        screen.print("no track moved")


def show_plan(plan: "Plan", folder: Path) -> None:
    """What to expect of a layout, and what would change it."""
    from abyssnav.plan.page import enough, headline

    screen = console()
    screen.print(headline(plan), markup=False)
    screen.print(enough(plan), markup=False)
    table = _table("95 % radius along the track, median")
    for name in ("change", "final m", "real time m"):
        table.add_column(name, justify="left" if name == "change" else "right")
    for change in plan.changes:
        radii = _metres(change.radius_95_m), _metres(change.filter_radius_95_m)
        table.add_row(change.what, *radii)
    screen.print(table)
    if plan.origin is None:
        screen.print("! no origin: plan.geojson is in local metres", style="yellow")
    screen.print(f"Look at it: {folder}/plan.html", markup=False)


def show_score(result: "TrackScore") -> None:
    """Errors of a track, what it claimed, and what was left out."""
    screen = console()
    screen.print(
        f"{result.n} positions: rms {_metres(result.rms_m)}, median {_metres(result.median_m)}, "
        f"95 % within {_metres(result.p95_m)}, largest {_metres(result.max_m)} m; "
        f"mean {_metres(result.mean_m)}, std {_metres(result.std_m)} m"
    )
    if result.nees is not None and result.inside_95 is not None:
        screen.print(
            f"NEES {result.nees:.2f} (2 is exact); {100 * result.inside_95:.1f} % within their "
            "own 95 % ellipse"
        )
    for remark in result.remarks:
        screen.print(f"! {remark}", style="yellow", markup=False)


def show_inspection(inspection: "Inspection") -> None:
    """Topics, the roles they play, and what is odd about the log."""
    screen = console()
    role_of: dict[str, str] = {}
    for role, topics in inspection.roles.items():
        for topic in topics.split(", "):
            role_of[topic] = f"{role_of[topic]}, {role}" if topic in role_of else role
    shown = _table()
    for name in ("topic", "role", "type"):
        shown.add_column(name, overflow="fold")
    for name in ("messages", "Hz", "gap s"):
        shown.add_column(name, justify="right", no_wrap=True)
    for found in inspection.topics:
        kind = found.type.replace("/msg/", "/")
        kind += "" if found.encoding == "cdr" else f" ({found.encoding})"
        figures = (f"{found.messages:,}", _figure(found.rate_hz), _figure(found.longest_gap_s))
        role = role_of.get(found.topic, "")
        shown.add_row(printable(found.topic), role, printable(kind), *figures)
    screen.print(shown)
    for name, extras in inspection.extras:
        for record in extras.metadata:
            pairs = ", ".join(f"{key} = {value}" for key, value in record.pairs.items())
            screen.print(printable(f"metadata of {name}: {record.name}: {pairs:.300}"))
        for file in extras.attachments:
            kind = f"{file.media_type}, {file.size_bytes:,} bytes"
            screen.print(printable(f"attachment of {name}: {file.name} ({kind})"))
    for finding in inspection.findings:
        _look(screen, f"{finding.what}: {finding.where}: {finding.detail}")
    if any(finding.what.startswith(_DAMAGE) for finding in inspection.findings):
        screen.print(
            "abyssnav run uses all that could be read; above stands what was lost, by file and byte"
        )
    if not inspection.profile_fits and inspection.proposal:
        screen.print(
            "\nA profile that may fit this log (--profile-out FILE writes it):\n", style="bold"
        )
        screen.print(inspection.proposal, soft_wrap=True)


def _headline(solution: Solution, duration_s: float) -> str:
    dive = solution.dive
    start = solution.starts.get("ekf_gated")
    confirmed = f"start confirmed after {start.t_s / 60:.1f} min" if start else "no start confirmed"
    return (
        f"{dive.name}: {duration(duration_s)}, {len(dive.replies):,} replies of "
        f"{len(dive.beacons)} beacons, {len(solution.fixes):,} fixes, {confirmed}"
    )


def _by_reference(comparison: Comparison, solution: Solution) -> Table:
    """One row a method: error to the fixes, the paper's Tables 1-2, and to truth."""
    rows = {
        (str(comparison.method[i]), str(comparison.reference[i])): i for i in range(len(comparison))
    }
    truth = any(reference == "truth" for _, reference in rows)
    shown = _table(caption="horizontal distance in metres")
    shown.add_column("method")
    for name in ("accepted", "to fix: mean", "std"):
        shown.add_column(name, justify="right")
    for name in ("to truth: mean", "std", "rms", "p95", "max") if truth else ():
        shown.add_column(name, justify="right")
    for method in (*METHODS, *OPTIONAL_METHODS):
        to_fix, to_truth = rows.get((method, "fix")), rows.get((method, "truth"))
        if to_fix is None and to_truth is None:
            continue
        cells = [
            _metres(None if to_fix is None else getattr(comparison, name)[to_fix])
            for name in ("mean_m", "std_m")
        ]
        cells += [
            _metres(None if to_truth is None else getattr(comparison, name)[to_truth])
            for name in ("mean_m", "std_m", "rms_m", "p95_m", "max_m")
            if truth
        ]
        shown.add_row(_method(method), _accepted(solution, method), *cells)
    return shown


def _accepted(solution: Solution, method: str) -> str:
    gate = solution.statistics.get(method)
    if gate is None or not gate.replies.sum():
        return ""
    return f"{100 * gate.accepted.sum() / gate.replies.sum():.0f} %"


def _show_checks(screen: Console, checks: Sequence[Check]) -> None:
    for check in checks[:FINDINGS]:
        figure = f"{check.value:g} {check.unit}, limit {check.limit:g}".replace(" ,", ",")
        words = f": {check.detail}" if check.detail else ""
        _look(screen, f"{check.stage}: {check.name} {figure}{words}")
    if len(checks) > FINDINGS:
        _look(screen, f"{len(checks) - FINDINGS} more in summary.json")


def _look(screen: Console, words: str) -> None:
    """One thing that a person should look at; its further lines are indented."""
    lines = wrap(
        f"! {words}",
        screen.width,
        subsequent_indent="  ",
        break_long_words=False,
        break_on_hyphens=False,
    )
    screen.print("\n".join(lines), style="yellow", soft_wrap=True)


def _table(caption: str | None = None) -> Table:
    from rich import box

    return Table(
        box=box.SIMPLE_HEAD,
        header_style="bold",
        caption=caption,
        caption_justify="left",
        caption_style="dim",
        pad_edge=False,
        padding=(0, 1),
        collapse_padding=True,
    )


def _method(name: str) -> Text:
    return Text(name, style=method_colour(name))


def _metres(value: float | None) -> str:
    if value is None or math.isnan(value):
        return ""
    return f"{value:,.2f}" if value < 100 else f"{value:,.0f}"


def _figure(value: float | None) -> str:
    return "" if value is None or math.isnan(value) else f"{value:,.1f}"
