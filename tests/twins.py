# SPDX-License-Identifier: Apache-2.0
"""Protobuf and JSON Schema twins of the messages in schemas/msg; run it to write them anew."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from google.protobuf import descriptor_pb2, duration_pb2, timestamp_pb2

from abyssnav.formats.schema import SEQUENCE, TIMES, Definition, Field, our_definition

SCHEMAS = Path(__file__).parent.parent / "schemas"
#: What a log of the contract holds, and what we write.
TYPES = (
    "sensor_msgs/msg/Imu",
    "geometry_msgs/msg/TwistWithCovarianceStamped",
    "nav_msgs/msg/Odometry",
    "abyssnav_msgs/msg/Depth",
    "abyssnav_msgs/msg/TravelTime",
    "abyssnav_msgs/msg/BeaconArray",
    "abyssnav_msgs/msg/SoundSpeedProfile",
    "abyssnav_msgs/msg/TravelTimeInnovation",
    "abyssnav_msgs/msg/GateStatistics",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "sensor_msgs/msg/NavSatFix",
)
_FieldProto = descriptor_pb2.FieldDescriptorProto
_PROTO = {
    "bool": "bool", "byte": "uint32", "char": "uint32", "int8": "int32", "uint8": "uint32",
    "int16": "int32", "uint16": "uint32", "int32": "int32", "uint32": "uint32", "int64": "int64",
    "uint64": "uint64", "float32": "float", "float64": "double", "string": "string",
}  # fmt: skip
_TIME_FILES = {
    "builtin_interfaces/Time": timestamp_pb2,
    "builtin_interfaces/Duration": duration_pb2,
}
_TIME_NAMES = {
    "builtin_interfaces/Time": "google.protobuf.Timestamp",
    "builtin_interfaces/Duration": "google.protobuf.Duration",
}


def all_types(names: Sequence[str] = TYPES) -> dict[str, tuple[Field, ...]]:
    """Fields of the types and of all in them, times left out."""
    found: dict[str, tuple[Field, ...]] = {}
    for name in names:
        found |= our_definition(name).types
    return {name: found[name] for name in sorted(found) if name not in TIMES}


def proto_files(names: Sequence[str] = TYPES) -> list[Any]:
    """One proto3 file descriptor a ROS package, times first."""
    types = all_types(names)
    files = {}
    for name, fields in types.items():
        package, kind = name.split("/")
        file = files.setdefault(
            package,
            descriptor_pb2.FileDescriptorProto(
                name=f"{package}.proto", package=package, syntax="proto3"
            ),
        )
        message = file.message_type.add(name=kind)
        for number, member in enumerate(fields, start=1):
            label = (
                _FieldProto.LABEL_OPTIONAL if member.count is None else _FieldProto.LABEL_REPEATED
            )
            field = message.field.add(name=member.name, number=number, label=label)
            if member.type in _PROTO:
                field.type = getattr(_FieldProto, f"TYPE_{_PROTO[member.type].upper()}")
                continue
            field.type = _FieldProto.TYPE_MESSAGE
            field.type_name = "." + _TIME_NAMES.get(member.type, member.type.replace("/", "."))
            time = _TIME_FILES.get(member.type)
            needed = time.DESCRIPTOR.name if time else f"{member.type.split('/')[0]}.proto"
            if needed != file.name and needed not in file.dependency:
                file.dependency.append(needed)
    ready, done = [], set()
    for module in (timestamp_pb2, duration_pb2):
        copy = descriptor_pb2.FileDescriptorProto()
        module.DESCRIPTOR.CopyToProto(copy)
        ready.append(copy)
        done.add(copy.name)
    while files:
        package = next(p for p, f in files.items() if done.issuperset(f.dependency))
        ready.append(files.pop(package))
        done.add(ready[-1].name)
    return ready


def proto_text(file: Any) -> str:
    """The file as .proto source."""
    names = {number: name for name, number in _FieldProto.Type.items()}
    lines = ["// SPDX-License-Identifier: Apache-2.0"]
    lines += ["// Made from schemas/msg by tests/twins.py."]
    lines += ['syntax = "proto3";', f"package {file.package};"]
    lines += [f'import "{name}";' for name in file.dependency]
    for message in file.message_type:
        lines += ["", f"message {message.name} {{"]
        for field in message.field:
            many = "repeated " if field.label == _FieldProto.LABEL_REPEATED else ""
            kind = field.type_name[1:] or names[field.type].removeprefix("TYPE_").lower()
            lines.append(f"  {many}{kind} {field.name} = {field.number};")
        lines.append("}")
    return "\n".join(lines) + "\n"


def json_schema(definition: Definition, name: str = "") -> dict[str, Any]:
    """JSON Schema of a type; null stands for a number that is unknown."""
    name = name or definition.root
    if name in TIMES:
        whole = {"type": "integer"}
        return {"type": "object", "properties": {"sec": whole, "nanosec": whole}}
    members = {f.name: _json_member(definition, f) for f in definition.types[name]}
    return {"title": name.replace("/", "/msg/"), "type": "object", "properties": members}


def _json_member(definition: Definition, member: Field) -> dict[str, Any]:
    if member.type == "bool":
        one: dict[str, Any] = {"type": "boolean"}
    elif member.type == "string":
        one = {"type": "string"}
    elif member.type.startswith("float"):
        one = {"type": ["number", "null"]}
    elif member.type in _PROTO:
        one = {"type": "integer"}
    else:
        one = json_schema(definition, member.type)
    if member.count is None:
        return one
    size = {} if member.count == SEQUENCE else {"minItems": member.count, "maxItems": member.count}
    return {"type": "array", "items": one, **size}


def twin_files() -> dict[Path, str]:
    """Path below schemas/ -> text, of every twin."""
    files = {
        Path("proto") / file.name: proto_text(file)
        for file in proto_files()
        if not file.name.startswith("google/")
    }
    for name in TYPES:
        package, _, kind = name.split("/")
        schema = {"$schema": "https://json-schema.org/draft/2020-12/schema",
                  "$comment": "Made from schemas/msg by tests/twins.py.",
                  **json_schema(our_definition(name))}  # fmt: skip
        files[Path("json") / package / f"{kind}.json"] = json.dumps(schema, indent=1) + "\n"
    return files


if __name__ == "__main__":
    for path, text in twin_files().items():
        (SCHEMAS / path).parent.mkdir(parents=True, exist_ok=True)
        (SCHEMAS / path).write_text(text, encoding="utf-8")
