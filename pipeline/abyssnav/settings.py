# SPDX-License-Identifier: Apache-2.0
"""TOML to settings structs, whose fields hold their ranges; what is wrong is named by its place.

Settings, profiles, scenarios and layouts are read so.  msgspec decides whether a text is right;
where it is not, the tables are walked beside the struct for the key, word or number that is wrong
and what would be right.
"""

import math
import tomllib
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin

import msgspec
from msgspec import Meta

from abyssnav.errors import ConfigError, nearest_names

#: Numbers no larger than any dive's, so that their squares are numbers too.
LARGEST = 1e9
Finite = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
Positive = Annotated[float, Meta(gt=0, le=LARGEST)]
NotNegative = Annotated[float, Meta(ge=0, le=LARGEST)]
Share = Annotated[float, Meta(gt=0, lt=1)]
SigmaDegrees = Annotated[float, Meta(ge=0, le=180)]
Latitude = Annotated[float, Meta(ge=-90, le=90)]
#: Longitudes may count to 180 or to 360.
Longitude = Annotated[float, Meta(ge=-360, le=360)]

S = TypeVar("S")


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of what is read from TOML: frozen, and no key that is not its own."""


def settings_from_toml(text: str, where: str, kind: type[S]) -> S:
    """Decode TOML `text` into the settings struct `kind`.

    Raises
    ------
    ConfigError
        Not TOML, an unknown key (with the nearest known one), or a value of the wrong type or out
        of its range; the message begins with `where`.
    """
    return settings_from_tables(tables_from_toml(text, where), where, kind)


def tables_from_toml(text: str, where: str) -> dict[str, Any]:
    """The tables of a TOML text.

    Raises
    ------
    ConfigError
        Not TOML; the message begins with `where`.
    """
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{where}: not TOML: {error}") from None


def settings_from_tables(tables: Mapping[str, Any], where: str, kind: type[S]) -> S:
    """Tables as the settings struct `kind`; see `settings_from_toml`."""
    try:
        return msgspec.convert(tables, kind)
    except msgspec.ValidationError as error:
        fault = next(_faults(tables, kind, ""), str(error))
        raise ConfigError(f"{where}: {fault}") from None


def _faults(value: Any, hint: Any, place: str) -> Iterator[str]:
    """Unknown keys, unknown words and numbers out of range, in the order of the text."""
    hints = list(_alternatives(hint))
    structs = [h for h in hints if isinstance(h, type) and issubclass(h, msgspec.Struct)]
    if isinstance(value, Mapping) and structs:
        fields = {f.encode_name: f.type for kind in structs for f in msgspec.structs.fields(kind)}
        for key, item in value.items():
            if key in fields:
                yield from _faults(item, fields[key], _inside(place, key, item))
            else:
                yield _unknown(place, key, list(fields))
    elif isinstance(value, Mapping):
        for key, item in value.items():
            for inner in [get_args(h)[1] for h in hints if get_origin(h) is dict]:
                yield from _faults(item, inner, _inside(place, key, item))
    elif isinstance(value, list):
        inner = [part for h in hints for part in get_args(h) if part is not Ellipsis]
        for number, item in enumerate(value):
            for part in inner[:1] if len(inner) == 1 else inner[number : number + 1]:
                yield from _faults(item, part, place)
    else:
        yield from _wrong_value(value, hint, place)


def _inside(place: str, key: str, item: Any) -> str:
    """Place of a key: tables in brackets, `[gate] gamma`."""
    table = place.strip("[]")
    if isinstance(item, Mapping) or (isinstance(item, list) and item and isinstance(item[0], dict)):
        return f"[{table}.{key}]" if table else f"[{key}]"
    return f"{place} {key}".strip()


def _unknown(place: str, key: str, known: list[str]) -> str:
    nearest = nearest_names(key, known)
    hint = f"; nearest: {nearest[0]}" if nearest else ""
    return f"unknown key {f'{place} {key}'.strip()}{hint}"


def _wrong_value(value: Any, hint: Any, place: str) -> Iterator[str]:
    """A word that is none of the choices, a number out of its range, a value of another type."""
    hints = list(_alternatives(hint))
    choices = [word for h in hints if get_origin(h) is Literal for word in get_args(h)]
    if choices and isinstance(value, str) and value not in choices and str not in hints:
        yield f"{place}: {value!r} is none of {', '.join(map(str, choices))}"
    numbers = [h for h in hints if h in (int, float)]
    if numbers and isinstance(value, int | float) and not isinstance(value, bool):
        ranges = [meta for meta in _metas(hint) if not _fits(value, meta)]
        if ranges:
            yield f"{place} = {value}: must be {_in_words(ranges[0])}"


def _alternatives(hint: Any) -> Iterator[Any]:
    """What a hint allows, without its annotations: the members of a union, or itself."""
    origin = get_origin(hint)
    if origin is Annotated:
        yield from _alternatives(get_args(hint)[0])
    elif origin is not None and origin not in (tuple, list, dict, Literal):  # Union and X | Y
        for part in get_args(hint):
            yield from _alternatives(part)
    else:
        yield hint


def _metas(hint: Any) -> Iterator[Meta]:
    """Annotations of a hint and of the members of its union."""
    origin = get_origin(hint)
    if origin is Annotated:
        yield from (part for part in get_args(hint)[1:] if isinstance(part, Meta))
        yield from _metas(get_args(hint)[0])
    elif origin is not None and origin not in (tuple, list, dict, Literal):
        for part in get_args(hint):
            yield from _metas(part)


def _fits(value: float, meta: Meta) -> bool:
    return not math.isnan(value) and (
        (meta.gt is None or value > meta.gt)
        and (meta.ge is None or value >= meta.ge)
        and (meta.lt is None or value < meta.lt)
        and (meta.le is None or value <= meta.le)
    )


def _in_words(meta: Meta) -> str:
    """A range as text: `above 0 and at most 180`."""
    bounds = (("above", meta.gt), ("at least", meta.ge), ("below", meta.lt), ("at most", meta.le))
    return " and ".join(f"{word} {bound:g}" for word, bound in bounds if bound is not None)
