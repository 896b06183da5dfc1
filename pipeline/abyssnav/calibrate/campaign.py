# SPDX-License-Identifier: Apache-2.0
"""Many dives of a vehicle -> what is wrong with its sensors and with the beacons."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from abyssnav.batch import Recording, local_places
from abyssnav.calibrate.adjustment import Adjustment, adjust, begin, sum_dives
from abyssnav.calibrate.evidence import (
    DiveEvidence,
    SurveyResiduals,
    gather,
    reduce_dive,
    survey_residuals,
)
from abyssnav.calibrate.hypotheses import split, with_likelier_arm, with_wrong_tables
from abyssnav.calibrate.unknowns import make_layout
from abyssnav.calibrate.verdicts import Estimate, judge
from abyssnav.config import Config
from abyssnav.errors import SolveError, refusal_reason
from abyssnav.profile import Profile
from abyssnav.remote import local_logs
from abyssnav.workers import run_in_processes, run_on_dask

#: A dive of which the track explains less than this share of the replies says nothing of sensors.
_EXPLAINED = 0.3


class Piece(NamedTuple):
    """One dive to be gathered by a worker."""

    recording: Recording
    config: Config
    profile: Profile


class LeftOut(NamedTuple):
    """A dive that takes no part, and why."""

    dive: str
    reason: str


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """What many dives say."""

    config: Config  #: that the dives were read with
    dives: tuple[DiveEvidence, ...]
    left_out: tuple[LeftOut, ...]
    adjustment: Adjustment
    estimates: tuple[Estimate, ...]
    explained: tuple[float, ...]  #: share of each dive's replies, by the common unknowns
    surveys: Mapping[str, SurveyResiduals]  #: of the dives that are surveys of beacons


def calibrate(
    recordings: Sequence[Recording],
    config: Config,
    profile: Profile,
    jobs: int = 1,
    on_dive: Callable[[str, str], None] = lambda *_: None,
    scheduler: str | None = None,
) -> CalibrationResult:
    """Estimate what the dives share, from all of them.

    Parameters
    ----------
    jobs : worker processes at a time
    on_dive : called with each dive's name and why it is left out, if it is
    scheduler : address of a Dask scheduler whose workers see the same files; empty for a cluster of
        `jobs` workers on this machine; None for plain processes

    Raises
    ------
    SolveError
        No dive of them can be used.
    """
    pieces = [Piece(recording, config, profile) for recording in recordings]
    gathered, left_out = dict[str, DiveEvidence](), list[LeftOut]()
    for piece, made in _gathered(pieces, jobs, scheduler):
        name = piece.recording.name
        reason = made if isinstance(made, str) else _unfit(made)
        if reason:
            left_out.append(LeftOut(name, reason))
        elif not isinstance(made, str):
            gathered[name] = made
        on_dive(name, reason)
    if not gathered:
        reasons = "; ".join(f"{dive.dive}: {dive.reason}" for dive in left_out)
        raise SolveError(f"no dive can be used: {reasons}")
    dives = sorted(gathered.values(), key=lambda dive: (dive.begin_ns, dive.name))
    return estimate(dives, config, tuple(sorted(left_out)))


def estimate(
    dives: Sequence[DiveEvidence], config: Config, left_out: tuple[LeftOut, ...] = ()
) -> CalibrationResult:
    """The same from dives that are gathered."""
    start = begin(dives)
    alone = [reduce_dive(*pair, None) for pair in zip(dives, start, strict=True)]
    layout = make_layout(dives, split(dives, alone))
    together = sum_dives(layout, alone)
    tables_stated = any(bool(np.any(dive.setting.stated)) for dive in dives)
    layout = with_wrong_tables(layout, together, stated=tables_stated)
    arm_stated = config.vehicle.transducer_offset_m is not None
    layout = with_likelier_arm(layout, together, stated=arm_stated)
    adjustment = adjust(dives, layout, start)
    surveys = {
        dive.name: survey_residuals(dive, iterate, end)
        for dive, iterate, end in zip(dives, adjustment.iterates, adjustment.reduced, strict=True)
        if dive.survey
    }
    return CalibrationResult(
        config,
        tuple(dives),
        left_out,
        adjustment,
        tuple(judge(adjustment)),
        tuple(end.explained for end in adjustment.reduced),
        surveys,
    )


def _gathered(
    pieces: Sequence[Piece], jobs: int, scheduler: str | None
) -> "list[tuple[Piece, DiveEvidence | str]]":
    if scheduler is not None:
        paths = local_places(piece.recording for piece in pieces)
        return list(run_on_dask(gather_piece, pieces, scheduler, jobs, paths))
    if len(pieces) == 1:
        return [(piece, gather_piece(piece)) for piece in pieces]
    return list(run_in_processes(gather_piece, pieces, jobs))


def gather_piece(piece: Piece) -> DiveEvidence | str:
    """One dive's evidence, under its recording's name; or why there is none."""
    try:
        with local_logs([piece.recording.place], piece.profile) as paths:
            return gather(paths, piece.config, piece.profile, piece.recording.name)
    except Exception as fault:
        return refusal_reason(fault)


def _unfit(dive: DiveEvidence) -> str:
    if dive.explained < _EXPLAINED:
        return (
            f"its track explains {100 * dive.explained:.0f} % of the replies only: look at "
            "abyssnav run first"
        )
    return ""
