# SPDX-License-Identifier: Apache-2.0
"""Simulated dives: scenario -> dive with known truth -> log."""

from pipeline.simulate.dive import Simulation, Truth, simulate
from pipeline.simulate.limits import bound, error_model
from pipeline.simulate.record import to_log, write_log
from pipeline.simulate.replies import LABELS, HeardReplies
from pipeline.simulate.scenario import Scenario, load_scenario

__all__ = [
    "LABELS",
    "HeardReplies",
    "Scenario",
    "Simulation",
    "Truth",
    "bound",
    "error_model",
    "load_scenario",
    "simulate",
    "to_log",
    "write_log",
]
