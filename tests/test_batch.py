# SPDX-License-Identifier: Apache-2.0
"""Many dives: nothing lost, nothing done twice, the same bytes however they came about."""

import json
import os
import random
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import pandas as pd
import pyarrow.dataset as ds
import pytest

from abyssnav.batch import Outcome, Recording, batch, find_recordings
from abyssnav.config import Config, Gate
from abyssnav.errors import PipelineError
from abyssnav.profile import load_profile
from abyssnav.run import Setup
from abyssnav.simulate import load_scenario, simulate, write_log
from abyssnav.workers import jobs_for, run_in_processes, run_on_dask

GOOD = ("dive_0", "dive_1", "dive_2")


@pytest.fixture(scope="session")
def cruise(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three short dives, one of them in a directory of its own, and two that cannot be used."""
    folder = tmp_path_factory.mktemp("cruise")
    for number, name in enumerate(GOOD):
        scenario = load_scenario("voyage_2")
        scenario = msgspec.structs.replace(scenario, duration_s=420.0, seed=50 + number)
        path = folder / "dive_2" / "part.mcap" if name == "dive_2" else folder / f"{name}.mcap"
        path.parent.mkdir(exist_ok=True)
        write_log(simulate(scenario), path)
    (folder / "noise.mcap").write_text("no log at all")
    (folder / "short.mcap").write_bytes((folder / "dive_0.mcap").read_bytes()[:64])
    return folder


@pytest.fixture(scope="session")
def undisturbed(cruise: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("undisturbed")
    processed(cruise, out)
    return out


def processed(
    cruise: Path, out: Path, config: Config | None = None, jobs: int = 1
) -> list[Outcome]:
    return batch(
        find_recordings([str(cruise)]), Setup(config or Config(), load_profile()), out, jobs
    )


def same_bytes(one: Path, other: Path) -> None:
    """Assert that two outputs are the same but for the recordings and the efforts."""
    names = sorted(path.relative_to(one) for path in one.rglob("*") if path.is_file())
    assert names == sorted(path.relative_to(other) for path in other.rglob("*") if path.is_file())
    for name in names:
        first, second = (one / name).read_bytes(), (other / name).read_bytes()
        if name.name == "summary.json":
            first, second = (without_effort(text) for text in (first, second))
        if name.suffix not in {".rrd", ".html"}:
            assert first == second, name


def without_effort(text: bytes) -> bytes:
    told = json.loads(text)
    del told["timings_s"], told["peak_memory_mb"]
    return json.dumps(told).encode()


def test_a_bad_dive_gets_its_reason_and_stops_no_other(cruise: Path, undisturbed: Path) -> None:
    table = pd.read_parquet(undisturbed / "dives.parquet").set_index("dive")
    assert table["status"].to_dict() == dict.fromkeys(GOOD, "done") | {
        "noise": "refused",
        "short": "refused",
    }
    assert "noise.mcap" in table.loc["noise", "reason"]
    assert (table.loc[list(GOOD), "reason"] == "").all()
    assert not (undisturbed / "noise").exists()
    assert table.loc["dive_0", "seconds"] == pytest.approx(420.0, abs=1.0)
    assert table.loc["dive_0", "ekf_gated_accepted"] <= table.loc["dive_0", "replies"]


def test_every_dive_has_the_same_columns_and_reads_as_one_data_set(undisturbed: Path) -> None:
    for name in ("tracks", "fixes", "innovations", "statistics", "comparison", "errors"):
        files = sorted(undisturbed.glob(f"*/{name}.parquet"))
        assert len(files) == len(GOOD)
        schemas = [ds.dataset(file).schema for file in files]
        assert all(schema.equals(schemas[0]) for schema in schemas)
        rows = ds.dataset(files).count_rows()
        assert rows == sum(len(pd.read_parquet(file)) for file in files)


def test_the_pooled_comparison_counts_every_dive(undisturbed: Path) -> None:
    pooled = pd.read_parquet(undisturbed / "comparison.parquet")
    single = pd.concat(pd.read_parquet(undisturbed / name / "comparison.parquet") for name in GOOD)
    for row in pooled.to_dict("records"):
        same = single[
            (single["method"] == row["method"]) & (single["reference"] == row["reference"])
        ]
        assert row["n"] == same["n"].sum()
        mean_m = (same["mean_m"] * same["n"]).sum() / same["n"].sum()
        assert row["mean_m"] == pytest.approx(mean_m, rel=1e-9)
        assert row["max_m"] == same["max_m"].max()


def test_one_file_says_what_was_run_with_what_from_which_inputs(
    cruise: Path, undisturbed: Path
) -> None:
    told = json.loads((undisturbed / "batch.json").read_text(encoding="utf-8"))
    assert told["settings"]["gate"]["gamma"] == 9.21
    assert told["profile"]["heading"]["topic"] == "/imu"
    dives = {dive["dive"]: dive for dive in told["dives"]}
    assert set(dives) == {*GOOD, "noise", "short"}
    assert dives["dive_2"]["place"] == str(cruise / "dive_2")
    assert len(dives["dive_0"]["inputs"][0]["sha256"]) == 64


def test_a_second_batch_does_nothing_again(cruise: Path, undisturbed: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(undisturbed, out)
    before = {name: (out / name / "summary.json").read_bytes() for name in GOOD}
    outcomes = processed(cruise, out)
    assert [o.dive for o in outcomes if not o.fresh] == list(GOOD)
    assert {name: (out / name / "summary.json").read_bytes() for name in GOOD} == before
    same_bytes(out, undisturbed)


def test_what_is_missing_changed_or_spoilt_is_done_again(
    cruise: Path, undisturbed: Path, tmp_path: Path
) -> None:
    logs, out = tmp_path / "logs", tmp_path / "out"
    shutil.copytree(cruise, logs)
    shutil.copytree(undisturbed, out)
    shutil.rmtree(out / "dive_0")
    (out / "dive_2" / "summary.json").write_text("{}")
    shutil.copy(logs / "dive_1.mcap", logs / "noise.mcap")
    outcomes = {outcome.dive: outcome for outcome in processed(logs, out)}
    assert {name for name, outcome in outcomes.items() if not outcome.fresh} == {"dive_1"}
    assert outcomes["noise"].status == "done"


def test_other_settings_are_another_result(cruise: Path, undisturbed: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(undisturbed, out)
    outcomes = processed(cruise, out, Config(gate=Gate(gamma=4.0)))
    assert all(outcome.fresh for outcome in outcomes)
    told = json.loads((out / "dive_0" / "summary.json").read_text(encoding="utf-8"))
    assert told["settings"]["gate"]["gamma"] == 4.0


def test_the_number_of_workers_changes_no_byte(
    cruise: Path, undisturbed: Path, tmp_path: Path
) -> None:
    processed(cruise, tmp_path, jobs=3)
    same_bytes(tmp_path, undisturbed)


def killed_after(seconds: float, cruise: Path, out: Path) -> None:
    command = [sys.executable, "-m", "abyssnav", "batch", str(cruise), "-o", str(out), "-j", "2"]
    with subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    ) as process:
        time.sleep(seconds)
        os.killpg(process.pid, signal.SIGKILL)


@pytest.mark.parametrize("kills", [1, pytest.param(10, marks=pytest.mark.slow)])
def test_killed_and_resumed_it_ends_in_the_same_bytes(
    cruise: Path, undisturbed: Path, tmp_path: Path, kills: int
) -> None:
    moments = random.Random(6)
    for _ in range(kills):
        killed_after(moments.uniform(1.0, 6.0), cruise, tmp_path / "out")
        for summary in (tmp_path / "out").glob("[!.]*/summary.json"):
            assert {path.name for path in summary.parent.iterdir()} == {
                path.name for path in (undisturbed / "dive_0").iterdir()
            }
    processed(cruise, tmp_path / "out", jobs=2)
    same_bytes(tmp_path / "out", undisturbed)


def dies(number: int) -> int:
    if number == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    if number == 3:
        os._exit(7)
    if number == 4:
        os.kill(os.getpid(), signal.SIGTERM)
    return -number


def test_a_worker_that_dies_is_told_and_takes_no_other_along() -> None:
    made = dict(run_in_processes(dies, range(5), jobs=2))
    assert made == {
        0: 0,
        1: -1,
        2: "its process was ended by SIGKILL; out of memory?",
        3: "its process ended with status 7",
        4: "its process was ended by SIGTERM",
    }


def told(name: str) -> str | None:
    return os.environ.get(name)


def test_a_worker_has_the_environment_of_who_asks_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for region in ("first", "second"):
        monkeypatch.setenv("AWS_DEFAULT_REGION", region)
        assert list(run_in_processes(told, ["AWS_DEFAULT_REGION"], jobs=1)) == [
            ("AWS_DEFAULT_REGION", region)
        ]


def sleeps(seconds: float) -> None:
    time.sleep(seconds)


def test_workers_leave_the_environment_of_their_caller_alone() -> None:
    before = dict(os.environ)
    assert list(run_in_processes(sleeps, [0.0], jobs=1)) == [(0.0, None)]
    assert dict(os.environ) == before


def test_workers_end_when_nobody_waits_for_them_any_more() -> None:
    results = run_in_processes(sleeps, [0.0, 600.0], jobs=2)
    next(results)
    results.close()  # type: ignore[attr-defined]


def test_workers_are_as_many_as_cores_and_memory_bear(monkeypatch: pytest.MonkeyPatch) -> None:
    cores = len(os.sched_getaffinity(0))
    for free_bytes, input_bytes, jobs in (
        (1e12, 5e6, cores),
        (1e6, 5e6, 1),
        (1.6e9, 1e12, 1),
    ):
        monkeypatch.setattr("abyssnav.workers._free_memory_bytes", lambda free=free_bytes: free)
        assert jobs_for(int(input_bytes)) == jobs


def names(places: Sequence[Path]) -> list[str]:
    return [recording.name for recording in find_recordings([str(place) for place in places])]


def test_dives_of_one_name_are_told_apart_by_their_directories(tmp_path: Path) -> None:
    for place in ("a/dive.mcap", "b/dive.mcap", "b/other.mcap", "b/deep/x_0.mcap"):
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / place).touch()
    assert names([tmp_path / "a", tmp_path / "b"]) == ["a_dive", "b_dive", "deep", "other"]
    assert names([tmp_path / "a", tmp_path / "a" / "dive.mcap"]) == ["dive"]
    # One level below, a directory is one split recording.
    (tmp_path / "top.mcap").touch()
    found = {recording.name: recording.place for recording in find_recordings([str(tmp_path)])}
    folders = {name: str(tmp_path / name) for name in ("a", "b")}
    deep = {"deep": str(tmp_path / "b" / "deep"), "top": str(tmp_path / "top.mcap")}
    assert found == folders | deep


def test_a_pattern_stands_for_what_it_matches(tmp_path: Path) -> None:
    for place in ("one_1.mcap", "one_2.mcap", "two.mcap"):
        (tmp_path / place).touch()
    assert names([tmp_path / "one_*.mcap"]) == ["one_1", "one_2"]
    assert names([tmp_path / "**" / "*.mcap"]) == ["one_1", "one_2", "two"]
    with pytest.raises(PipelineError, match="nothing matches this pattern"):
        names([tmp_path / "three*"])


def test_a_directory_without_logs_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PipelineError, match=r"no \.mcap file in or below"):
        find_recordings([str(tmp_path)])


def test_a_log_that_is_not_there_is_a_refused_dive(tmp_path: Path) -> None:
    gone = Recording("gone", str(tmp_path / "gone.mcap"))
    (outcome,) = batch([gone], Setup(Config(), load_profile()), tmp_path / "out", 1)
    assert outcome.status == "refused"
    assert "gone.mcap" in outcome.reason


def test_the_command_ends_1_when_a_dive_was_refused_and_0_when_none(
    abyssnav: Any, cruise: Path, tmp_path: Path
) -> None:
    ended = abyssnav("batch", cruise, "-o", tmp_path, "--jobs", 2)
    assert ended.status == 1
    assert "3 dives done (0 of them before), 2 refused" in ended.out
    assert "noise.mcap: " in ended.err
    again = abyssnav("batch", cruise / "dive_0.mcap", "-o", tmp_path)
    assert again.status == 0
    assert "1 dive done (1 of them before), 0 refused" in again.out


@pytest.mark.slow
def test_on_a_dask_cluster_that_loses_a_worker_nothing_is_lost(
    cruise: Path, undisturbed: Path, tmp_path: Path
) -> None:
    distributed = pytest.importorskip("distributed", reason="needs the extra `cluster`")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None
    ) as cluster:
        victim = next(iter(cluster.workers.values())).pid
        killed: list[int] = []

        def kill_once(_: Outcome) -> None:
            if not killed:
                killed.append(victim)
                os.kill(victim, signal.SIGKILL)

        recordings = find_recordings([str(cruise)])
        batch(
            recordings,
            Setup(Config(), load_profile()),
            tmp_path,
            2,
            kill_once,
            cluster.scheduler_address,
        )
        assert killed
    same_bytes(tmp_path, undisturbed)


def test_a_scheduler_that_does_not_answer_is_named(
    cruise: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed", reason="needs the extra `cluster`")
    monkeypatch.setattr("abyssnav.workers._ANSWER_WITHIN_S", 1.0)
    recordings = find_recordings([str(cruise)])
    with pytest.raises(PipelineError, match=r"tcp://127\.0\.0\.1:9: no Dask scheduler answers"):
        batch(
            recordings, Setup(Config(), load_profile()), tmp_path, 1, scheduler="tcp://127.0.0.1:9"
        )


@pytest.mark.parametrize(
    ("worker_path", "files", "refusal"),
    [
        (None, [], "no Dask worker within 1 s"),
        ("nothing", [], "cannot import abyssnav: "),
        ("older", [], "has abyssnav 0.0.9, not "),
        ("same", ["nowhere.mcap"], "does not see nowhere.mcap"),
    ],
)
def test_a_cluster_is_asked_before_it_is_given_work(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    worker_path: str | None,
    files: list[str],
    refusal: str,
) -> None:
    """A scheduler without workers, and workers with nothing, or another version, of ours."""
    monkeypatch.setattr("abyssnav.workers._WORKERS_WITHIN_S", 1.0 if worker_path is None else 30.0)
    (tmp_path / "older" / "abyssnav").mkdir(parents=True)
    (tmp_path / "older" / "abyssnav" / "__init__.py").write_text("__version__ = '0.0.9'\n")
    path = {"older": str(tmp_path / "older"), "same": os.pathsep.join(sys.path)}
    dask = [sys.executable, "-I" if worker_path == "nothing" else "-P", "-c"]
    hidden = "import sys; sys.modules['abyssnav'] = None; " if worker_path == "nothing" else ""
    environment = {**os.environ, "PYTHONPATH": path.get(worker_path or "", "")}
    address = f"tcp://127.0.0.1:{free_port()}"
    scheduler = subprocess.Popen(
        [*dask, "from distributed.cli.dask_scheduler import main; main()",
         "--port", address.rsplit(":", 1)[1], "--host", "127.0.0.1", "--no-dashboard"],
        env=environment, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    processes = [scheduler]
    if worker_path is not None:
        worker = f"{hidden}from distributed.cli.dask_worker import main; main()"
        processes.append(
            subprocess.Popen(
                [
                    *dask,
                    worker,
                    address,
                    "--no-nanny",
                    "--no-dashboard",
                    "--local-directory",
                    str(tmp_path),
                ],
                env=environment,
                stderr=subprocess.DEVNULL,
            )
        )
    try:
        with pytest.raises(PipelineError, match=re.escape(refusal)):
            list(run_on_dask(dies, [0], address, 1, files))
    finally:
        for process in processes:
            process.kill()
            process.wait()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def test_without_dask_its_name_and_the_way_to_it_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(PipelineError, match=r"pip install 'abyssnav\[cluster\]'"):
        list(run_on_dask(dies, [0], "", 1))


def test_a_batch_inside_the_cruises_folder_does_not_take_its_results_for_dives(
    cruise: Path, tmp_path: Path
) -> None:
    (tmp_path / "dive_0.mcap").write_bytes((cruise / "dive_0.mcap").read_bytes())
    out = tmp_path / "out"
    for _ in range(2):
        recordings = find_recordings([str(tmp_path)], str(out))
        assert [recording.name for recording in recordings] == ["dive_0"]
        (outcome,) = batch(recordings, Setup(Config(), load_profile()), out, 1)
        assert outcome.status == "done"
    elsewhere = find_recordings([str(tmp_path)], str(tmp_path / "other"))
    assert [recording.name for recording in elsewhere] == ["dive_0"]


@pytest.mark.parametrize(
    ("file_name", "name"),
    [
        (b".mcap", "%"),
        (b"..mcap", "%2E"),
        (b"...mcap", "%2E%2E"),
        (b"caf\xe9.mcap", "caf%E9"),
        (b"line\nend.mcap", "line%0Aend"),
        (b"d\xc3\xa9j\xc3\xa0 vu.mcap", "d\u00e9j\u00e0 vu"),
    ],
)
def test_an_odd_file_name_costs_nobody_his_results(
    cruise: Path, tmp_path: Path, file_name: bytes, name: str
) -> None:
    logs, out = tmp_path / "logs", tmp_path / "out"
    logs.mkdir()
    shutil.copy(cruise / "dive_0.mcap", os.fsencode(logs) + b"/" + file_name)
    (out / "of_another").mkdir(parents=True)
    recordings = find_recordings([str(logs)], str(out))
    (outcome,) = batch(recordings, Setup(Config(), load_profile()), out, 1)
    assert (outcome.dive, outcome.status) == (name, "done")
    assert (out / name / "summary.json").is_file()
    assert (out / "of_another").is_dir()
    assert pd.read_parquet(out / "dives.parquet")["dive"].to_list() == [name]
    assert json.loads((out / "batch.json").read_text("utf-8"))["dives"][0]["dive"] == name
    (again,) = batch(
        find_recordings([str(logs)], str(out)), Setup(Config(), load_profile()), out, 1
    )
    assert not again.fresh


def test_a_log_that_is_still_being_copied_is_not_done(
    cruise: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from abyssnav import run

    log = tmp_path / "dive.mcap"
    whole = (cruise / "dive_0.mcap").read_bytes()
    log.write_bytes(whole[: len(whole) // 2])

    def align_while_copying(*arguments: Any) -> Any:
        log.write_bytes(whole)
        return align(*arguments)

    align = run.align
    monkeypatch.setattr(run, "align", align_while_copying)
    with pytest.raises(PipelineError, match="changed while it was read"):
        run.run_dive([log], Setup(Config(), load_profile()), tmp_path / "out")
    assert not (tmp_path / "out").exists()
