# SPDX-License-Identifier: Apache-2.0
"""The files of one dive, and the messages that a role finds in all of them."""

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from abyssnav.errors import ReadError
from abyssnav.formats.decoding import take_fields
from abyssnav.formats.gathering import Messages, Take
from abyssnav.formats.mcap.layout import Channel
from abyssnav.formats.mcap.reader import Recording, read_mcap
from abyssnav.formats.ragged import Column, concat
from abyssnav.profile import Profile, Role, same_type
from abyssnav.read.roles import Fields, paths_of
from abyssnav.tables import Finding, Int

#: Parts of one recording hold at most this much of the same time, and are silent between for less.
_SHARED_S, _SILENCE_S = 60.0, 86_400.0


@dataclass(frozen=True, eq=False)
class Part:
    """One file of a dive."""

    path: Path
    recording: Recording

    @property
    def first_ns(self) -> int:
        """Return the log time of its first message; a file without any comes last."""
        counts = self.recording.counts.values()
        return min((count.first_ns for count in counts), default=1 << 63)

    def totals(self) -> dict[str, int]:
        """Return the number of messages by topic."""
        totals: dict[str, int] = {}
        for channel in self.recording.channels:
            count = self.recording.counts.get(channel.id)
            totals[channel.topic] = totals.get(channel.topic, 0) + (count.messages if count else 0)
        return dict(sorted(totals.items()))


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


def dive_name(path: Path) -> str:
    """Stem of a file, or a directory's name."""
    return path.resolve().name if path.is_dir() else path.stem


def read_part(path: Path, profile: Profile, others: Take | None) -> Part:
    """Read what the profile's roles need of a file; of other topics what `others` says."""
    wanted: dict[str, list[str]] = {}
    for role in profile.roles().values():
        wanted.setdefault(role.topic, []).extend(paths_of(role))

    def select(channel: Channel) -> Take | None:
        paths = wanted.get(channel.topic)
        return others if paths is None else take_fields(channel, paths)

    return Part(path, read_mcap(path, select))


def collect(role: str, profile: Profile, parts: Sequence[Part], findings: list[Finding]) -> Fields:
    """Fields of a role's topic over all files and channels, by log time.

    Raises
    ------
    ReadError
        No such topic, no message on it, or none that can be read.
    """
    spec = profile.roles()[role]
    pieces: list[tuple[Int, Mapping[str, Column]]] = []
    problems: list[ReadError] = []
    for part in parts:
        for messages in part.recording.messages:
            if messages.channel.topic == spec.topic:
                try:
                    pieces.append(_columns(part, messages, spec, findings))
                except ReadError as error:
                    problems.append(error)
    if not pieces:
        raise problems[0] if problems else ReadError(_not_there(role, profile, parts))
    findings += [Finding("channel left out", spec.topic, str(error)) for error in problems]
    time = np.concatenate([time for time, _ in pieces])
    try:
        columns = {name: concat([part[name] for _, part in pieces]) for name in pieces[0][1]}
    except (TypeError, ValueError):
        raise ReadError(f"{spec.topic}: fields differ in kind between its channels") from None
    if (np.diff(time) < 0).any():
        order = np.argsort(time, kind="stable")
        time, columns = time[order], {name: column[order] for name, column in columns.items()}
    return Fields(spec, columns, time)


def refuse_strangers(parts: Sequence[Part], topics: Sequence[str]) -> None:
    """Refuse files that cannot be parts of one recording: days apart, or of the same time.

    Judged by the 5th and 95th percentile of each topic's log times, so that single wild stamps
    decide nothing.

    Raises
    ------
    ReadError
        Naming the two files, the topic, and what to do.
    """
    if len(parts) < 2:
        return
    for topic in topics:
        spans = [
            (*np.quantile(messages.log_time_ns, (0.05, 0.95)), part.path.name)
            for part in parts
            for messages in part.recording.messages
            if messages.channel.topic == topic and len(messages.log_time_ns)
        ]
        spans.sort()
        for (_, end, name), (begin, _, other) in pairwise(spans):
            apart_s = (begin - end) / 1e9
            if name == other or -_SHARED_S <= apart_s <= _SILENCE_S:
                continue
            told = (
                f"lie {apart_s / 86_400:.0f} days apart on {topic!r}"
                if apart_s > 0
                else f"hold {topic!r} of the same time"
            )
            raise ReadError(
                f"{name} and {other} {told}: not parts of one recording; "
                "run them one by one, or give their names to batch"
            )


def _columns(
    part: Part, messages: Messages, spec: Role, findings: list[Finding]
) -> tuple[Int, Mapping[str, Column]]:
    """Log times and columns of one channel of one file."""
    channel, paths = messages.channel, paths_of(spec)
    where = f"{part.path.name}, topic {channel.topic!r}"
    if spec.type and channel.type and not same_type(spec.type, channel.type):
        raise ReadError(f"{where}: is {channel.type}; the profile says {spec.type}")
    if messages.problem:
        raise ReadError(f"{where}: {messages.problem}")
    if messages.lost:
        total = messages.lost + len(messages.log_time_ns)
        detail = f"{messages.lost} of {total} messages do not fit {channel.type}: left out"
        findings.append(Finding("damaged messages", where, detail))
    for path in paths if channel.message_encoding == "json" else ():  # which has no definition
        column = messages.columns[path]
        if isinstance(column, np.ndarray) and column.dtype.kind == "f" and np.isnan(column).all():
            findings.append(Finding("no value", where, f"{path} is unknown in every message"))
    return messages.log_time_ns, {path: messages.columns[path] for path in paths}


def _not_there(role: str, profile: Profile, parts: Sequence[Part]) -> str:
    """Say which topic was expected, and what there is."""
    topic = profile.roles()[role].topic
    names = ", ".join(part.path.name for part in parts)
    present = sorted({c.topic for part in parts for c in part.recording.channels})
    if topic in present:
        return f"{names}: topic {topic!r} for the role {role} holds no message"
    cuts = [f for part in parts for f in part.recording.findings if f.what == "cut short"]
    if cuts and not present:
        return f"{cuts[0].where}: cut short before any message: {cuts[0].detail}"
    nearest = difflib.get_close_matches(topic, present, n=1)
    hint = f"; nearest: {nearest[0]!r}" if nearest else "" if present else "; there is none at all"
    return f"{names}: no topic {topic!r} for the role {role} (profile {profile.name}){hint}"
