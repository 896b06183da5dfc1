# SPDX-License-Identifier: Apache-2.0
"""ROS message definitions (`ros2msg`, `ros1msg`, `ros2idl`): anybody's as a tree of fields.

Of IDL are read modules, structs, constants, typedefs of arrays, sequences, and enumerations, which
is what ROS 2 makes of messages; annotations and comments are skipped.
"""

import re
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

from abyssnav.config import schemas
from abyssnav.errors import ReadError

#: Bytes of each primitive, which is also its alignment.
PRIMITIVES = {
    "bool": "u1", "byte": "u1", "char": "u1", "octet": "u1",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip
#: Definitions leave these out at times; they are one int64 nanosecond column to us.
TIMES = TIME, DURATION = ("builtin_interfaces/Time", "builtin_interfaces/Duration")
#: What ROS 1 has under other names; its `byte` is signed.
_ROS1_TYPES = {"time": TIME, "duration": DURATION, "byte": "int8"}
#: Field -> {} for all of it, or the fields wanted inside.
Want = Mapping[str, Any]
SEQUENCE = -1  #: `Field.count` of an array whose length stands in the message
_SEPARATOR = re.compile(r"^={3,}\s*$", re.MULTILINE)
_FIELD = re.compile(
    r"(?P<type>[A-Za-z][\w/]*)(?:<=\d+)?(?P<array>\[(?P<bound><=)?(?P<count>\d*)\])?"
    r"\s+(?P<name>[A-Za-z]\w*)\s*(?P<rest>.*)"
)
MOST_ITEMS = 1 << 28  #: of a fixed array; a chunk has no more bytes
_MOST_FIELDS = 1 << 14  #: with those of messages in it, each time that they are
MAX_DEPTH = 32  #: of messages in messages; a definition that contains itself would have no end


@dataclass(frozen=True)
class Field:
    """One field: a primitive, `string` or message type, and how many of it."""

    name: str
    type: str
    count: int | None = None  #: None one, k >= 0 a fixed array, `SEQUENCE` a variable one


Types = dict[str, tuple[Field, ...]]
#: What a message without fields takes on the wire.
NO_FIELDS = (Field("structure_needs_at_least_one_member", "uint8"),)


@dataclass(frozen=True)
class Definition:
    """A message type and all that it is made of."""

    root: str
    types: Mapping[str, tuple[Field, ...]]  #: `package/Type` -> its fields in order

    @cached_property
    def least_bytes(self) -> dict[str, int]:
        """Fewest bytes that a message of each ROS type takes, padding not counted."""
        least = {name: int(dtype[1:]) for name, dtype in PRIMITIVES.items()}

        def least_of(kind: str) -> int:
            if kind not in least:
                fields = self.types.get(kind)
                least[kind] = 4 if fields is None else sum(map(least_of_field, fields))
            return least[kind]

        def least_of_field(field: Field) -> int:
            if field.count == SEQUENCE:
                return 4
            return (1 if field.count is None else field.count) * least_of(field.type)

        for kind in self.types:
            least_of(kind)
        return least


@cache
def message_definition(type_name: str) -> str:
    """Full `ros2msg` text of a type in `schemas/msg`, dependencies after it.

    Raises
    ------
    ValueError
        `schemas/msg` has no such type.
    """
    names = [_short(type_name)]
    texts: list[str] = []
    for name in names:  # grows while it runs: breadth first
        package, kind = name.split("/")
        file = schemas() / "msg" / package / "msg" / f"{kind}.msg"
        if not file.is_file():
            raise ValueError(f"no message definition {name} in schemas/msg")
        text = file.read_text(encoding="utf-8")
        texts.append(text if not texts else f"{'=' * 80}\nMSG: {name}\n{text}")
        for field in _fields(text, package):
            if "/" in field.type and field.type not in names:
                names.append(field.type)
    return "".join(texts)


def our_definition(type_name: str) -> Definition:
    """Field tree of a type in `schemas/msg`."""
    return parse_ros2msg(message_definition(type_name), type_name)


@cache
def parse_ros2msg(text: str, type_name: str) -> Definition:
    """Field tree of a concatenated `ros2msg` definition.

    Raises
    ------
    ReadError
        A line that is no field, a type that is nowhere defined, or one that contains itself.
    """
    types: Types = {n: (Field("sec", "int32"), Field("nanosec", "uint32")) for n in TIMES}
    return _parse_msg(text, type_name, types, {})


@cache
def parse_ros1msg(text: str, type_name: str) -> Definition:
    """Field tree of a concatenated `ros1msg` definition; `time` and `duration` are messages to us.

    Raises
    ------
    ReadError
        As of `parse_ros2msg`.
    """
    types: Types = {
        TIME: (Field("sec", "uint32"), Field("nanosec", "uint32")),
        DURATION: (Field("sec", "int32"), Field("nanosec", "int32")),
    }
    return _parse_msg(text, type_name, types, _ROS1_TYPES)


def _parse_msg(text: str, type_name: str, times: Types, aliases: Mapping[str, str]) -> Definition:
    """Field tree of a definition; where there are `aliases` for types it is one of ROS 1."""
    first, *others = _SEPARATOR.split(text)
    root = _short(type_name)
    parts = [(root, first)]
    for part in others:
        head, _, body = part.strip().partition("\n")
        if not head.startswith("MSG:"):
            raise ReadError(
                f"definition of {type_name}: 'MSG: package/Type' expected, not {head!r}"
            )
        parts.append((_short(head.removeprefix("MSG:").strip()), body))
    names = {name for name, _ in parts}
    types = dict(times)
    for name, body in parts:
        fields = _fields(body, name.split("/")[0], names, aliases)
        types[name] = fields or (() if aliases else NO_FIELDS)
    return checked(Definition(root, types))


def checked(definition: Definition) -> Definition:
    """Return `definition` when every type in it is known, and its fields can be counted.

    Raises
    ------
    ReadError
        It is not so.
    """
    counts: dict[str, int] = {}

    def count(name: str, above: tuple[str, ...]) -> int:
        if name in above or len(above) > MAX_DEPTH:
            raise ReadError(f"definition of {definition.root}: {name} contains itself")
        if name not in counts:
            fields = definition.types.get(name, ())
            inner = [field for field in fields if is_message(field.type)]
            for field in inner:
                if field.type not in definition.types:
                    raise ReadError(
                        f"definition of {definition.root}: {name}.{field.name} has the unknown "
                        f"type {field.type!r}"
                    )
            counts[name] = len(fields) + sum(count(f.type, (*above, name)) for f in inner)
            if counts[name] > _MOST_FIELDS:
                raise ReadError(f"definition of {definition.root}: {name} has too many fields")
        return counts[name]

    count(definition.root, ())
    return definition


def wanted(tree: Definition, fields: Sequence[str] | None) -> Want:
    """Dotted paths as nested mappings, checked against the definition.

    Raises
    ------
    ReadError
        A path that the definition does not have.
    """
    if fields is None:
        return {}
    want: dict[str, Any] = {}
    for path in fields:
        inside, kind = want, tree.root
        parts = path.split(".")
        for place_, part in enumerate(parts):
            known = {f.name: f.type for f in tree.types.get(kind, ())}
            if part not in known:
                raise ReadError(
                    f"no field {path!r} in {tree.root}; {kind} has: {', '.join(known) or 'nothing'}"
                )
            whole = place_ == len(parts) - 1
            if whole:
                inside[part] = {}
            elif part in inside and not inside[part]:
                break  # all of it is wanted already
            else:
                inside = inside.setdefault(part, {})
            kind = known[part]
    return want


def leaves(tree: Definition, times: Container[str] = TIMES) -> Iterator[tuple[str, str]]:
    """Dotted path and type of every field that holds no further fields; `times` are one.

    Of types that hold two of another, which holds two of a third ..., there are more than anyone
    can want: take as many as you need.
    """

    def below(kind: str, prefix: str, depth: int) -> Iterator[tuple[str, str]]:
        for field in tree.types.get(kind, ()) if depth <= MAX_DEPTH else ():
            path = f"{prefix}{field.name}"
            if field.type not in times and field.type in tree.types:
                yield from below(field.type, f"{path}.", depth + 1)
            else:
                yield path, field.type

    return below(tree.root, "", 0)


def is_message(type_name: str) -> bool:
    """Whether the type is neither a primitive nor text."""
    return type_name not in PRIMITIVES and type_name not in ("string", "wstring")


def _short(type_name: str) -> str:
    """`package/msg/Type` as `package/Type`."""
    parts = type_name.split("/")
    if len(parts) < 2 or not all(parts):
        raise ReadError(f"{type_name!r} is no message type; package/msg/Type expected")
    return f"{parts[0]}/{parts[-1]}"


def _fields(
    text: str, package: str, known: Container[str] = (), aliases: Mapping[str, str] = {}
) -> tuple[Field, ...]:
    fields = []
    for raw in text.split("\n"):  # other ends of lines may stand in comments
        line = raw.partition("#")[0].strip()
        if not line:
            continue
        match = _FIELD.fullmatch(line)
        if match is None:
            raise ReadError(f"definition in {package}: no field in the line {line!r}")
        if match["rest"].startswith("="):  # a constant takes no room in the message
            continue
        count = None
        if match["array"]:
            count = _size(match["count"]) if match["count"] and not match["bound"] else SEQUENCE
        kind = aliases.get(match["type"]) or _resolve(match["type"], package, known)
        fields.append(Field(match["name"], kind, count))
    return tuple(fields)


def _size(digits: str) -> int:
    """Items of a fixed array."""
    size = int(digits[:12])
    if not 0 < size <= MOST_ITEMS:
        raise ReadError(f"an array of {digits[:12]} items: 1 to {MOST_ITEMS} are read")
    return size


def _resolve(name: str, package: str, known: Container[str]) -> str:
    if not is_message(name):
        return name
    if "/" in name:
        return _short(name)
    own = f"{package}/{name}"
    return "std_msgs/Header" if name == "Header" and own not in known else own


# --- IDL ------------------------------------------------------------------------------------------

_WORDS = {
    "boolean": "bool", "octet": "byte", "char": "char", "float": "float32", "double": "float64",
    "short": "int16", "long": "int32", "long long": "int64", "unsigned short": "uint16",
    "unsigned long": "uint32", "unsigned long long": "uint64", "int8": "int8", "uint8": "uint8",
    "int16": "int16", "uint16": "uint16", "int32": "int32", "uint32": "uint32", "int64": "int64",
    "uint64": "uint64", "string": "string", "wstring": "wstring",
}  # fmt: skip
#: Comments and what else means nothing here; and text, in which it is none.
_SKIPPED = re.compile(
    r"(\"(?:\\.|[^\"\\])*\"|'(?:\\.|[^'\\])*')"
    r"|//[^\n]*|/\*.*?\*/|^\s*#[^\n]*|={3,}|^\s*IDL:[^\n]*"
    r"|@\w+(?:::\w+)*\s*(?:\((?:[^()\"]|\"(?:\\.|[^\"\\])*\")*\))?",
    re.DOTALL | re.MULTILINE,
)
_TOKEN = re.compile(r"\"(?:\\.|[^\"\\])*\"|'(?:\\.|[^'\\])*'|::|[\w.+-]+|[^\s\w]")
Typedef = tuple[str, int | None]


@cache
def parse_ros2idl(text: str, type_name: str) -> Definition:
    """Field tree of a `ros2idl` definition: one or more IDL files, each under its `IDL:` line.

    Raises
    ------
    ReadError
        Not IDL as ROS 2 writes it, a type that is nowhere defined, or one that contains itself.
    """
    parts = type_name.split("/")
    root = f"{parts[0]}/{parts[-1]}"
    if "@bit_bound" in text:
        raise ReadError(f"definition of {type_name}: @bit_bound is not read in IDL")
    words = _TOKEN.findall(_SKIPPED.sub(lambda result: result[1] or " ", text))
    reader = _Idl(words, type_name)
    reader.read()
    for name in TIMES:
        reader.types.setdefault(name, our_definition(name).types[name])
    if root not in reader.types:
        known = ", ".join(sorted(set(reader.types) - set(TIMES))) or "none"
        raise ReadError(f"definition of {type_name}: there is no such struct; there are: {known}")
    return checked(Definition(root, reader.types))


class _Idl:
    """One pass over the words of a definition."""

    def __init__(self, words: list[str], what: str) -> None:
        self.words, self.position, self.what = words, 0, what
        self.modules: list[str] = []
        self.types: dict[str, tuple[Field, ...]] = {}
        self.typedefs: dict[str, Typedef] = {}
        self.constants: dict[str, int] = {}

    def read(self) -> None:
        while self.position < len(self.words):
            self._declaration()

    def _next(self) -> str:
        if self.position >= len(self.words):
            raise ReadError(f"definition of {self.what}: the IDL ends too early")
        self.position += 1
        return self.words[self.position - 1]

    def _expect(self, word: str) -> None:
        result = self._next()
        if result != word:
            raise ReadError(
                f"definition of {self.what}: {word!r} expected in the IDL, not {result!r}"
            )

    def _until(self, word: str) -> Iterator[str]:
        while (result := self._next()) != word:
            yield result

    def _declaration(self) -> None:
        word = self._next()
        if word == "module":
            self.modules.append(self._next())
            self._expect("{")
            while self.words[self.position : self.position + 1] != ["}"]:
                self._declaration()
            self._expect("}")
            self.modules.pop()
        elif word == "struct":
            name = self._next()
            self._expect("{")
            fields: list[Field] = []
            while self.words[self.position : self.position + 1] != ["}"]:
                fields += self._members()
            self._expect("}")
            self.types[self._full(name)] = tuple(fields) or NO_FIELDS
        elif word == "typedef":
            for field in self._members():
                self.typedefs[self._full(field.name)] = (field.type, field.count)
            return
        elif word == "const":
            words = list(self._until(";"))
            if words[-2:-1] == ["="] and words[-1].isdigit() and len(words) > 3:
                self.constants[words[-3]] = int(words[-1])
            return
        elif word == "enum":
            self.typedefs[self._full(self._next())] = ("uint32", None)
            list(self._until("}"))
        elif word != ";":
            raise ReadError(f"definition of {self.what}: {word!r} is not read in IDL")
        if self.words[self.position : self.position + 1] == [";"]:
            self.position += 1

    def _members(self) -> list[Field]:
        """Fields of one declaration, up to its semicolon."""
        kind, count = self._type()
        fields = []
        while True:
            name, sizes = self._next(), 1
            is_array = False
            while self.words[self.position : self.position + 1] == ["["]:
                self.position += 1
                sizes *= self._number(self._next())
                is_array = True
                self._expect("]")
            if is_array and count == SEQUENCE:
                raise ReadError(f"definition of {self.what}: arrays of sequences are not read")
            sizes *= count or 1  # a typedef may be an array itself
            fields.append(Field(name, kind, sizes if is_array else count))
            end = self._next()
            if end == ";":
                return fields
            if end != ",":
                raise ReadError(f"definition of {self.what}: ';' expected in the IDL, not {end!r}")

    def _type(self) -> Typedef:
        word = self._next()
        if word == "sequence":
            self._expect("<")
            kind, count = self._type()
            if count is not None:
                raise ReadError(f"definition of {self.what}: arrays in sequences are not read")
            for end in self._until(">"):
                if end != ",":
                    self._number(end)
            return kind, SEQUENCE
        while (
            f"{word} {''.join(self.words[self.position : self.position + 1])}" in _WORDS
            or word == "unsigned"
        ):
            word = f"{word} {self._next()}"
        while self.words[self.position : self.position + 1] == ["::"]:
            self.position += 1
            word = f"{word}::{self._next()}"
        if word in ("string", "wstring") and self.words[self.position : self.position + 1] == ["<"]:
            list(self._until(">"))
        if word in _WORDS:
            return _WORDS[word], None
        full = _unscoped(word) if "::" in word else self._full(word)
        return self.typedefs.get(full, (full, None))

    def _number(self, word: str) -> int:
        size = int(word[:12]) if word.isdigit() else self.constants.get(word, 0)
        if not 0 < size <= MOST_ITEMS:
            raise ReadError(f"definition of {self.what}: {word!r} is no size known in the IDL")
        return size

    def _full(self, name: str) -> str:
        return f"{self.modules[0] if self.modules else self.what.split('/')[0]}/{name}"


def _unscoped(scoped: str) -> str:
    parts = scoped.strip(":").split("::")
    return f"{parts[0]}/{parts[-1]}"
