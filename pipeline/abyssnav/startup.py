# SPDX-License-Identifier: Apache-2.0
"""How a process of ours begins, for speed alone: what it may skip, and how it keeps memory."""

import gc
import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from typing import Final

#: One heap for all threads, to which large arrays go back, where glibc gives the memory.  Left
#: alone, it gives each thread a heap of its own, where what others have freed is not found again
#: (a quarter of a day's memory), and large arrays fresh pages each time (a third of all page
#: faults).  Variable of a process yet to begin, number in malloc.h for one that runs, and value.
_MALLOC: Final = (
    ("MALLOC_ARENA_MAX", -8, 1),
    ("MALLOC_MMAP_THRESHOLD_", -3, 1 << 25),
    ("MALLOC_TRIM_THRESHOLD_", -1, 1 << 28),
)
#: For processes to be started: a tenth less than when each sets it for itself.
MALLOC_ENVIRONMENT: Final = {name: str(value) for name, _, value in _MALLOC}


def tune_gc() -> None:
    """Let the garbage collector look seldom: imports leave 50,000 objects, none of them garbage."""
    gc.set_threshold(100_000)


def tune_malloc() -> None:
    """Set `MALLOC_ENVIRONMENT` for this process; nothing where there is no glibc."""
    import ctypes

    with suppress(AttributeError, OSError):
        for _, parameter, value in _MALLOC:
            ctypes.CDLL(None).mallopt(parameter, value)


def use_one_blas_thread() -> None:
    """Keep NumPy's matrix library to one thread, in a process that has not imported it yet.

    Matrices are small, and a second process works beside: more threads spin while they wait for
    each other (a day's smoother took five times the processor time).  Sums do not depend on the
    number of cores then.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def use_one_memory_pool() -> None:
    """Let pyarrow, in a process that has not imported it yet, take memory where NumPy does.

    A pool of its own keeps what is free for itself, 30 MB after a day's tables.
    """
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")


def give_back_memory() -> None:
    """Return to the system what was freed; nothing where there is no glibc."""
    import ctypes

    with suppress(AttributeError, OSError):
        ctypes.CDLL(None).malloc_trim(0)


def importable(modules: Iterable[str]) -> list[str]:
    """Those modules whose package is installed, in their order."""
    return [name for name in modules if find_spec(name.split(".")[0]) is not None]


@contextmanager
def block_pandas_import() -> Iterator[None]:
    """Let no pandas be imported meanwhile.

    pyarrow imports it with its first array, to ask whether it was given a Series: a third of the
    time that a dive takes, and nothing in a dive is one.
    """
    finder = _NoPandas()
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)


class _NoPandas:
    """Finder of modules that knows of no pandas."""

    def find_spec(self, name: str, *_: object) -> None:
        if name == "pandas":
            raise ModuleNotFoundError("No module named 'pandas'", name=name)
