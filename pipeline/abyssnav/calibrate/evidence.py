# SPDX-License-Identifier: Apache-2.0
"""One dive's part of a calibration: its equations, and where it alone leaves the unknowns."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, cast

import msgspec
import numpy as np

from abyssnav.align import align
from abyssnav.calibrate.clock_offsets import (
    RateTables,
    directions,
    rate_tables,
    shifted_cells,
    shifted_observations,
)
from abyssnav.calibrate.survey import box_in, elsewhere, is_survey, settings_of
from abyssnav.config import Config, OriginSetting
from abyssnav.errors import SolveError
from abyssnav.estimation.block_tridiagonal import invert_chain
from abyssnav.estimation.dive_problem import OffsetMaker
from abyssnav.estimation.dive_states import DEVIATION, OFFSET, DiveStates, NoiseModel
from abyssnav.estimation.map_estimator import Predicted, Setting, taking_part, weighted_terms
from abyssnav.estimation.normal_equations import (
    Factored,
    Linearised,
    Solved,
    eliminate_nodes,
    node_step,
    normal_equations,
)
from abyssnav.estimation.observations import LegTable, Observations, Offsets, observe
from abyssnav.estimation.preintegration import preintegrate
from abyssnav.estimation.smoother import FirstGuess, SmootherResult
from abyssnav.estimation.variance_components import learn_random
from abyssnav.geometry import plane
from abyssnav.navigate.inputs import NavigationInputs, prepare
from abyssnav.navigate.shared import Shared
from abyssnav.navigate.smoothed import run_smoother
from abyssnav.profile import Profile
from abyssnav.read import read
from abyssnav.second_process import InlineExecutor
from abyssnav.tables import (
    Beacons,
    Bool,
    Dive,
    Float,
    Int,
    Log,
    Origin,
    SoundSpeed,
    SoundSpeedErrors,
    Table,
)

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
    lever_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  #: as stated
    survey: bool = False  #: position fixes go along with the acoustics
    #: (b, 3) from the beacons' tables to where the equations have them, where those are far apart
    boxed_m: Float | None = None


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
    log = read(paths, profile)
    return evidence_of_log(log, config, name)


def evidence_of_log(log: Log, config: Config, name: str = "") -> DiveEvidence:
    """The same from a log that is read.

    Where position fixes go along with the acoustics, it is a survey: the beacons may be hundreds of
    metres from where their tables have them, so their first places come from ranges.
    """
    dive = align(log, config)
    if not is_survey(dive):
        return evidence_from(dive, config, name)
    places_m = box_in(dive)
    off = elsewhere(dive.beacons, places_m)
    if not off.any():
        return replace(evidence_from(dive, config, name), survey=True)
    places_m = np.where(off[:, None], places_m, dive.beacons.position_enu_m)
    nearer = msgspec.structs.replace(
        config, beacon=settings_of(dive.beacons, places_m, off), origin=_origin_setting(dive)
    )
    evidence = evidence_from(align(log, nearer), nearer, name)
    return replace(
        evidence,
        origin=dive.origin,
        beacons=dive.beacons,
        survey=True,
        boxed_m=places_m - dive.beacons.position_enu_m,
    )


def _origin_setting(dive: Dive) -> OriginSetting | None:
    if dive.origin is None:
        return None
    return OriginSetting(dive.origin.latitude_deg, dive.origin.longitude_deg)


def evidence_from(dive: Dive, config: Config, name: str = "") -> DiveEvidence:
    """The same from a dive that is aligned, its beacons near their tables."""
    inputs = prepare(dive, config)
    result = _smoothed(inputs, config)
    if result is None:
        raise SolveError(
            f"{dive.name}: too few travel times agree on a place: nothing to calibrate"
        )
    setting, estimate = result.unmoved  # dives have the beacons of their tables in common
    problem = setting.problem
    times = problem.n_times
    t_position_s = np.empty(0) if dive.positions is None else dive.positions.t_s
    rates = rate_tables(problem, inputs.motion, inputs.usable_replies, t_position_s)
    # Dead reckoning between nodes is in the tables; the sums behind it would be ten times as much.
    lean = setting._replace(problem=problem._replace(offsets=cast("OffsetMaker", None)))
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
        lever_m=config.vehicle.lever_arm_m,
    )


def _smoothed(inputs: NavigationInputs, config: Config) -> SmootherResult | None:
    """As `smoother` navigates; a survey begins at its own position fixes."""
    shared, table = Shared(inputs, config, InlineExecutor()), inputs.dive.positions
    if table is None or not is_survey(inputs.dive):
        return shared.smooth()
    first = FirstGuess(table.t_s, table.vehicle_enu_m)
    return run_smoother(inputs, None, first, shared.fixes, config)


def _notes(dive: Dive) -> tuple[str, ...]:
    repeated = ("sound_speed_assumed",) if is_survey(dive) else _REPEATED
    odd = [c for c in dive.checks if c.name in repeated and not c.ok]
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
    weight: Float  #: (r,) of each observation; none of replies that count twice
    explained: float  #: share of the replies


def reduce_dive(evidence: DiveEvidence, iterate: DiveIterate, mu: float | None) -> Reduced:
    """Linearise a dive at an iterate and eliminate its nodes.

    Parameters
    ----------
    mu : of the robust weight; None for the final one
    """
    setting, (states, further, noise) = evidence.setting, iterate
    problem, rates = setting.problem, evidence.rates
    observations = _with_arms_turned(problem.observations, states, evidence.lever_m)
    rows = observe(
        shifted_observations(observations, rates, further),
        states,
        directions(problem.observations, rates, states, further),
    )
    shapes = np.column_stack([-rates.cell_turn_rad_per_s, np.zeros(len(rates.cell_turn_rad_per_s))])
    step = preintegrate(shifted_cells(problem.cells, rates, further), states, shapes)
    predicted = Predicted(states, rows, step, taking_part(setting, rows.residual))
    terms, weight, _ = weighted_terms(setting, predicted, noise, mu)
    constant = np.concatenate([states.constant, further])
    terms = terms._replace(constant=constant, constant_variance=np.ones(len(constant)))
    factored = eliminate_nodes(normal_equations(terms, problem.slots))
    right = factored.right + factored.information @ constant
    of_times = weight[: problem.n_times][predicted.part[: problem.n_times]]
    explained = float(np.mean(of_times > 0.5)) if len(of_times) else 1.0
    return Reduced(factored.information, right, terms, factored, weight, explained)


def _with_arms_turned(
    observations: Observations, states: DiveStates, lever_m: tuple[float, float, float]
) -> Observations:
    """Lever arms as they lie by the heading without the compass's constant errors.

    The tables have them by the heading that was read: 5 m of arm and 8° of bias make 0.7 m.
    """

    def turned(offsets: Offsets, leg: LegTable) -> tuple[Offsets, LegTable]:
        error_rad = states.constant[OFFSET] + offsets.shapes @ states.constant[DEVIATION]
        turn = np.exp(1j * error_rad)
        stated = offsets.body_level @ np.array(lever_m)
        level = offsets.body_level * turn[:, None]
        return (
            replace(offsets, body_level=level),
            replace(leg, virtual_beacon=leg.virtual_beacon + stated * (1 - turn)),
        )

    ping, leg_ping = turned(observations.ping, observations.leg_ping)
    reply, leg_reply = turned(observations.reply, observations.leg_reply)
    return observations._replace(ping=ping, reply=reply, leg_ping=leg_ping, leg_reply=leg_reply)


def moved(iterate: DiveIterate, reduced: Reduced, constant: Float) -> DiveIterate:
    """The iterate at new constants (m + 2,), its nodes where they lie best for those."""
    step = constant - reduced.terms.constant
    n = len(iterate.states.constant)
    node = iterate.states.node + node_step(reduced.factored, step)
    return DiveIterate(DiveStates(node, constant[:n]), constant[n:], iterate.noise)


def relearned(
    evidence: DiveEvidence, iterate: DiveIterate, reduced: Reduced, constant: Float, cov: Float
) -> NoiseModel:
    """Noise and slow errors by what the step to new constants leaves over.

    Parameters
    ----------
    constant, cov : (m + 2,) and their covariance by all dives
    """
    factored, step = reduced.factored, constant - reduced.terms.constant
    node = node_step(factored, step)
    solved = Solved(reduced.terms, factored, invert_chain(factored.levels), cov, node, step)
    setting = evidence.setting
    return learn_random(setting.problem, solved, setting.prior, iterate.noise)


@dataclass(frozen=True, eq=False)
class SurveyResiduals(Table):
    """What a survey's ranges miss, in all directions."""

    beacon_id: Int
    azimuth_deg: Float  #: from the beacon to the ship, clockwise from north
    residual_m: Float  #: of one-way range
    used: Bool


def survey_residuals(
    evidence: DiveEvidence, iterate: DiveIterate, reduced: Reduced
) -> SurveyResiduals:
    """Residuals of every reply at the end of an adjustment."""
    problem, states = evidence.setting.problem, iterate.states
    times, leg = problem.observations.times, problem.observations.leg_ping
    n = len(times)
    ship = plane(states.node[times.node, :2]) + problem.observations.ping.displacement
    beacon = leg.virtual_beacon + plane(states.beacon[times.beacon, :2])
    away = ship - beacon
    return SurveyResiduals(
        evidence.beacons.id[times.beacon],
        np.degrees(np.arctan2(away.real, away.imag)) % 360.0,
        0.5 * reduced.terms.rows.residual[:n] * leg.speed_mps,
        reduced.weight[:n] > 0.5,
    )
