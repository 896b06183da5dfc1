# SPDX-License-Identifier: Apache-2.0
"""A calibration as one self-contained page."""

from collections.abc import Callable, Sequence
from html import escape
from importlib import resources
from itertools import cycle
from string import Template

import numpy as np

from abyssnav.calibrate.campaign import CalibrationResult
from abyssnav.calibrate.evidence import SurveyResiduals
from abyssnav.calibrate.words import (
    LEVELS,
    correlation_table,
    dive_table,
    estimate_table,
    headline,
    remarks,
)
from abyssnav.errors import printable
from abyssnav.outputs.html.render import head, level_mark, table
from abyssnav.outputs.palette import level_colour
from abyssnav.tables import Float
from abyssnav.version import __version__

#: Of the plot of a survey, and the room left of it, in pixels of the page.
_PLOT_PX, _EDGE_PX = (860.0, 260.0), 56.0
_DOTS, _SECTOR_DEG = 3000, 30.0
_COLOURS = ("#1d6fb8", "#b45a00", "#1a7f45", "#8a63f5", "#c22a2a", "#5b6b78")


def page(result: CalibrationResult, settings: str) -> str:
    """HTML of a calibration, without any reference to a network.

    Parameters
    ----------
    settings : the TOML that goes with it
    """
    template = (resources.files("abyssnav.calibrate") / "calibrate.html").read_text("utf-8")
    return Template(template).substitute(
        head=head("Calibration"),
        version=escape(__version__),
        title=f"Calibration from {len(result.dives)} dives",
        headline=escape(headline(result)),
        remarks=remark_list(remarks(result)),
        survey=_surveys(result),
        estimates=_coloured(table(estimate_table(result))),
        dives=table(dive_table(result)),
        correlation=table(correlation_table(result)),
        settings=escape(printable_lines(settings)),
        green=level_colour("good"),
        amber=level_colour("check"),
        red=level_colour("unusable"),
    )


def _surveys(result: CalibrationResult) -> str:
    """A plot of residuals by azimuth for every survey."""
    if not result.surveys:
        return ""
    figures = "".join(
        f"<figure>{_by_azimuth(residuals)}<figcaption>{escape(printable(name))}: one-way range "
        f"measured less predicted, {_scatter(residuals)}; grey is not used.</figcaption></figure>"
        for name, residuals in result.surveys.items()
    )
    return (
        "<h2>Survey of the beacons</h2><p>Residuals by azimuth from the beacon to the ship. A wave "
        "once round is a place that is wrong, a shift of all a depth, turn-around or sound speed."
        f"</p>{figures}"
    )


def _scatter(residuals: SurveyResiduals) -> str:
    used_m = residuals.residual_m[residuals.used]
    return f"{np.sqrt(np.mean(used_m**2)):.2f} m rms of {len(used_m)}" if len(used_m) else "none"


def _by_azimuth(residuals: SurveyResiduals) -> str:
    """Dots of residual over azimuth, a colour a beacon, with the mean of every 30 degrees."""
    width, height = _PLOT_PX
    used = residuals[residuals.used]
    top_m = 4.0 * float(np.sqrt(np.mean(used.residual_m**2))) if len(used) else 1.0

    def pixel(azimuth_deg: Float, residual_m: Float) -> Float:
        x = _EDGE_PX + (width - 2 * _EDGE_PX) * azimuth_deg / 360
        y = 20 + 0.5 * (height - 44) * (1 - residual_m / top_m)
        return np.column_stack([x, y])

    parts = [_grid(top_m, pixel)]
    colours = dict(zip(np.unique(residuals.beacon_id).tolist(), cycle(_COLOURS), strict=False))
    shown = residuals[np.abs(residuals.residual_m) < top_m]
    shown = shown[:: max(1, len(shown) // _DOTS)]
    dots = pixel(shown.azimuth_deg, shown.residual_m).tolist()
    for (x, y), number, is_used in zip(
        dots, shown.beacon_id.tolist(), shown.used.tolist(), strict=True
    ):
        colour = colours[number] if is_used else "#9aa7b1"
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="1.8" fill="{colour}"/>')
    for number, colour in colours.items():
        own = used[used.beacon_id == number]
        sector = (own.azimuth_deg // _SECTOR_DEG).astype(int)
        count = np.bincount(sector, minlength=int(360 / _SECTOR_DEG))
        mean_m = np.bincount(sector, own.residual_m, minlength=len(count)) / np.maximum(count, 1)
        middle_deg = np.asarray(_SECTOR_DEG * (np.arange(len(count)) + 0.5), dtype=np.float64)
        way = "L".join(f"{x:.1f} {y:.1f}" for x, y in pixel(middle_deg, mean_m)[count > 2].tolist())
        title = f"<title>beacon {number}</title>"
        parts.append(
            f'<path d="M{way}" fill="none" stroke="{colour}" stroke-width="2">{title}</path>'
            if way
            else ""
        )
    key = " ".join(f'<tspan fill="{c}">beacon {n}</tspan>' for n, c in colours.items())
    parts.append(f'<text x="{_EDGE_PX}" y="12" class="tick">{key}</text>')
    return (
        f'<svg viewBox="0 0 {width:.0f} {height:.0f}" role="img" '
        f'aria-label="Residuals by azimuth">{"".join(parts)}</svg>'
    )


def _grid(top_m: float, pixel: Callable[[Float, Float], Float]) -> str:
    parts = []
    for share in (-1.0, -0.5, 0.0, 0.5, 1.0):
        (x0, y), (x1, _) = pixel(np.array([0.0, 360.0]), np.full(2, share * top_m)).tolist()
        parts.append(
            f'<path d="M{x0:.1f} {y:.1f}H{x1:.1f}" class="grid"/>'
            f'<text x="2" y="{y + 4:.1f}" class="tick">{share * top_m:+.2f} m</text>'
        )
    for azimuth, name in zip((0, 90, 180, 270, 360), "NESWN", strict=True):
        x = float(pixel(np.array([float(azimuth)]), np.zeros(1))[0, 0])
        parts.append(f'<text x="{x - 4:.1f}" y="{_PLOT_PX[1] - 6}" class="tick">{name}</text>')
    return "".join(parts)


def remark_list(sentences: Sequence[str]) -> str:
    """What a person should know, as a list; nothing where there is nothing."""
    if not sentences:
        return ""
    items = "".join(f"<li>{escape(printable(sentence))}</li>" for sentence in sentences)
    return f'<ul class="remarks">{items}</ul>'


def printable_lines(text: str) -> str:
    """Text of several lines, each of them printable."""
    return "\n".join(printable(line) for line in text.splitlines())


def _coloured(html: str) -> str:
    """The verdicts' words on their colours."""
    for word, level in LEVELS.items():
        cell = f'<td class="text">{word}</td>'
        html = html.replace(cell, f'<td class="text">{level_mark(level, word)}</td>')
    return html
