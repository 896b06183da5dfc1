# SPDX-License-Identifier: Apache-2.0
"""Columns handed to Arrow, pandas and xarray: the same memory, by the names that each expects."""

from collections.abc import Mapping
from itertools import product
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa
    import xarray as xr

#: Axes of the frames that names of columns speak of.
_AXES: Final = {
    "enu": ("east", "north", "up"),
    "body": ("forward", "starboard", "down"),
    "cov": ("east", "north", "up"),
}


def arrow_table(columns: Mapping[str, NDArray[Any]]) -> "pa.Table":
    """Columns as an Arrow table; (n, 3) and (n, 2, 2) as fixed-size lists.

    Numbers that lie in one piece are shared, not copied; flags (a bit each) and text are made anew.
    """
    import pyarrow as pa

    return pa.table({name: _arrow(values) for name, values in columns.items()})


def _arrow(values: NDArray[Any]) -> Any:
    import pyarrow as pa

    if values.dtype.kind == "U":
        return pa.array(values.tolist(), pa.string())
    array = pa.array(np.ascontiguousarray(values).reshape(-1))
    for width in reversed(values.shape[1:]):
        array = pa.FixedSizeListArray.from_arrays(array, width)
    return array


def scalar_columns(columns: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Columns with one number a row, as views: `position_enu_m` (n, 3) is `position_east_m` ...

    >>> import numpy as np
    >>> list(scalar_columns({"t_s": np.zeros(2), "position_enu_m": np.zeros((2, 3))}))
    ['t_s', 'position_east_m', 'position_north_m', 'position_up_m']
    """
    scalars = {}
    for name, values in columns.items():
        for places in product(*map(range, values.shape[1:])):
            rows: Any = (slice(None), *places)
            scalars[_scalar_name(name, places)] = values[rows]
    return scalars


def _scalar_name(name: str, places: tuple[int, ...]) -> str:
    if not places:
        return name
    words, frame = name.split("_"), _frame(name)
    axes = [_AXES[frame][place] for place in places]
    place = words.index(frame) if frame in words else len(words) - 1
    kept = [frame] if frame == "cov" else []
    return "_".join([*words[:place], *kept, *axes, *words[place + (frame in words) :]])


def _frame(name: str) -> str:
    """The frame that a column's name speaks of."""
    return next((word for word in name.split("_") if word in _AXES), "enu")


def data_frame(columns: Mapping[str, NDArray[Any]]) -> "pd.DataFrame":
    """`scalar_columns` as a pandas data frame that shares their memory."""
    import pandas as pd

    return pd.DataFrame(scalar_columns(columns), copy=False)


def dataset(columns: Mapping[str, NDArray[Any]]) -> "xr.Dataset":
    """Columns as an xarray dataset over `row`, with the axes of vectors named."""
    import xarray as xr

    variables = {}
    for name, values in columns.items():
        dims = [f"{_frame(name)}_{n}" for n in values.shape[1:]]
        dims = [dim if i == 0 else f"{dim}_{i}" for i, dim in enumerate(dims)]
        variables[name] = (("row", *dims), values)
    return xr.Dataset(variables)
