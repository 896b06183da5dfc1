# SPDX-License-Identifier: Apache-2.0
"""The MCAP container: `read` gives a file's topics as Arrow tables."""

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pyarrow as pa


def read(
    path: str | PathLike[str], topics: str | Sequence[str] | None = None
) -> "dict[str, pa.Table]":
    """Topics of an MCAP file as Arrow tables, by topic; no loop over messages where layouts allow.

    >>> from abyssnav.formats import mcap
    >>> tables = mcap.read("sample_logs/clean.mcap", ["/depth"])
    >>> tables["/depth"].column_names
    ['log_time', 'header.stamp', 'header.frame_id', 'depth']
    >>> tables["/depth"].num_rows
    1800

    ROS 2 (CDR), ROS 1, Protobuf and JSON messages are decoded, in files with or without chunks,
    index, compression, and in rosbag2's packed ones.  Rows are by log time.

    Parameters
    ----------
    topics : topics wanted; default: all that have messages

    Returns
    -------
    tables : `log_time` timestamp[ns, UTC], then a column a field by its dotted path: numbers and
        flags as they are, stamps timestamp[ns, UTC], durations duration[ns], text large_string,
        fixed arrays fixed_size_list, others large_list (members of an array of messages: one each).
        Of messages that cannot be decoded, `payload` large_binary.  The schema's metadata tells
        `type`, `encoding`, `problem` (why not), `lost` (messages that do not fit their definition,
        left out) and `findings` (JSON: damage of the file and where).

    Raises
    ------
    ReadError
        The file cannot be opened or is no MCAP, a topic is not in it, or its fields are no columns.
    """
    from abyssnav.formats.arrow import read_tables

    return read_tables(Path(path), [topics] if isinstance(topics, str) else topics)
