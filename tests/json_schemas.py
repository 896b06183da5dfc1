# SPDX-License-Identifier: Apache-2.0
"""JSON Schemas of profile, settings, scenario and layout, from the code.

Run it to write schemas/*.schema.json anew.
"""

import json
import re
import sys
from pathlib import Path
from typing import Any

import msgspec

from abyssnav.config import Config
from abyssnav.plan import Layout
from abyssnav.profile import Profile
from abyssnav.simulate.scenario import Scenario

ROOT = Path(__file__).parent.parent
KINDS: dict[str, type[msgspec.Struct]] = {
    "profile": Profile, "settings": Config, "scenario": Scenario, "layout": Layout,
}  # fmt: skip


def comments(kind: type) -> dict[str, str]:
    """What the `#:` lines above the keys of a struct say, those of its bases among them."""
    said: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if base is msgspec.Struct or not issubclass(base, msgspec.Struct):
            continue
        source = Path(str(sys.modules[base.__module__].__file__)).read_text(encoding="utf-8")
        body = re.search(rf"^class {base.__name__}\(.*?(?=^\S|\Z)", source, re.M | re.S)
        lines: list[str] = []
        for line in body[0].splitlines() if body else ():
            comment = re.fullmatch(r"    #: ?(.*)", line)
            key = re.match(r"    (\w+): ", line)
            if comment:
                lines.append(comment[1])
            elif key:
                beside = re.search(r"  #: ?(.*)$", line)
                words = lines or ([beside[1]] if beside else [])
                if words:
                    said[key[1].rstrip("_")] = " ".join(words)
                lines = []
            elif line.strip() == "":
                lines = []
    return said


def schema_of(kind: type[msgspec.Struct]) -> dict[str, Any]:
    """JSON Schema of a struct, each key with its comment."""
    schema = msgspec.json.schema(kind)
    structs = {cls.__name__: cls for cls in structs_of(kind)}
    for name, definition in schema["$defs"].items():
        said = comments(structs[name]) if name in structs else {}
        for key, part in definition.get("properties", {}).items():
            if key.rstrip("_") in said:
                part["description"] = said[key.rstrip("_")]
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def structs_of(kind: Any, known: set[type] | None = None) -> set[type]:
    known = set() if known is None else known
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        if kind not in known:
            known.add(kind)
            for field in msgspec.structs.fields(kind):
                structs_of(field.type, known)
    else:
        for part in getattr(kind, "__args__", ()):
            structs_of(part, known)
    return known


def files() -> dict[Path, str]:
    """Every file that is made from the code, below the project's root."""
    return {
        Path("schemas") / f"{name}.schema.json": json.dumps(
            schema_of(kind), indent=1, ensure_ascii=False
        )
        + "\n"
        for name, kind in KINDS.items()
    }


if __name__ == "__main__":
    for path, text in files().items():
        (ROOT / path).write_text(text, encoding="utf-8")
