# SPDX-License-Identifier: Apache-2.0
"""A folder of tracks against the logs of a benchmark: a score a dive, and a row a kind of dive."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from abyssnav.errors import ReadError
from abyssnav.score.given_track import TRACK_SUFFIXES
from abyssnav.score.measures import Options, TrackScore, score

#: Beside the tracks, by anybody who measured it: `dive`, `seconds`, `memory_mb`.
_COSTS = "costs.csv"
_MEDIANS = (
    "rms_m", "x_filter", "x_smoother", "nees", "inside_95", "sharpness", "outliers_accepted",
    "good_rejected", "start_s", "coverage",
)  # fmt: skip


@dataclass(frozen=True)
class DiveScore:
    """One dive of a benchmark; without a score where the track is missing or none."""

    dive: str
    score: TrackScore | None
    reason: str = ""  #: why there is no score
    seconds: float | None = None
    memory_mb: float | None = None

    def plain(self) -> dict[str, Any]:
        """The row for JSON."""
        costs = {"seconds": self.seconds, "memory_mb": self.memory_mb, "reason": self.reason}
        known = {name: value for name, value in costs.items() if value}
        return {"dive": self.dive} | (self.score.plain() if self.score else {}) | known


@dataclass(frozen=True)
class PooledScore:
    """Dives of one kind: medians over those with a track, but for the worst."""

    kind: str
    dives: int
    scored: int
    max_m: float
    values: dict[str, float]  #: medians by the name of `TrackScore`'s field; NaN where unknown

    def plain(self) -> dict[str, Any]:
        """The row for JSON."""
        known = {name: value for name, value in self.values.items() if not np.isnan(value)}
        row = {"kind": self.kind, "dives": self.dives, "scored": self.scored}
        return row | ({} if np.isnan(self.max_m) else {"max_m": self.max_m}) | known


def score_folder(logs: Path, tracks: Path, options: Options | None = None) -> list[DiveScore]:
    """Score of each log of a folder by the track of its name, or by its result.

    For `<dive>.mcap` that is `<dive>.parquet`, `.csv`, `.tum` or `.txt` in the folder of the
    tracks, or `<dive>/tracks.parquet`.

    Raises
    ------
    ReadError
        No log in the one folder, or no track of any in the other.
    """
    dives = sorted(path for path in logs.glob("*.mcap") if path.is_file())
    if not dives:
        raise ReadError(f"{logs}: no log (*.mcap)")
    if not tracks.is_dir():
        raise ReadError(f"{tracks}: a folder of logs is scored against a folder of tracks")
    costs, rows = _costs(tracks), []
    for log_path in dives:
        row = _scored(log_path, _track_of(log_path.stem, tracks), options)
        seconds, memory_mb = costs.get(row.dive, (None, None))
        rows.append(replace(row, seconds=seconds, memory_mb=memory_mb))
    if not any(row.score for row in rows):
        raise ReadError(f"{tracks}: no track of any dive in {logs}; {rows[0].reason}")
    return rows


def _track_of(dive: str, tracks: Path) -> Path | None:
    names = [f"{dive}{suffix}" for suffix in TRACK_SUFFIXES] + [f"{dive}/tracks.parquet"]
    return next((path for name in names if (path := tracks / name).is_file()), None)


def _scored(log_path: Path, track: Path | None, options: Options | None) -> DiveScore:
    if track is None:
        return DiveScore(log_path.stem, None, f"no track {log_path.stem}.csv or .parquet")
    try:
        return DiveScore(log_path.stem, score(log_path, track, options))
    except ReadError as refusal:
        return DiveScore(log_path.stem, None, str(refusal))


def _costs(tracks: Path) -> dict[str, tuple[float, float]]:
    """What each dive cost, where somebody wrote it down."""
    path = tracks / _COSTS
    if not path.is_file():
        return {}
    import pandas as pd

    try:
        table = pd.read_csv(path).set_index("dive")[["seconds", "memory_mb"]].astype(float)
    except (KeyError, ValueError, pd.errors.ParserError) as error:
        raise ReadError(f"{path}: needs dive, seconds, memory_mb: {error}") from None
    return {str(dive): (s, mb) for dive, s, mb in table.itertuples()}


def pool(rows: Sequence[DiveScore]) -> list[PooledScore]:
    """A row a kind of dive, which is a dive's name without its last number."""
    kinds: dict[str, list[DiveScore]] = {}
    for row in rows:
        kinds.setdefault(re.sub(r"[-_]\d+$", "", row.dive), []).append(row)
    return [_pooled(kind, dives) for kind, dives in kinds.items()]


def _pooled(kind: str, dives: Sequence[DiveScore]) -> PooledScore:
    scores = [row.score for row in dives if row.score is not None]
    values = {name: _median([getattr(s, name) for s in scores]) for name in _MEDIANS}
    values |= {
        name: _median([getattr(d, name) for d in dives]) for name in ("seconds", "memory_mb")
    }
    worst_m = max((s.max_m for s in scores), default=np.nan)
    return PooledScore(kind, len(dives), len(scores), worst_m, values)


def _median(values: Sequence[float | None]) -> float:
    known = [value for value in values if value is not None and not np.isnan(value)]
    return float(np.median(known)) if known else np.nan
