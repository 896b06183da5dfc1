# SPDX-License-Identifier: Apache-2.0
"""The command `abyssnav`, which `python -P -m abyssnav` is too.

Whoever stops it (Ctrl-C, SIGTERM) reads one line, from the first instant on: nothing is imported
before the signals are looked after.
"""

import gc
import signal
import sys
import warnings
from types import FrameType


class _Stopped(BaseException):
    """A signal, as an exception that nobody else catches: what was begun is cleared up."""


def _stop(number: int, _: FrameType | None) -> None:
    signal.signal(number, signal.SIG_IGN)  # once is enough, and clearing up takes a moment
    raise _Stopped(number)


def main() -> None:
    """Run the command line; stopped by a signal, say so and end with 128 and its number."""
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is not signal.SIG_IGN:  # as a shell leaves it behind an &
            signal.signal(number, _stop)
    if not sys.warnoptions:  # a library's warning is for whoever works on us: python -W default
        warnings.simplefilter("ignore")
    try:
        from abyssnav.cli import main as run_command_line

        run_command_line()
    except _Stopped as stopped:
        number = signal.Signals(stopped.args[0])
        name = "Ctrl-C" if number is signal.SIGINT else number.name
        sys.stderr.write(f"abyssnav: stopped by {name}\n")
        sys.exit(128 + number)
    finally:
        gc.freeze()  # what ends takes its memory along: no last look at all objects for garbage


if __name__ == "__main__":  # a worker of `batch` imports this module too
    main()
