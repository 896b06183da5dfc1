# SPDX-License-Identifier: Apache-2.0
"""Pages of docs/reference made from the code: commands, settings, profile, tables, messages.

Run it to write them anew.
"""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec
from json_schemas import ROOT, comments, structs_of
from typer.main import get_command

from abyssnav.cli import app
from abyssnav.config import Config
from abyssnav.outputs.parquet import FILES
from abyssnav.profile import UNITS, Condition, Profile, Quantity, TimeField, shipped_profiles
from abyssnav.profile import model as profile_model

FOLDER = Path("docs/reference")
LICENCE = "<!-- SPDX-License-Identifier: Apache-2.0 -->"
MADE = "Made from the code by `make schemas`."


def page(title: str, text: str) -> str:
    """A whole page."""
    return f"{LICENCE}\n# {title}\n\n{MADE} {text.strip()}\n"


def rows(names: Sequence[str], cells: Iterator[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [names, ["---"] * len(names), *cells]
    return "\n".join(
        "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines
    )


def commands_page() -> str:
    """Every command with its arguments and options, from the command line itself."""
    parts = ["`abyssnav COMMAND --help` says the same in a terminal.\n"]
    for name, command in get_command(app).commands.items():  # type: ignore[attr-defined]
        parts.append(f"## abyssnav {name}\n\n{command.help}\n")
        parts.append(rows(["", ""], map(_parameter, command.params)) + "\n")
    return page("Commands", "\n".join(parts))


def _parameter(parameter: Any) -> tuple[str, str]:
    if type(parameter).__name__ == "TyperArgument":
        return f"`{parameter.metavar}`", parameter.help
    value = "" if parameter.is_flag else f" {parameter.metavar or parameter.name.upper()}"
    given = ", ".join(f"`{option}{value}`" for option in parameter.opts)
    plain = parameter.is_flag or parameter.default in (None, "") or not parameter.default
    return given, parameter.help + ("" if plain else f" Default: `{parameter.default}`.")


def settings_page() -> str:
    """Every setting with its default and reason."""
    parts = [
        "Settings are TOML files with what differs, given with `--config`; of several files the "
        "later wins, key by key. An unknown key is refused with the nearest known one. "
        "`schemas/settings.schema.json` lets an editor complete and check them. Settings in force "
        "stand in each result's `summary.json`.\n"
    ]
    for table in msgspec.structs.fields(Config):
        (kind,) = _direct(table.type)
        title = (
            f"[[{table.encode_name}]]" if "tuple" in str(table.type) else f"[{table.encode_name}]"
        )
        parts.append(f"## {title}\n\n{_first(kind)}\n")
        parts.append(rows(["key", "default", "meaning"], _keys(kind)) + "\n")
    return page("Settings", "\n".join(parts))


def _direct(kind: Any) -> list[type[msgspec.Struct]]:
    """The struct that a table or an array of tables is of."""
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        return [kind]
    return [found for part in getattr(kind, "__args__", ()) for found in _direct(part)]


def _keys(kind: type[msgspec.Struct], above: str = "") -> Iterator[tuple[str, str, str]]:
    said = comments(kind)
    for key in msgspec.structs.fields(kind):
        inner = _direct(key.type)
        if inner:
            yield from _keys(inner[0], f"{above}{key.encode_name}.")
            continue
        required = key.default is msgspec.NODEFAULT and key.default_factory is msgspec.NODEFAULT
        default = "required" if required else f"`{_toml(key.default)}`"
        yield f"`{above}{key.encode_name}`", default, said[key.encode_name]


def _toml(value: Any) -> str:
    return "none" if value is None else json.dumps(value)


def _first(kind: type) -> str:
    """The docstring's paragraphs on one line each."""
    parts = (kind.__doc__ or "").strip().split("\n\n")
    return "\n\n".join(" ".join(part.split()) for part in parts)


def profile_page() -> str:
    """All that a profile can say, and the profiles that are shipped."""
    parts = [
        "A profile is a TOML file with one table a role; "
        "`schemas/profile.schema.json` lets an editor complete and check it.\n",
        "Units: " + ", ".join(f"`{unit}`" for unit in UNITS if unit) + ".\n",
    ]
    roles = [(f"[{f.encode_name}]", f.type) for f in msgspec.structs.fields(Profile)]
    shared = set(comments(profile_model.Role))
    tables: list[tuple[str, Any]] = [("Every role", profile_model.Role)]
    tables += [(title, next(iter(structs_of(kind) & set(_roles())), None)) for title, kind in roles]
    tables += [("A field with its conversion", Quantity), ("A condition", Condition)]
    tables.append(("A time", TimeField))
    for title, kind in tables:
        if kind is None:
            continue
        said = comments(kind)
        keys = [k for k in kind.__struct_fields__ if title == "Every role" or k not in shared]
        parts.append(f"\n## {title}\n\n{_first(kind)}\n")
        parts.append("| key | |\n|---|---|")
        parts += [f"| `{key}` | {said[key]} |" for key in keys]
    parts.append("\n## Profiles that are shipped\n\nBy name: `--profile twist`.\n")
    shipped = ((f"`{p.name}`", p.about) for p in shipped_profiles())
    parts.append(rows(["name", "for"], shipped))
    return page("What a profile can say", "\n".join(parts))


def _roles() -> list[type]:
    return [cls for cls in structs_of(Profile) if issubclass(cls, profile_model.Role)]


def tables_page() -> str:
    """Every Parquet file of a result, column by column."""
    parts = [
        "The Parquet files of `OUT/<dive>/`. Times are UTC (`timestamp[ns, UTC]`); a number that "
        "does not exist is null, and no column holds NaN. Each file's metadata say "
        "`abyssnav_version`, `origin` (`latitude,longitude` or `none`) and `frame` (`ENU`). All "
        "dives of a batch read as one table: `results/*/tracks.parquet`.\n"
    ]
    for name, file in FILES.items():
        parts.append(f"## {name}.parquet\n\nA row is {file.row}.\n")
        cells = ((f"`{c.name}`", c.unit, c.kind, _meaning(c)) for c in file.columns())
        parts.append(rows(["column", "unit", "kind", "meaning"], cells) + "\n")
    return page("Tables", "\n".join(parts))


def _meaning(column: Any) -> str:
    words = ", ".join(f"`{word}`" for word in column.words if word)
    return f"{column.meaning} ({words})" if words else column.meaning


def messages_page() -> str:
    """Messages that abyssnav defines, as they stand in schemas/msg."""
    parts = [
        "What a log may hold and what `solution.mcap` holds, in ROS 2's notation; twins for "
        "Protobuf and JSON lie in `schemas/proto` and `schemas/json`. A log whose messages are "
        "others needs a profile, not these.\n"
    ]
    for path in sorted((ROOT / "schemas/msg/abyssnav_msgs/msg").glob("*.msg")):
        text = path.read_text(encoding="utf-8").strip()
        parts.append(f"## abyssnav_msgs/msg/{path.stem}\n\n```text\n{text}\n```\n")
    return page("Messages", "\n".join(parts))


def pages() -> dict[Path, str]:
    """Every page that is made from the code, below the project's root."""
    return {
        FOLDER / "commands.md": commands_page(),
        FOLDER / "settings.md": settings_page(),
        FOLDER / "profile.md": profile_page(),
        FOLDER / "tables.md": tables_page(),
        FOLDER / "messages.md": messages_page(),
    }


if __name__ == "__main__":
    for path, text in pages().items():
        (ROOT / path).parent.mkdir(parents=True, exist_ok=True)
        (ROOT / path).write_text(text, encoding="utf-8")
