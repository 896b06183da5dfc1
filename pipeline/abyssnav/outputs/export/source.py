# SPDX-License-Identifier: Apache-2.0
"""What is exported: the tables of a dive's output folder as columns."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from abyssnav.errors import ConfigError, ReadError
from abyssnav.tables import in_order

Table = Mapping[str, NDArray[Any]]


@dataclass(frozen=True, eq=False)
class Exported:
    """A dive's output, `time_ns` int64 UTC in each table; numbers that do not exist are NaN."""

    name: str
    version: str
    tracks: Mapping[str, Table]  #: method -> the columns of `tracks.parquet`
    fixes: Table
    errors: Mapping[tuple[str, str], Table]  #: (method, reference) -> time_ns, distance_m

    def on_earth(self, kind: str) -> None:
        """Refuse a format that needs latitude and longitude where there is no origin."""
        known = [np.isfinite(track["latitude_deg"]).all() for track in self.tracks.values()]
        if not all(known):
            raise ConfigError(
                f"{self.name}: {kind} needs latitude and longitude, and the dive has no origin; "
                "give [origin] in the config and run it again"
            )


def load(dive: Path) -> Exported:
    """Tables of an output folder.

    Raises
    ------
    ReadError
        A file is missing or damaged.
    """
    tracks, version = _read(dive / "tracks.parquet")
    fixes, _ = _read(dive / "fixes.parquet")
    errors, _ = _read(dive / "errors.parquet")
    pairs = np.unique(np.column_stack([errors["method"], errors["reference"]]), axis=0)
    return Exported(
        name=dive.resolve().name,
        version=version,
        tracks={
            m: _rows(tracks, tracks["method"] == m)
            for m in in_order(set(tracks["method"].tolist()))
        },
        fixes=fixes,
        errors={
            (str(m), str(r)): _rows(errors, (errors["method"] == m) & (errors["reference"] == r))
            for m, r in pairs
        },
    )


def _read(path: Path) -> tuple[Table, str]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(path)
    except (OSError, pa.ArrowInvalid) as error:
        reason = str(error).splitlines()[0]
        raise ReadError(f"{path}: not the output of a dive: {reason}") from None
    columns: dict[str, NDArray[Any]] = {}
    for name in table.column_names:
        column = table[name]
        if pa.types.is_timestamp(column.type):
            columns[f"{name}_ns"] = column.cast(pa.int64()).to_numpy()
        elif pa.types.is_string(column.type):
            columns[name] = np.array(column.to_pylist(), dtype=np.str_)
        else:
            columns[name] = column.to_numpy()
    version = (table.schema.metadata or {}).get(b"abyssnav_version", b"").decode()
    return columns, version


def _rows(table: Table, mask: NDArray[np.bool_]) -> Table:
    return {name: column[mask] for name, column in table.items()}
