# SPDX-License-Identifier: Apache-2.0
"""What the data of a log say of its conventions, for `inspect`: no filter is run."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from abyssnav.align import align
from abyssnav.config import Config
from abyssnav.diagnose.causes import find_causes
from abyssnav.errors import PipelineError
from abyssnav.profile import Profile, profile_from_toml
from abyssnav.read import Inspection, read
from abyssnav.tables import Dive


def conventions(dive: Dive, config: Config) -> list[dict[str, Any]]:
    """Conventions that the data contradict, each with what they say and what mends it.

    Returns
    -------
    conventions : role, name, value, log_likelihood_ratio over the runner-up, runner_up, mend, and
        seen, with the numbers
    """
    return [
        {
            "role": cause.role,
            "name": cause.name,
            "value": cause.value,
            "log_likelihood_ratio": round(float(cause.evidence.ratio), 1),
            "runner_up": cause.evidence.runner_up,
            "mend": cause.mend.phrase(),
            "seen": cause.seen,
        }
        for cause in find_causes(dive, config)
    ]


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
    return replace(inspection, conventions=(*inspection.conventions, *conclusions))
