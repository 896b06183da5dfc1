# SPDX-License-Identifier: Apache-2.0
"""A channel's payloads to columns, whatever their encoding."""

from collections.abc import Sequence

from pipeline.errors import ReadError
from pipeline.formats import cdr
from pipeline.formats.definitions import Definition, parse_ros2msg
from pipeline.formats.mcap import PAYLOADS, Take
from pipeline.formats.mcap_layout import Channel


def take_fields(channel: Channel, fields: Sequence[str], all_bytes: bool = False) -> Take:
    """What `read_mcap` needs to know to turn a channel's messages into columns of `fields`.

    Reading or decoding raises `ReadError` on an encoding that is not read, a definition that cannot
    be, or a field that it does not have.  With `all_bytes`, payloads are not cut behind the last
    field of the first message: needed where text or arrays before it vary in length.
    """
    if all_bytes:
        return Take(PAYLOADS.extent, lambda p: cdr.decode_rows(definition_of(channel), p, fields))
    return Take(
        lambda payload: cdr.extent(definition_of(channel), payload, fields),
        lambda p: cdr.decode_rows(definition_of(channel), p, fields),
    )


def definition_of(channel: Channel) -> Definition:
    """Field tree of a ROS 2 channel."""
    if channel.message_encoding != "cdr" or channel.schema_encoding != "ros2msg":
        raise ReadError(
            f"{channel.topic}: encoding {channel.message_encoding!r} with schema "
            f"{channel.schema_encoding!r} is not read; cdr with ros2msg is"
        )
    return parse_ros2msg(channel.definition.decode("utf-8", "replace"), channel.type)
