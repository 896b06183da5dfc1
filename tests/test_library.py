# SPDX-License-Identifier: Apache-2.0
"""`import abyssnav as an`: what people type who never saw the inside."""

import doctest
import subprocess
import sys
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest

import abyssnav as an
from abyssnav.config import Gate
from abyssnav.run import Result
from abyssnav.tables import Comparison, Solution, Track

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "pipeline" / "abyssnav"
QUICK = {"methods": ["dead_reckoning", "fix"]}


def modules_with_examples() -> list[str]:
    return [
        ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")
        for path in sorted(PACKAGE.rglob("*.py"))
        if ">>> " in path.read_text(encoding="utf-8")
    ]


@pytest.mark.parametrize("module", modules_with_examples())
def test_the_examples_of_the_docstrings_run(
    module: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(ROOT)
    code = import_module(module)
    failed, tried = doctest.testmod(code, extraglobs={"folder": tmp_path})
    assert tried > 0
    assert failed == 0


def test_the_door_imports_nothing_until_it_is_used() -> None:
    program = (
        "import sys; import abyssnav as an\n"
        "assert not {m.split('.')[0] for m in sys.modules} & {'numpy', 'pyarrow', 'msgspec'}\n"
        "assert 'abyssnav.library' not in sys.modules\n"
        "import abyssnav.read\n"
        "assert an.read.__module__ == 'abyssnav.library', an.read\n"
    )
    subprocess.run([sys.executable, "-P", "-c", program], check=True)


def test_all_that_the_door_lists_is_there() -> None:
    assert set(an.__all__) <= set(dir(an))
    for name in an.__all__:
        assert getattr(an, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = an.nothing  # type: ignore[attr-defined]


def test_the_library_gives_what_the_command_gives(dive_log: Path, result: Result) -> None:
    log = an.read(str(dive_log), "default")
    solution = an.navigate(an.align(log))
    errors = an.compare(solution, log)
    assert errors.columns().keys() == result.comparison.columns().keys()
    np.testing.assert_array_equal(errors.rms_m, result.comparison.rms_m)
    assert solution.verdict == result.solution.verdict


def test_settings_are_keywords_structs_or_files(tmp_path: Path) -> None:
    path = tmp_path / "ship.toml"
    path.write_text("[gate]\ngamma = 6.0\nstretch_s = 600.0\n")
    for given in (str(path), path, [path], an.load_settings(path)):
        config = an.load_settings(given, gate={"gamma": 7.0}, output={"rate_hz": 2})
        assert (config.gate.gamma, config.gate.stretch_s, config.output.rate_hz) == (7.0, 600.0, 2)
    assert an.load_settings(gate=Gate(gamma=float("inf"))).gate.gamma == np.inf
    table = tmp_path / "beacons.csv"
    table.write_text("id,east_m,north_m,up_m,turn_around_s\n3,0,0,-10,0.1\n")
    assert an.load_settings(beacons=str(table)).beacon[0].id == 3


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"gate": {"gama": 3}}, "nearest: gamma"),
        ({"gates": {}}, "nearest: gate"),
        ({"gate": {"gamma": -1}}, "must be above 0"),
        ({"start": {"m": 9, "n": 4}}, "3 <= m <= n"),
    ],
)
def test_a_wrong_keyword_is_refused_as_in_a_file(tables: Any, message: str) -> None:
    with pytest.raises(an.ConfigError, match=message):
        an.load_settings(**tables)


def test_a_profile_is_a_name_a_path_or_a_struct(tmp_path: Path) -> None:
    shipped = an.load_profile("twist")
    assert an.load_profile(shipped) is shipped
    copied = tmp_path / "mine.toml"
    copied.write_text((ROOT / "schemas/profiles/twist.toml").read_text())
    assert an.load_profile(copied).velocity == shipped.velocity
    with pytest.raises(an.ConfigError, match="twist"):
        an.load_profile("twits")


def share_memory(one: Any, other: Any) -> bool:
    return bool(np.shares_memory(np.asarray(one), np.asarray(other)))


def test_tables_hand_over_without_copies(result: Result) -> None:
    track = result.solution.tracks["smoother"]

    arrow = pa.table(track)
    flat = arrow["position_enu_m"].chunk(0).flatten()
    assert share_memory(flat.to_numpy(zero_copy_only=True), track.position_enu_m)
    assert share_memory(arrow["t_s"].chunk(0).to_numpy(zero_copy_only=True), track.t_s)

    frame = track.to_pandas()
    assert share_memory(frame["position_north_m"], track.position_enu_m)
    assert share_memory(frame["position_cov_east_north_m2"], track.position_cov_m2)
    np.testing.assert_array_equal(frame["position_up_m"], track.position_enu_m[:, 2])


def test_polars_takes_a_table_as_it_is(result: Result) -> None:
    polars = pytest.importorskip("polars")
    frame = polars.DataFrame(result.comparison)
    assert frame["method"].to_list() == result.comparison.method.tolist()
    track = polars.DataFrame(result.solution.tracks["smoother"])
    assert track.height == len(result.solution.tracks["smoother"])
    assert share_memory(
        track["heading_rad"].to_numpy(), result.solution.tracks["smoother"].heading_rad
    )


def test_xarray_names_the_axes(result: Result) -> None:
    pytest.importorskip("xarray")
    track = result.solution.tracks["smoother"]
    dataset = track.to_xarray()
    assert dataset["position_enu_m"].dims == ("row", "enu_3")
    assert dataset["position_cov_m2"].dims == ("row", "cov_2", "cov_2_1")
    assert share_memory(dataset["position_enu_m"].values, track.position_enu_m)


def test_an_empty_table_hands_over_too() -> None:
    none = Comparison(*[np.zeros(0, dtype=np.str_)] * 2, *[np.zeros(0, dtype=np.int64)] * 7)
    assert pa.table(none).num_rows == 0
    assert none.to_pandas().columns[0] == "method"


def test_pose_is_that_of_the_files_whatever_the_times_are(result: Result) -> None:
    solution, start_ns = result.solution, result.solution.dive.start_ns
    at_ns = start_ns + 900_123_456_789
    of_file = an.pose(str(result.folder), at_ns, offset_m=(1.0, 0.2, 0.5))
    stamp = pd.Timestamp(at_ns, unit="ns", tz="UTC")
    for times in (at_ns, [at_ns], np.datetime64(at_ns, "ns"), stamp.isoformat(), [stamp]):
        poses = an.pose(solution, times, offset_m=(1.0, 0.2, 0.5))
        assert poses.method == of_file.method == "smoother"
        np.testing.assert_array_equal(poses.time_ns, [at_ns])
        np.testing.assert_allclose(poses.track.position_enu_m, of_file.track.position_enu_m)
    noon = datetime(2013, 6, 5, 12, 0, tzinfo=UTC)
    assert an.pose(solution, noon).time_ns[0] == int(noon.timestamp()) * 1_000_000_000
    with pytest.raises(an.ReadError, match="no track by 'ekff'; nearest: ekf"):
        an.pose(solution, at_ns, "ekff")


def test_write_makes_the_files_of_a_solution(
    dive_log: Path, result: Result, tmp_path: Path
) -> None:
    paths = an.write(result.solution, tmp_path / "new", an.read(dive_log))
    names = {path.name for path in paths}
    assert {"tracks.parquet", "solution.mcap", "dive.rrd", "comparison.csv"} <= names
    assert (tmp_path / "new" / "tracks.parquet").read_bytes() == (
        result.folder / "tracks.parquet"
    ).read_bytes()
    with pytest.raises(an.ConfigError, match="run_dive makes it"):
        an.write(result.solution, tmp_path, files=["report.html"])
    with pytest.raises(an.ConfigError, match=r"nearest: tracks\.parquet"):
        an.write(result.solution, tmp_path, files=["track.parquet"])


def test_without_a_viewer_the_recording_is_left_out_and_said(
    short_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("abyssnav.outputs.files.has_viewer", lambda: False)
    made = an.run_dive(short_log, tmp_path, output=QUICK)
    assert not (made.folder / "dive.rrd").exists()
    assert (made.folder / "report.html").is_file()
    (said,) = [check for check in made.solution.checks if check.stage == "view"]
    assert "pip install rerun-sdk" in said.detail
    with pytest.raises(an.ConfigError, match="pip install rerun-sdk"):
        an.run_dive(short_log, tmp_path, output={"files": ["dive.rrd"]})


def test_types_of_the_door_are_those_of_the_stages(short_log: Path) -> None:
    solution = an.navigate(an.align(an.read(short_log)), an.Config(), output=QUICK)
    assert isinstance(solution, Solution)
    assert isinstance(solution.tracks["dead_reckoning"], Track)
    assert issubclass(an.ReadError, an.PipelineError)
