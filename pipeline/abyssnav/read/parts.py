# SPDX-License-Identifier: Apache-2.0
"""The files of one dive, and the messages that a role finds in all of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from abyssnav.errors import ReadError, nearest_names, printable
from abyssnav.formats.columns import Column, concatenate
from abyssnav.formats.decoding import field_decoder
from abyssnav.formats.mcap.accumulator import ChannelDecoder, Messages
from abyssnav.formats.mcap.file_index import Channel
from abyssnav.formats.mcap.reader import Recording, read_mcap
from abyssnav.profile import Profile, Role, paths_of, same_type
from abyssnav.read.fields import RoleFields
from abyssnav.tables import Finding, Int

#: How the names of logs end; the last two are rosbag2's packed as a whole.
SUFFIXES = (".mcap", ".mcap.zst", ".mcap.zstd")
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
    """Files of a dive; a directory stands for the MCAP files in it.

    Raises
    ------
    ReadError
        A path that is not there, or a directory without such files.
    """
    files: list[Path] = []
    for path in paths:
        inside = sorted(f for f in path.iterdir() if is_mcap(f)) if path.is_dir() else [path]
        if not inside:
            raise ReadError(f"{path}: no .mcap file in this directory")
        files += [file for file in inside if file not in files]
    if not files:
        raise ReadError("no file to read")
    return files


def is_mcap(path: Path) -> bool:
    """Whether a file's name is that of a log, packed as a whole or not."""
    return path.name.endswith(SUFFIXES)


def dive_name(path: Path) -> str:
    """Stem of a file, or a directory's name."""
    if path.is_dir():
        return path.resolve().name
    suffix = next((s for s in SUFFIXES if path.name.endswith(s)), path.suffix)
    return path.name.removesuffix(suffix)


def read_part(path: Path, profile: Profile, others: ChannelDecoder | None) -> Part:
    """Read what the profile's roles need of a file; of other topics what `others` says."""
    roles = profile.roles().values()

    def select(channel: Channel) -> ChannelDecoder | None:
        paths = [path for role in roles if role.is_on(channel.topic) for path in paths_of(role)]
        on_any = any(role.is_on(channel.topic) for role in roles)
        return field_decoder(channel, list(dict.fromkeys(paths))) if on_any else others

    return Part(path, read_mcap(path, select))


def topics_of(role: Role, parts: Sequence[Part]) -> list[str]:
    """Topics of the files that a role is on, by name."""
    return sorted(
        {c.topic for part in parts for c in part.recording.channels if role.is_on(c.topic)}
    )


def collect_role(
    role: str, profile: Profile, parts: Sequence[Part], findings: list[Finding]
) -> RoleFields:
    """Fields of a role's topics over all files and channels, by log time.

    Messages of one instant come in the order of their topics' names, then of the files, so that
    it is the same dive however a recording is split.

    Raises
    ------
    ReadError
        No such topic, no message on it, or none that can be read.
    """
    spec = profile.roles()[role]
    pieces: list[tuple[tuple[str, int], Int, Mapping[str, Column]]] = []
    problems: list[ReadError] = []
    for part in parts:
        for messages in part.recording.messages:
            topic = messages.channel.topic
            if spec.is_on(topic):
                try:
                    time_ns, columns = _columns(part, messages, spec, findings)
                except ReadError as error:
                    problems.append(error)
                else:
                    first_ns = int(time_ns.min()) if len(time_ns) else 0
                    pieces.append(((topic, first_ns), time_ns, columns))
    if not pieces:
        raise problems[0] if problems else ReadError(_not_there(role, profile, parts))
    findings += [Finding("channel left out", spec.where, str(error)) for error in problems]
    pieces.sort(key=lambda piece: piece[0])
    time = np.concatenate([time for _, time, _ in pieces])
    try:
        merged = {name: concatenate([part[name] for *_, part in pieces]) for name in pieces[0][2]}
    except (TypeError, ValueError):
        raise ReadError(f"{spec.where}: fields differ in kind between its channels") from None
    if (np.diff(time) < 0).any():
        order = np.argsort(time, kind="stable")
        time, merged = time[order], {name: column[order] for name, column in merged.items()}
    return RoleFields(spec, merged, time)


def check_same_recording(parts: Sequence[Part], topics: Sequence[str]) -> None:
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
            (*np.quantile(messages.log_time_ns, (0.05, 0.95)), printable(part.path.name))
            for part in parts
            for messages in part.recording.messages
            if messages.channel.topic == topic and len(messages.log_time_ns)
        ]
        spans.sort()
        for (_, end, name), (begin, _, other) in pairwise(spans):
            apart_s = (begin - end) / 1e9
            if name == other or -_SHARED_S <= apart_s <= _SILENCE_S:
                continue
            problem = (
                f"lie {apart_s / 86_400:.0f} days apart on {topic!r}"
                if apart_s > 0
                else f"hold {topic!r} of the same time"
            )
            raise ReadError(
                f"{name} and {other} {problem}: not parts of one recording; "
                "run them one by one, or give their names to batch"
            )


def _columns(
    part: Part, messages: Messages, spec: Role, findings: list[Finding]
) -> tuple[Int, Mapping[str, Column]]:
    """Log times and columns of one channel of one file."""
    channel, paths = messages.channel, paths_of(spec)
    where = f"{printable(part.path.name)}, topic {channel.topic!r}"
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
    spec = profile.roles()[role]
    topic = spec.where
    names = ", ".join(printable(part.path.name) for part in parts)
    present = sorted({c.topic for part in parts for c in part.recording.channels})
    if any(spec.is_on(one) for one in present):
        return f"{names}: topic {topic!r} for the role {role} holds no message"
    cuts = [f for part in parts for f in part.recording.findings if f.what == "cut short"]
    if cuts and not present:
        return f"{cuts[0].where}: cut short before any message: {cuts[0].detail}"
    nearest = nearest_names(topic, present, cutoff=0.6)
    hint = f"; nearest: {nearest[0]!r}" if nearest else "" if present else "; there is none at all"
    return (
        f"{names}: no topic {topic!r} for the role {role} (profile {profile.name}){hint}; "
        "abyssnav inspect proposes a profile, for -p"
    )
