# SPDX-License-Identifier: Apache-2.0
"""Stage report: one page that opens from disk, without a network, on a phone or on paper.

The page is a template with the tables in it, the plots' columns as base64 in one JSON block, and
plotly.js (basic bundle, MIT; `plotly-LICENSE.txt`), which stands gzipped beside this file.  Nothing
leads off the page: a content security policy forbids it to load or send anything, the plots have
no button but those named in `plots.js`, and the addresses that plotly.js knows are taken out of it.
"""

import gzip
import json
from collections.abc import Mapping
from html import escape
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any, Final

from abyssnav.errors import printable
from abyssnav.outputs import presentation
from abyssnav.outputs.html import render
from abyssnav.outputs.html.data import ACCEPTED_POINTS, CURVE_POINTS, plot_data
from abyssnav.outputs.html.plan import TRACK_POINTS, overview
from abyssnav.tables import Comparison, Evaluation, Solution

#: Addresses in plotly.js that a control of a plot could open or ask.
_ADDRESSES: Final = ("https://cloud.plotly.com/newchart", "https://cdn.plot.ly/un/")


def report(evaluation: Evaluation, summary: Mapping[str, Any], path: Path) -> None:
    """Write `report.html`.

    Parameters
    ----------
    summary : of `abyssnav.outputs.summary.summarise_dive`
    """
    files = resources.files("abyssnav.outputs.html")
    page = Template((files / "page.html").read_text("utf-8"))
    text = page.substitute(
        _text_parts(evaluation.solution, evaluation.comparison, summary),
        data=script_json(plot_data(evaluation.solution, evaluation.errors, evaluation.reference)),
        plotly=plotting_script(),
        script=(files / "plots.js").read_text("utf-8"),
    )
    path.write_text(text, encoding="utf-8")


def plotting_script() -> str:
    """plotly.js without any address that it could open."""
    packed = resources.files("abyssnav.outputs.html") / "plotly-basic.min.js.gz"
    script = gzip.decompress(packed.read_bytes()).decode()
    for address in _ADDRESSES:
        script = script.replace(address, "")
    return script


def _text_parts(
    solution: Solution, comparison: Comparison, summary: Mapping[str, Any]
) -> dict[str, str]:
    """All that the page says in words and tables."""
    dive, shown = solution.dive, presentation
    version = printable(summary["version"])
    checks = shown.check_table((*dive.checks, *solution.checks))
    return {
        "head": render.head(dive.name, scripts=True),
        "dive": escape(printable(dive.name)),
        "version": escape(version),
        "attribution": _attribution(summary),
        "profile": escape(printable(summary["profile"])),
        "verdict": render.verdict_banner(shown.headline(solution), solution.verdict.reasons),
        "tiles": render.fact_tiles(shown.facts(solution, comparison, summary["duration_s"])),
        "overview": overview(solution),
        "plan_note": _plan_note(solution),
        "paper": escape(shown.PAPER),
        "methods": render.table(shown.method_table(solution)),
        "comparison": render.tables(shown.comparison_tables(comparison)),
        "gates": render.tables(shown.gate_tables(solution)),
        "positions": render.table(shown.position_table(solution)),
        "arrivals": render.table(shown.arrival_table(solution)),
        "accuracy": render.table(shown.accuracy_table(solution)),
        "learned": render.table(shown.learned_table(solution)),
        "beacons": render.table(shown.beacon_table(dive))
        + render.table(shown.beacon_estimate_table(solution))
        + f"<p>{escape(shown.water_words(dive))}</p>",
        "sensors": render.table(shown.sensor_table(solution)),
        "events": render.table(shown.event_table(solution)),
        "checks": render.table(checks),
        "n_checks": f"{len(shown.failed_checks(solution))} of {len(checks.rows)}",
        "findings": render.table(shown.finding_table(summary)),
        "starts": render.table(shown.start_table(summary)),
        "inputs": render.table(shown.input_table(summary)),
        "settings": render.table(shown.setting_table(summary)),
        "track_points": f"{TRACK_POINTS:,}",
        "curve_points": f"{CURVE_POINTS:,}",
        "accepted_points": f"{ACCEPTED_POINTS:,}",
    }


def _attribution(summary: Mapping[str, Any]) -> str:
    """Who made the dive's data, for whom, and how they may be used, as far as settings say."""
    stated = summary["settings"]["attribution"]
    names = ("creator_name", "institution", "project", "license")
    words = " · ".join(stated[name] for name in names if stated[name])
    return f"<span>{escape(printable(words))}</span>" if words else ""


def _plan_note(solution: Solution) -> str:
    """What the plan shows, and what it does not."""
    if not presentation.is_positioned(solution):
        return (
            "Dead reckoning from an arbitrary point: the shape of the way, not where it lies. "
            "Beacons are left out, as the way has no place among them."
        )
    band = "; the band about it holds 95 %" if presentation.radius_words(solution) else ""
    return (
        f"East and north of the dive's origin, framed on {presentation.best_method(solution)}"
        f'{band}.<span class="screen"> Other methods are a click on their names away. Drag to '
        "zoom, double-click to go back.</span>"
    )


def script_json(value: Any) -> str:
    """JSON that cannot end the script element it stands in, nor break a line of it."""
    text = json.dumps(value, allow_nan=False, ensure_ascii=True, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace("&", "\\u0026")
