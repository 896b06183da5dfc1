# SPDX-License-Identifier: Apache-2.0
"""One dive end to end, held to the contract."""

import csv
import dataclasses
import hashlib
import json
import threading
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from abyssnav.config import Config, Output
from abyssnav.errors import PipelineError, ReadError
from abyssnav.profile import load_profile
from abyssnav.run import Result, Setup, run_dive
from abyssnav.tables import ARRIVALS, DECISIONS, Log

PAPER = ("dead_reckoning", "fix", "kf_fix", "ekf_ungated", "ekf_gated")
FILES = {
    "comparison.csv",
    "comparison.parquet",
    "dive.rrd",
    "fixes.parquet",
    "innovations.parquet",
    "report.html",
    "solution.mcap",
    "statistics.parquet",
    "summary.json",
    "tracks.parquet",
}
TEXT, TIME, FLAG = "text", pa.timestamp("ns", tz="UTC"), pa.bool_()
NUMBER, WHOLE = pa.float64(), "integer"
#: Section 4 of the contract, column by column.
COLUMNS = {
    "tracks": {
        "method": TEXT,
        "time": TIME,
        **dict.fromkeys(("east_m", "north_m", "depth_m", "sigma_east_m", "sigma_north_m"), NUMBER),
        **dict.fromkeys(
            ("cov_east_north_m2", "heading_rad", "latitude_deg", "longitude_deg"), NUMBER
        ),
    },
    "fixes": {
        "time": TIME,
        "ping_id": WHOLE,
        **dict.fromkeys(
            ("east_m", "north_m", "depth_m", "sigma_east_m", "sigma_north_m", "rms_s"), NUMBER
        ),
        "n_replies": WHOLE,
        "consistent": FLAG,
    },
    "innovations": {
        "method": TEXT,
        "ping_id": WHOLE,
        "beacon_id": WHOLE,
        "ping_time": TIME,
        "time": TIME,
        **dict.fromkeys(("travel_time_s", "predicted_s", "innovation_s"), NUMBER),
        **dict.fromkeys(("innovation_sigma_s", "nis"), NUMBER),
        "accepted": FLAG,
        "decision": TEXT,
        "arrival": TEXT,
        "explanation": TEXT,
    },
    "comparison": {
        "method": TEXT,
        "reference": TEXT,
        "n": WHOLE,
        **dict.fromkeys(("mean_m", "std_m", "rms_m", "median_m", "p95_m", "max_m"), NUMBER),
    },
}


def table(result: Result, name: str) -> pd.DataFrame:
    return pd.read_parquet(result.folder / f"{name}.parquet")


def kind(found: pa.DataType) -> object:
    found = found.value_type if pa.types.is_dictionary(found) else found
    if pa.types.is_string(found) or pa.types.is_large_string(found):
        return TEXT
    return WHOLE if pa.types.is_integer(found) else found


def test_every_file_of_the_contract_is_there_and_nothing_beside(result: Result) -> None:
    names = {path.name for path in result.folder.iterdir() if path.stat().st_size}
    assert names >= FILES
    assert [path.name for path in result.folder.parent.iterdir()] == ["dive_7"]


@pytest.mark.parametrize("name", COLUMNS)
def test_every_column_of_the_contract_has_its_type(result: Result, name: str) -> None:
    schema = pq.read_schema(result.folder / f"{name}.parquet")
    found = {column: kind(schema.field(column).type) for column in COLUMNS[name]}
    assert found == COLUMNS[name]


def test_tracks_are_finite_and_rise_second_by_second(result: Result) -> None:
    tracks = table(result, "tracks")
    assert set(tracks["method"]) >= set(PAPER) - {"fix"}
    assert np.isfinite(tracks[["east_m", "north_m", "depth_m"]]).all(axis=None)
    for _, track in tracks.groupby("method", observed=True):
        step_s = track["time"].diff().dt.total_seconds().iloc[1:]
        assert (step_s > 0).all()
        assert step_s.median() == pytest.approx(1.0, abs=1e-9)


def test_each_method_has_one_innovation_a_reply_and_keeps_its_definitions(
    result: Result,
) -> None:
    innovations = table(result, "innovations")
    for _, rows in innovations.groupby("method", observed=True):
        assert len(rows) == len(result.solution.dive.replies)
        assert (rows["accepted"] == (rows["decision"] == "accepted")).all()
        taken = rows[rows["accepted"]]
        difference = taken["travel_time_s"] - taken["predicted_s"]
        np.testing.assert_allclose(taken["innovation_s"], difference, atol=1e-12)
        nis = (taken["innovation_s"] / taken["innovation_sigma_s"]) ** 2
        np.testing.assert_allclose(taken["nis"], nis, rtol=1e-9)
    assert set(innovations["method"]) >= {"ekf_ungated", "ekf_gated"}
    assert set(innovations["decision"]) <= set(DECISIONS)
    assert set(innovations["arrival"]) <= set(ARRIVALS)


def test_the_gate_lets_none_through_beyond_gamma(result: Result) -> None:
    rows = table(result, "innovations").query("method == 'ekf_gated'")
    assert rows[rows["accepted"]]["nis"].max() <= 9.21
    assert rows[rows["decision"] == "gated"]["nis"].min() > 9.21


def test_comparison_says_the_same_in_both_forms(result: Result) -> None:
    comparison = table(result, "comparison")
    with (result.folder / "comparison.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(comparison)
    assert [float(row["mean_m"]) for row in rows] == comparison["mean_m"].tolist()
    pairs = set(zip(comparison["method"], comparison["reference"], strict=True))
    assert pairs >= {(method, "truth") for method in PAPER}
    assert pairs >= {(method, "fix") for method in PAPER if method != "fix"}


def test_the_summary_tells_what_went_in_and_what_came_out(result: Result, dive_log: Path) -> None:
    summary = json.loads((result.folder / "summary.json").read_text(encoding="utf-8"))
    assert summary["settings"]["gate"]["gamma"] == 9.21
    (given,) = summary["inputs"]
    assert given["name"] == "dive_7.mcap"
    assert given["sha256"] == hashlib.sha256(dive_log.read_bytes()).hexdigest()
    replies = given["messages"]["/lbl/travel_time"]
    gated = summary["methods"]["ekf_gated"]
    assert gated["accepted"] + sum(gated["rejected"].values()) == gated["replies"] == replies
    assert set(summary["timings_s"]) >= {
        "read",
        "align",
        "navigate",
        "compare",
        "write",
        "view",
        "report",
    }
    assert summary["peak_memory_mb"] > 10
    assert set(summary["starts"]["ekf_gated"]) >= {"time", "east_m", "north_m", "cycles", "how"}
    for check in summary["checks"]:
        assert set(check) >= {"stage", "name", "value", "limit", "unit", "ok"}


def test_the_same_dive_gives_the_same_bytes(result: Result, dive_log: Path, tmp_path: Path) -> None:
    again = run_dive([dive_log], Setup(Config(), load_profile()), tmp_path)
    for path in result.folder.iterdir():
        if path.suffix in {".parquet", ".csv", ".mcap"}:
            assert path.read_bytes() == (again.folder / path.name).read_bytes(), path.name
    first, second = (
        json.loads((folder / "summary.json").read_text("utf-8"))
        for folder in (result.folder, again.folder)
    )
    effort = {"timings_s", "peak_memory_mb"}
    assert {k: first[k] for k in set(first) - effort} == {
        k: second[k] for k in set(second) - effort
    }


def test_another_output_rate_moves_no_estimate(
    result: Result, dive_log: Path, tmp_path: Path
) -> None:
    config = Config(output=Output(rate_hz=0.5))
    coarse = run_dive([dive_log], Setup(config, load_profile()), tmp_path)
    pd.testing.assert_frame_equal(table(result, "innovations"), table(coarse, "innovations"))
    both = table(result, "tracks").merge(table(coarse, "tracks"), on=["method", "time"])
    assert len(both) == len(table(coarse, "tracks"))
    np.testing.assert_allclose(both["east_m_x"], both["east_m_y"], atol=1e-9)


def test_no_estimate_sees_the_reference(
    result: Result, dive_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from abyssnav.read import read

    def blindly(*words: object) -> Log:
        log = read(*words)  # type: ignore[arg-type]
        roles = {role: columns for role, columns in log.roles.items() if role != "reference"}
        return dataclasses.replace(log, roles=roles)

    monkeypatch.setattr("abyssnav.run.read", blindly)
    blind = run_dive([dive_log], Setup(Config(), load_profile()), tmp_path)
    pd.testing.assert_frame_equal(table(result, "tracks"), table(blind, "tracks"))
    assert set(table(blind, "comparison")["reference"]) == {"fix"}


def test_a_directory_is_one_dive_by_its_own_name(short_log: Path, tmp_path: Path) -> None:
    (tmp_path / "voyage").mkdir()
    (tmp_path / "voyage" / "part.mcap").write_bytes(short_log.read_bytes())
    made = run_dive([tmp_path / "voyage"], Setup(Config(), load_profile()), tmp_path / "out")
    assert made.folder == tmp_path / "out" / "voyage"


def test_stages_are_told_as_they_begin_and_end(short_log: Path, tmp_path: Path) -> None:
    heard: list[tuple[str, float | None, int]] = []
    made = run_dive(
        [short_log], Setup(Config(), load_profile()), tmp_path, lambda *it: heard.append(it)
    )
    begun = [name for name, took_s, _ in heard if took_s is None]
    assert begun[:5] == ["read", "align", "navigate", "compare", "diagnose"]
    assert set(begun[5:]) == {"write", "view", "report"}  # side by side
    ended = {name: took_s for name, took_s, _ in heard if took_s is not None}
    assert ended == made.timings_s
    assert [(name, n) for name, _, n in heard if n] == [("read", _messages_in(short_log))]


def _messages_in(path: Path) -> int:
    from mcap.reader import make_reader

    with path.open("rb") as file:
        return sum(1 for _ in make_reader(file).iter_messages(log_time_order=False))


def test_a_stage_that_fails_leaves_the_older_result(
    short_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = run_dive([short_log], Setup(Config(), load_profile()), tmp_path)
    before = {path.name: path.read_bytes() for path in made.folder.iterdir()}

    def fails(*_: object) -> None:
        raise PipelineError("no viewer")

    monkeypatch.setattr("abyssnav.run.view", fails)
    with pytest.raises(PipelineError, match="no viewer"):
        run_dive([short_log], Setup(Config(), load_profile()), tmp_path)
    assert {path.name: path.read_bytes() for path in made.folder.iterdir()} == before
    assert [path.name for path in tmp_path.iterdir()] == ["short"]


def test_of_stages_side_by_side_the_first_error_is_told_when_all_have_ended(
    short_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writes_failed, there = threading.Event(), list[bool]()

    def write_fails(*_: object) -> None:
        writes_failed.set()
        raise PipelineError("no disk")

    def view_fails_too(*words: object) -> None:
        there.append(writes_failed.wait(60) and Path(str(words[-1])).parent.is_dir())
        raise PipelineError("no viewer")

    monkeypatch.setattr("abyssnav.run.write", write_fails)
    monkeypatch.setattr("abyssnav.run.view", view_fails_too)
    with pytest.raises(PipelineError, match="no disk"):
        run_dive([short_log], Setup(Config(), load_profile()), tmp_path / "out")
    assert there == [True]  # nothing was taken away meanwhile
    assert list((tmp_path / "out").iterdir()) == []


def test_a_log_that_cannot_be_read_leaves_no_folder(tmp_path: Path) -> None:
    (tmp_path / "text.mcap").write_text("not a log")
    with pytest.raises(ReadError, match=r"text\.mcap"):
        run_dive([tmp_path / "text.mcap"], Setup(Config(), load_profile()), tmp_path / "out")
    assert not (tmp_path / "out").exists()
