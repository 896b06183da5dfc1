# SPDX-License-Identifier: Apache-2.0
"""The open benchmark: its kinds of dives, and their logs, truth and starts as files."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from abyssnav.config import schemas
from abyssnav.errors import ConfigError
from abyssnav.settings import settings_from_toml
from abyssnav.simulate.dive import Simulation, simulate
from abyssnav.simulate.limits import bound
from abyssnav.simulate.record import write_log
from abyssnav.simulate.replies import LABELS
from abyssnav.simulate.scenario import Scenario, load_scenario, with_keys
from abyssnav.simulate.stated import settings_toml
from abyssnav.tables import Int

#: Name on the command line -> which of the seeds.
SETS: Mapping[str, Literal["open", "scored"]] = {
    "benchmark": "open",
    "benchmark_scored": "scored",
}
#: How well a start that is given is known, each axis; the bound begins with the same.
START_SIGMA_M = 10.0
#: What the default profile lacks for the position fixes of a dive.
_POSITION_ROLES = {
    "gnss": 'topic = "/gnss/fix"\ntype = "sensor_msgs/msg/NavSatFix"\nlatitude = "latitude"\n'
    'longitude = "longitude"\ncovariance = "position_covariance"\n',
    "usbl": 'topic = "/usbl"\ntype = "geometry_msgs/msg/PoseWithCovarianceStamped"\n'
    'position = ["pose.pose.position.x", "pose.pose.position.y", "pose.pose.position.z"]\n'
    'covariance = "pose.covariance"\n',
}


class Kind(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Dives of one kind: a shipped scenario, and what differs from it."""

    name: str
    about: str
    scenario: str
    keys: dict[str, Any] = {}


class Seeds(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Of the dives to tune on, and of those that are only scored."""

    open: tuple[int, ...]
    scored: tuple[int, ...]


class Benchmark(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What `schemas/benchmark.toml` says."""

    seeds: Seeds
    kind: tuple[Kind, ...]


@dataclass(frozen=True)
class BenchmarkDive:
    """One dive of the benchmark."""

    name: str
    scenario: Scenario  #: with its seed


def load_benchmark() -> Benchmark:
    """The shipped benchmark."""
    path = schemas() / "benchmark.toml"
    return settings_from_toml(path.read_text(encoding="utf-8"), path.name, Benchmark)


def benchmark_dives(name: str = "benchmark", kinds: Sequence[str] = ()) -> list[BenchmarkDive]:
    """Dives of one of `SETS`, kind by kind.

    Parameters
    ----------
    kinds : only these; none: all

    Raises
    ------
    ConfigError
        A kind that the benchmark does not have.
    """
    benchmark = load_benchmark()
    known = [kind.name for kind in benchmark.kind]
    for wanted in kinds:
        if wanted not in known:
            raise ConfigError(f"no kind '{wanted}' in the benchmark; known: {', '.join(known)}")
    dives = []
    for kind in benchmark.kind:
        if kinds and kind.name not in kinds:
            continue
        scenario = with_keys(load_scenario(kind.scenario), kind.keys)
        for seed in getattr(benchmark.seeds, SETS[name]):
            seeded = msgspec.structs.replace(scenario, seed=seed)
            dives.append(BenchmarkDive(f"{kind.name}_{seed}", seeded))
    return dives


def write_benchmark(
    folder: Path, dives: Sequence[BenchmarkDive], tell: Callable[[str], None] = lambda _: None
) -> None:
    """Write each dive's log, and beside it what whoever navigates or scores needs.

    - `<dive>.mcap`: the log, its truth on /reference (ENU, 1 Hz)
    - `<dive>.settings.toml`: what no log can hold, where there is any
    - `<dive>.profile.toml`: where position fixes are on the log
    - `<dive>.start.toml`: a start within 10 m an axis of the truth, for who takes one
    - `<dive>.bound.parquet`, `<dive>.replies.parquet`: for scoring (`score/truth_files.py`)
    """
    folder.mkdir(parents=True, exist_ok=True)
    for dive in dives:
        simulation = simulate(dive.scenario)
        path = folder / f"{dive.name}.mcap"
        write_log(simulation, path)
        texts = {
            ".settings.toml": settings_toml(simulation),
            ".profile.toml": _profile(simulation),
            ".start.toml": _start(simulation),
        }
        for suffix, text in texts.items():
            if text:
                path.with_suffix(suffix).write_text(text, encoding="utf-8")
        _write_truth(simulation, path)
        tell(dive.name)


def _profile(simulation: Simulation) -> str:
    """The default profile with the position fixes of the dive; empty where it has none."""
    kinds = [kind for kind, fixes in simulation.positions.items() if len(fixes)]
    if not kinds:
        return ""
    if len(kinds) > 1:
        raise ConfigError("a dive of the benchmark has one kind of position fixes")
    default = (schemas() / "profiles" / "default.toml").read_text(encoding="utf-8")
    return f"{default}\n[position]\n{_POSITION_ROLES[kinds[0]]}"


def _start(simulation: Simulation) -> str:
    """The true position at the first ping, as far off as `START_SIGMA_M` says."""
    first_s = float(simulation.replies.t_ping_s.min())
    rng = np.random.default_rng([simulation.scenario.seed, *b"start"])
    true_m = simulation.position_at(np.array([first_s]))[0, :2]
    east_m, north_m = (true_m + rng.normal(0.0, START_SIGMA_M, 2)).round(2).tolist()
    first = np.datetime64(simulation.start_ns + round(first_s * 1e9), "ns").astype("M8[us]")
    return (
        f"[start]\nposition_m = [{east_m}, {north_m}]\nsigma_m = {START_SIGMA_M}\nat = {first}Z\n"
    )


def _write_truth(simulation: Simulation, log_path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    limit, replies = bound(simulation), simulation.replies

    def stamps(t_s: Any) -> Any:
        ns: Int = simulation.start_ns + np.round(t_s * 1e9).astype(np.int64)
        return pa.array(ns).cast(pa.timestamp("ns", "UTC"))

    tables = {
        ".bound.parquet": {
            "time": stamps(limit.t_s),
            "filter_m": limit.filter_m,
            "smoother_m": limit.smoother_m,
        },
        ".replies.parquet": {
            "ping_id": replies.ping_id,
            "beacon_id": simulation.beacons.id[replies.beacon],
            "ping_time": stamps(replies.t_ping_s),
            "travel_time_s": replies.travel_time_s,
            "direct_s": replies.direct_s,
            "what": np.array(LABELS)[replies.label],
        },
    }
    for suffix, columns in tables.items():
        pq.write_table(pa.table(dict(columns)), log_path.with_suffix(suffix))
