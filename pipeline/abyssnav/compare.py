# SPDX-License-Identifier: Apache-2.0
"""Stage compare: how far each method is from the fixes and from truth, over one dive or many.

The distance to `fix` is what the paper's Tables 1 and 2 call the error.  It rewards the method that
shares the fix's own bias (the vehicle taken as at rest), so it is never a goal to tune for; where
the log has a reference, the rows with `truth` tell which method is right.
"""

import re
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from abyssnav.errors import ReadError
from abyssnav.results import is_unusable, local_dives, read_arrow
from abyssnav.tables import Comparison, Errors, Fixes, Float, Int, Reference, Solution, in_order

if TYPE_CHECKING:
    import pandas as pd

#: Fewer say nothing of how dives differ.
_LEAST_DIVES = 3
#: No vehicle with a beacon interrogator runs faster: Eq. 4, generously.
_FASTEST_MPS = 10.0
_GATE_COLUMNS = (
    "method", "beacon_id", "replies", "accepted", "mean_nis", "smallest_visible_outlier_m",
)  # fmt: skip
_POOLED_COLUMNS = (
    "beacon_id", "dives", "method", "replies", "accepted", "accepted_low", "accepted_high",
    "mean_nis", "smallest_visible_outlier_m",
)  # fmt: skip
_FILES = ("errors.parquet", "statistics.parquet")
STATISTICS = ("mean_m", "std_m", "rms_m", "median_m", "p95_m", "max_m")


def compare(solution: Solution, reference: Reference | None) -> Comparison:
    """Error statistics of every method, against the fixes and, where there is one, the reference.

    One row a method and reference for which there is at least one distance; methods in the order
    of `abyssnav.tables.METHODS`, those against `fix` first.
    """
    return summarise(error_over_time(solution, reference))


def error_over_time(
    solution: Solution, reference: Reference | None
) -> dict[tuple[str, str], Errors]:
    """Horizontal distance of each method to each reference, at every instant both are known.

        fix:    |track(t_j) - fix_j|      at the stamps t_j of the consistent fixes
        truth:  |track_k - truth(t_k)|    at the track's own times t_k; for `fix`, at its stamps

    Positions in brackets are interpolated linearly, never extrapolated.  Fixes that their own
    residuals refute, or that lie further from both neighbours than anything runs, are left out:
    they are outliers of hundreds of metres.

    Returns
    -------
    errors : (method, reference) -> table of seconds since the dive's start and metres
    """
    fixes = _believable(solution.fixes)
    placed = {m: (t.t_s, t.position_enu_m) for m, t in solution.tracks.items()}
    to_fix = {
        (method, "fix"): _distance(fixes.t_s, fixes.position_enu_m, *placed[method])
        for method in in_order(placed)
        if method != "fix"
    }
    if reference is None:
        return to_fix
    truth = _truth(reference, solution.dive.start_ns)
    placed["fix"] = (fixes.t_s, fixes.position_enu_m)
    to_truth = {(m, "truth"): _distance(*placed[m], *truth) for m in in_order(placed)}
    return to_fix | to_truth


def summarise(errors: Mapping[tuple[str, str], Errors]) -> Comparison:
    """Statistics of the distances; pairs without any are left out.

    `std_m` is the population's standard deviation of the 2-D distance, the paper's "standard
    error"; `rms_m`² = `mean_m`² + `std_m`².
    """
    kept = {pair: e.distance_m for pair, e in errors.items() if len(e)}
    rows = [describe(distance_m) for distance_m in kept.values()]
    return Comparison(
        method=np.array([method for method, _ in kept], dtype=np.str_),
        reference=np.array([name for _, name in kept], dtype=np.str_),
        n=np.array([len(distance_m) for distance_m in kept.values()], dtype=np.int64),
        **{name: np.array([row[name] for row in rows], dtype=np.float64) for name in STATISTICS},
    )


def describe(distance_m: Float) -> dict[str, float]:
    """The six statistics of at least one distance, by the names of `STATISTICS`."""
    median_m, p95_m = np.quantile(distance_m, [0.5, 0.95])
    return {
        "mean_m": float(distance_m.mean()),
        "std_m": float(distance_m.std()),
        "rms_m": float(np.sqrt(np.square(distance_m).mean())),
        "median_m": float(median_m),
        "p95_m": float(p95_m),
        "max_m": float(distance_m.max()),
    }


def compare_dives(
    folders: Sequence[Path], by: Literal["method", "dive", "voyage", "beacon"]
) -> "pd.DataFrame":
    """Error statistics over the outputs of many dives, or what the gates did in them.

    Pooled, a 95 % interval is a bootstrap over dives: what one dive holds hangs together, so a dive
    is drawn whole.  It is null below three dives.

    Parameters
    ----------
    folders : output folders of dives
    by : `method` pools the distances of all dives, `voyage` those of each voyage, `dive` keeps a
        row a dive and method; `beacon` pools what the gates did, a row a beacon and method

    Returns
    -------
    table : columns of `comparison.parquet`, after `dives` (their number), `voyage` or `dive` (the
        name); pooled, `mean_low_m` and `mean_high_m` besides.  By beacon: `replies`, `accepted`
        (their share) with `accepted_low` and `accepted_high`, `mean_nis` of the accepted and
        `smallest_visible_outlier_m`, the median over dives

    Raises
    ------
    ReadError
        No folder, or one whose errors or statistics cannot be read.
    """
    import pandas as pd

    if not folders:
        raise ReadError("no dive to compare: no folder with errors.parquet")
    if by == "beacon":
        return _by_beacon(folders)
    parts: dict[tuple[str, str, str], list[Float]] = {}
    for folder in folders:
        pool = {"method": "", "voyage": voyage_of(folder.name), "dive": folder.name}[by]
        for (method, name), distance_m in _read_errors(folder).items():
            parts.setdefault((pool, method, name), []).append(distance_m)
    rows = [
        {
            by: pool,
            "dives": len(dives),
            "method": method,
            "reference": name,
            "n": sum(map(len, dives)),
        }
        | describe(np.concatenate(dives))
        | _interval_of_mean(dives)
        for (pool, method, name), dives in parts.items()
    ]
    leading = {"method": ["dives"], "voyage": ["voyage", "dives"], "dive": ["dive"]}[by]
    pooled = [] if by == "dive" else ["mean_low_m", "mean_high_m"]
    columns = [*leading, "method", "reference", "n", *STATISTICS, *pooled]
    order = ["reference"] if by == "method" else [by, "reference"]
    return _by_rank(pd.DataFrame(rows, columns=columns), order)


def compare_places(
    places: Sequence[str],
    by: Literal["method", "dive", "voyage", "beacon"],
    *,
    everything: bool = False,
) -> tuple["pd.DataFrame", list[str]]:
    """`compare_dives` over folders or URLs, each of one dive or of many.

    What is pooled leaves out dives whose verdict is `unusable`, as one of them would spoil the
    statistics of all; a dive that is named by its own folder stays.

    Parameters
    ----------
    everything : pool the unusable ones too

    Returns
    -------
    table, left_out : as of `compare_dives`, and the names of the dives left out

    Raises
    ------
    ReadError
        Nothing to compare, or what cannot be read.
    """
    kept, left_out = list[Path](), list[str]()
    with ExitStack() as stack:
        for place in places:
            folders = stack.enter_context(local_dives(place, _FILES))
            named = len(folders) == 1 and folders[0].name == Path(place).name
            for folder in folders:
                if everything or named or by == "dive" or not is_unusable(folder):
                    kept.append(folder)
                else:
                    left_out.append(folder.name)
        if not kept:
            raise ReadError(f"all {len(left_out)} dives are unusable; --all compares them")
        return compare_dives(kept, by), left_out


def voyage_of(dive: str) -> str:
    """Name of a dive up to its last separator and number: `leg_2` of `leg_2_007` or `leg_2-7`."""
    match = re.fullmatch(r"(.+?)[-_. ]+\d+", dive)
    return match[1] if match else dive


def _by_beacon(folders: Sequence[Path]) -> "pd.DataFrame":
    import pandas as pd

    statistics = pd.concat([_read_table(f, "statistics", _GATE_COLUMNS) for f in folders])
    rows = []
    for (beacon_id, method), group in statistics.groupby(["beacon_id", "method"], observed=True):
        replies, accepted = group["replies"].to_numpy(), group["accepted"].to_numpy()
        low, high = _interval(accepted, replies)
        with_accepted = group[group["accepted"] > 0]
        nis = (with_accepted["mean_nis"] * with_accepted["accepted"]).sum()
        row = {"beacon_id": beacon_id, "dives": len(group), "method": str(method)}
        row |= {"replies": replies.sum(), "accepted": accepted.sum() / max(replies.sum(), 1)}
        row |= {"accepted_low": low, "accepted_high": high}
        row |= {"mean_nis": nis / accepted.sum() if len(with_accepted) else np.nan}
        row |= {"smallest_visible_outlier_m": group["smallest_visible_outlier_m"].median()}
        rows.append(row)
    return _by_rank(pd.DataFrame(rows, columns=_POOLED_COLUMNS), ["beacon_id"])


def _by_rank(table: "pd.DataFrame", order: Sequence[str]) -> "pd.DataFrame":
    """Rows by the columns `order`, then by method as people read them."""
    rank = {method: place for place, method in enumerate(in_order(table["method"]))}
    table = table.assign(_place=table["method"].map(rank))
    table = table.sort_values([*order, "_place"], kind="stable")
    return table.drop(columns="_place").reset_index(drop=True)


def _interval_of_mean(parts: Sequence[Float]) -> dict[str, float]:
    sums_m = np.array([distance_m.sum() for distance_m in parts])
    low_m, high_m = _interval(sums_m, np.array([len(distance_m) for distance_m in parts]))
    return {"mean_low_m": low_m, "mean_high_m": high_m}


def _interval(sums: Float | Int, counts: Int) -> tuple[float, float]:
    """95 % interval of Σ sums / Σ counts over as many dives drawn, with fixed seed."""
    dives = len(sums)
    if dives < _LEAST_DIVES or not counts.all():
        return float("nan"), float("nan")
    draws = max(200, min(2000, 20_000_000 // dives))
    drawn = np.random.default_rng(dives).multinomial(dives, np.full(dives, 1 / dives), size=draws)
    counts_drawn = drawn @ counts.astype(np.float64)
    low, high = np.quantile((drawn @ sums) / counts_drawn, [0.025, 0.975])
    return float(low), float(high)


def _read_errors(folder: Path) -> dict[tuple[str, str], Float]:
    """Distances of one dive by method and reference."""
    table = _read_table(folder, "errors", ("method", "reference", "distance_m"))
    groups = table.groupby(["method", "reference"], sort=False, observed=True)["distance_m"]
    return {(str(method), str(name)): rows.to_numpy() for (method, name), rows in groups}


def _read_table(folder: Path, name: str, columns: Sequence[str]) -> "pd.DataFrame":
    return read_arrow(folder / f"{name}.parquet", columns).to_pandas()


def _truth(reference: Reference, start_ns: int) -> tuple[Float, Float]:
    """Seconds since the dive's start, rising, and finite positions."""
    finite = np.isfinite(reference.position_enu_m[:, :2]).all(axis=1)
    time_ns, first = np.unique(reference.time_ns[finite], return_index=True)
    return (time_ns - start_ns) / 1e9, reference.position_enu_m[finite][first]


def _believable(fixes: Fixes) -> Fixes:
    """The consistent fixes that a vehicle could have reached from the one before or after."""
    fixes = fixes[fixes.consistent]
    if len(fixes) < 2:
        return fixes
    step_m = np.linalg.norm(np.diff(fixes.position_enu_m[:, :2], axis=0), axis=1)
    within_reach = step_m <= _FASTEST_MPS * np.diff(fixes.t_s)
    reached = np.zeros(len(fixes), dtype=bool)
    reached[1:] |= within_reach
    reached[:-1] |= within_reach
    return fixes[reached]


def _distance(t_s: Float, enu_m: Float, track_t_s: Float, track_enu_m: Float) -> Errors:
    """Distance of points (n, 3) from the track (m, 3) at their own times inside its span."""
    if len(track_t_s) == 0:
        return Errors(np.empty(0), np.empty(0))
    inside = (t_s >= track_t_s[0]) & (t_s <= track_t_s[-1])
    t_s, enu_m = t_s[inside], enu_m[inside]
    east_m = np.interp(t_s, track_t_s, track_enu_m[:, 0])
    north_m = np.interp(t_s, track_t_s, track_enu_m[:, 1])
    return Errors(t_s, np.hypot(enu_m[:, 0] - east_m, enu_m[:, 1] - north_m))
