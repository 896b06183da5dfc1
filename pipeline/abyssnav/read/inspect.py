# SPDX-License-Identifier: Apache-2.0
"""What a log holds: topics, roles found and missed, clocks, damage."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from abyssnav.config import Config
from abyssnav.errors import ReadError
from abyssnav.formats.gathering import TIMES, Decoded, Take
from abyssnav.formats.mcap.reader import read_mcap
from abyssnav.formats.ragged import Ragged
from abyssnav.profile import REQUIRED, Profile
from abyssnav.read.field_guesses import Example
from abyssnav.read.fields import RoleFields
from abyssnav.read.infer_profile import propose
from abyssnav.read.parts import Part, collect_role, mcap_files, read_part
from abyssnav.read.roles import role_columns
from abyssnav.tables import Finding, Int

#: A stamp before 1990 was never set.
_UNSET_NS = 631_152_000_000_000_000
#: Log time follows the stamp by transport, not by more.
_MAX_LATE_S = 1.0


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
class Survey:
    """What `inspect` shows."""

    topics: tuple[TopicSummary, ...]
    roles: dict[str, str]  #: role -> topic, of the roles that can be read
    findings: tuple[Finding, ...]
    proposal: str = ""  #: a profile to start from, TOML; empty when all required roles are there

    def plain(self) -> dict[str, Any]:
        """Return the object that `inspect --json` prints."""
        shown = ("topic", "type", "encoding", "messages", "first_ns", "last_ns")
        return {
            "topics": [{name: getattr(topic, name) for name in shown} for topic in self.topics],
            "roles": self.roles,
            "findings": [asdict(finding) for finding in self.findings],
        }


def survey(paths: Sequence[Path], profile: Profile, config: Config | None = None) -> Survey:
    """Look through every file, whatever is in it.

    Raises
    ------
    ReadError
        No file, or one that is not MCAP.
    """
    parts = [read_part(file, profile, others=TIMES) for file in mcap_files(paths)]
    parts.sort(key=lambda part: part.first_ns)
    findings = [finding for part in parts for finding in part.recording.findings]
    roles = {}
    for role, spec in profile.roles().items():
        try:
            fields = collect_role(role, profile, parts, findings)
            role_columns(spec, fields)
            clock = _clock_findings(role, fields)
        except ReadError as error:
            findings.append(Finding(f"no {role}", spec.where, str(error)))
            continue
        roles[role] = spec.where
        findings += fields.findings + clock
    missed = any(role not in roles for role in REQUIRED)
    proposal = propose(profile, _examples(parts), roles) if missed else ""
    if profile.beacons is None and not (config and config.beacon):
        told = "neither [beacons] in the profile, nor [[beacon]] in the settings"
        findings.append(Finding("no beacons", profile.name, told))
    return Survey(_topics(parts), roles, tuple(findings), proposal)


def _examples(parts: Sequence[Part]) -> dict[str, Example]:
    """First message of each topic."""
    first = Take(_first_payload, lambda _: None)
    found: dict[str, Example] = {}
    for part in parts:
        for messages in read_mcap(part.path, lambda _: first).messages:
            if len(messages.log_time_ns):
                payloads = messages.columns["payload"]
                assert isinstance(payloads, Ragged)
                payload = payloads.row_bytes()[0]
                found.setdefault(messages.channel.topic, Example(messages.channel, payload))
    return dict(sorted(found.items()))


def _first_payload(payloads: Ragged) -> Decoded:
    kept = np.arange(len(payloads)) < 1
    return {"payload": payloads[kept]}, kept


def _topics(parts: Sequence[Part]) -> tuple[TopicSummary, ...]:
    times: dict[tuple[str, str, str], list[Int]] = {}
    for part in parts:
        by_id = {m.channel.id: m.log_time_ns for m in part.recording.messages}
        for channel in part.recording.channels:
            key = (channel.topic, channel.type, channel.message_encoding)
            times.setdefault(key, []).append(by_id.get(channel.id, np.zeros(0, np.int64)))
    return tuple(_summary(*key, np.concatenate(of)) for key, of in sorted(times.items()))


def _summary(topic: str, kind: str, encoding: str, log_time_ns: Int) -> TopicSummary:
    n = len(log_time_ns)
    if n == 0:
        return TopicSummary(topic, kind, encoding, 0, None, None, np.nan, np.nan)
    ordered = np.sort(log_time_ns)
    first, last = int(ordered[0]), int(ordered[-1])
    rate_hz = (n - 1) / (last - first) * 1e9 if last > first else np.nan
    gap_s = float(np.diff(ordered).max(initial=0)) / 1e9 if n > 1 else np.nan
    return TopicSummary(topic, kind, encoding, n, first, last, rate_hz, gap_s)


def _clock_findings(role: str, fields: RoleFields) -> list[Finding]:
    """Stamps that were never set, run back, or are far from the log's own time."""
    stamp, log, topic = fields.time_ns(), fields.log_time_ns[fields.message], fields.role.where
    unset = stamp < _UNSET_NS
    found = []
    if unset.any():
        detail = f"{int(unset.sum())} of {len(stamp)} messages have no stamp (before 1990)"
        found.append(Finding("clock: unset stamps", topic, detail))
    stamp, log = stamp[~unset], log[~unset]
    back = int((np.diff(stamp) < 0).sum())
    if back:
        found.append(
            Finding("clock: stamps run back", topic, f"{back} times, in order of log time")
        )
    late_s = float(np.median(log - stamp)) / 1e9 if len(stamp) else 0.0
    if abs(late_s) > _MAX_LATE_S and not np.isnan(late_s):
        detail = f"log time is {late_s:+.3f} s after the {role} stamps, in the median"
        found.append(Finding("clock: stamp and log differ", topic, detail))
    return found
