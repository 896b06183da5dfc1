# SPDX-License-Identifier: Apache-2.0
"""A channel's payloads to columns, whatever their encoding."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ReadError
from pipeline.formats import cdr
from pipeline.formats.definitions import Definition, parse_ros2msg
from pipeline.formats.mcap import Extent
from pipeline.formats.mcap_layout import Channel
from pipeline.formats.ragged import Column, Ragged
from pipeline.tables import Bool


def decode_channel(
    channel: Channel, payloads: Ragged, fields: Sequence[str]
) -> tuple[dict[str, Column], Bool]:
    """Columns of `fields` of all messages that fit their definition, and which those are.

    Raises
    ------
    ReadError
        An encoding that is not read, a definition that cannot be, or a field it does not have.
    """
    return cdr.decode_rows(definition_of(channel), payloads, fields)


def extent_of(channel: Channel, fields: Sequence[str]) -> Extent:
    """How many bytes of a payload `fields` need, told from the first one."""

    def extent(payload: NDArray[np.uint8]) -> int:
        try:
            return cdr.extent(definition_of(channel), payload, fields)
        except ReadError:  # told by `decode_channel`, to whoever asks for this channel
            return 0

    return extent


def definition_of(channel: Channel) -> Definition:
    """Field tree of a ROS 2 channel."""
    if channel.message_encoding != "cdr" or channel.schema_encoding != "ros2msg":
        raise ReadError(
            f"{channel.topic}: encoding {channel.message_encoding!r} with schema "
            f"{channel.schema_encoding!r} is not read; cdr with ros2msg is"
        )
    return parse_ros2msg(channel.definition.decode("utf-8", "replace"), channel.type)
