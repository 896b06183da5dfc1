# SPDX-License-Identifier: Apache-2.0
import json
import tomllib
from pathlib import Path
from typing import Any

import pytest
from json_schemas import KINDS, ROOT, files, schema_of

from abyssnav.profile import profile_names


@pytest.mark.parametrize("path", files(), ids=str)
def test_what_is_made_from_the_code_is_fresh(path: Path) -> None:
    assert (ROOT / path).read_text(encoding="utf-8") == files()[path], "make schemas"


@pytest.mark.parametrize("kind", KINDS)
def test_every_key_of_the_profile_has_a_description(kind: str) -> None:
    schema = schema_of(KINDS[kind])
    bare = [
        f"{name}.{key}"
        for name, part in schema["$defs"].items()
        for key, value in part["properties"].items()
        if "description" not in value
    ]
    if kind == "profile":
        assert bare == []
    assert schema["$defs"]


@pytest.mark.parametrize("name", profile_names())
def test_shipped_profiles_hold_only_keys_of_the_schema(name: str) -> None:
    schema = json.loads(files()[Path("schemas/profile.schema.json")])
    text = (ROOT / "schemas" / "profiles" / f"{name}.toml").read_text(encoding="utf-8")

    def keys_of(part: dict[str, Any]) -> set[str]:
        name = next(p["$ref"] for p in part.get("anyOf", [part]) if "$ref" in p)
        return set(schema["$defs"][name.rsplit("/", 1)[1]]["properties"])

    tables = schema["$defs"]["Profile"]["properties"]
    for key, value in tomllib.loads(text).items():
        assert key in tables
        if isinstance(value, dict):
            assert value.keys() <= keys_of(tables[key])
