# SPDX-License-Identifier: Apache-2.0
"""Stage diff: what two outputs of the same dives say differently, by reply and by track."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from abyssnav.errors import ReadError

if TYPE_CHECKING:
    import pandas as pd

#: A reply, by what does not change between two runs; ping numbers may begin anew within a dive.
_REPLY: Final = ["method", "ping_id", "beacon_id", "ping_time"]


@dataclass(frozen=True, eq=False)
class Difference:
    """What changed between two outputs."""

    only_before: tuple[str, ...]  #: dives that the second output lacks
    only_after: tuple[str, ...]  #: dives that the first output lacks
    settings: tuple[tuple[str, str, str], ...]  #: key, before, after; version and profile too
    #: one row a reply whose verdict changed: dive, `_REPLY`, before, after
    verdicts: "pd.DataFrame"
    #: one row a dive and method that moved: n common instants, mean_m, rms_m, max_m, time of it
    tracks: "pd.DataFrame"


def diff(before: Path, after: Path) -> Difference:
    """Compare two outputs, each of one dive or of many.

    Verdicts are those of `innovations.parquet`; tracks are compared at the instants that both have,
    by horizontal distance.  What stayed the same is left out.

    Raises
    ------
    ReadError
        A folder without results, or two without a common dive.
    """
    import pandas as pd

    firsts, seconds = _dives(before), _dives(after)
    if len(firsts) == len(seconds) == 1:  # one dive each: their names may differ
        seconds = dict(zip(firsts, seconds.values(), strict=True))
    pairs = [(name, firsts[name], seconds[name]) for name in firsts if name in seconds]
    if not pairs:
        raise ReadError(f"{before} and {after} have no dive in common")
    settings = {row: None for _, one, other in pairs for row in _settings(one, other)}
    verdicts = [_verdicts(one, other).assign(dive=name) for name, one, other in pairs]
    tracks = [row for name, one, other in pairs for row in _moves(name, one, other)]
    columns = ["dive", "method", "n", "mean_m", "rms_m", "max_m", "time"]
    return Difference(
        only_before=tuple(sorted(set(firsts) - set(seconds))),
        only_after=tuple(sorted(set(seconds) - set(firsts))),
        settings=tuple(settings),
        verdicts=pd.concat(verdicts, ignore_index=True)[["dive", *_REPLY, "before", "after"]],
        tracks=pd.DataFrame(tracks, columns=columns),
    )


def _dives(place: Path) -> dict[str, Path]:
    if (place / "summary.json").is_file():
        return {place.name: place}
    found = {path.parent.name: path.parent for path in sorted(place.glob("[!.]*/summary.json"))}
    if not found:
        raise ReadError(f"{place}: holds no result of abyssnav run")
    return found


def _settings(one: Path, other: Path) -> Iterator[tuple[str, str, str]]:
    first, second = (_flat(_told(folder)) for folder in (one, other))
    for key in sorted(first.keys() | second.keys()):
        values = (first.get(key, "not there"), second.get(key, "not there"))
        if values[0] != values[1]:
            yield key, *values


def _told(folder: Path) -> dict[str, Any]:
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    kept = {key: summary[key] for key in ("version", "profile", "settings")}
    return kept | {"inputs": [file["sha256"] for file in summary["inputs"]]}


def _flat(told: Mapping[str, Any], above: str = "") -> dict[str, str]:
    found: dict[str, str] = {}
    for key, value in told.items():
        if isinstance(value, dict):
            found |= _flat(value, f"{above}{key}.")
        else:
            found[above.removeprefix("settings.") + key] = json.dumps(value)
    return found


def _verdicts(one: Path, other: Path) -> "pd.DataFrame":
    """Replies whose decision changed, those that only one output holds included."""
    first, second = _decisions(one, "before"), _decisions(other, "after")
    both = first.join(second, how="outer").reset_index()
    both = both.fillna({"before": "not there", "after": "not there"})
    return both[both["before"] != both["after"]]


def _decisions(folder: Path, name: str) -> "pd.DataFrame":
    table = _read(folder / "innovations.parquet", [*_REPLY, "decision"])
    table["copy"] = table.groupby(_REPLY).cumcount()
    return table.set_index([*_REPLY, "copy"]).rename(columns={"decision": name})


def _moves(dive: str, one: Path, other: Path) -> Iterator[dict[str, Any]]:
    columns = ["method", "time", "east_m", "north_m"]
    first, second = (_read(folder / "tracks.parquet", columns) for folder in (one, other))
    both = first.merge(second, on=["method", "time"], suffixes=("_before", "_after"))
    if both.empty and len(first) and len(second):
        raise ReadError(f"{one} and {other} have no instant in common: they are of two dives")
    both["moved_m"] = np.hypot(
        both["east_m_after"] - both["east_m_before"],
        both["north_m_after"] - both["north_m_before"],
    )
    for method, track in both.groupby("method", sort=False):
        moved_m = track["moved_m"].to_numpy()
        if moved_m.max() > 0.0:
            yield {
                "dive": dive,
                "method": method,
                "n": len(moved_m),
                "mean_m": float(moved_m.mean()),
                "rms_m": float(np.sqrt(np.square(moved_m).mean())),
                "max_m": float(moved_m.max()),
                "time": track["time"].iloc[int(moved_m.argmax())],
            }


def _read(path: Path, columns: list[str]) -> "pd.DataFrame":
    import pandas as pd

    try:
        return pd.read_parquet(path, columns=columns)
    except (OSError, ValueError) as error:
        raise ReadError(f"{path}: not of a dive: {str(error).splitlines()[0]}") from None
