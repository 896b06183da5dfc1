# SPDX-License-Identifier: Apache-2.0
"""A calibration as one self-contained page."""

from collections.abc import Sequence
from html import escape
from importlib import resources
from string import Template

from abyssnav.calibrate.campaign import CalibrationResult
from abyssnav.calibrate.words import (
    LEVELS,
    correlation_table,
    dive_table,
    estimate_table,
    headline,
    remarks,
)
from abyssnav.errors import printable
from abyssnav.outputs.html.render import level_mark, table
from abyssnav.outputs.palette import level_colour
from abyssnav.version import __version__


def page(result: CalibrationResult, settings: str) -> str:
    """HTML of a calibration, without any reference to a network.

    Parameters
    ----------
    settings : the TOML that goes with it
    """
    template = (resources.files("abyssnav.calibrate") / "calibrate.html").read_text("utf-8")
    return Template(template).substitute(
        version=escape(__version__),
        title=f"Calibration from {len(result.dives)} dives",
        headline=escape(headline(result)),
        remarks=remark_list(remarks(result)),
        survey="",
        estimates=_coloured(table(estimate_table(result))),
        dives=table(dive_table(result)),
        correlation=table(correlation_table(result)),
        settings=escape(printable_lines(settings)),
        green=level_colour("good"),
        amber=level_colour("check"),
        red=level_colour("unusable"),
    )


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
