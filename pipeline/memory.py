# SPDX-License-Identifier: Apache-2.0
"""One heap for all threads, to which large arrays go back, where glibc gives the memory.

Left alone, it gives each thread a heap of its own, where what others have freed is not found again
(a quarter of a day's memory), and large arrays fresh pages each time (a third of all page faults).
"""

from contextlib import suppress
from typing import Final

#: Variable of a process yet to begin, number in malloc.h for one that runs, and value.
_MALLOC: Final = (
    ("MALLOC_ARENA_MAX", -8, 1),
    ("MALLOC_MMAP_THRESHOLD_", -3, 1 << 25),
    ("MALLOC_TRIM_THRESHOLD_", -1, 1 << 28),
)
#: For processes to be started: a tenth less than when each sets it for itself.
MALLOC_ENVIRONMENT: Final = {name: str(value) for name, _, value in _MALLOC}


def keep_freed_memory() -> None:
    """Set it for this process; nothing where there is no glibc."""
    import ctypes

    with suppress(AttributeError, OSError):
        for _, parameter, value in _MALLOC:
            ctypes.CDLL(None).mallopt(parameter, value)
