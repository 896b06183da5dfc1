# SPDX-License-Identifier: Apache-2.0
"""What changes over time: innovations and their gate, NIS, errors, depth."""

import numpy as np

from pipeline.palette import ACCEPTED, BOUND, DEPTH, REJECTED, method_colour, rgb
from pipeline.tables import DECISIONS, Bool, Errors, Float, Innovations
from pipeline.view.sender import Sender


def log_innovations(
    log: Sender, path: str, innovations: Innovations, gamma: float, limit_s: float
) -> None:
    """Innovations of one beacon: accepted, rejected, the gate's bound ±√(γ S), and NIS.

    What lies beyond `limit_s`, where the plot ends, is marked at its edge by an arrow as well, in
    entities of their own (`above`, `below`).
    """
    import rerun as rr

    known = innovations[np.isfinite(innovations.innovation_s)]
    accepted = known.decision == DECISIONS.index("accepted")
    nu_s, shape = known.innovation_s, rr.components.MarkerShape
    edge_s = 0.94 * limit_s

    def points(
        name: str, mine: Bool, values: Float, colour: str, marker: rr.components.MarkerShape
    ) -> None:
        look = rr.SeriesPoints(colors=rgb(colour), names=name, markers=marker, marker_sizes=3.0)
        log.static(f"{path}/{name}", look)
        _scalars(log, f"{path}/{name}", known.t_reply_s[mine], values[mine])

    points("accepted", accepted, nu_s, ACCEPTED, shape.Circle)
    points("rejected", ~accepted, nu_s, REJECTED, shape.Cross)
    edge = np.full(len(known), edge_s)
    points("above", nu_s > limit_s, edge, REJECTED, shape.Up)
    points("below", nu_s < -limit_s, -edge, REJECTED, shape.Down)
    if np.isfinite(gamma):
        bound_s = np.sqrt(gamma) * known.innovation_sigma_s
        lines = rr.SeriesLines(colors=[rgb(BOUND)] * 2, names=["+gate", "-gate"], widths=[1.0, 1.0])
        log.static(f"{path}/bound", lines)
        _scalars(log, f"{path}/bound", known.t_reply_s, np.column_stack([bound_s, -bound_s]))


def log_errors(log: Sender, method: str, errors: Errors) -> None:
    """Distance of a method to the reference."""
    import rerun as rr

    look = rr.SeriesLines(colors=rgb(method_colour(method)), names=method, widths=1.5)
    log.static(f"error/{method}", look)
    _scalars(log, f"error/{method}", errors.t_s, errors.distance_m, with_ping=False)


def log_depth(log: Sender) -> None:
    """Measured depth, positive down."""
    import rerun as rr

    log.static("depth", rr.SeriesLines(colors=rgb(DEPTH), names="depth", widths=1.5))
    depth = log.dive.depth
    _scalars(log, "depth", depth.t_s, depth.depth_m, with_ping=False)


def _scalars(log: Sender, path: str, t_s: Float, values: Float, with_ping: bool = True) -> None:
    import rerun as rr

    log.columns(path, t_s, lambda rows: rr.Scalars.columns(scalars=values[rows]), with_ping)
