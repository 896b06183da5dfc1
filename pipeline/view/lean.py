# SPDX-License-Identifier: Apache-2.0
"""A second saved for a process that is all ours."""

import sys
from types import SimpleNamespace


def spare_pandas() -> None:
    """Keep pyarrow from importing pandas at its first `pa.array`: 1.2 s of a run of 3 s.

    Arrow looks for pandas once, to know its objects when it meets them; the viewer's library calls
    it with arrays only.  Data frames still go to Arrow and Parquet and come back, as those calls
    look again, but `pa.array(series)` takes a series for any sequence from then on.  So this is for
    the command line and its workers, never for a program that has other people's code in it.
    """
    if "pandas" in sys.modules:
        return
    import pyarrow as pa

    def refuse(name: str, *_: object) -> None:
        if name == "pandas":
            raise ModuleNotFoundError(name)

    finder = SimpleNamespace(find_spec=refuse)
    sys.meta_path.insert(0, finder)
    try:
        pa.array([0])
    finally:
        sys.meta_path.remove(finder)
