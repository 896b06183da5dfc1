# SPDX-License-Identifier: Apache-2.0
"""Simulated dives: scenario -> dive with known truth -> log."""

from abyssnav.simulate.benchmark import SETS, benchmark_dives, write_benchmark
from abyssnav.simulate.dive import Simulation, Truth, simulate
from abyssnav.simulate.limits import beacon_errors, bound, error_model
from abyssnav.simulate.record import to_log, write_log
from abyssnav.simulate.replies import LABELS, SimulatedReplies
from abyssnav.simulate.scenario import Scenario, load_scenario
from abyssnav.simulate.stated import settings_toml, stated_settings

__all__ = [
    "LABELS",
    "SETS",
    "Scenario",
    "SimulatedReplies",
    "Simulation",
    "Truth",
    "beacon_errors",
    "benchmark_dives",
    "bound",
    "error_model",
    "load_scenario",
    "settings_toml",
    "simulate",
    "stated_settings",
    "to_log",
    "write_benchmark",
    "write_log",
]
