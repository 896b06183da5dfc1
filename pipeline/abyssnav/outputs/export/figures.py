# SPDX-License-Identifier: Apache-2.0
"""Figures for papers: tracks on a plan and errors over time, as PNG and SVG."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from abyssnav.errors import ConfigError
from abyssnav.outputs.export.source import Exported
from abyssnav.outputs.palette import method_colour

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_WIDTH_IN: Final = 6.7  # 170 mm, a page's text width
_LOST: Final = ("ekf_ungated",)


def write_png(source: Exported, folder: Path) -> list[Path]:
    """Plan and errors at 300 dots an inch."""
    return _write(source, folder, "png")


def write_svg(source: Exported, folder: Path) -> list[Path]:
    """Plan and errors as drawings that can be edited."""
    return _write(source, folder, "svg")


def _write(source: Exported, folder: Path, kind: str) -> list[Path]:
    try:
        import matplotlib as mpl
    except ModuleNotFoundError:
        raise ConfigError(f"export to {kind} needs matplotlib: pip install matplotlib") from None
    look: Any = {"svg.hashsalt": source.name, "svg.fonttype": "none", "font.size": 9.0}
    look |= {"axes.grid": True, "grid.linewidth": 0.4, "grid.color": "#d5dde3"}
    figures = {"plan": _plan, **{f"error_{name}": _errors for name in _references(source)}}
    paths = []
    with mpl.rc_context(look):
        for name, make in figures.items():
            paths.append(folder / f"{source.name}_{name}.{kind}")
            figure = make(source, name.removeprefix("error_"))
            stamp = {"Date": None} if kind == "svg" else {"Software": f"abyssnav {source.version}"}
            figure.savefig(paths[-1], dpi=300, metadata=stamp, bbox_inches="tight")
    return paths


def _references(source: Exported) -> list[str]:
    return sorted({reference for _, reference in source.errors})


def _plan(source: Exported, _: str) -> "Figure":
    from matplotlib.figure import Figure

    figure = Figure(figsize=(_WIDTH_IN, _WIDTH_IN))
    axes = figure.add_subplot()
    dots: dict[str, Any] = {"s": 4, "color": method_colour("fix"), "label": "fix", "zorder": 1.5}
    axes.scatter(source.fixes["east_m"], source.fixes["north_m"], **dots)
    for method, track in source.tracks.items():
        if method not in _LOST or len(source.tracks) == 1:  # unasked, it would set the extent
            colour = method_colour(method)
            axes.plot(track["east_m"], track["north_m"], color=colour, lw=1.0, label=method)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("east [m]")
    axes.set_ylabel("north [m]")
    axes.legend(loc="best", frameon=False)
    return figure


def _errors(source: Exported, reference: str) -> "Figure":
    from matplotlib.figure import Figure

    figure = Figure(figsize=(_WIDTH_IN, 0.5 * _WIDTH_IN))
    axes = figure.add_subplot()
    shown = {m: e for (m, r), e in source.errors.items() if r == reference}
    start_ns = min(int(e["time_ns"][0]) for e in shown.values())
    for method in (*source.tracks, "fix"):
        if method in shown:
            hours = (shown[method]["time_ns"] - start_ns) / 3.6e12
            sparse = len(hours) < 2 or np.median(np.diff(hours)) > 5.0 / 3600
            style, marker = ("", ".") if sparse else ("-", "")
            values, colour = shown[method]["distance_m"], method_colour(method)
            axes.plot(
                hours, values, color=colour, label=method, ls=style, marker=marker, ms=3, lw=0.9
            )
    axes.set_yscale("log")
    axes.set_xlabel("dive time [h]")
    axes.set_ylabel("error to truth [m]" if reference == "truth" else "distance to fixes [m]")
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncol=4, frameon=False)
    return figure
