# SPDX-License-Identifier: Apache-2.0
"""ROS 2 messages (CDR): a whole topic's payloads seen as columns, no loop over messages.

The encoding: 4 bytes that name the byte order, then the fields in order, each aligned to its own
size, counted from behind those 4 bytes.  Text is a length with its NUL, the bytes, the NUL; a
variable array is a length and its items.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from abyssnav.errors import ReadError
from abyssnav.formats.cdr_walk import ENCAPSULATION, Trace, Walk
from abyssnav.formats.definitions import Definition, wanted
from abyssnav.formats.patterns import Pattern
from abyssnav.formats.ragged import Column, Ragged, UnfitError, placed, runs
from abyssnav.tables import Bool, Int

_LITTLE, _BIG = 1, 0  #: plain CDR; higher ones are parameter lists and XCDR2, which differ
_MOST_MARKS = 400  #: a layout told by more bytes is one of long lists, which seldom comes again


def decode(
    definition: Definition, payloads: Ragged, fields: Sequence[str] | None = None
) -> dict[str, Column]:
    """Columns by dotted path of all `fields` (default: of every field).

    Scalars are (n,), fixed arrays (n, k), times int64 nanoseconds, text a string array, variable
    arrays `Ragged`; the members of an array of messages are one column each.

    Raises
    ------
    ReadError
        A field that the definition does not have, or a payload that does not fit the definition.
    """
    columns, kept = decode_rows(definition, payloads, fields)
    if not kept.all():
        raise ReadError(f"message {int(np.argmin(kept))} does not fit its definition")
    return columns


def decode_rows(
    tree: Definition, payloads: Ragged, fields: Sequence[str] | None = None
) -> tuple[dict[str, Column], Bool]:
    """As `decode`, but payloads that do not fit are left out: columns of the rest, and which."""
    want = wanted(tree, fields)
    kept = np.zeros(len(payloads), bool)
    order = _byte_orders(payloads)
    parts: list[tuple[Int, dict[str, Column]]] = []
    for big in (False, True):
        rows = np.flatnonzero(order == (_BIG if big else _LITTLE))
        while len(rows) or not (big or parts):
            walk = Walk.over(payloads, rows, tree, big)
            try:
                walk.fields(tree.root, want, 0, "", True)
            except UnfitError as unfit:
                rows = rows[~unfit.rows]
                continue
            parts.append((rows, walk.columns))
            kept[rows] = True
            break
    if len(parts) == 1:
        return parts[0][1], kept
    return placed(parts), kept


def pattern(tree: Definition, payload: NDArray[np.uint8], fields: Sequence[str]) -> Pattern | None:
    """Layout of messages like `payload`; None when it does not fit, or when a field has no place.

    What lies inside arrays of messages, or of texts, has none.

    Raises
    ------
    ReadError
        A field that the definition does not have.
    """
    order = _byte_orders(one := Ragged.regular(payload[None, :]))[0]
    walk = Walk.over(one, np.arange(1), tree, bool(order == _BIG))
    walk.trace = trace = Trace([(k, 0xFF, int(payload[k])) for k in range(min(2, len(payload)))])
    try:
        walk.fields(tree.root, wanted(tree, fields), 0, "", True)
    except UnfitError:
        return None
    all_have = trace.places.keys() == walk.columns.keys()
    if order < 0 or not all_have or len(trace.marks) > _MOST_MARKS:
        return None
    return Pattern(ENCAPSULATION + walk.reach, trace.marks, trace.places)


def _byte_orders(payloads: Ragged) -> Int:
    """Byte order of each payload, -1 where it is too short or no plain CDR."""
    content, width = np.asarray(payloads.content), payloads.width
    if width and width >= ENCAPSULATION:
        first = content.reshape(-1, width)[:, :2].copy().view(">u2")[:, 0]
        return np.where(first <= _LITTLE, first.astype(np.int64), -1)
    rows = np.flatnonzero(payloads.lengths >= ENCAPSULATION)
    first = runs(content, payloads.offsets[rows], 2).view(">u2")
    order = np.full(len(payloads), -1, np.int64)
    order[rows] = np.where(first <= _LITTLE, first.astype(np.int64), -1)
    return order
