# SPDX-License-Identifier: Apache-2.0
"""One dive's part of a calibration: its equations, and where it alone leaves the unknowns."""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np

from abyssnav.align import align
from abyssnav.calibrate.clock_offsets import (
    RateTables,
    directions,
    rate_tables,
    shifted_cells,
    shifted_observations,
)
from abyssnav.config import Config
from abyssnav.errors import SolveError
from abyssnav.estimation.dive_problem import (
    OffsetMaker,
    best_reply_per_beacon,
    drift_terms,
    motion_terms,
    row_sigma,
)
from abyssnav.estimation.dive_states import DiveStates, NoiseModel
from abyssnav.estimation.map_estimator import Setting, robust_weight, squares
from abyssnav.estimation.normal_equations import (
    Factored,
    Linearised,
    eliminate_nodes,
    marginals,
    normal_equations,
)
from abyssnav.estimation.observations import observe
from abyssnav.estimation.preintegration import preintegrate
from abyssnav.estimation.variance_components import Solved, learn_random
from abyssnav.navigate.inputs import prepare
from abyssnav.navigate.shared import Shared
from abyssnav.profile import Profile
from abyssnav.read import read
from abyssnav.second_process import InlineExecutor
from abyssnav.tables import Beacons, Dive, Float, Origin, SoundSpeed, SoundSpeedErrors

#: Checks of the stage align that a calibration repeats in its words.
_REPEATED = ("beacons_corrected", "beacons_moving", "beacons", "sound_speed_assumed")


@dataclass(frozen=True, eq=False)
class Water:
    """The sound speed that a dive was navigated with."""

    profile: SoundSpeed
    errors: SoundSpeedErrors


@dataclass(frozen=True, eq=False)
class DiveEvidence:
    """All that a calibration needs of a dive; a few megabytes."""

    name: str
    begin_ns: int  #: UTC
    end_ns: int
    origin: Origin | None
    beacons: Beacons  #: as stated
    water: Water
    setting: Setting
    rates: RateTables
    states: DiveStates  #: as the dive alone leaves them
    noise: NoiseModel
    n_replies: int
    explained: float  #: share of the usable replies
    notes: tuple[str, ...] = ()  #: what was odd about it


def gather(paths: list[Path], config: Config, profile: Profile, name: str = "") -> DiveEvidence:
    """Read and navigate one dive as the smoother does.

    Parameters
    ----------
    name : of the dive; empty, its file's stem

    Raises
    ------
    PipelineError
        It cannot be read or navigated; or nothing in it says where the vehicle was.
    """
    return evidence_from(align(read(paths, profile), config), config, name)


def evidence_from(dive: Dive, config: Config, name: str = "") -> DiveEvidence:
    """The same from a dive that is aligned."""
    inputs = prepare(dive, config)
    result = Shared(inputs, config, InlineExecutor()).smoother_result
    if result is None:
        raise SolveError(
            f"{dive.name}: too few travel times agree on a place: nothing to calibrate"
        )
    problem, estimate = result.setting.problem, result.estimate
    times = problem.n_times
    t_position_s = np.empty(0) if dive.positions is None else dive.positions.t_s
    rates = rate_tables(problem, inputs.motion, inputs.usable_replies, t_position_s)
    # Dead reckoning between nodes is in the tables; the sums behind it would be ten times as much.
    lean = result.setting._replace(problem=problem._replace(offsets=cast("OffsetMaker", None)))
    explained = estimate.weight[:times][estimate.taking_part[:times]] > 0.5
    return DiveEvidence(
        name=name or dive.name,
        begin_ns=dive.start_ns + int(1e9 * problem.t_node_s[0]),
        end_ns=dive.start_ns + int(1e9 * problem.t_node_s[-1]),
        origin=dive.origin,
        beacons=dive.beacons,
        water=Water(dive.sound_speed, dive.water),
        setting=lean,
        rates=rates,
        states=estimate.states,
        noise=estimate.noise,
        n_replies=len(dive.replies),
        explained=float(np.mean(explained)) if len(explained) else 0.0,
        notes=_notes(dive),
    )


def _notes(dive: Dive) -> tuple[str, ...]:
    odd = [c for c in dive.checks if c.name in _REPEATED and not c.ok]
    moving = [c for c in dive.checks if c.name == "beacons_moving"]
    return tuple(f"{check.name.replace('_', ' ')}: {check.detail}" for check in (*odd, *moving))


class DiveIterate(NamedTuple):
    """Where a dive stands in the adjustment."""

    states: DiveStates
    further: Float  #: (2,) time offsets
    noise: NoiseModel


class Reduced(NamedTuple):
    """A dive's nodes eliminated: a quadratic ½ xᵀ S x - hᵀ x in its constants x (m + 2,)."""

    information: Float  #: S
    right: Float  #: h
    terms: Linearised
    factored: Factored
    explained: float  #: share of the replies


def reduce_dive(evidence: DiveEvidence, iterate: DiveIterate, mu: float | None) -> Reduced:
    """Linearise a dive at an iterate and eliminate its nodes.

    Parameters
    ----------
    mu : of the robust weight; None for the final one
    """
    setting, (states, further, noise) = evidence.setting, iterate
    problem, rates = setting.problem, evidence.rates
    rows = observe(
        shifted_observations(problem.observations, rates, further),
        states,
        directions(problem.observations, rates, states, further),
    )
    n, sigma = problem.n_times, row_sigma(problem, noise)
    part = np.ones(len(rows.residual), dtype=bool)
    beacon = problem.observations.times.beacon
    part[:n] = best_reply_per_beacon(rows.residual[:n], setting.ping, beacon)
    weight = robust_weight(squares(problem, rows.residual / sigma), mu) * part
    shapes = np.column_stack([-rates.cell_turn_rad_per_s, np.zeros(len(rates.cell_turn_rad_per_s))])
    step = preintegrate(shifted_cells(problem.cells, rates, further), states, shapes)
    constant = np.concatenate([states.constant, further])
    terms = Linearised(
        rows,
        weight / sigma**2,
        motion_terms(problem, states, step, noise),
        drift_terms(problem, states, noise),
        constant,
        np.ones(len(constant)),
    )
    factored = eliminate_nodes(normal_equations(terms, problem.slots))
    right = factored.right + factored.information @ constant
    explained = float(np.mean(weight[:n][part[:n]] > 0.5)) if n else 1.0
    return Reduced(factored.information, right, terms, factored, explained)


def moved(iterate: DiveIterate, reduced: Reduced, constant: Float) -> DiveIterate:
    """The iterate at new constants (m + 2,), its nodes where they lie best for those."""
    step = constant - np.concatenate([iterate.states.constant, iterate.further])
    node = reduced.factored.node - reduced.factored.spread @ step
    n = len(iterate.states.constant)
    states = DiveStates(iterate.states.node + node, constant[:n])
    return DiveIterate(states, constant[n:], iterate.noise)


def relearned(
    evidence: DiveEvidence, iterate: DiveIterate, reduced: Reduced, constant: Float, cov: Float
) -> NoiseModel:
    """Noise and slow errors by what the step to new constants leaves over.

    Parameters
    ----------
    constant, cov : (m + 2,) and their covariance by all dives
    """
    step = constant - np.concatenate([iterate.states.constant, iterate.further])
    node = reduced.factored.node - reduced.factored.spread @ step
    solved = Solved(reduced.terms, reduced.factored, marginals(reduced.factored), cov, node, step)
    setting = evidence.setting
    return learn_random(setting.problem, solved, setting.prior, iterate.noise)
