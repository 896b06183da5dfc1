# SPDX-License-Identifier: Apache-2.0
"""What a log holds: topics, the roles that can be read and those that cannot, clocks, damage."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from abyssnav.config import Config
from abyssnav.errors import ReadError
from abyssnav.formats.mcap.accumulator import TIMES
from abyssnav.formats.mcap.official import Extras, compare_with_library, list_extras
from abyssnav.profile import Profile, Role
from abyssnav.read.infer_profile import infer_profile
from abyssnav.read.log import with_value
from abyssnav.read.parts import Part, collect_role, mcap_files, read_part, topics_of
from abyssnav.read.roles import role_columns
from abyssnav.read.samples import sample_topics
from abyssnav.read.stamps import clock_findings, is_of_other_clock, on_recorders_clock
from abyssnav.tables import Columns, Finding, Int


@dataclass(frozen=True)
class TopicSummary:
    """One topic; times are log times."""

    topic: str
    type: str
    encoding: str
    messages: int
    first_ns: int | None
    last_ns: int | None
    rate_hz: float
    longest_gap_s: float


@dataclass(frozen=True)
class Inspection:
    """What `inspect` shows."""

    topics: tuple[TopicSummary, ...]
    roles: dict[str, str]  #: role -> topic, of the roles that can be read
    findings: tuple[Finding, ...]
    proposal: str = ""  #: a profile for this log, TOML; empty when it holds no message
    profile_fits: bool = True  #: whether the given profile reads all required roles
    extras: tuple[tuple[str, Extras], ...] = ()  #: file name, and what it holds beside messages
    conventions: tuple[Mapping[str, Any], ...] = ()  #: of units, signs and frames, by the data
    latencies: tuple[Mapping[str, Any], ...] = ()  #: of the sensors against each other, by the data

    def plain(self) -> dict[str, Any]:
        """Return the object that `inspect --json` prints."""
        shown = ("topic", "type", "encoding", "messages", "first_ns", "last_ns")
        return {
            "topics": [{name: getattr(topic, name) for name in shown} for topic in self.topics],
            "roles": self.roles,
            "findings": [asdict(finding) for finding in self.findings],
            "profile": self.proposal,
            "conventions": [dict(convention) for convention in self.conventions],
            "latencies": [dict(latency) for latency in self.latencies],
        }


def inspect(
    paths: Sequence[Path], profile: Profile, config: Config | None = None, *, verify: bool = False
) -> Inspection:
    """Look through every file, whatever is in it, and propose a profile.

    Parameters
    ----------
    verify : read sound files with the official library too, and say where the two differ

    Raises
    ------
    ReadError
        No file, or one that is not MCAP.
    """
    files = mcap_files(paths)
    parts = [read_part(file, profile, others=TIMES) for file in files]
    parts.sort(key=lambda part: (part.first_ns, part.path.name))
    findings = [finding for part in parts for finding in part.recording.findings]
    roles: dict[str, str] = {}
    missing: dict[str, Finding] = {}
    on_log_time: dict[str, Role] = {}
    for role, spec in profile.roles().items():
        try:
            fields = collect_role(role, profile, parts, findings)
            with_value(role, spec.where, role_columns(spec, fields), [])
            clock = clock_findings(role, fields)
        except ReadError as error:
            missing[role] = Finding(f"no {role}", spec.where, str(error))
            continue
        roles[role] = ", ".join(topics_of(spec, parts))
        if is_of_other_clock(fields):
            on_log_time[role] = on_recorders_clock(fields)
        findings += fields.findings + clock
    findings += _missing(missing, profile, parts)
    has_beacons = bool(config and config.beacon)
    if profile.travel_time is not None and profile.beacons is None and not has_beacons:
        detail = "neither [beacons] in the profile, nor [[beacon]] in the settings, nor --beacons"
        findings.append(Finding("no beacons", profile.name, detail))
    samples = sample_topics(parts)
    given = msgspec.structs.replace(profile, **on_log_time)
    proposal = infer_profile(given, samples, roles, has_beacons, partial(_reread, parts))
    extras = [(part.path.name, list_extras(part.path)) for part in parts]
    findings += [finding for _, extra in extras for finding in extra.findings]
    if verify:
        findings += [f for part in parts for f in compare_with_library(part.path).differences]
    return Inspection(
        _topics(parts),
        roles,
        tuple(findings),
        proposal.text,
        all(role in roles for role in profile.required()),
        tuple(extras),
    )


def _reread(parts: Sequence[Part], specs: Mapping[str, Any]) -> dict[str, Columns] | None:
    """Columns of three sensors over all messages; None where one cannot be read."""
    sensors = Profile(**specs)
    again = [read_part(part.path, sensors, others=None) for part in parts]
    try:
        return {
            role: role_columns(spec, collect_role(role, sensors, again, []))
            for role, spec in specs.items()
        }
    except ReadError:
        return None


def _missing(
    missing: Mapping[str, Finding], profile: Profile, parts: Sequence[Part]
) -> list[Finding]:
    """What is missing: each required role, and the optional ones without a topic in one line."""
    specs, required = profile.roles(), profile.required()
    absent = [
        role for role in missing if role not in required and not topics_of(specs[role], parts)
    ]
    findings = [finding for role, finding in missing.items() if role not in absent]
    if absent:
        detail = f"no topic for {', '.join(absent)}: optional"
        findings.append(Finding("optional roles", f"profile {profile.name}", detail))
    return findings


def _topics(parts: Sequence[Part]) -> tuple[TopicSummary, ...]:
    times: dict[tuple[str, str, str], list[Int]] = {}
    for part in parts:
        by_id = {m.channel.id: m.log_time_ns for m in part.recording.messages}
        for channel in part.recording.channels:
            key = (channel.topic, channel.type, channel.message_encoding)
            times.setdefault(key, []).append(by_id.get(channel.id, np.zeros(0, np.int64)))
    return tuple(_summary(*key, np.concatenate(every)) for key, every in sorted(times.items()))


def _summary(topic: str, kind: str, encoding: str, log_time_ns: Int) -> TopicSummary:
    n = len(log_time_ns)
    if n == 0:
        return TopicSummary(topic, kind, encoding, 0, None, None, np.nan, np.nan)
    ordered = np.sort(log_time_ns)
    first, last = int(ordered[0]), int(ordered[-1])
    rate_hz = (n - 1) / (last - first) * 1e9 if last > first else np.nan
    gap_s = float(np.diff(ordered).max(initial=0)) / 1e9 if n > 1 else np.nan
    return TopicSummary(topic, kind, encoding, n, first, last, rate_hz, gap_s)
