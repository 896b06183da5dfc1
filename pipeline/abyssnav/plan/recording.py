# SPDX-License-Identifier: Apache-2.0
"""The plan as a Rerun recording."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from abyssnav.outputs.palette import BEACON, GROUND, method_colour, rgb, sequential
from abyssnav.plan.expect import Plan
from abyssnav.plan.page import assumptions, enough, headline

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb


def write_recording(plan: Plan, name: str, path: Path) -> None:
    """Map, track and beacons in space, the radius along the track on the timeline `track_time`.

    Entities: `/plan/map`, `/plan/track`, `/plan/vehicle`, `/plan/beacons`, `/radius/final`,
    `/radius/real_time`, `/radius/two_beacons`, `/radius/one_beacon`, `/report`.
    """
    import rerun as rr

    recording = rr.RecordingStream("abyssnav", recording_id=f"plan-{name}", send_properties=False)
    stream = rr.binary_stream(recording)
    recording.send_blueprint(_blueprint(plan), make_active=False)
    recording.send_recording_name(f"plan {name}")
    _log_space(recording, plan)
    _log_radii(recording, plan)
    text = rr.TextDocument(_report(plan, name), media_type=rr.MediaType.MARKDOWN)
    recording.log("report", text, static=True)
    path.write_bytes(stream.read(flush=True) or b"")


def _log_space(recording: "rr.RecordingStream", plan: Plan) -> None:
    import rerun as rr

    cells, track, beacons = plan.cells, plan.track, plan.beacons
    largest_m = float(cells.radius_95_m.max())
    up_m = np.full(len(cells), track.position_enu_m[0, 2] - 20.0)  # below the track
    half_m = 0.5 * plan.side_m
    colours = [rgb(sequential(radius / largest_m)) for radius in cells.radius_95_m.tolist()]
    tiles = rr.Boxes3D(
        centers=np.column_stack([cells.east_m, cells.north_m, up_m]),
        half_sizes=np.broadcast_to([half_m, half_m, 0.5], (len(cells), 3)),
        colors=colours,
        labels=[f"{radius:.1f} m" for radius in cells.radius_95_m.tolist()],
        show_labels=False,
        fill_mode="solid",
    )
    recording.log("plan/map", tiles, static=True)
    line = rr.LineStrips3D([track.position_enu_m], colors=[(255, 255, 255)])
    recording.log("plan/track", line, static=True)
    points = rr.Points3D(
        beacons.position_enu_m,
        labels=beacons.name.tolist(),
        colors=[rgb(BEACON)],
        radii=rr.Radius.ui_points(7.0),
    )
    recording.log("plan/beacons", points, static=True)


def _log_radii(recording: "rr.RecordingStream", plan: Plan) -> None:
    import rerun as rr

    track = plan.track
    times = [rr.TimeColumn("track_time", duration=np.rint(track.t_s * 1e9).astype("m8[ns]"))]
    place = rr.Points3D.columns(positions=track.position_enu_m)
    recording.send_columns("plan/vehicle", times, place)
    curves = {
        "final": (track.radius_95_m, method_colour("smoother")),
        "real_time": (track.filter_radius_95_m, method_colour("ekf")),
        "two_beacons": (track.two_beacons_95_m, method_colour("kf_fix")),
        "one_beacon": (track.one_beacon_95_m, method_colour("dead_reckoning")),
    }
    for curve, (radius_m, colour) in curves.items():
        style = rr.SeriesLines(names=[curve.replace("_", " ")], colors=[rgb(colour)])
        recording.log(f"radius/{curve}", style, static=True)
        recording.send_columns(f"radius/{curve}", times, rr.Scalars.columns(scalars=radius_m))


def _blueprint(plan: Plan) -> "rrb.Blueprint":
    """Map from above, radius along the track, and the report."""
    import rerun.blueprint as rrb

    cells = plan.cells
    middle = np.array(
        [np.mean(cells.east_m), np.mean(cells.north_m), plan.track.position_enu_m[0, 2]]
    )
    extent_m = max(float(np.ptp(cells.east_m)), float(np.ptp(cells.north_m)))
    eye = rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=middle + np.array([0.0, 0.0, 1.3 * extent_m]),
        look_target=middle,
        eye_up=(0.0, 1.0, 0.0),
    )
    plan_view = rrb.Spatial3DView(
        origin="/plan", name="Plan, north up", background=GROUND, eye_controls=eye
    )
    radius = rrb.TimeSeriesView(origin="/radius", name="95 % radius, m")
    report = rrb.TextDocumentView(origin="/report", name="Report")
    side = rrb.Vertical(radius, report)
    both = rrb.Horizontal(plan_view, side, column_shares=[3, 2])
    return rrb.Blueprint(both, collapse_panels=True)


def _report(plan: Plan, name: str) -> str:
    """The page's sentences and tables in Markdown."""
    rows = [
        f"| {change.what} | {change.radius_95_m:.2f} | {change.filter_radius_95_m:.2f} |"
        for change in plan.changes
    ]
    table = ["| change | final, m | in real time, m |", "|---|--:|--:|", *rows]
    parts = [f"# {name}", headline(plan), enough(plan), "\n".join(table), assumptions(plan)]
    return "\n\n".join(parts) + "\n"
