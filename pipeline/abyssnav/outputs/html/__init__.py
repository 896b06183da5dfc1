# SPDX-License-Identifier: Apache-2.0
"""Stage report: one page that opens from disk, without a network, on a phone or on paper.

The page is a template with the tables in it, the plots' columns as base64 in one JSON block, and
plotly.js (basic bundle, MIT; `plotly-LICENSE.txt`), which stands gzipped beside this file.  A
content security policy forbids the page to load anything.
"""

import gzip
import json
from collections.abc import Mapping
from html import escape
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

from abyssnav.outputs.html import words
from abyssnav.outputs.html.data import ACCEPTED_POINTS, CURVE_POINTS, TRACK_POINTS, plot_data
from abyssnav.outputs.html.environment import beacon_table, surroundings
from abyssnav.tables import Comparison, Errors, Reference, Solution


def report(
    solution: Solution,
    comparison: Comparison,
    errors: Mapping[tuple[str, str], Errors],
    reference: Reference | None,
    summary: Mapping[str, Any],
    path: Path,
) -> None:
    """Write `report.html`.

    Parameters
    ----------
    summary : of `abyssnav.outputs.summary.summarise_dive`
    """
    here = resources.files("abyssnav.outputs.html")
    page = Template((here / "page.html").read_text("utf-8"))
    text = page.substitute(
        dive=escape(solution.dive.name),
        version=escape(str(summary["version"])),
        tiles=words.headline(solution, comparison, summary["duration_s"]),
        verdict=words.verdict(solution),
        comparison=words.comparison_tables(comparison),
        gates=words.gate_tables(solution),
        arrivals=words.arrival_table(solution),
        accuracy=words.accuracy_table(solution),
        beacons=beacon_table(solution.dive) + surroundings(solution.dive),
        sensors=words.sensor_table(solution),
        events=words.event_table(solution),
        checks=words.check_table(solution),
        findings=words.finding_table(summary),
        provenance=words.provenance(summary),
        track_points=f"{TRACK_POINTS:,}",
        curve_points=f"{CURVE_POINTS:,}",
        accepted_points=f"{ACCEPTED_POINTS:,}",
        data=script_json(plot_data(solution, errors, reference)),
        plotly=gzip.decompress((here / "plotly-basic.min.js.gz").read_bytes()).decode(),
        script=(here / "plots.js").read_text("utf-8"),
    )
    path.write_text(text, encoding="utf-8")


def script_json(value: Any) -> str:
    """JSON that cannot end the script element it stands in, nor break a line of it."""
    text = json.dumps(value, allow_nan=False, ensure_ascii=True, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace("&", "\\u0026")
