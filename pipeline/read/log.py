# SPDX-License-Identifier: Apache-2.0
"""One or more MCAP files and a profile to a `Log`, as recorded."""

import difflib
import hashlib
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ReadError
from pipeline.formats.decoding import decode_channel, extent_of
from pipeline.formats.mcap import Channel, Extent, Messages, Recording, mapped, read_mcap
from pipeline.formats.ragged import Column, concat
from pipeline.profile import REQUIRED, Profile
from pipeline.read.roles import Fields, paths_of, role_columns
from pipeline.tables import Finding, InputFile, Int, Log


def read(paths: Sequence[Path], profile: Profile) -> Log:
    """One dive's recording with our names and units.

    Parameters
    ----------
    paths : files, or directories of files, of one dive; their order does not matter

    Raises
    ------
    ReadError
        No file, a file that is not MCAP, or a required role without messages.
    """
    files = mcap_files(paths)
    with ThreadPoolExecutor(max_workers=1) as pool:
        hashes = [pool.submit(_sha256, file) for file in files]
        parts = [_read_part(file, profile) for file in files]
        inputs = tuple(
            InputFile(part.path.name, part.path.stat().st_size, sha.result(), _totals(part))
            for part, sha in zip(parts, hashes, strict=True)
        )
    parts.sort(key=lambda part: part.first_ns)
    findings = [finding for part in parts for finding in part.recording.findings]
    roles = {}
    for role in profile.roles():
        columns = _role(role, profile, parts, findings)
        if columns:
            roles[role] = columns
    return Log(
        name=dive_name(paths),
        inputs=tuple(sorted(inputs, key=lambda file: file.name)),
        profile=profile.name,
        topics={role: profile.roles()[role].topic for role in roles},
        roles=roles,
        findings=tuple(findings),
    )


def mcap_files(paths: Sequence[Path]) -> list[Path]:
    """Files of a dive; a directory stands for the .mcap files in it.

    Raises
    ------
    ReadError
        A path that is not there, or a directory without such files.
    """
    files: list[Path] = []
    for path in paths:
        inside = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
        if not inside:
            raise ReadError(f"{path}: no .mcap file in this directory")
        files += [file for file in inside if file not in files]
    if not files:
        raise ReadError("no file to read")
    return files


def dive_name(paths: Sequence[Path]) -> str:
    """Stem of the first file, or the directory's name."""
    first = paths[0].resolve()
    return first.name if first.is_dir() else first.stem


@dataclass(frozen=True, eq=False)
class _Part:
    """One file of the dive."""

    path: Path
    recording: Recording

    @property
    def first_ns(self) -> int:
        return min((count.first_ns for count in self.recording.counts.values()), default=0)


def _sha256(path: Path) -> str:
    with mapped(path) as buffer:
        return hashlib.sha256(buffer).hexdigest()


def _read_part(path: Path, profile: Profile) -> _Part:
    """Read one file; topics whose payloads vary before the last field wanted are read whole."""
    wanted = _paths_by_topic(profile)
    recording = read_mcap(path, lambda channel: _extent(channel, wanted))
    return _Part(path, recording)


def _paths_by_topic(profile: Profile) -> dict[str, list[str]]:
    wanted: dict[str, list[str]] = {}
    for role in profile.roles().values():
        wanted.setdefault(role.topic, []).extend(paths_of(role))
    return wanted


def _extent(channel: Channel, wanted: Mapping[str, list[str]]) -> Extent | None:
    if channel.topic not in wanted:
        return None
    return extent_of(channel, wanted[channel.topic])


def _totals(part: _Part) -> dict[str, int]:
    """Messages by topic."""
    totals: dict[str, int] = {}
    for channel in part.recording.channels:
        count = part.recording.counts.get(channel.id)
        totals[channel.topic] = totals.get(channel.topic, 0) + (count.messages if count else 0)
    return dict(sorted(totals.items()))


def _role(
    role: str, profile: Profile, parts: Sequence[_Part], findings: list[Finding]
) -> dict[str, NDArray[Any]]:
    """Columns of one role over all files, by log time; empty when it is optional and not there."""
    spec = profile.roles()[role]
    found = [
        (part, messages)
        for part in parts
        for messages in part.recording.messages
        if messages.channel.topic == spec.topic
    ]
    if not found:
        if role in REQUIRED:
            raise ReadError(_not_there(role, profile, parts))
        return {}
    pieces = [_decode(part, messages, paths_of(spec), findings) for part, messages in found]
    time = np.concatenate([time for time, _ in pieces])
    columns = {name: concat([c[name] for _, c in pieces]) for name in pieces[0][1]}
    order = np.argsort(time, kind="stable")
    if (np.diff(order) != 1).any():
        time, columns = time[order], {name: column[order] for name, column in columns.items()}
    fields = Fields(spec, columns, time)
    ours = role_columns(spec, fields)
    own = fields.time_ns()
    ours["time_ns"] = own[ours["message"]] if "message" in ours else own
    return _without_nan(role, spec.topic, ours, findings)


def _decode(
    part: _Part, messages: Messages, paths: list[str], findings: list[Finding]
) -> tuple[Int, dict[str, Column]]:
    channel = messages.channel
    try:
        columns, kept = decode_channel(channel, messages.payloads, paths)
        if not (kept.all() or messages.complete):
            whole = read_mcap(part.path, lambda c: len if c.id == channel.id else None)
            messages = replace(whole.messages[0], channel=channel)
            columns, kept = decode_channel(channel, messages.payloads, paths)
    except ReadError as error:
        raise ReadError(f"{part.path.name}, topic {channel.topic!r}: {error}") from None
    if not kept.all():
        lost = int((~kept).sum())
        detail = f"{lost} of {len(kept)} messages do not fit {channel.type}: left out"
        findings.append(Finding("damaged messages", f"{part.path.name} {channel.topic}", detail))
    return messages.log_time_ns[kept], columns


def _without_nan(
    role: str, topic: str, columns: dict[str, NDArray[Any]], findings: list[Finding]
) -> dict[str, NDArray[Any]]:
    """Leave out messages whose depth or heading is not there."""
    name = {"heading": "heading_rad", "depth": "depth_m"}.get(role)
    if name is None:
        return columns
    kept = np.isfinite(columns[name])
    if kept.all():
        return columns
    detail = f"{int((~kept).sum())} of {len(kept)} messages without a value: left out"
    findings.append(Finding(f"no {role}", topic, detail))
    return {key: column[kept] for key, column in columns.items()}


def _not_there(role: str, profile: Profile, parts: Sequence[_Part]) -> str:
    """Say which topic was expected, and what there is."""
    topic = profile.roles()[role].topic
    names = ", ".join(part.path.name for part in parts)
    present = sorted({c.topic for part in parts for c in part.recording.channels})
    if topic in present:
        return f"{names}: topic {topic!r} for the role {role} holds no message"
    nearest = difflib.get_close_matches(topic, present, n=1, cutoff=0.0)
    hint = f"nearest: {nearest[0]!r}" if nearest else "it has no topic at all"
    return f"{names}: no topic {topic!r} for the role {role} (profile {profile.name}); {hint}"
