# SPDX-License-Identifier: Apache-2.0
"""Profiles as TOML: shipped ones by name, others by path."""

import re
from functools import cache
from pathlib import Path

import msgspec

from abyssnav.config import schemas
from abyssnav.errors import ConfigError, nearest_names
from abyssnav.profile.model import Profile
from abyssnav.profile.rules import problems
from abyssnav.settings import settings_from_toml


def load_profile(name_or_path: str | Path = "default") -> Profile:
    """Load a profile from `schemas/profiles` by name, or a TOML file by path.

    Raises
    ------
    ConfigError
        No such profile (the nearest is named), an unknown key or unit, a value of a wrong type, or
        keys that exclude each other.
    """
    text, where = _text_of(str(name_or_path))
    return profile_from_toml(text, where)


def profile_from_toml(text: str, where: str) -> Profile:
    """Profile from TOML; messages of a `ConfigError` begin with `where`, its name's default.

    Raises
    ------
    ConfigError
        As `load_profile`.
    """
    profile = settings_from_toml(text, where, Profile)
    for problem in problems(profile):
        raise ConfigError(f"{where}: {problem}")
    return profile if profile.name else msgspec.structs.replace(profile, name=Path(where).stem)


def profile_names() -> list[str]:
    """Names of the shipped profiles."""
    files = (schemas() / "profiles").iterdir()
    return sorted(file.name.removesuffix(".toml") for file in files if file.name.endswith(".toml"))


@cache
def shipped_profiles() -> tuple[Profile, ...]:
    """Shipped profiles, by name."""
    return tuple(load_profile(name) for name in profile_names())


def same_type(one: str, other: str) -> bool:
    """Whether two type names are one: `a/msg/B`, `a/B` and Protobuf's `a.B`."""
    names = [name.replace("/msg/", "/").replace("/", ".") for name in (one, other)]
    return names[0] == names[1]


def _text_of(name: str) -> tuple[str, str]:
    if re.fullmatch(r"[\w-]+", name):
        file = schemas() / "profiles" / f"{name}.toml"
        if file.is_file():
            return file.read_text(encoding="utf-8"), f"profile {name}"
        nearest = nearest_names(name, profile_names())
        hint = f"; nearest: {nearest[0]}; or the path of a .toml file" if nearest else ""
        raise ConfigError(f"no profile {name!r}{hint}")
    try:
        return Path(name).read_text(encoding="utf-8"), name
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"profile {name}: cannot be read: {error}") from None
