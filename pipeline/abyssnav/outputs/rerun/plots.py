# SPDX-License-Identifier: Apache-2.0
"""What changes over time: innovations and their gate, NIS, errors, depth."""

from typing import Final

import numpy as np

from abyssnav.outputs.palette import ACCEPTED, BOUND, DEPTH, REJECTED, method_colour, rgb
from abyssnav.outputs.rerun.logger import RerunLogger
from abyssnav.tables import (
    ARRIVALS,
    DECISIONS,
    Bool,
    Errors,
    Float,
    Innovations,
    SensorEstimates,
    usual_step_s,
)

#: Part of the entity path, and title, of what a filter learns of its sensors.
ESTIMATES: Final = (
    ("heading_error_deg", "Heading error [°]"),
    ("dvl_scale_percent", "DVL scale [%]"),
    ("sound_speed_scale_percent", "Sound speed [%]"),
)


def log_innovations(
    log: RerunLogger, path: str, innovations: Innovations, gamma: float, limit_s: float
) -> None:
    """Innovations of one beacon in ms: accepted, rejected, and the gate's bound ±√(γ S).

    Of the rejected, a diamond marks what came by a bounce or late, a square what nothing of the
    kind explains.  What lies beyond `limit_s`, where the plot ends, is marked at its edge by an
    arrow as well, in entities of its own: `above` and `below`, and of accepted replies
    `accepted_above` and `accepted_below`.  Where nothing is to be marked there is no entity.
    """
    import rerun as rr

    known = innovations[np.isfinite(innovations.innovation_s)]
    accepted = known.decision == DECISIONS.index("accepted")
    nu_s, shape = known.innovation_s, rr.components.MarkerShape
    edge_s = np.full(len(known), 0.94 * limit_s)

    def points(
        name: str, rows: Bool, values_s: Float, colour: str, marker: rr.components.MarkerShape
    ) -> None:
        if not rows.any() and name not in ("accepted", "rejected"):
            return
        size = 2.5 if marker is shape.Circle else 3.5
        look = rr.SeriesPoints(colors=rgb(colour), names=name, markers=marker, marker_sizes=size)
        log.static(f"{path}/{name}", look)
        _scalars(log, f"{path}/{name}", known.t_reply_s[rows], 1e3 * values_s[rows])

    points("accepted", accepted, nu_s, ACCEPTED, shape.Circle)
    points("rejected", ~accepted, nu_s, REJECTED, shape.Cross)
    for name, marker in (("multipath", shape.Diamond), ("outlier", shape.Square)):
        rows = ~accepted & (known.arrival == ARRIVALS.index(name))
        points(name, rows, nu_s, REJECTED, marker)
    for prefix, rows, colour in (
        ("", ~accepted, REJECTED),
        ("accepted_", accepted, ACCEPTED),
    ):
        points(f"{prefix}above", rows & (nu_s > limit_s), edge_s, colour, shape.Up)
        points(f"{prefix}below", rows & (nu_s < -limit_s), -edge_s, colour, shape.Down)
    if np.isfinite(gamma):
        bound_ms = 1e3 * np.sqrt(gamma) * known.innovation_sigma_s
        lines = rr.SeriesLines(colors=[rgb(BOUND)] * 2, names=["+gate", "-gate"], widths=[1.0, 1.0])
        log.static(f"{path}/bound", lines)
        _scalars(log, f"{path}/bound", known.t_reply_s, np.column_stack([bound_ms, -bound_ms]))


def log_nis(log: RerunLogger, path: str, innovations: Innovations, name: str, colour: str) -> None:
    """Normalised innovation squared of one beacon, of all replies that met the gate."""
    import rerun as rr

    known = innovations[np.isfinite(innovations.nis)]
    look = rr.SeriesPoints(colors=rgb(colour), names=name, marker_sizes=2.0)
    log.static(path, look)
    _scalars(log, path, known.t_reply_s, known.nis)


def log_level(log: RerunLogger, path: str, name: str, value: float) -> None:
    """Horizontal line over the whole dive."""
    import rerun as rr

    ends_s = log.dive.depth.t_s[[0, -1]] if len(log.dive.depth) else np.zeros(1)
    log.static(path, rr.SeriesLines(colors=rgb(BOUND), names=name, widths=1.0))
    _scalars(log, path, ends_s, np.full(len(ends_s), value), with_ping=False)


def log_estimates(log: RerunLogger, method: str, estimates: SensorEstimates) -> None:
    """What the filter learned of compass, DVL and sound, each between lines of ± one sigma."""
    import rerun as rr

    e, colour = estimates, rgb(method_colour(method))
    values = (
        (np.degrees(e.heading_error_rad), np.degrees(e.heading_error_sigma_rad)),
        (100.0 * e.dvl_scale, 100.0 * e.dvl_scale_sigma),
        (100.0 * e.sound_speed_scale, 100.0 * e.sound_speed_scale_sigma),
    )
    for (name, _), (value, sigma) in zip(ESTIMATES, values, strict=True):
        path = f"estimate/{name}/{method}"
        log.static(path, rr.SeriesLines(colors=colour, names=method, widths=1.5))
        _scalars(log, path, e.t_s, value)
        lines = rr.SeriesLines(colors=[rgb(BOUND)] * 2, names=["+1σ", "-1σ"], widths=[0.8, 0.8])
        log.static(f"{path}/sigma", lines)
        _scalars(log, f"{path}/sigma", e.t_s, np.column_stack([value + sigma, value - sigma]))


def log_errors(log: RerunLogger, root: str, method: str, errors: Errors) -> None:
    """Distance of a method to the reference: points where it is known at fixes only."""
    import rerun as rr

    colour, path = rgb(method_colour(method)), f"{root}/{method}"
    sparse = len(errors) < 2 or usual_step_s(errors.t_s) > 5.0
    points = rr.SeriesPoints(colors=colour, names=method, marker_sizes=2.0)
    log.static(path, points if sparse else rr.SeriesLines(colors=colour, names=method, widths=1.5))
    _scalars(log, path, errors.t_s, errors.distance_m, with_ping=False)


def log_depth(log: RerunLogger) -> None:
    """Measured depth, positive down."""
    import rerun as rr

    log.static("depth", rr.SeriesLines(colors=rgb(DEPTH), names="depth", widths=1.5))
    depth = log.dive.depth
    _scalars(log, "depth", depth.t_s, depth.depth_m, with_ping=False)


def _scalars(
    log: RerunLogger, path: str, t_s: Float, values: Float, with_ping: bool = True
) -> None:
    import rerun as rr

    log.columns(path, t_s, lambda rows: rr.Scalars.columns(scalars=values[rows]), with_ping)
