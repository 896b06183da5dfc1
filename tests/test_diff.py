# SPDX-License-Identifier: Apache-2.0
"""Two outputs of one dive: what changed is named, what did not is not."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from abyssnav.config import Config, Gate
from abyssnav.diff import diff
from abyssnav.errors import ReadError
from abyssnav.profile import load_profile
from abyssnav.run import Result, Setup, run_dive
from abyssnav.terminal import FINDINGS, show_difference


@pytest.fixture(scope="module")
def tighter(dive_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Result:
    config = Config(gate=Gate(gamma=2.0))
    return run_dive([dive_log], Setup(config, load_profile()), tmp_path_factory.mktemp("tighter"))


def test_the_same_output_differs_in_nothing(result: Result) -> None:
    found = diff(result.folder, result.folder)
    assert found.settings == found.only_before == found.only_after == ()
    assert len(found.verdicts) == len(found.tracks) == 0


def test_a_tighter_gate_is_told_setting_by_reply_by_track(result: Result, tighter: Result) -> None:
    found = diff(result.folder, tighter.folder)
    assert found.settings == (("gate.gamma", "9.21", "2.0"),)

    first, second = (
        pd.read_parquet(made.folder / "innovations.parquet").query("method == 'ekf_gated'")
        for made in (result, tighter)
    )
    changed = (first["decision"].to_numpy() != second["decision"].to_numpy()).sum()
    assert (found.verdicts["method"] == "ekf_gated").sum() == changed > 0
    assert not (found.verdicts["method"] == "ekf_ungated").any()

    (row,) = found.tracks.query("method == 'ekf_gated'").to_dict("records")
    both = [
        pd.read_parquet(made.folder / "tracks.parquet").query("method == 'ekf_gated'")
        for made in (result, tighter)
    ]
    moved_m = np.hypot(
        *(both[1][k].to_numpy() - both[0][k].to_numpy() for k in ("east_m", "north_m"))
    )
    assert row["max_m"] == moved_m.max()
    assert row["time"] == both[0]["time"].iloc[moved_m.argmax()]
    assert not found.tracks["method"].isin(["dead_reckoning", "ekf_ungated", "kf_fix"]).any()


def test_replies_beyond_the_first_few_are_counted(
    result: Result, tighter: Result, capsys: pytest.CaptureFixture[str]
) -> None:
    found = diff(result.folder, tighter.folder)
    assert len(found.verdicts) > FINDINGS
    show_difference(found)
    assert f"and {len(found.verdicts) - FINDINGS:,} more" in capsys.readouterr().out
    show_difference(replace(found, verdicts=found.verdicts.head(FINDINGS)))
    assert " more" not in capsys.readouterr().out


def test_a_reply_that_only_one_output_holds_is_told(result: Result, tmp_path: Path) -> None:
    shutil.copytree(result.folder, tmp_path / "dive_7")
    path = tmp_path / "dive_7" / "innovations.parquet"
    table = pd.read_parquet(path)
    table.iloc[:-1].to_parquet(path)
    (row,) = diff(result.folder, tmp_path / "dive_7").verdicts.to_dict("records")
    assert row["after"] == "not there"
    assert row["ping_id"] == table["ping_id"].iloc[-1]


def test_dives_of_one_output_only_are_named(result: Result, tmp_path: Path) -> None:
    for name in ("a", "b"):
        shutil.copytree(result.folder, tmp_path / "before" / name)
    for name in ("b", "c"):
        shutil.copytree(result.folder, tmp_path / "after" / name)
    found = diff(tmp_path / "before", tmp_path / "after")
    assert (found.only_before, found.only_after) == (("a",), ("c",))
    shutil.rmtree(tmp_path / "after" / "b")
    shutil.copytree(result.folder, tmp_path / "after" / "d")
    with pytest.raises(ReadError, match="have no dive in common"):
        diff(tmp_path / "before", tmp_path / "after")


def test_a_folder_without_results_is_refused(result: Result, tmp_path: Path) -> None:
    with pytest.raises(ReadError, match="holds no result"):
        diff(result.folder, tmp_path)


def test_the_command_shows_what_changed(abyssnav: Any, result: Result, tighter: Result) -> None:
    ended = abyssnav("diff", result.folder, tighter.folder)
    assert ended.status == 0
    for words in ("gate.gamma: 9.21 -> 2.0", "accepted", "gated", "ekf_gated", "ping"):
        assert words in ended.out
    assert max(map(len, ended.out.splitlines())) <= 100
    same = abyssnav("diff", result.folder, result.folder)
    assert same.out == "no reply changed its verdict\nno track moved\n"


def test_outputs_of_two_dives_are_refused(result: Result, tmp_path: Path) -> None:
    other = shutil.copytree(result.folder, tmp_path / "other")
    table = pd.read_parquet(other / "tracks.parquet")
    table["time"] += pd.Timedelta(days=30)
    table.to_parquet(other / "tracks.parquet")
    with pytest.raises(ReadError, match="have no instant in common: they are of two dives"):
        diff(result.folder, other)


def test_two_dives_at_the_same_time_are_refused(result: Result, tmp_path: Path) -> None:
    other = shutil.copytree(result.folder, tmp_path / "other")
    summary = json.loads((other / "summary.json").read_text())
    for file in summary["inputs"]:
        file["sha256"] = "0" * 64
    (other / "summary.json").write_text(json.dumps(summary))
    assert len(diff(result.folder, other).tracks) == 0  # converted, say: the replies are the same
    table = pd.read_parquet(other / "innovations.parquet")
    table["ping_time"] += pd.Timedelta(seconds=1)
    table.to_parquet(other / "innovations.parquet")
    with pytest.raises(ReadError, match="are of two dives: no input file in common, and 0 replies"):
        diff(result.folder, other)


def test_the_command_gives_json(abyssnav: Any, result: Result, tighter: Result) -> None:
    told = json.loads(abyssnav("diff", result.folder, tighter.folder, "--json").out)
    assert told["settings"] == [{"key": "gate.gamma", "before": "9.21", "after": "2.0"}]
    changed = diff(result.folder, tighter.folder).verdicts
    assert [row["after"] for row in told["verdicts"]] == changed["after"].tolist()
    assert told["tracks"][0]["dive"] == "dive_7"
