# SPDX-License-Identifier: Apache-2.0
"""Stage view: a solution as a Rerun recording that opens on what happened.

Columns only: an entity's rows go in slices, a track is one static set of line strips; one call a
row would be some 250 times slower, and endless history of points would stall the viewer.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from abyssnav.errors import PipelineError
from abyssnav.outputs.palette import REFERENCE, beacon_colour
from abyssnav.outputs.rerun.blueprint import Scene, layout, scene_of
from abyssnav.outputs.rerun.logger import Sender, beacon_parts
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
    log_fixes,
    log_line,
    log_map,
    log_ranges,
    log_track,
)
from abyssnav.outputs.rerun.text import log_events, log_states, report_text
from abyssnav.tables import Comparison, Errors, Reference, Solution

#: A whole recording ends with the mark of its footer and four bytes.
_FOOTER_BYTES = 12


def view(
    solution: Solution,
    comparison: Comparison,
    errors: Mapping[tuple[str, str], Errors],
    reference: Reference | None,
    path: Path,
) -> None:
    """Write `dive.rrd`: the contract's entities on the timelines `time`, `dive_time` and `ping`.

    Positions are ENU metres, innovations seconds, errors and depth metres.  `/error/<method>` is
    against truth when there is a reference, else against the fixes.

    Raises
    ------
    PipelineError
        Rerun did not finish the recording.
    OSError
        It cannot be written.
    """
    import rerun as rr

    dive = solution.dive
    parts = beacon_parts(dive.beacons)
    scene = scene_of(solution, errors, list(parts.values()))
    recording = rr.RecordingStream(
        "abyssnav", recording_id=f"{dive.name}-{dive.start_ns}", send_properties=False
    )
    # By way of memory: Rerun's own writer waits for ever where a disk is full.
    stream = rr.binary_stream(recording)
    recording.send_blueprint(layout(scene), make_active=False)
    recording.send_recording_name(dive.name)
    log = Sender(recording, dive)
    _log_space(log, solution, reference, scene)
    _log_plots(log, solution, errors, scene)
    log_events(log, solution)
    for method in scene.filters[:1]:
        log_states(log, solution, method, parts)
    text = rr.TextDocument(report_text(solution, comparison), media_type=rr.MediaType.MARKDOWN)
    log.static("report", text)
    content = stream.read(flush=True)
    recording.disconnect()
    if content is None or content[-_FOOTER_BYTES:][:8] != b"RRF2FOOT":
        raise PipelineError(f"{path}: the recording was not finished")
    path.write_bytes(content)


def shown(solution: Solution) -> Solution:
    """The solution without what its recording does not show: most of the sensors' rows, a half.

    Of the velocity it shows where bottom lock came and went, and the ends.
    """
    dive = solution.dive
    velocity, changes = dive.velocity, np.flatnonzero(np.diff(dive.velocity.valid))
    rows = np.unique(np.concatenate([changes, changes + 1, [0, len(velocity) - 1]]))
    kept = velocity[rows] if len(velocity) else velocity
    return replace(solution, dive=replace(dive, heading=dive.heading[:0], velocity=kept))


def _log_space(log: Sender, solution: Solution, reference: Reference | None, scene: Scene) -> None:
    import rerun as rr

    dive = solution.dive
    log.static("dive", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    log_beacons(log, dive.beacons)
    log_fixes(log, solution.fixes)
    for method, track in solution.tracks.items():
        log_track(log, method, track, followed=method == scene.best)
        if dive.origin is not None and method not in scene.lost:
            log_map(log, dive.origin, method, track)
    if reference is not None:
        log_line(log, "dive/reference", reference.position_enu_m, REFERENCE)
    for method in scene.filters[:1]:
        log_ranges(log, beacon_parts(dive.beacons), dive, solution.innovations[method])


def _log_plots(
    log: Sender, solution: Solution, errors: Mapping[tuple[str, str], Errors], scene: Scene
) -> None:
    parts = beacon_parts(solution.dive.beacons)
    for method, innovations in solution.innovations.items():
        for place, (beacon_id, part) in enumerate(parts.items()):
            mine = innovations[innovations.beacon_id == beacon_id]
            where = f"innovation/{method}/{part}"
            log_innovations(log, where, mine, solution.gamma, scene.innovation_limit_s)
            log_nis(log, f"nis/{method}/{part}", mine, part, beacon_colour(place))
        log_level(log, f"nis/{method}/gate", "gate", scene.gate)
    for method, estimates in solution.estimates.items():
        log_estimates(log, method, estimates)
    for (method, reference), distances in errors.items():
        root = "error" if reference == scene.error_reference else "distance_to_fix"
        log_errors(log, root, method, distances)
    log_depth(log)
