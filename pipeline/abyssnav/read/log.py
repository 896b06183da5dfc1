# SPDX-License-Identifier: Apache-2.0
"""One or more MCAP files and a profile to a `Log`, as recorded."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from abyssnav.errors import ReadError
from abyssnav.profile import REQUIRED, Profile
from abyssnav.read.parts import Part, collect, dive_name, mcap_files, read_part, refuse_strangers
from abyssnav.read.roles import role_columns
from abyssnav.tables import Finding, InputFile, Log


def read(paths: Sequence[Path], profile: Profile) -> Log:
    """One dive's recording with our names and units.

    Parameters
    ----------
    paths : files, or directories of files, of one dive; their order does not matter

    Raises
    ------
    ReadError
        No file, a file that is not MCAP, files of different dives, or a required role without
        messages.
    """
    files = mcap_files(paths)
    parts = [read_part(file, profile, others=None) for file in files]
    inputs = [InputFile(p.path.name, p.path.stat().st_size, p.totals()) for p in parts]
    parts.sort(key=lambda part: part.first_ns)
    refuse_strangers(parts, [profile.roles()[role].topic for role in REQUIRED])
    findings = [finding for part in parts for finding in part.recording.findings]
    roles = {}
    for role in profile.roles():
        columns = _role(role, profile, parts, findings)
        if columns is not None:
            roles[role] = columns
    return Log(
        name=dive_name(paths[0]) if len(paths) == 1 else parts[0].path.stem,
        inputs=tuple(sorted(inputs, key=lambda file: file.name)),
        profile=profile.name,
        topics={role: profile.roles()[role].topic for role in roles},
        roles=roles,
        findings=tuple(findings),
    )


def _role(
    role: str, profile: Profile, parts: Sequence[Part], findings: list[Finding]
) -> dict[str, NDArray[Any]] | None:
    """Columns of one role; None when it is optional and cannot be had."""
    spec = profile.roles()[role]
    here = any(m.channel.topic == spec.topic for part in parts for m in part.recording.messages)
    if not here and role not in REQUIRED:
        return None
    try:
        fields = collect(role, profile, parts, findings)
        columns, time_ns = role_columns(spec, fields), fields.time_ns()
    except ReadError as error:
        if role in REQUIRED:
            raise
        findings.append(Finding(f"no {role}", spec.topic, str(error)))
        return None
    findings += fields.findings
    columns["time_ns"] = time_ns[columns["message"]] if "message" in columns else time_ns
    return _with_value(role, spec.topic, columns, findings)


def _with_value(
    role: str, topic: str, columns: dict[str, NDArray[Any]], findings: list[Finding]
) -> dict[str, NDArray[Any]]:
    """Leave out messages whose depth or heading is not there."""
    names = {"heading": ("heading_rad",), "depth": ("depth_m", "pressure_dbar")}.get(role, ())
    name = next((name for name in names if name in columns), None)
    if name is None or (kept := np.isfinite(columns[name])).all():
        return columns
    detail = f"{int((~kept).sum())} of {len(kept)} messages without a value: left out"
    findings.append(Finding(f"no {role}", topic, detail))
    if not kept.any():
        raise ReadError(f"topic {topic!r} for the role {role}: no message has a value")
    return {key: column[kept] for key, column in columns.items()}
