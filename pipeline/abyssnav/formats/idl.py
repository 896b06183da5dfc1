# SPDX-License-Identifier: Apache-2.0
"""ROS 2 definitions in IDL, as rosbag2 writes them for packages that have them: `ros2idl`.

Read are modules, structs, constants, typedefs of arrays, sequences, and enumerations, which is what
ROS 2 makes of messages; annotations and comments are skipped.
"""

import re
from collections.abc import Iterator
from functools import cache

from abyssnav.errors import ReadError
from abyssnav.formats.schema import (
    MOST_ITEMS,
    NO_FIELDS,
    SEQUENCE,
    TIMES,
    Definition,
    Field,
    checked,
    our_definition,
)

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
        full = _short(word) if "::" in word else self._full(word)
        return self.typedefs.get(full, (full, None))

    def _number(self, word: str) -> int:
        size = int(word[:12]) if word.isdigit() else self.constants.get(word, 0)
        if not 0 < size <= MOST_ITEMS:
            raise ReadError(f"definition of {self.what}: {word!r} is no size known in the IDL")
        return size

    def _full(self, name: str) -> str:
        return f"{self.modules[0] if self.modules else self.what.split('/')[0]}/{name}"


def _short(scoped: str) -> str:
    parts = scoped.strip(":").split("::")
    return f"{parts[0]}/{parts[-1]}"
