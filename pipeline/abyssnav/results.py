# SPDX-License-Identifier: Apache-2.0
"""Results as they lie in folders or at URLs: which dives there are, and their tables read."""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from abyssnav.atomic import COMPLETION_MARKER
from abyssnav.errors import PipelineError, ReadError, UnknownMethodError, nearest_hint
from abyssnav.remote import download_results, is_url
from abyssnav.tables import Origin

if TYPE_CHECKING:
    import pyarrow as pa


@dataclass(frozen=True, eq=False)
class ResultTable:
    """A Parquet file of ours: columns, times as int64 `<name>_ns`; and what its metadata say."""

    columns: dict[str, NDArray[Any]]
    version: str
    origin: Origin | None

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), ()))


def dive_folders(place: Path) -> list[Path]:
    """Folders of the dives at a folder of one result or of many, by name.

    Raises
    ------
    ReadError
        No such folder, or none of a dive in it.
    """
    if not place.is_dir():
        raise ReadError(f"{place}: no such folder; abyssnav run makes one")
    if (place / COMPLETION_MARKER).is_file():
        return [place]
    dives = sorted(path.parent for path in place.glob(f"[!.]*/{COMPLETION_MARKER}"))
    if not dives:
        raise ReadError(f"{place}: holds no result of abyssnav run")
    return dives


@contextmanager
def local_dives(place: str, files: Sequence[str]) -> Iterator[list[Path]]:
    """Folders of the dives at a path or URL; from a URL these files of each are fetched.

    Raises
    ------
    ReadError
        Nothing there, or it cannot be reached.
    """
    if not is_url(place):
        yield dive_folders(Path(place))
        return
    with TemporaryDirectory(prefix="abyssnav-") as folder:
        target = Path(folder) / (place.rstrip("/").rsplit("/", 1)[-1] or "results")
        download_results(place.rstrip("/"), (*files, COMPLETION_MARKER), target)
        try:
            yield dive_folders(target)
        except PipelineError as refusal:  # whoever reads it knows the result by its URL
            text = str(refusal).replace(str(target), place.rstrip("/"))
            raise type(refusal)(text) from refusal


@contextmanager
def one_dive(place: str, files: Sequence[str]) -> Iterator[Path]:
    """Folder of the one dive at a path or URL; from a URL these files are fetched.

    Raises
    ------
    ReadError
        Nothing there, several dives, or it cannot be reached.
    """
    with local_dives(place, files) as dives:
        if len(dives) != 1:
            raise ReadError(f"{place}: one dive at a time; there are {len(dives)}")
        yield dives[0]


def read_summary(folder: Path) -> dict[str, Any]:
    """What `summary.json` of a dive's folder says.

    Raises
    ------
    ReadError
        It is not there, or no JSON object.
    """
    path = folder / COMPLETION_MARKER
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ReadError(f"{path}: not the summary of a dive: {reason}") from None
    if not isinstance(summary, dict):
        raise ReadError(f"{path}: not the summary of a dive: no JSON object")
    return summary


def is_unusable(folder: Path) -> bool:
    """Whether the verdict says that a dive's tracks cannot be relied on."""
    return (read_summary(folder).get("verdict") or {}).get("level") == "unusable"


def chosen_methods(present: Sequence[str], wanted: Sequence[str], where: str) -> list[str]:
    """Those of a result's methods that are wanted, in its order; the smoother, or last, if none is.

    Raises
    ------
    ReadError
        The result has no track, or none by one of them (`UnknownMethodError`).
    """
    if not present:
        raise ReadError(f"{where}: no track in it")
    for method in wanted:
        if method not in present:
            hint = nearest_hint(method, present)
            raise UnknownMethodError(f"{where}: no track by {method!r}{hint}", method)
    best = "smoother" if "smoother" in present else present[-1]
    return [method for method in present if method in (wanted or [best])]


def read_arrow(path: Path, columns: Sequence[str] | None = None, filters: Any = None) -> "pa.Table":
    """A Parquet file of ours, all of it or these columns.

    Raises
    ------
    ReadError
        It is missing or damaged, or an older version made it, without a column that is wanted.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        known = pq.read_schema(path)
        missing = [name for name in columns or () if name not in known.names]
        if missing:
            version = (known.metadata or {}).get(b"abyssnav_version", b"something else").decode()
            raise ReadError(f"{path}: made by {version}, without {missing[0]}: run the dive again")
        return pq.read_table(path, columns=list(columns) if columns else None, filters=filters)
    except FileNotFoundError:
        whole = (path.parent / COMPLETION_MARKER).is_file()
        advice = "run the dive with it in output.files" if whole else "is this a dive's folder?"
        raise ReadError(f"{path}: not there: {advice}") from None
    except (OSError, pa.ArrowInvalid) as error:
        reason = str(error).splitlines()[0]
        raise ReadError(f"{path}: not a table of a dive: {reason}") from None


def read_table(
    path: Path, columns: Sequence[str] | None = None, filters: Any = None
) -> ResultTable:
    """The same as NumPy columns: a number that is not there is NaN.

    Raises
    ------
    ReadError
        As of `read_arrow`.
    """
    table = read_arrow(path, columns, filters)
    metadata = table.schema.metadata or {}
    place = metadata.get(b"origin", b"none").decode()
    origin = None if place == "none" else _origin(place)
    return ResultTable(
        dict(_numpy(name, table[name]) for name in table.column_names),
        metadata.get(b"abyssnav_version", b"").decode(),
        origin,
    )


def _origin(text: str) -> Origin:
    latitude_deg, longitude_deg = map(float, text.split(","))
    return Origin(latitude_deg, longitude_deg)


def _numpy(name: str, column: Any) -> tuple[str, NDArray[Any]]:
    import pyarrow as pa

    if pa.types.is_timestamp(column.type):
        return f"{name}_ns", column.cast(pa.timestamp("ns")).cast(pa.int64()).to_numpy()
    if pa.types.is_string(column.type):
        codes = column.combine_chunks().dictionary_encode()  # each word becomes a str once
        words = np.array(codes.dictionary.to_pylist() or [""], dtype=np.str_)
        return name, words[codes.indices.to_numpy(zero_copy_only=False)]
    return name, column.to_numpy()
