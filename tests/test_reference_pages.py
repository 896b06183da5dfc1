# SPDX-License-Identifier: Apache-2.0
"""The pages made from the code are fresh, and say all that the code has."""

import re
from pathlib import Path

import msgspec
import pytest
from json_schemas import ROOT, comments
from reference_pages import FOLDER, pages

from abyssnav.config import Config, plain
from abyssnav.profile import UNITS, model


@pytest.mark.parametrize("path", pages(), ids=str)
def test_a_page_made_from_the_code_is_fresh(path: Path) -> None:
    assert (ROOT / path).read_text(encoding="utf-8") == pages()[path], "make schemas"


def test_the_page_of_a_profile_names_every_key_and_unit() -> None:
    page = pages()[FOLDER / "profile.md"]
    for role in (getattr(model, name) for name in dir(model) if name.endswith("Role")):
        keys = comments(role)
        assert set(keys) == set(role.__struct_fields__)
        assert all(f"| `{key}` |" in page for key in keys)
    assert all(f"`{unit}`" in page for unit in UNITS if unit)


def test_the_page_of_the_settings_lists_each_with_its_default() -> None:
    page = pages()[FOLDER / "settings.md"]
    for table, keys in plain(Config()).items():
        if isinstance(keys, dict):
            section = page.split(f"## [{table}]\n")[1].split("\n## ")[0]
            listed = dict(re.findall(r"^\| `([\w.]+)` \| `([^`]*)` \|", section, re.MULTILINE))
            assert {name.split(".")[0] for name in listed} == set(keys)
            assert listed == {**listed, **spelt(keys)}


def spelt(keys: dict[str, object]) -> dict[str, str]:
    """Defaults as the page writes them, but for tables within tables."""
    text = {
        key: msgspec.json.encode(value).decode().replace(",", ", ")
        for key, value in keys.items()
        if not isinstance(value, dict)
    }
    return {key: {"null": "none"}.get(value, value) for key, value in text.items()}
