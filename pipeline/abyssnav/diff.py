# SPDX-License-Identifier: Apache-2.0
"""Stage diff: what two outputs of the same dives say differently, by reply and by track."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from abyssnav.errors import ReadError
from abyssnav.results import local_dives, read_arrow, read_summary

if TYPE_CHECKING:
    import pandas as pd

#: A reply, by what does not change between two runs; ping numbers may begin anew within a dive.
_FILES: Final = ("innovations.parquet", "tracks.parquet")
#: Two outputs of other files, a log and its conversion, say, are of one dive when they share more.
_SAME_SHARE: Final = 0.5
_SAME_S: Final = 1e-3  #: between travel times of one reply, as two logs round them
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

    def to_json(self) -> str:
        """All of it as one JSON object, tables as lists of rows."""
        plain = {
            "only_before": self.only_before,
            "only_after": self.only_after,
            "settings": [
                dict(zip(("key", "before", "after"), s, strict=True)) for s in self.settings
            ],
        }
        for name in ("verdicts", "tracks"):
            text = getattr(self, name).to_json(orient="records", date_format="iso", date_unit="ns")
            plain[name] = json.loads(text)
        return json.dumps(plain, indent=2)


def diff(before: str | Path, after: str | Path) -> Difference:
    """Compare two outputs, each of one dive or of many, in folders or at URLs.

    Verdicts are those of `innovations.parquet`; tracks are compared at the instants that both have,
    by horizontal distance.  What stayed the same is left out.

    Raises
    ------
    ReadError
        A folder without results, two without a common dive, or two different dives.
    """
    with local_dives(str(before), _FILES) as ones, local_dives(str(after), _FILES) as others:
        firsts, seconds = ({path.name: path for path in paths} for paths in (ones, others))
        if len(firsts) == len(seconds) == 1:  # one dive each: their names may differ
            seconds = dict(zip(firsts, seconds.values(), strict=True))
        pairs = [(name, firsts[name], seconds[name]) for name in firsts if name in seconds]
        if not pairs:
            raise ReadError(f"{before} and {after} have no dive in common")
        for _, one, other in pairs:
            _check_same_dive(one, other)
        return _difference(pairs, firsts, seconds)


def _difference(
    pairs: Sequence[tuple[str, Path, Path]], firsts: Mapping[str, Path], seconds: Mapping[str, Path]
) -> Difference:
    import pandas as pd

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


def _check_same_dive(one: Path, other: Path) -> None:
    """Refuse two dives: of other files, and with other replies too."""
    first, second = ({i["sha256"] for i in read_summary(f)["inputs"]} for f in (one, other))
    if first & second:
        return
    keys = ["ping_id", "beacon_id", "ping_time"]
    columns = [*keys, "travel_time_s"]
    replies = [
        _read(f / "innovations.parquet", columns).drop_duplicates(keys) for f in (one, other)
    ]
    both = replies[0].merge(replies[1], on=keys, suffixes=("", "_other"))
    # two dives may ping by the same clock; their travel times tell them apart
    common = int(((both["travel_time_s"] - both["travel_time_s_other"]).abs() < _SAME_S).sum())
    if common <= _SAME_SHARE * min(map(len, replies)):
        raise ReadError(
            f"{one} and {other} are of two dives: no input file in common, and {common} replies"
        )


def _settings(one: Path, other: Path) -> Iterator[tuple[str, str, str]]:
    first, second = (_flat(_provenance(folder)) for folder in (one, other))
    for key in sorted(first.keys() | second.keys()):
        values = (first.get(key, "not there"), second.get(key, "not there"))
        if values[0] != values[1]:
            yield key, *values


def _provenance(folder: Path) -> dict[str, Any]:
    summary = read_summary(folder)
    kept = {key: summary[key] for key in ("version", "profile", "settings")}
    return kept | {"inputs": [file["sha256"] for file in summary["inputs"]]}


def _flat(nested: Mapping[str, Any], above: str = "") -> dict[str, str]:
    flat: dict[str, str] = {}
    for key, value in nested.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{above}{key}.")
        else:
            flat[above.removeprefix("settings.") + key] = json.dumps(value)
    return flat


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
    return read_arrow(path, columns).to_pandas()
