# SPDX-License-Identifier: Apache-2.0
"""How the recording opens: plan from above, innovations by beacon, errors, tables."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from abyssnav.outputs.palette import GRID, GROUND
from abyssnav.outputs.presentation import best_method, is_positioned, lost_methods
from abyssnav.outputs.rerun.plots import ESTIMATES
from abyssnav.tables import Errors, Float, Solution

if TYPE_CHECKING:
    import rerun.blueprint as rrb

#: Best first: whose innovations are shown first.
BEST_FILTER: Final = ("ekf", "ekf_gated", "ekf_ungated")
#: Whose errors no axis is stretched for.
_DRIFTING: Final = ("dead_reckoning", "ekf_ungated")
_TRAIL_S: Final = 900.0
_EYE_FIELD_RAD: Final = np.radians(55.0)  # the viewer's vertical field of view


@dataclass(frozen=True)
class Scene:
    """What the layout is made for: names of entities, and the ranges of their numbers."""

    methods: tuple[str, ...]
    lost: tuple[str, ...]  #: of `methods`, those whose track would hide all others
    best: str  #: of `methods`, or empty
    filters: tuple[str, ...]  #: methods with innovations, the best first
    beacons: tuple[str, ...]  #: their parts of entity paths
    first_ns: int
    last_ns: int
    centre_enu_m: Float  #: (3,) middle of beacons and trusted tracks
    extent_m: tuple[float, float]  #: east, north
    track_centre_enu_m: Float  #: (3,) the same of the trusted track alone
    track_extent_m: tuple[float, float]
    innovation_limit_s: float
    gate: float  #: gamma, or the paper's where there is no gate
    estimates: tuple[tuple[str, str], ...]  #: part of the entity path, title
    error_limit_m: float
    error_reference: str
    depth_range_m: tuple[float, float]
    has_map: bool  #: an origin, and tracks that lie where the vehicle was
    positioned: bool


def scene_of(
    solution: Solution, errors: Mapping[tuple[str, str], Errors], beacons: Sequence[str]
) -> Scene:
    """Scene of a solution: cameras and axes that show what the trusted methods did."""
    dive = solution.dive
    methods = tuple(solution.tracks)
    best = best_method(solution)
    trusted = [solution.tracks[m].position_enu_m for m in (best,) if m]
    centre_enu_m, extent_m = _frame([dive.beacons.position_enu_m, *trusted])
    track_centre_enu_m, track_extent_m = _frame(trusted)
    ends_s = [c for c in (dive.depth.t_s, dive.replies.t_reply_s, dive.velocity.t_s) if len(c)]
    filters = tuple(m for m in BEST_FILTER if m in solution.innovations)
    reference = "truth" if any(name == "truth" for _, name in errors) else "fix"
    depths_m = dive.depth.depth_m if len(dive.depth) else np.zeros(1)
    return Scene(
        methods=methods,
        lost=lost_methods(solution),
        best=best,
        filters=filters + tuple(m for m in solution.innovations if m not in filters),
        beacons=tuple(beacons),
        first_ns=dive.start_ns + round(min((c[0] for c in ends_s), default=0.0) * 1e9),
        last_ns=dive.start_ns + round(max((c[-1] for c in ends_s), default=1.0) * 1e9),
        centre_enu_m=centre_enu_m,
        extent_m=extent_m,
        track_centre_enu_m=track_centre_enu_m,
        track_extent_m=track_extent_m,
        innovation_limit_s=_innovation_limit_s(solution, filters),
        gate=solution.gamma if np.isfinite(solution.gamma) else 9.21,
        estimates=ESTIMATES if any(len(e) for e in solution.estimates.values()) else (),
        error_limit_m=_error_limit_m(errors, reference),
        error_reference=reference,
        depth_range_m=(float(depths_m.min()), float(depths_m.max())),
        has_map=dive.origin is not None and is_positioned(solution),
        positioned=is_positioned(solution),
    )


def layout(scene: Scene) -> "rrb.Blueprint":
    """Blueprint: plan left; innovations, error and tables right."""
    import rerun.blueprint as rrb

    trusted = [m for m in scene.methods if m not in scene.lost]
    close = (scene.track_centre_enu_m, scene.track_extent_m)
    wide = (scene.centre_enu_m, scene.extent_m)
    plan = "Plan, north up" if scene.positioned else "Shape of the way, not its place"
    everything = "Beacons and track" if scene.positioned else "Beacons"
    space = [
        _space(plan, scene, trusted, _from_above(*close)),
        _space(everything, scene, trusted, _from_above(*wide)),
        *([_space("All methods", scene, scene.methods, _from_above(*wide))] if scene.lost else []),
        _space("3-D", scene, trusted, _from_aside(*close)),
        *([rrb.MapView(origin="/geo", name="Map (fetches tiles)")] if scene.has_map else []),
    ]
    right = rrb.Vertical(
        rrb.Tabs(
            rrb.TextDocumentView(origin="/report", name="Verdict, guide, tables"),
            rrb.StateTimelineView(
                origin="/state", name="Lock and gate", time_view=_time_axis(scene)
            ),
            rrb.TextLogView(
                origin="/events",
                name="Events",
                columns=rrb.TextLogColumns(
                    timeline_columns=[], text_log_columns=["LogLevel", "Body"]
                ),
            ),
        ),
        rrb.Tabs(*[_innovations(scene, method) for method in scene.filters], name="Innovations"),
        rrb.Tabs(*_over_time(scene), name="Over time"),
        row_shares=[5, 5, 3],
    )
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Tabs(*space, active_tab=0), right, column_shares=[6, 5]),
        _time_panel(),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
        auto_layout=False,
    )


def _time_panel() -> "rrb.TimePanel":
    """Time line that stands at the dive's end as it opens, the replies of the last pings drawn.

    Rerun 0.41 has no place for another instant, begins to play where it is not told its state, and
    leaves that state out of the panel that it writes.
    """
    import rerun.blueprint as rrb
    from rerun.blueprint.archetypes import TimePanelBlueprint

    class Standing(rrb.TimePanel):
        def _log_to_stream(self, stream: Any) -> None:
            super()._log_to_stream(stream)
            state = TimePanelBlueprint.from_fields(play_state="following")
            stream.log(self.blueprint_path(), state)

    return Standing(state="collapsed", timeline="time")


def _frame(parts: Sequence[Float]) -> tuple[Float, tuple[float, float]]:
    """Middle and extent, east and north, of all points (n, 3), at the usual height of the last.

    The last part is the track where there is one: what is nearer to the eye looks larger, and a
    ship far above its beacons must not leave the frame.
    """
    points = np.concatenate([np.empty((0, 3)), *parts])
    if not len(points):
        return np.zeros(3), (100.0, 100.0)
    low, high = points.min(axis=0), points.max(axis=0)
    centre_enu_m = 0.5 * (low + high)
    centre_enu_m[2] = np.median(next(part for part in reversed(parts) if len(part))[:, 2])
    return centre_enu_m, (float(high[0] - low[0]), float(high[1] - low[1]))


def _innovation_limit_s(solution: Solution, filters: Sequence[str]) -> float:
    """Twice the gate's usual half width: what is far outside needs no exact place in a plot."""
    for method in filters:
        sigma_s = solution.innovations[method].innovation_sigma_s
        if np.isfinite(sigma_s).any():
            gamma = solution.gamma if np.isfinite(solution.gamma) else 9.21
            return float(2.0 * np.sqrt(gamma) * np.nanquantile(sigma_s, 0.9))
    return 0.02


def _error_limit_m(errors: Mapping[tuple[str, str], Errors], reference: str) -> float:
    trusted = [
        float(np.quantile(e.distance_m, 0.99))
        for (method, name), e in errors.items()
        if name == reference and method not in _DRIFTING and len(e)
    ]
    return 1.25 * min(max(trusted, default=10.0), 10.0 * min(trusted, default=10.0))


def _from_above(centre_enu_m: Float, extent_m: tuple[float, float]) -> "rrb.EyeControls3D":
    import rerun.blueprint as rrb

    height_m = 0.58 * max(*extent_m, 100.0) / np.tan(0.5 * _EYE_FIELD_RAD)
    return rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=centre_enu_m + np.array([0.0, 0.0, height_m]),
        look_target=centre_enu_m,
        eye_up=(0.0, 1.0, 0.0),
    )


def _from_aside(centre_enu_m: Float, extent_m: tuple[float, float]) -> "rrb.EyeControls3D":
    import rerun.blueprint as rrb

    return rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=centre_enu_m + max(*extent_m, 100.0) * np.array([0.35, -1.1, 0.65]),
        look_target=centre_enu_m,
        eye_up=(0.0, 0.0, 1.0),
    )


def _space(name: str, scene: Scene, methods: Sequence[str], eye: Any) -> "rrb.Spatial3DView":
    """View of the dive; those with the eye close to the track have the scale bar."""
    import rerun as rr
    import rerun.blueprint as rrb

    eye_is_close = name not in ("Beacons and track", "Beacons", "All methods")
    ways = ["/dive/ends", *(f"/dive/{method}" for method in methods)]
    ways += [f"/dive/{scene.best}/**"] if scene.best else []
    places = [
        "/dive/beacons",
        "/dive/fixes",
        "/dive/positions",
        "/dive/reference",
        "/dive/ranges/**",
    ]
    if not scene.positioned:  # a way that begins anywhere is not drawn among what has a place
        ways = [way for way in ways if not way.endswith("/**")] if eye_is_close else []
        ways += [f"/dive/{scene.best}/vehicle/**"] if ways and scene.best else []
        places = [] if eye_is_close else places
    paths = ways + places + (["/dive/scale"] if eye_is_close else [])
    extent_m = scene.track_extent_m if eye_is_close else scene.extent_m
    return rrb.Spatial3DView(
        origin="/dive",
        name=name,
        contents=[f"+ {path}" for path in paths],
        background=GROUND,
        line_grid=rrb.LineGrid3D(
            visible=True,
            spacing=_round_spacing(max(extent_m) / 8.0),
            plane=rr.components.Plane3D.XY.with_distance(float(scene.centre_enu_m[2])),
            stroke_width=0.5,
            color=GRID,
        ),
        eye_controls=eye,
        overrides={
            "/dive/fixes": _visible(rrb.TimeRangeBoundary.infinite()),
            f"/dive/{scene.best}/vehicle": _visible(
                rrb.TimeRangeBoundary.cursor_relative(seconds=-_TRAIL_S),
                rrb.TimeRangeBoundary.cursor_relative(),
            ),
        },
    )


def _visible(
    start: "rrb.TimeRangeBoundary", end: "rrb.TimeRangeBoundary | None" = None
) -> "rrb.VisibleTimeRanges":
    import rerun as rr
    import rerun.blueprint as rrb

    return rrb.VisibleTimeRanges([rr.VisibleTimeRange("time", start=start, end=end or start)])


def _innovations(scene: Scene, method: str) -> "rrb.Grid":
    import rerun.blueprint as rrb

    limit_ms = 1e3 * scene.innovation_limit_s
    views = [
        rrb.TimeSeriesView(
            origin=f"/innovation/{method}/{beacon}",
            name=f"{beacon} [ms]: blue accepted, orange rejected",
            axis_x=_time_axis(scene),
            axis_y=rrb.ScalarAxis(range=(-limit_ms, limit_ms)),
            plot_legend=rrb.PlotLegend(visible=False),
        )
        for beacon in scene.beacons
    ]
    return rrb.Grid(*views, grid_columns=1 if len(views) < 3 else 2, name=method)


def _over_time(scene: Scene) -> "list[rrb.TimeSeriesView]":
    import rerun.blueprint as rrb

    def plot(origin: str, name: str, limits: tuple[float, float] | None) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(
            origin=origin,
            name=name,
            axis_x=_time_axis(scene),
            axis_y=rrb.ScalarAxis(range=limits) if limits else None,
            plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop, visible=True),
        )

    low_m, high_m = scene.depth_range_m
    margin_m = max(0.1 * (high_m - low_m), 5.0)
    views = [plot("/error", f"Error to {scene.error_reference} [m]", (0.0, scene.error_limit_m))]
    if scene.error_reference == "truth":
        views.append(plot("/distance_to_fix", "To fixes [m]", (0.0, scene.error_limit_m)))
    views += [plot(f"/nis/{m}", f"NIS {m}", (0.0, 1.5 * scene.gate)) for m in scene.filters[:1]]
    for name, title in scene.estimates:
        views.append(plot(f"/estimate/{name}", title, None))
    return [*views, plot("/depth", "Depth [m]", (high_m + margin_m, low_m - margin_m))]


def _time_axis(scene: Scene) -> "rrb.TimeAxis":
    import rerun as rr
    import rerun.blueprint as rrb

    # Without a range the viewer shows 30 s on either side of the cursor.
    whole = rr.TimeRange(
        start=rrb.TimeRangeBoundary.absolute(nanos=scene.first_ns),
        end=rrb.TimeRangeBoundary.absolute(nanos=scene.last_ns),
    )
    return rrb.TimeAxis(view_range=whole)


def _round_spacing(spacing_m: float) -> float:
    """1, 2 or 5 times a power of ten, at or above `spacing_m`."""
    decade = 10.0 ** np.floor(np.log10(max(spacing_m, 1.0)))
    return float(next(k * decade for k in (1.0, 2.0, 5.0, 10.0) if k * decade >= spacing_m))
