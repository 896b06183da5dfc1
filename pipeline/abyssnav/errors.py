# SPDX-License-Identifier: Apache-2.0
"""What the product refuses, in one family.

PipelineError
├── ReadError      the file: not MCAP, a role without a topic, a field that is not there
│   └── UnknownMethodError   a method by which a result has no track
├── ConfigError    the settings, the profile or the scenario
├── ClockError     the log's times
└── SolveError     the log's numbers: too few beacons, nothing to navigate with

Each message is one line that says what, where (file, topic, row) and what was there instead.
What can be lived with is not an error but a `abyssnav.tables.Check`.
"""

import difflib
from collections.abc import Iterable


class PipelineError(Exception):
    """Anything that ends a dive with one line and exit status 1."""


class ReadError(PipelineError):
    """The file cannot be used: what, in which file and topic, and what was there instead."""


class UnknownMethodError(ReadError):
    """A result has no track by that method."""

    def __init__(self, message: str, method: str = "") -> None:
        super().__init__(message)  # alone: from another process it comes back by these words
        self.method = method


class ConfigError(PipelineError):
    """The settings, profile or scenario cannot be used: which key, and the nearest known one."""


class ClockError(PipelineError):
    """The log's times cannot be used."""


class SolveError(PipelineError):
    """The log's numbers cannot be navigated with."""


def printable(text: str) -> str:
    """Text for a terminal: what is no letter, such as an escape sequence or a line's end, escaped.

    Topics, types and names of fields are strangers' words; none of them may move a cursor.
    """
    if text.isprintable():
        return text
    return "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in text)


def refusal_reason(fault: Exception) -> str:
    """Why one of many was left out, on one line: a refusal's words, or what went wrong here."""
    if isinstance(fault, MemoryError):
        return "out of memory"
    words = str(fault)
    if not isinstance(fault, PipelineError):
        words = f"fault in abyssnav itself: {type(fault).__name__}: {fault}"
    return printable(" ".join(words.split()))


def nearest_names(name: str, known: Iterable[str], cutoff: float = 0.0) -> list[str]:
    """The known name that is most like `name`, in a list; none is like it enough, an empty one."""
    return difflib.get_close_matches(name, list(known), n=1, cutoff=cutoff)


def nearest_hint(name: str, known: Iterable[str]) -> str:
    """What to add to "no such name": the nearest known one and all of them."""
    names = list(known)
    nearest = nearest_names(name, names)
    return f"; nearest: {nearest[0]}; known: {', '.join(names)}" if nearest else ""
