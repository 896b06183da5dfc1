# SPDX-License-Identifier: Apache-2.0
"""Figures for papers: tracks on a plan and errors over time, as PNG and SVG."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from abyssnav.errors import ConfigError
from abyssnav.outputs.export.source import Exported, Table
from abyssnav.outputs.palette import BEACON, REFERENCE, method_colour
from abyssnav.outputs.presentation import BEST

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_WIDTH_IN: Final = 6.7  # 170 mm, a page's text width


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
    """Tracks framed on the one that stands for the dive; beacons about it in a small plan."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(_WIDTH_IN, 0.72 * _WIDTH_IN), layout="constrained")
    axes, wide = figure.subplots(1, 2, width_ratios=(3.2, 1.0))
    best = next((m for m in BEST if m in source.tracks), next(iter(source.tracks)))
    dots: dict[str, Any] = {"s": 4, "color": method_colour("fix"), "label": "fix", "zorder": 1.5}
    axes.scatter(source.fixes["east_m"], source.fixes["north_m"], **dots)
    if source.reference is not None:
        _line(axes, source.reference, REFERENCE, "reference")
    if best == "smoother":
        _band(axes, source)
    for method, track in source.tracks.items():
        for plan in (axes, wide) if method == best else (axes,):
            _line(plan, track, method_colour(method), method)
    _ends(axes, source.tracks[best])
    _frame(axes, source.tracks[best])
    wide.scatter(source.beacons["east_m"], source.beacons["north_m"], c=BEACON, marker="^", s=24)
    rows = (source.beacons[name] for name in ("name", "east_m", "north_m"))
    for name, east_m, north_m in zip(*rows, strict=True):
        wide.annotate(str(name), (east_m, north_m), (0, 5), textcoords="offset points", ha="center")
    wide.set_title("beacons", fontsize=9)
    wide.margins(0.25)
    wide.set_aspect("equal", adjustable="box", anchor="N")
    wide.tick_params(labelsize=6)
    wide.locator_params(nbins=3)
    axes.set_xlabel("east [m]")
    axes.set_ylabel("north [m]")
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncol=4, frameon=False, fontsize=8)
    return figure


def _line(axes: Any, track: Table, colour: str, label: str) -> None:
    axes.plot(track["east_m"], track["north_m"], color=colour, lw=1.0, label=label)


def _ends(axes: Any, track: Table) -> None:
    for row, marker, label in ((0, "o", "start"), (-1, "s", "end")):
        place = track["east_m"][row], track["north_m"][row]
        axes.plot(*place, marker, color="black", ms=4, label=label, zorder=3)


def _frame(axes: Any, track: Table) -> None:
    """Limits of one track, whatever else is drawn."""
    east_m, north_m = track["east_m"], track["north_m"]
    margin_m = 0.06 * max(np.ptp(east_m), np.ptp(north_m), 20.0)
    axes.set_xlim(east_m.min() - margin_m, east_m.max() + margin_m)
    axes.set_ylim(north_m.min() - margin_m, north_m.max() + margin_m)
    axes.set_aspect("equal", adjustable="box")


def _band(axes: Any, source: Exported) -> None:
    """The 95 % radius to either side of the smoother's track."""
    track = source.tracks["smoother"]
    radius_m = source.radius_95_m(track["time_ns"])
    if len(radius_m) < 2 or not np.isfinite(radius_m).any():
        return
    along_m = np.gradient(np.column_stack([track["east_m"], track["north_m"]]), axis=0)
    across = along_m[:, ::-1] * [1.0, -1.0] / np.maximum(np.hypot(*along_m.T), 1e-9)[:, None]
    offset_m = (across * radius_m[:, None])[np.isfinite(radius_m)]
    middle_m = np.column_stack([track["east_m"], track["north_m"]])[np.isfinite(radius_m)]
    outline_m = np.concatenate([middle_m + offset_m, (middle_m - offset_m)[::-1]])
    axes.fill(*outline_m.T, color=method_colour("smoother"), alpha=0.25, lw=0, label="95 % radius")


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
