# SPDX-License-Identifier: Apache-2.0
"""What the data of a log say of its conventions, for `inspect`: no filter is run."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from abyssnav.align import align
from abyssnav.config import Config
from abyssnav.diagnose.causes import examine
from abyssnav.diagnose.latencies import latencies, plain
from abyssnav.errors import PipelineError
from abyssnav.profile import Profile, profile_from_toml
from abyssnav.read import Inspection, read
from abyssnav.tables import Dive


class Conclusions(NamedTuple):
    """What `inspect` shows of a dive's conventions and clocks."""

    conventions: list[dict[str, Any]]
    latencies: list[dict[str, Any]]


def conventions(dive: Dive, config: Config) -> Conclusions:
    """Conventions that the data contradict, and how late the sensors are against each other.

    Returns
    -------
    conventions : role, name, value, log_likelihood_ratio over the runner-up, runner_up, mend, and
        seen, with the numbers
    latencies : sensor, late_s and sigma_s of those that the dive tells; none where a convention is
        contradicted
    """
    causes, fixes = examine(dive, config)
    shown = [
        {
            "role": cause.role,
            "name": cause.name,
            "value": cause.value,
            "log_likelihood_ratio": round(float(cause.evidence.ratio), 1),
            "runner_up": cause.evidence.runner_up,
            "mend": cause.mend.phrase(),
            "seen": cause.seen,
        }
        for cause in causes
    ]
    late = latencies(dive, fixes) if fixes is not None and not shown else ()
    return Conclusions(shown, plain(late))


def with_conventions(
    inspection: Inspection, paths: Sequence[Path], profile: Profile, config: Config
) -> Inspection:
    """The inspection with what the data say of the conventions of the profile that reads them.

    That is the given profile, or the proposed one where the given one does not fit; a log that
    neither makes a dive of says nothing of conventions.
    """
    try:
        if not inspection.profile_fits:
            profile = profile_from_toml(inspection.proposal, "the proposed profile")
        conclusions = conventions(align(read(paths, profile), config), config)
    except PipelineError:
        return inspection
    return replace(
        inspection,
        conventions=(*inspection.conventions, *conclusions.conventions),
        latencies=tuple(conclusions.latencies),
    )
