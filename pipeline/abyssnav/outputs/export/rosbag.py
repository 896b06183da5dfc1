# SPDX-License-Identifier: Apache-2.0
"""A rosbag2 folder: `solution.mcap` with the metadata.yaml that `ros2 bag` reads."""

import shutil
from pathlib import Path
from typing import Any

from abyssnav.errors import ReadError
from abyssnav.formats.mcap.official import topic_counts
from abyssnav.outputs.export.source import Exported


def write_rosbag2(source: Exported, folder: Path) -> list[Path]:
    """All messages of all methods: the bag is the dive's `solution.mcap` as it stands."""
    recording = source.folder / "solution.mcap"
    if not recording.is_file():
        raise ReadError(f"{recording}: not there; run the dive with it in output.files")
    bag = folder / f"{source.name}_rosbag2"
    bag.mkdir(exist_ok=True)
    copied = bag / f"{source.name}.mcap"
    shutil.copyfile(recording, copied)
    (bag / "metadata.yaml").write_text(_metadata(copied), encoding="utf-8")
    return [bag / "metadata.yaml", copied]


def _metadata(recording: Path) -> str:
    """Version 5 of the metadata, which every rosbag2 since Foxy reads."""
    topics, first_ns, last_ns = topic_counts(recording)
    lines = [
        "rosbag2_bagfile_information:",
        "  version: 5",
        "  storage_identifier: mcap",
        "  duration:",
        f"    nanoseconds: {last_ns - first_ns}",
        "  starting_time:",
        f"    nanoseconds_since_epoch: {first_ns}",
        f"  message_count: {sum(count for *_, count in topics)}",
        "  topics_with_message_count:",
    ]
    for topic, kind, count in topics:
        lines += [
            "    - topic_metadata:",
            f"        name: {topic}",
            f"        type: {kind}",
            "        serialization_format: cdr",
            '        offered_qos_profiles: ""',
            f"      message_count: {count}",
        ]
    lines += [
        '  compression_format: ""',
        '  compression_mode: ""',
        "  relative_file_paths:",
        f"    - {_quoted(recording.name)}",
        "  files:",
        f"    - path: {_quoted(recording.name)}",
        "      starting_time:",
        f"        nanoseconds_since_epoch: {first_ns}",
        "      duration:",
        f"        nanoseconds: {last_ns - first_ns}",
        f"      message_count: {sum(count for *_, count in topics)}",
    ]
    return "\n".join(lines) + "\n"


def _quoted(text: Any) -> str:
    return "'" + str(text).replace("'", "''") + "'"
