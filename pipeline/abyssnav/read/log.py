# SPDX-License-Identifier: Apache-2.0
"""One or more MCAP files and a profile to a `Log`, as recorded."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from abyssnav.errors import ReadError, printable
from abyssnav.profile import REQUIRED, SENSORS, Profile
from abyssnav.read.parts import (
    Part,
    check_same_recording,
    collect_role,
    dive_name,
    mcap_files,
    read_part,
    topics_of,
)
from abyssnav.read.roles import role_columns
from abyssnav.tables import Finding, InputFile, Int, Log


def read(paths: Sequence[Path], profile: Profile) -> Log:
    """One dive's recording with our names and units.

    Parameters
    ----------
    paths : files, or directories of files, of one dive; their order does not matter, nor how the
        recording is split, by time or by topic

    Raises
    ------
    ReadError
        No file, a file that is not MCAP, files of different dives, or a required role without
        messages.
    """
    files = mcap_files(paths)
    parts = [read_part(file, profile, others=None) for file in files]
    inputs = [InputFile(printable(p.path.name), p.path.stat().st_size, p.totals()) for p in parts]
    parts.sort(key=lambda part: (part.first_ns, part.path.name))
    specs = profile.roles()
    required = [t for role in profile.required() for t in topics_of(specs[role], parts)]
    check_same_recording(parts, required)
    findings = [finding for part in parts for finding in part.recording.findings]
    roles, recorded_after_s = {}, dict[str, float]()
    for role in specs:
        columns = _role(role, profile, parts, findings, recorded_after_s)
        if columns is not None:
            roles[role] = columns
    return Log(
        name=dive_name(paths[0]) if len(paths) == 1 else dive_name(parts[0].path),
        inputs=tuple(sorted(inputs, key=lambda file: file.name)),
        profile=profile.name,
        topics={role: specs[role].where for role in roles},
        roles=roles,
        findings=tuple(findings),
        recorded_after_s=recorded_after_s,
    )


def read_optional(paths: Sequence[Path], profile: Profile, names: Sequence[str]) -> Log:
    """Some roles of a recording, none of which it must hold: for evaluation, not to navigate.

    Raises
    ------
    ReadError
        No file, or a file that is not MCAP.
    """
    parts = [read_part(file, profile, others=None) for file in mcap_files(paths)]
    parts.sort(key=lambda part: (part.first_ns, part.path.name))
    findings = [finding for part in parts for finding in part.recording.findings]
    specs, roles = profile.roles(), {}
    for name in names:
        columns = _role(name, profile, parts, findings, {})
        if columns is not None:
            roles[name] = columns
    topics = {name: specs[name].where for name in roles}
    return Log(parts[0].path.stem, (), profile.name, topics, roles, tuple(findings))


def _role(
    role: str,
    profile: Profile,
    parts: Sequence[Part],
    findings: list[Finding],
    recorded_after_s: dict[str, float],
) -> dict[str, NDArray[Any]] | None:
    """Columns of one role; None when it is optional and cannot be had."""
    spec, required = profile.roles()[role], role in profile.required()
    present = any(spec.is_on(m.channel.topic) for part in parts for m in part.recording.messages)
    if not present and not required:
        return None
    try:
        fields = collect_role(role, profile, parts, findings)
        columns = role_columns(spec, fields)
    except ReadError as error:
        if required:
            raise
        findings.append(Finding(f"no {role}", spec.where, str(error)))
        return None
    findings += fields.findings
    if role in REQUIRED:
        recorded_after_s |= _recorded_after_s(role, columns, fields.log_time_ns[fields.message])
    return with_value(role, spec.where, columns, findings)


def _recorded_after_s(
    role: str, columns: Mapping[str, NDArray[Any]], log_time_ns: Int
) -> dict[str, float]:
    """By how much the recorder's time follows a role's stamps, and the pings' of replies.

    Of a sensor it is the least, which is no longer where messages are written in blocks, or all
    at the end; of replies the median, as a single wrong ping would make theirs less.
    """
    delay = np.min if role in SENSORS else np.median
    stamps = {role: columns["time_ns"]}
    if "ping_time_ns" in columns:
        stamps["ping"] = columns["ping_time_ns"]
    return {
        name: float(delay(log_time_ns - stamp_ns)) / 1e9
        for name, stamp_ns in stamps.items()
        if 0 < len(log_time_ns) == len(stamp_ns)
    }


#: Columns without which a message of a role has no value.
_VALUE = {
    "heading": ("heading_rad",), "depth": ("depth_m", "pressure_dbar"), "altitude": ("altitude_m",)
}  # fmt: skip


def with_value(
    role: str, where: str, columns: dict[str, NDArray[Any]], findings: list[Finding]
) -> dict[str, NDArray[Any]]:
    """Leave out messages whose depth, heading or altitude is not there.

    Raises
    ------
    ReadError
        No message has a value: such a topic is no sensor.
    """
    name = next((name for name in _VALUE.get(role, ()) if name in columns), None)
    if name is None or (kept := np.isfinite(columns[name])).all():
        return columns
    detail = f"{int((~kept).sum())} of {len(kept)} messages without a value: left out"
    findings.append(Finding(f"no {role}", where, detail))
    if not kept.any():
        raise ReadError(f"topic {where!r} for the role {role}: no message has a value")
    return {key: column[kept] for key, column in columns.items()}
