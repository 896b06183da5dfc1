# SPDX-License-Identifier: Apache-2.0
"""Logs and results in an S3-compatible store, served on this machine by moto."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from test_batch import same_bytes
from test_remote import same_roles, with_camera

from abyssnav.batch import Outcome, batch, find_recordings
from abyssnav.config import Config, Gate
from abyssnav.errors import ReadError
from abyssnav.profile import load_profile
from abyssnav.remote import fetch, identity, logs_at
from abyssnav.run import Setup
from abyssnav.simulate import load_scenario, simulate, write_log

pytest.importorskip("s3fs", reason="needs the extra `cloud`")
pytest.importorskip("moto.server", reason="needs the extra `dev`")

GOOD = ("dive_0", "dive_1")


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two short dives, one of them full of pictures, and one that cannot be used."""
    folder = tmp_path_factory.mktemp("logs")
    scenario = msgspec.structs.replace(load_scenario("voyage_2"), duration_s=420.0)
    write_log(simulate(scenario), folder / "dive_0.mcap")
    with_camera(folder / "dive_0.mcap", folder / "dive_1.mcap", megabytes=12)
    (folder / "noise.mcap").write_text("no log at all")
    return folder


@pytest.fixture(scope="module")
def undisturbed(logs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the same dives come to on this machine's own disk."""
    out = tmp_path_factory.mktemp("undisturbed")
    processed(str(logs), str(out))
    return out


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    said = tmp_path_factory.mktemp("moto") / "said"
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", "0"]
    with said.open("w") as file, subprocess.Popen(command, stdout=file, stderr=file) as running:
        while not (found := re.search(r"http://127\.0\.0\.1:\d+", said.read_text())):
            assert running.poll() is None, said.read_text()
            time.sleep(0.05)
        yield found[0]
        running.terminate()


@pytest.fixture(scope="module")
def service(server: str) -> Iterator[Any]:
    """The store, found by the ordinary environment variables."""
    import fsspec

    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("AWS_ENDPOINT_URL", server)
        environment.setenv("AWS_ACCESS_KEY_ID", "key")
        environment.setenv("AWS_SECRET_ACCESS_KEY", "secret")
        environment.setenv("AWS_DEFAULT_REGION", "us-east-1")
        yield fsspec.filesystem("s3", use_listings_cache=False)


@pytest.fixture
def store(service: Any) -> Any:
    """An empty bucket named `bucket`."""
    if service.exists("bucket"):
        service.rm("bucket", recursive=True)
    service.mkdir("bucket")
    return service


@pytest.fixture
def cruise(store: Any, logs: Path) -> str:
    """The same logs in the bucket."""
    for path in logs.iterdir():
        store.put_file(str(path), f"bucket/cruise/{path.name}")
    return "s3://bucket/cruise"


@pytest.fixture(scope="module")
def kept(service: Any, logs: Path) -> list[Outcome]:
    """They and their results in a bucket named `kept`, in which nobody changes anything."""
    service.mkdir("kept")
    for path in logs.iterdir():
        service.put_file(str(path), f"kept/cruise/{path.name}")
    return processed("s3://kept/cruise", "s3://kept/results")


def processed(place: str, out: str, config: Config | None = None, jobs: int = 2) -> list[Outcome]:
    return batch(find_recordings([place]), Setup(config or Config(), load_profile()), out, jobs)


def downloaded(store: Any, place: str, folder: Path) -> Path:
    store.get(place, str(folder), recursive=True)
    return folder


def test_of_a_log_full_of_pictures_a_small_part_is_fetched(
    cruise: str, logs: Path, tmp_path: Path
) -> None:
    fetched = fetch(f"{cruise}/dive_1.mcap", load_profile(), tmp_path / "dive_1.mcap")
    assert fetched < 0.15 * (logs / "dive_1.mcap").stat().st_size
    same_roles(tmp_path / "dive_1.mcap", logs / "dive_1.mcap")


@pytest.mark.parametrize("place", ["", "/", "/*.mcap", "/**/*.mcap"])
def test_a_prefix_or_a_pattern_stands_for_the_logs_below_it(
    cruise: str, store: Any, place: str
) -> None:
    store.pipe_file("bucket/cruise/notes.txt", b"no log")
    names = ("dive_0.mcap", "dive_1.mcap", "noise.mcap")
    assert logs_at(cruise + place) == [f"{cruise}/{name}" for name in names]


def test_a_file_is_known_by_the_same_tag_however_it_was_found(cruise: str, store: Any) -> None:
    url = f"{cruise}/dive_0.mcap"
    before = identity(url)
    logs_at(cruise)
    assert identity(url) == before
    store.pipe_file(url, b"another")
    assert identity(url) != before


def test_results_in_the_store_are_those_of_the_disk(
    store: Any, logs: Path, undisturbed: Path, tmp_path: Path
) -> None:
    outcomes = processed(str(logs), "s3://bucket/results/")
    assert [o.status for o in outcomes] == ["done", "done", "refused"]
    same_bytes(downloaded(store, "bucket/results", tmp_path / "results"), undisturbed)


def test_from_store_to_store_nothing_is_done_twice(
    kept: list[Outcome], service: Any, undisturbed: Path, tmp_path: Path
) -> None:
    assert kept[-1].reason.startswith("s3://kept/cruise/noise.mcap: not MCAP: ")
    first = downloaded(service, "kept/results", tmp_path / "first")
    for name in GOOD:
        tracks = (first / name / "tracks.parquet").read_bytes()
        assert tracks == (undisturbed / name / "tracks.parquet").read_bytes()
    again = processed("s3://kept/cruise", "s3://kept/results")
    assert [o.dive for o in again if not o.fresh] == list(GOOD)
    second = downloaded(service, "kept/results", tmp_path / "second")
    names = [path.relative_to(first) for path in first.rglob("*") if path.is_file()]
    for name in names:
        assert (first / name).read_bytes() == (second / name).read_bytes(), name


def test_in_the_store_too_what_changed_or_lost_its_seal_is_done_again(
    kept: list[Outcome], store: Any
) -> None:
    for path in store.find("kept/results"):
        store.copy(path, path.replace("kept", "bucket", 1))
    store.rm_file("bucket/results/dive_0/summary.json")
    place, results = "s3://kept/cruise", "s3://bucket/results"
    again = {outcome.dive: outcome for outcome in processed(place, results)}
    assert (again["dive_0"].fresh, again["dive_1"].fresh) == (True, False)
    other = Config(gate=Gate(gamma=4.0))
    assert all(outcome.fresh for outcome in processed(place, results, other))
    told = json.loads(store.cat_file("bucket/results/dive_1/summary.json"))
    assert told["settings"]["gate"]["gamma"] == 4.0


def interrupted(store: Any, logs: Path, files: int, scratch: Path) -> None:
    """A batch into the store that dies by SIGKILL as soon as it has sent so many files of dives."""
    words = ["batch", str(logs), "-o", "s3://bucket/results", "-j", "2"]
    with subprocess.Popen(
        [sys.executable, "-m", "abyssnav", *words],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
        env=os.environ | {"TMPDIR": str(scratch)},
    ) as process:
        while len(store.glob("bucket/results/dive_*/*")) < files:
            assert process.poll() is None
            time.sleep(0.05)  # each look is work for the store too
        os.killpg(process.pid, signal.SIGKILL)


def test_killed_while_it_sends_only_whole_results_carry_the_seal(
    store: Any, logs: Path, undisturbed: Path, tmp_path: Path
) -> None:
    whole = {path.name for path in (undisturbed / "dive_0").iterdir()}
    for files in (1, len(whole) + 1):
        interrupted(store, logs, files, tmp_path)
        for seal in store.glob("bucket/results/*/summary.json"):
            sent = store.ls(seal.rpartition("/")[0], detail=False)
            assert {file.rpartition("/")[2] for file in sent} == whole
    processed(str(logs), "s3://bucket/results")
    same_bytes(downloaded(store, "bucket/results", tmp_path / "results"), undisturbed)


def test_a_result_loses_its_seal_before_anything_of_it_is_replaced(
    store: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from abyssnav.remote import upload

    for name in ("tracks.parquet", "summary.json"):
        (tmp_path / name).write_text("old")
    upload(tmp_path, "s3://bucket/results/dive")

    def cut_off(*_: Any) -> None:
        raise OSError("the line is cut")

    monkeypatch.setattr(store, "put", cut_off)
    with pytest.raises(ReadError, match=r"s3://bucket/results/dive: .*the line is cut"):
        upload(tmp_path, "s3://bucket/results/dive")
    assert store.ls("bucket/results/dive", detail=False) == ["bucket/results/dive/tracks.parquet"]


def test_a_bucket_that_is_not_there_is_refused_before_any_work(
    store: Any, logs: Path, abyssnav: Any
) -> None:
    ended = abyssnav("batch", logs, "-o", "s3://no-such-bucket/results")
    assert ended.status == 1
    assert ended.err.startswith("abyssnav: s3://no-such-bucket/results: cannot be reached: ")
    assert "dive_0" not in ended.err
    with pytest.raises(ReadError, match=r"s3://no-such-bucket/\*: "):
        logs_at("s3://no-such-bucket/*")


def test_the_command_names_what_it_wrote_to_the_store(
    cruise: str, store: Any, abyssnav: Any
) -> None:
    ended = abyssnav("batch", f"{cruise}/dive_*.mcap", "-o", "s3://bucket/results/", "-j", 2)
    assert ended.status == 0, ended.err
    assert "2 dives done (0 of them before), 0 refused" in ended.out
    assert "s3://bucket/results/comparison.parquet" in ended.out
    assert store.exists("bucket/results/index.html")
