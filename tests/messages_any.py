# SPDX-License-Identifier: Apache-2.0
"""Random message types with random messages, and their columns made one by one, by the book."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from hypothesis import strategies as st

from abyssnav.formats.columns import Column, Ragged, row_offsets

Tree = Mapping[str, Sequence[tuple[str, str, int | None]]]  # type -> (field, type, count)

NUMBERS = {
    "bool": st.booleans(),
    "int8": st.integers(-(2**7), 2**7 - 1),
    "uint8": st.integers(0, 2**8 - 1),
    "int16": st.integers(-(2**15), 2**15 - 1),
    "uint16": st.integers(0, 2**16 - 1),
    "int32": st.integers(-(2**31), 2**31 - 1),
    "uint32": st.integers(0, 2**32 - 1),
    "int64": st.integers(-(2**63), 2**63 - 1),
    "uint64": st.integers(0, 2**64 - 1),
    "float32": st.floats(width=32, allow_nan=False),
    "float64": st.floats(allow_nan=False),
}
TEXT = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9)
ROOT = "any_msgs/msg/Root"


@dataclass(frozen=True)
class Example:
    """A message type and some messages of it, as nested dictionaries."""

    tree: Tree
    messages: list[dict[str, Any]]

    @property
    def text(self) -> str:
        """The definition as `ros2msg`, with comments, constants and defaults in the way."""
        return ("=" * 80 + "\n").join(
            (f"MSG: any_msgs/{name}\n" if name != "Root" else "# any type\n")
            + "int32 LIMIT=7  # no field\nstring WORD=abc\n"
            + "".join(f"{kind}{_bracket(n)} {field}\n" for field, kind, n in fields)
            for name, fields in sorted(self.tree.items(), key=lambda item: item[0] != "Root")
        )

    @property
    def idl(self) -> str:
        """The definition as `ros2idl`, one file a type, with what ROS 2 puts around it."""
        return "\n".join(_idl_file(name, self.tree[name]) for name in ("Root", "Branch", "Leaf"))


IDL_NAMES = {
    "bool": "boolean", "int8": "int8", "uint8": "uint8", "int16": "short", "uint16": "uint16",
    "int32": "long", "uint32": "unsigned long", "int64": "int64", "uint64": "unsigned long long",
    "float32": "float", "float64": "double", "string": "string",
}  # fmt: skip


def _idl_file(name: str, fields: Sequence[tuple[str, str, int | None]]) -> str:
    typedefs, members = "", ""
    for field, kind, count in fields:
        one = IDL_NAMES.get(kind, f"any_msgs::msg::{kind}")
        if count is not None and count >= 0:
            typedefs += f"    typedef {one} {field}__array[{count}];\n"
            one = f"{field}__array"
        elif count is not None:
            one = f"sequence<{one}>"
        members += (
            f'      @verbatim (language="comment", text="what; {{it}} is")\n      {one} {field};\n'
        )
    return f"""{"=" * 80}
IDL: any_msgs/msg/{name}
// generated from rosidl_adapter
#include "any_msgs/msg/other.idl"
module any_msgs {{
  module msg {{
    module {name}_Constants {{ const int32 LIMIT = 7; }};
{typedefs}    @verbatim (language="comment", text=
      "a message" "\\n" "of two lines")
    struct {name} {{
{members}    }};
  }};
}};
"""


def _bracket(count: int | None) -> str:
    return "" if count is None else "[]" if count < 0 else f"[{count}]"


KINDS = [*NUMBERS, "string"]
COUNTS = st.sampled_from([None, None, -1, 1, 3])
#: Fields of a type that may hold those below it.  All strategies are made once: each takes longer
#: to make than to draw from.
FIELDS = {
    name: st.lists(st.tuples(st.sampled_from([*KINDS, *below]), COUNTS), min_size=1, max_size=5)
    for name, below in (("Leaf", []), ("Branch", ["Leaf"]), ("Root", ["Leaf", "Branch"]))
}
ONE = {**NUMBERS, "string": TEXT}
LISTS = {
    (kind, count): st.lists(ONE[kind], min_size=max(count, 0), max_size=4 if count < 0 else count)
    for kind in KINDS
    for count in (-1, 1, 3)
}
SIZE = st.integers(0, 4)


@st.composite
def examples(draw: st.DrawFn) -> Example:
    """Up to three types in each other, and 0 to 5 messages."""
    tree = {
        name: [(f"f{i}_{name.lower()}", kind, n) for i, (kind, n) in enumerate(draw(fields))]
        for name, fields in FIELDS.items()
    }
    return Example(tree, [_message(draw, tree, "Root") for _ in range(draw(st.integers(0, 5)))])


def _message(draw: st.DrawFn, tree: Tree, name: str) -> dict[str, Any]:
    return {field: _value(draw, tree, kind, n) for field, kind, n in tree[name]}


def _value(draw: st.DrawFn, tree: Tree, kind: str, count: int | None) -> Any:
    if kind in ONE:
        return draw(ONE[kind] if count is None else LISTS[kind, count])
    if count is None:
        return _message(draw, tree, kind)
    return [_message(draw, tree, kind) for _ in range(draw(SIZE) if count < 0 else count)]


def columns_by_the_book(
    tree: Tree, rows: Sequence[Mapping[str, Any]], name: str = "Root", prefix: str = ""
) -> dict[str, Column]:
    """Dotted path -> column, from one message after the other."""
    columns: dict[str, Column] = {}
    for field, kind, count in tree[name]:
        values, path = [row[field] for row in rows], f"{prefix}{field}"
        if count is None:
            columns |= _plain_columns(tree, kind, values, path)
            continue
        flat = [item for value in values for item in value]
        for inner, column in _plain_columns(tree, kind, flat, path).items():
            if count >= 0 and not isinstance(column, Ragged):
                columns[inner] = column.reshape(len(rows), count, *column.shape[1:])
            else:
                columns[inner] = Ragged(column, row_offsets([len(value) for value in values]))
    return columns


def _plain_columns(tree: Tree, kind: str, values: list[Any], path: str) -> dict[str, Column]:
    if kind == "string":
        return {path: np.array(values, np.dtypes.StringDType())}
    if kind in NUMBERS:
        return {path: np.array(values, np.dtype(kind))}
    return columns_by_the_book(tree, values, kind, f"{path}.")


def same(ours: Column, theirs: Column) -> bool:
    """Equal in every item, shape and type."""
    if isinstance(ours, Ragged) and isinstance(theirs, Ragged):
        return np.array_equal(ours.offsets, theirs.offsets) and same(ours.content, theirs.content)
    if isinstance(ours, Ragged) or isinstance(theirs, Ragged):
        return False
    return ours.dtype == theirs.dtype and np.array_equal(ours, theirs)
