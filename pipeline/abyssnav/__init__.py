# SPDX-License-Identifier: Apache-2.0
"""abyssnav: an AUV's raw dive log in, a track people trust out.

    log -> dive -> solution -> outputs

`read` takes MCAP files to a `Log` (as recorded), `align` to a `Dive` (one clock, checked),
`navigate` to a `Solution` (tracks, fixes, innovations); `compare`, `pose` and `write` hand it on.

    >>> import abyssnav as an
    >>> solution = an.navigate(an.align(an.read("sample_logs/clean.mcap")))
    >>> solution.verdict.level
    'good'
    >>> track = solution.tracks["smoother"]    # polars.DataFrame(track), track.to_pandas() ...
    >>> track.position_enu_m.shape == (len(track), 3)
    True

Glossary
--------
ENU
    Local frame: x east, y north, z up, metres from the dive's origin.  `depth_m` is positive down.
body
    Forward, starboard, down.  A heading is clockwise from true north, in radians.
time
    `_ns` int64 nanoseconds UTC at rest; `_s` float64 seconds since the dive's start in between.
ping, reply, cycle
    One interrogation; one beacon's answer to it; the replies that one fix uses.
travel time
    Two-way: reply heard minus ping, the beacon's turn-around included.

The equations are those of "Deep Sea AUV Navigation Using Multiple Acoustic Beacons"; docstrings
name them as Eq. 1 to Eq. 11.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any, Final

from abyssnav.version import __version__

if TYPE_CHECKING:
    from abyssnav.config import Config
    from abyssnav.errors import ClockError, ConfigError, PipelineError, ReadError, SolveError
    from abyssnav.library import (
        align,
        compare,
        inspect,
        load_profile,
        load_settings,
        navigate,
        pose,
        read,
        run_dive,
        write,
    )
    from abyssnav.profile import Profile
    from abyssnav.tables import Comparison, Dive, Log, Reference, Solution, Track

__all__ = [
    "ClockError", "Comparison", "Config", "ConfigError", "Dive", "Log", "PipelineError", "Profile",
    "ReadError", "Reference", "Solution", "SolveError", "Track", "__version__", "align", "compare",
    "inspect", "load_profile", "load_settings", "navigate", "pose", "read", "run_dive", "write",
]  # fmt: skip

#: Name -> module that has it; `import abyssnav` itself imports none of them.
_HOMES: Final = {
    name: module
    for module, names in {
        "config": ["Config"],
        "errors": ["ClockError", "ConfigError", "PipelineError", "ReadError", "SolveError"],
        "profile": ["Profile"],
        "tables": ["Comparison", "Dive", "Log", "Reference", "Solution", "Track"],
        "library": [
            "align", "compare", "inspect", "load_profile", "load_settings", "navigate", "pose",
            "read", "run_dive", "write",
        ],
    }.items()
    for name in names
}  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)


class _Door(ModuleType):
    """A package whose functions keep their names although modules of it are called the same.

    Python hangs each module that is imported into its package: `abyssnav.read`, the folder, would
    take the place of the function.  `from abyssnav.read import ...` is as ever.
    """

    def __setattr__(self, name: str, value: object) -> None:
        if not (name in _HOMES and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Door
