# SPDX-License-Identifier: Apache-2.0
"""Rows of text as HTML, every character of them escaped."""

from collections.abc import Iterable, Sequence
from html import escape
from importlib import resources
from string import Template
from typing import Final

from abyssnav.errors import printable
from abyssnav.outputs.palette import level_colour, method_colour
from abyssnav.outputs.presentation import CALM, Column, Headline, TextTable
from abyssnav.tables import Reason
from abyssnav.version import __version__

#: A table of no more rows is not broken over two sheets.
_SHORT_ROWS: Final = 15


def head(title: str, scripts: bool = False) -> str:
    """What each page begins with, up to its own style: nothing may be loaded or sent."""
    template = (resources.files("abyssnav.outputs.html") / "head.html").read_text("utf-8")
    return Template(template).substitute(
        title=escape(printable(title)),
        version=escape(__version__),
        scripts="script-src 'unsafe-inline'; img-src data: blob:;" if scripts else "",
    )


def tables(parts: Iterable[TextTable]) -> str:
    """Tables one below the other; those without rows are left out."""
    return "".join(table(part) for part in parts)


def table(shown: TextTable) -> str:
    """One table with its caption; nothing where there is no row."""
    if not shown.rows:
        return ""
    top = "".join(f"<th{_side(column)}>{escape(column.title)}</th>" for column in shown.columns)
    span = "wide short" if len(shown.rows) <= _SHORT_ROWS else "wide"
    body = "".join(f"<tr>{_cells(shown.columns, row)}</tr>" for row in shown.rows)
    return (
        f'<div class="{span}"><table id="{escape(shown.name)}">'
        f"<caption>{escape(shown.title)}</caption>"
        f"<thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def fact_tiles(pairs: Iterable[tuple[str, str]]) -> str:
    """A tile for each fact."""
    return "".join(
        f'<div class="tile"><span>{escape(name)}</span><b>{escape(value)}</b></div>'
        for name, value in pairs
    )


def verdict_banner(headline: Headline, reasons: Sequence[Reason]) -> str:
    """Verdict in colour and words, its reasons with what was seen and what to do."""
    radius = f" <b>{escape(headline.radius)}.</b>" if headline.radius else ""
    listed = "".join(
        f"<li><b>{escape(printable(reason.cause))}</b> {escape(printable(reason.seen))} "
        f"<em>{escape(printable(reason.advice))}</em></li>"
        for reason in reasons
    )
    return (
        f'<section class="verdict {escape(headline.level)}" id="verdict">'
        f"<p>{level_mark(headline.level, headline.word)} {escape(headline.sentence)}{radius}</p>"
        f"{f'<ol>{listed}</ol>' if listed else ''}</section>"
    )


def level_mark(level: str, word: str) -> str:
    """The word of a verdict on its colour."""
    colour = level_colour(level)
    return f'<b class="level" style="background:{colour}">{escape(word)}</b>'


def _cells(columns: Sequence[Column], row: Sequence[str]) -> str:
    return "".join(
        f"<td{_side(column)}>{_cell(column, cell)}</td>"
        for column, cell in zip(columns, row, strict=True)
    )


def _side(column: Column) -> str:
    return "" if column.kind == "number" else ' class="text"'


def _cell(column: Column, cell: str) -> str:
    text = escape(cell)
    if column.kind == "method" and cell:
        return f'<i class="swatch" style="background:{method_colour(cell)}"></i>{text}'
    if column.kind == "state" and cell not in CALM:
        return f'<b class="bad">{text}</b>'
    return text
