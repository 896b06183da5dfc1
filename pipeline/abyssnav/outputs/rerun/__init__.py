# SPDX-License-Identifier: Apache-2.0
"""Stage view: a solution as a Rerun recording that opens on what happened.

Columns only: an entity's rows go in slices, a track is one static set of line strips; one call a
row would be some 250 times slower, and endless history of points would stall the viewer.
"""

import os
import shutil
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from abyssnav.errors import PipelineError
from abyssnav.outputs.palette import REFERENCE, beacon_colour
from abyssnav.outputs.presentation import best_method, median_radius_m, utc
from abyssnav.outputs.rerun.blueprint import Scene, layout, scene_of
from abyssnav.outputs.rerun.logger import RerunLogger, beacon_parts, drawable
from abyssnav.outputs.rerun.opening import last_full_ping
from abyssnav.outputs.rerun.plots import (
    log_depth,
    log_errors,
    log_estimates,
    log_innovations,
    log_level,
    log_nis,
)
from abyssnav.outputs.rerun.spatial import (
    log_beacons,
    log_ends_and_scale,
    log_fixes,
    log_line,
    log_map,
    log_map_points,
    log_positions,
    log_ranges,
    log_track,
)
from abyssnav.outputs.rerun.text import log_events, log_states, report_text
from abyssnav.startup import importable
from abyssnav.tables import DECISIONS, Comparison, ErrorTables, Evaluation, Reference, Solution
from abyssnav.version import __version__

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

#: A whole recording ends with the mark of its footer and four bytes.
_FOOTER_BYTES = 12
_PIECE_BYTES: Final = 1 << 20


#: What to say where there is none: it is half of what is installed, and a worker needs none.
NO_VIEWER: Final = "the viewer is not installed: pip install rerun-sdk"


def has_viewer() -> bool:
    """Whether recordings can be made: Rerun is installed."""
    return bool(importable(["rerun"]))


def view(evaluation: Evaluation, path: Path) -> None:
    """Write `dive.rrd`: the contract's entities on the timelines `time`, `dive_time` and `ping`.

    Positions are ENU metres, innovations milliseconds, errors and depth metres.
    `/error/<method>` is against truth when there is a reference, else against the fixes.

    Raises
    ------
    PipelineError
        Rerun did not finish the recording.
    OSError
        It cannot be written.
    """
    from rerun_bindings import flush_and_cleanup_orphaned_recordings

    _record(evaluation, path)
    # Rerun keeps each recording of a process, and two threads of it, until it is asked not to.
    flush_and_cleanup_orphaned_recordings()
    if not _is_finished(path):
        raise PipelineError(f"{path}: the recording was not finished")


def _record(evaluation: Evaluation, path: Path) -> None:
    import rerun as rr

    solution, dive = evaluation.solution, evaluation.solution.dive
    parts = beacon_parts(dive.beacons)
    scene = scene_of(solution, evaluation.errors, list(parts.values()))
    recording = rr.RecordingStream(
        "abyssnav", recording_id=f"{drawable(dive.name)}-{dive.start_ns}", send_properties=False
    )
    with _written_to(path, recording):
        _send_blueprint(recording, layout(scene))
        recording.send_recording_name(drawable(dive.name))
        recording.send_property(
            "dive", rr.AnyValues(**dive_properties(solution, evaluation.comparison))
        )
        log = RerunLogger(recording, dive)
        _log_space(log, solution, evaluation.reference, scene)
        _log_plots(log, solution, evaluation.errors, scene)
        log_events(log, solution)
        for method in scene.filters[:1]:
            log_states(log, solution, method, parts)
        words = report_text(
            solution, evaluation.comparison, meeting_words(solution, scene.filters[:1])
        )
        log.static("report", rr.TextDocument(words, media_type=rr.MediaType.MARKDOWN))


def _send_blueprint(recording: "rr.RecordingStream", blueprint: "rrb.Blueprint") -> None:
    """As `recording.send_blueprint` does, whose own stream would never end.

    That keeps the recording too: 5 MB and two threads a dive, in a process that makes many.
    """
    import rerun_bindings as bindings
    from rerun.recording_stream import RecordingStream

    stream = RecordingStream._from_native(
        bindings.new_blueprint("abyssnav", make_default=False, make_thread_default=False)
    )
    stream.set_time("blueprint", sequence=0)
    blueprint._log_to_stream(stream)
    storage = stream.memory_recording().storage
    bindings.send_blueprint(storage, recording=recording.to_native())
    stream.disconnect()


@contextmanager
def _written_to(path: Path, recording: "rr.RecordingStream") -> Iterator[None]:
    """Let a recording go to a file as it grows, in place of two copies of all of it in memory.

    By way of a pipe: Rerun's own writer waits for ever where a disk is full.
    """
    pipe, into_pipe = os.pipe()
    with ThreadPoolExecutor(1) as thread:
        copied = thread.submit(_copy, pipe, path)
        try:
            recording.save(f"/dev/fd/{into_pipe}")
        finally:
            os.close(into_pipe)
        try:
            yield
        finally:
            recording.disconnect()
        copied.result()


def _copy(pipe: int, path: Path) -> None:
    """All that comes; when it cannot be written, the rest is still read: who writes would wait."""
    with os.fdopen(pipe, "rb", buffering=0) as recording:
        try:
            with path.open("wb") as file:
                shutil.copyfileobj(recording, file, _PIECE_BYTES)
        finally:
            while recording.read(_PIECE_BYTES):
                pass


def _is_finished(path: Path) -> bool:
    with path.open("rb") as file:
        file.seek(-min(_FOOTER_BYTES, path.stat().st_size), os.SEEK_END)
        return file.read(8) == b"RRF2FOOT"


def dive_properties(solution: Solution, comparison: Comparison) -> dict[str, Any]:
    """What a catalog of recordings can be asked for; what is not known is left out."""
    dive, best = solution.dive, best_method(solution)
    reasons, radius_m = solution.verdict.reasons, median_radius_m(solution)
    known: dict[str, Any] = {
        "abyssnav_version": __version__,
        "verdict": solution.verdict.level,
        "method": best,
        "replies": len(dive.replies),
    }
    if reasons:
        known["cause"] = reasons[0].name
    if radius_m is not None:
        known["uncertainty_95_m"] = radius_m
    for name in ("truth", "fix"):
        row = comparison[(comparison.method == best) & (comparison.reference == name)]
        if len(row):
            known[f"rms_to_{name}_m"] = float(row.rms_m[0])
    if dive.origin is not None:
        known["origin_latitude_deg"] = dive.origin.latitude_deg
        known["origin_longitude_deg"] = dive.origin.longitude_deg
    return known


def meeting_words(solution: Solution, filters: Sequence[str]) -> str:
    """When in the dive the most circles meet: the last ping of which the filter took most."""
    for method in filters:
        replies = solution.innovations[method]
        taken = replies[replies.decision == DECISIONS.index("accepted")]
        if len(taken):
            last_s = float(last_full_ping(taken.ping_id, taken.t_reply_s))
            when = utc(solution.dive.start_ns + round(last_s * 1e9))
            return f"All circles of one ping meet at {when} UTC."
    return ""


def trim_for_view(evaluation: Evaluation) -> Evaluation:
    """The same without what the recording does not show: most of the sensors' rows, a half.

    Of the velocity it shows where bottom lock came and went, and the ends.
    """
    solution, dive = evaluation.solution, evaluation.solution.dive
    velocity, changes = dive.velocity, np.flatnonzero(np.diff(dive.velocity.valid))
    rows = np.unique(np.concatenate([changes, changes + 1, [0, len(velocity) - 1]]))
    kept = velocity[rows] if len(velocity) else velocity
    shown = replace(dive, heading=dive.heading[:0], velocity=kept)
    return replace(evaluation, solution=replace(solution, dive=shown))


def _log_space(
    log: RerunLogger, solution: Solution, reference: Reference | None, scene: Scene
) -> None:
    import rerun as rr

    dive = solution.dive
    log.static("dive", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    log_beacons(log, dive.beacons)
    log_fixes(log, solution.fixes)
    log_positions(log, solution)
    extent_m = max(*scene.track_extent_m, 20.0)
    for method, track in solution.tracks.items():
        log_track(log, method, track, method == scene.best, arrow_m=0.05 * extent_m)
        if dive.origin is not None and scene.has_map and method not in scene.lost:
            log_map(log, dive.origin, method, track)
    if scene.best and len(solution.tracks[scene.best]):
        track = solution.tracks[scene.best]
        corner_m = scene.track_centre_enu_m - 0.5 * extent_m * np.array([1.0, 1.0, 0.0])
        log_ends_and_scale(log, track, corner_m, extent_m)
        if dive.origin is not None and scene.has_map:
            log_map_points(log, dive.origin, dive.beacons, scene.best, track)
    if reference is not None:
        log_line(log, "dive/reference", reference.position_enu_m, REFERENCE)
    for method in scene.filters[:1]:
        log_ranges(log, beacon_parts(dive.beacons), dive, solution.innovations[method])


def _log_plots(log: RerunLogger, solution: Solution, errors: ErrorTables, scene: Scene) -> None:
    parts = beacon_parts(solution.dive.beacons)
    for method, innovations in solution.innovations.items():
        for place, (beacon_id, part) in enumerate(parts.items()):
            own = innovations[innovations.beacon_id == beacon_id]
            path = f"innovation/{method}/{part}"
            log_innovations(log, path, own, solution.gamma, scene.innovation_limit_s)
            log_nis(log, f"nis/{method}/{part}", own, part, beacon_colour(place))
        log_level(log, f"nis/{method}/gate", "gate", scene.gate)
    for method, estimates in solution.estimates.items():
        log_estimates(log, method, estimates)
    for (method, reference), distances in errors.items():
        root = "error" if reference == scene.error_reference else "distance_to_fix"
        log_errors(log, root, method, distances)
    log_depth(log)
