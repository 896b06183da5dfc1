# SPDX-License-Identifier: Apache-2.0
"""Random Protobuf types with random messages, and their columns made one by one, by the book."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.descriptor import FieldDescriptor
from hypothesis import strategies as st

from abyssnav.formats.columns import Column, Ragged, row_offsets

FieldProto = descriptor_pb2.FieldDescriptorProto
F64, F32 = st.floats(allow_nan=False), st.floats(width=32, allow_nan=False)
I64, I32 = st.integers(-(2**63), 2**63 - 1), st.integers(-(2**31), 2**31 - 1)
U64, U32 = st.integers(0, 2**64 - 1), st.integers(0, 2**32 - 1)
TEXT = st.text(st.characters(codec="utf-8"), max_size=9)
VALUES = {
    "double": F64, "float": F32, "int64": I64, "uint64": U64, "int32": I32, "fixed64": U64,
    "fixed32": U32, "bool": st.booleans(), "string": TEXT, "bytes": st.binary(max_size=9),
    "uint32": U32, "sfixed32": I32, "sfixed64": I64, "sint32": I32, "sint64": I64,
}  # fmt: skip
DTYPES = {
    FieldDescriptor.CPPTYPE_DOUBLE: "f8", FieldDescriptor.CPPTYPE_FLOAT: "f4",
    FieldDescriptor.CPPTYPE_INT64: "i8", FieldDescriptor.CPPTYPE_UINT64: "u8",
    FieldDescriptor.CPPTYPE_INT32: "i4", FieldDescriptor.CPPTYPE_UINT32: "u4",
    FieldDescriptor.CPPTYPE_BOOL: "?", FieldDescriptor.CPPTYPE_ENUM: "i4",
}  # fmt: skip


@st.composite
def proto_examples(draw: st.DrawFn) -> tuple[bytes, list[Any]]:
    """A descriptor set with the message any.Root, and 0 to 5 messages of it."""
    file = descriptor_pb2.FileDescriptorProto(name="any.proto", package="any", syntax="proto3")
    below: list[str] = []
    for name in ("Leaf", "Branch", "Root"):
        message = file.message_type.add(name=name)
        kinds = draw(st.lists(st.sampled_from([*VALUES, *below]), min_size=1, max_size=5))
        numbers = draw(st.permutations([1, 2, 15, 16, 3000]))
        for i, kind in enumerate(kinds):
            field = message.field.add(name=f"f{i}_{name.lower()}", number=numbers[i])
            repeated = draw(st.booleans())
            field.label = FieldProto.LABEL_REPEATED if repeated else FieldProto.LABEL_OPTIONAL
            if kind in VALUES:
                field.type = getattr(FieldProto, f"TYPE_{kind.upper()}")
                if repeated and kind not in ("string", "bytes"):
                    field.options.packed = draw(st.booleans())
                elif not repeated and draw(st.booleans()):
                    field.proto3_optional = True
                    field.oneof_index = len(message.oneof_decl)
                    message.oneof_decl.add(name=f"_{field.name}")
            else:
                field.type, field.type_name = FieldProto.TYPE_MESSAGE, f".any.{kind}"
        below.append(name)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    root = message_factory.GetMessageClass(pool.FindMessageTypeByName("any.Root"))
    messages = draw(st.lists(_messages(root), max_size=5))
    return descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString(), messages


@st.composite
def _messages(draw: st.DrawFn, kind: Any) -> Any:
    message = kind()
    for field in kind.DESCRIPTOR.fields:
        if field.message_type is not None:
            one: Any = _messages(message_factory.GetMessageClass(field.message_type))
        else:
            one = VALUES[_type_name(field)]
        if field.is_repeated:
            getattr(message, field.name).extend(draw(st.lists(one, max_size=3)))
        elif draw(st.booleans()):
            if field.message_type is not None:
                getattr(message, field.name).CopyFrom(draw(one))
            else:
                setattr(message, field.name, draw(one))
    return message


def _type_name(field: FieldDescriptor) -> str:
    names = {number: name for name, number in FieldProto.Type.items()}
    return names[field.type].removeprefix("TYPE_").lower()


def proto_columns(descriptor: Any, messages: Sequence[Any], prefix: str = "") -> dict[str, Column]:
    """Dotted path -> column; None stands for a message that is not there."""
    columns: dict[str, Column] = {}
    for field in descriptor.fields:
        path = f"{prefix}{field.name}"
        if field.is_repeated:
            rows = [[] if m is None else list(getattr(m, field.name)) for m in messages]
            flat = [item for row in rows for item in row]
            offsets = row_offsets([len(row) for row in rows])
            inner = _plain(field, flat, path)
            columns |= {name: Ragged(column, offsets) for name, column in inner.items()}
        else:
            columns |= _plain(field, [_value(field, m) for m in messages], path)
    return columns


def _value(field: FieldDescriptor, message: Any) -> Any:
    """None where the field is known not to be there."""
    if message is None or (field.has_presence and not message.HasField(field.name)):
        return None
    return getattr(message, field.name)


def _plain(field: FieldDescriptor, values: list[Any], path: str) -> dict[str, Column]:
    if field.message_type is not None:
        return proto_columns(field.message_type, values, f"{path}.")
    if field.type == FieldDescriptor.TYPE_STRING:
        return {path: np.array([v or "" for v in values], np.dtypes.StringDType())}
    if field.type == FieldDescriptor.TYPE_BYTES:
        return {path: Ragged.from_bytes([v or b"" for v in values])}
    dtype = np.dtype(DTYPES[field.cpp_type])
    absent = np.nan if dtype.kind == "f" else 0
    return {path: np.array([absent if v is None else v for v in values], dtype)}
