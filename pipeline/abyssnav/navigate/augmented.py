# SPDX-License-Identifier: Apache-2.0
"""The product's own methods: `ekf` in real time, `smoother` for the final track."""

from typing import NamedTuple

import numpy as np

from abyssnav.config import Config
from abyssnav.estimation.fixes import ping_numbers
from abyssnav.estimation.model import ErrorModel, Steps, carry_states, deviation, steps
from abyssnav.estimation.tracker import Trail, track
from abyssnav.estimation.two_state import innovation_rows, undecided
from abyssnav.estimation.update import Judge
from abyssnav.navigate.inputs import Evidence, Run, place_track, since
from abyssnav.tables import (
    Event,
    Float,
    Innovations,
    Int,
    SensorEstimates,
    Start,
    Track,
)

#: `ekf_huber`, for comparison: the customary κ, and a gate for what no weight should see.
_HUBER_KAPPA, _HUBER_GAMMA = 1.345, 25.0


class Tracking(NamedTuple):
    """The augmented filter's run over the usable replies."""

    ping: Int
    steps: Steps
    trail: Trail
    start: Start | None
    model: ErrorModel
    judge: Judge

    def nodes(self) -> tuple[Float, Float, Float]:
        """Times, states and covariances at the replies from the start on."""
        known = self.trail.segment >= 0
        return self.steps.t_s[known], self.trail.x[known], self.trail.P[known]


def run_filter(
    evidence: Evidence, confirmed: Start | None, config: Config, *, huber: bool = False
) -> Tracking:
    """Run the augmented filter from its own start, or from the paper's where that is asked for."""
    model, judge = _error_model(evidence, config), _judge(config, huber)
    ping = ping_numbers(evidence.heard)
    prepared = steps(evidence.motion, evidence.heard.t_ping_s, evidence.heard.t_reply_s)
    given = None
    if config.start.ekf == "m_of_n" and confirmed is not None:
        given = (int(np.searchsorted(prepared.t_s, confirmed.t_s, side="right")) - 1, confirmed)
    trail, start = track(evidence.heard.beacon, ping, evidence.legs, prepared, model, judge, given)
    return Tracking(ping, prepared, trail, start, model, judge)


def real_time(evidence: Evidence, tracking: Tracking, method: str) -> Run:
    """Track, innovations and what was learned, as known at each instant."""
    trail, start = tracking.trail, tracking.start
    values = np.column_stack([trail.predicted_s, trail.variance_s2, trail.innovation_s])
    innovations = _innovations(evidence, trail.decision, values)
    if start is None:
        return Run(None, innovations, tracking.judge.gamma)
    nodes = tracking.nodes()
    here = since(evidence.live, float(nodes[0][0]))
    placed = carry_states(*nodes, evidence.motion, here, tracking.model)
    return Run(
        place_track(evidence, here.t_s, *placed),
        innovations,
        tracking.judge.gamma,
        start,
        _estimates(evidence, *nodes),
        _events(tracking, start, method),
        _of_every(evidence, np.sqrt(trail.noise_s2)),
    )


def real_time_places(evidence: Evidence, tracking: Tracking, t_s: Float) -> Track:
    """The filter's track at any instants, those before its start left out."""
    nodes = tracking.nodes()
    rows = since(evidence.motion.at(t_s), float(nodes[0][0]))
    return place_track(
        evidence, rows.t_s, *carry_states(*nodes, evidence.motion, rows, tracking.model)
    )


def _error_model(evidence: Evidence, config: Config) -> ErrorModel:
    first_mps = evidence.legs.speed_reply_mps[:1]  # what comes later must not move an estimate
    errors = config.errors
    first, second = np.radians(errors.deviation_sigma_deg).tolist()
    return ErrorModel(
        start_sigma_m=config.start.sigma_m,
        position_m2_per_s=errors.position_m2_per_s,
        heading_sigma_rad=float(np.radians(errors.heading_sigma_deg)),
        heading_time_s=errors.heading_time_s,
        dvl_scale_sigma=errors.dvl_scale_sigma,
        sound_scale_sigma=config.acoustics.sound_speed_sigma_mps
        / float(first_mps[0] if len(first_mps) else config.acoustics.sound_speed_mps),
        deviation_sigma_rad=(first, second),
        held_sigma_mps=config.process.gap_sigma_mps,
        held_time_s=errors.held_time_s,
    )


def _judge(config: Config, huber: bool) -> Judge:
    sigma_s = config.acoustics.travel_time_sigma_s
    if huber:
        return Judge(sigma_s, _HUBER_GAMMA, _HUBER_KAPPA)
    return Judge(sigma_s, config.gate.threshold)


def _innovations(evidence: Evidence, decision: Int, values: Float) -> Innovations:
    """Rows for all replies from those of the usable ones."""
    replies, usable = evidence.dive.replies, evidence.usable
    every = undecided(replies, usable)
    every[usable] = decision
    return innovation_rows(replies, every, _of_every(evidence, values), evidence.legs, usable)


def _of_every(evidence: Evidence, values: Float) -> Float:
    """Rows for all replies from those of the usable ones; NaN for the others."""
    every = np.full((len(evidence.usable), *values.shape[1:]), np.nan)
    every[evidence.usable] = values
    return every


def _estimates(evidence: Evidence, t_s: Float, x: Float, P: Float) -> SensorEstimates:
    heading_rad = evidence.motion.at(t_s).heading_rad
    sigma = np.sqrt(np.maximum(np.diagonal(P, axis1=1, axis2=2), 0.0))
    return SensorEstimates(
        t_s, deviation(x, heading_rad), sigma[:, 2], x[:, 3], sigma[:, 3], x[:, 4], sigma[:, 4]
    )


def _events(tracking: Tracking, start: Start, method: str) -> tuple[Event, ...]:
    """The start, and every recovery with how far it moved the track."""
    trail = tracking.trail
    begun = Event(start.t_s, method, f"start confirmed by {start.how} after {start.cycles} cycles")
    again = np.flatnonzero(np.diff(trail.segment, prepend=-1) > 0)[1:]
    moved_m = np.linalg.norm(trail.x[again, :2] - trail.x_prior[again, :2], axis=1)
    return begun, *(
        Event(t, method, f"recovered by consensus, {m:.0f} m away from where it was")
        for t, m in zip(tracking.steps.t_s[again].tolist(), moved_m.tolist(), strict=True)
    )
