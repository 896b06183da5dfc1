# SPDX-License-Identifier: Apache-2.0
"""Logs at a URL: the same columns, from a small part of the bytes."""

import functools
import gzip
import http.server
import io
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from abyssnav.batch import batch, find_recordings
from abyssnav.config import Config
from abyssnav.errors import ReadError
from abyssnav.formats.mcap.file_index import skippable_ranges, summary_start
from abyssnav.profile import load_profile
from abyssnav.read import read
from abyssnav.remote import fetch, identity, is_url, logs_at, try_to_write
from abyssnav.run import Setup
from abyssnav.simulate import load_scenario, simulate, write_log

pytest.importorskip("fsspec", reason="needs the extra `cloud`")
pytest.importorskip("aiohttp", reason="needs the extra `cloud`")


class Ranges(http.server.SimpleHTTPRequestHandler):
    """Serves files, whole or the bytes asked for, and counts what it gives."""

    served: list[int]

    def __init__(self, *words: Any, served: list[int], **more: Any) -> None:
        self.served = served
        super().__init__(*words, **more)

    def do_GET(self) -> None:
        path = Path(self.translate_path(self.path))
        asked = self.headers.get("Range", "")
        if not (path.is_file() and asked.startswith("bytes=")):
            super().do_GET()
            return
        size = path.stat().st_size
        first, last = asked.removeprefix("bytes=").split("-")
        begin, end = int(first), min(int(last or size), size - 1)
        with path.open("rb") as file:
            file.seek(begin)
            content = file.read(end - begin + 1)
        self.served.append(len(content))  # before it is sent: whoever has it may ask at once
        self.send_response(206)
        self.send_header("Content-Range", f"bytes {begin}-{end}/{size}")
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def end_headers(self) -> None:
        self.send_header("Accept-Ranges", "bytes")
        super().end_headers()

    def log_message(self, *_: Any) -> None:
        pass


def with_camera(source: Path, target: Path, megabytes: int) -> None:
    """The same log with pictures in it, in chunks of their own, and an attachment."""
    noise = np.random.default_rng(1)
    with source.open("rb") as given, target.open("wb") as made:
        writer = Writer(made, chunk_size=1 << 19)
        writer.start(profile="ros2", library="")
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(given).iter_messages():
            assert schema is not None
            if channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, number
                )
            writer.add_message(
                channels[channel.id], message.log_time, message.data, message.publish_time
            )
            end_ns = message.log_time
        schema_id = writer.register_schema("sensor_msgs/msg/Image", "ros2msg", b"uint8[] data")
        camera = writer.register_channel("/camera", "cdr", schema_id)
        for step in range(megabytes):
            writer.add_message(camera, end_ns + step, noise.bytes(1 << 20), end_ns + step)
        writer.add_attachment(end_ns, end_ns, "video", "video/mp4", noise.bytes(1 << 20))
        writer.finish()


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("served")
    scenario = msgspec.structs.replace(load_scenario("clean"), duration_s=420.0)
    write_log(simulate(scenario), folder / "plain.mcap")
    with_camera(folder / "plain.mcap", folder / "camera.mcap", megabytes=12)
    return folder


@pytest.fixture
def server(logs: Path) -> Iterator[tuple[str, list[int]]]:
    served: list[int] = []
    handler = functools.partial(Ranges, served=served, directory=str(logs))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as running:
        thread = threading.Thread(target=running.serve_forever, args=(0.02,))
        thread.start()
        yield f"http://127.0.0.1:{running.server_port}", served
        running.shutdown()
        thread.join()


def same_roles(one: Path, other: Path) -> None:
    first, second = (read([path], load_profile()) for path in (one, other))
    assert first.roles.keys() == second.roles.keys()
    for role, columns in first.roles.items():
        for name, column in columns.items():
            np.testing.assert_array_equal(column, second.roles[role][name])
    assert first.findings == second.findings


@pytest.mark.parametrize("name", ["plain", "camera"])
def test_what_is_fetched_reads_as_the_whole_file(
    logs: Path, server: tuple[str, list[int]], tmp_path: Path, name: str
) -> None:
    fetch(f"{server[0]}/{name}.mcap", load_profile(), tmp_path / f"{name}.mcap")
    same_roles(tmp_path / f"{name}.mcap", logs / f"{name}.mcap")


def test_pictures_are_not_fetched(
    logs: Path, server: tuple[str, list[int]], tmp_path: Path
) -> None:
    url, served = server
    fetched = fetch(f"{url}/camera.mcap", load_profile(), tmp_path / "camera.mcap")
    size = (logs / "camera.mcap").stat().st_size
    assert (tmp_path / "camera.mcap").stat().st_size == size
    assert fetched < 0.15 * size
    assert sum(served) == fetched


@pytest.mark.parametrize("damage", ["cut", "crc"])
def test_a_log_without_a_sound_summary_is_fetched_whole(
    logs: Path, server: tuple[str, list[int]], tmp_path: Path, damage: str
) -> None:
    content = bytearray((logs / "camera.mcap").read_bytes())
    if damage == "cut":
        content = content[: len(content) // 20]
    else:
        content[-200] ^= 1
    (logs / f"{damage}.mcap").write_bytes(content)
    fetch(f"{server[0]}/{damage}.mcap", load_profile(), tmp_path / f"{damage}.mcap")
    assert (tmp_path / f"{damage}.mcap").read_bytes() == bytes(content)
    (logs / f"{damage}.mcap").unlink()


def pictures_in(path: Path) -> list[bytes]:
    with path.open("rb") as file:
        return [m.data for _, _, m in make_reader(file).iter_messages(topics=["/camera"])]


def test_the_holes_hold_nothing_of_the_topics(logs: Path, tmp_path: Path) -> None:
    content = (logs / "camera.mcap").read_bytes()
    start = summary_start(content[-64:], len(content))
    assert start is not None
    holes = skippable_ranges(content[start:], start, {"/camera"})
    emptied = bytearray(content)
    for low, high in holes:
        emptied[low:high] = bytes(high - low)
    (tmp_path / "emptied.mcap").write_bytes(emptied)
    pictures = [pictures_in(logs / "camera.mcap"), pictures_in(tmp_path / "emptied.mcap")]
    assert len(pictures[0]) == 12
    assert pictures[0] == pictures[1]
    assert sum(high - low for low, high in holes) > 0


@pytest.mark.parametrize("options", [{"repeat_schemas": False}, {"repeat_channels": False}])
def test_nothing_is_dispensable_where_chunks_alone_name_the_topics(
    options: dict[str, bool],
) -> None:
    file = io.BytesIO()
    writer = Writer(file, chunk_size=100, **options)
    writer.start()
    schema = writer.register_schema("a", "ros2msg", b"uint8 x")
    for topic in ("/a", "/b"):
        channel = writer.register_channel(topic, "cdr", schema)
        for k in range(50):
            writer.add_message(channel, k, b"\0\1\0\0\1", k)
    writer.finish()
    content = file.getvalue()
    start = summary_start(content[-64:], len(content))
    assert start is not None
    assert skippable_ranges(content[start:], start, {"/a"}) == []


def test_a_batch_takes_urls_and_resumes_them(
    logs: Path, server: tuple[str, list[int]], tmp_path: Path
) -> None:
    url, served = server
    recordings = find_recordings([f"{url}/plain.mcap", f"{url}/none.mcap"])
    outcomes = batch(recordings, Setup(Config(), load_profile()), tmp_path / "out", 1)
    assert [(o.dive, o.status) for o in outcomes] == [("none", "refused"), ("plain", "done")]
    assert "none.mcap: cannot be reached: " in outcomes[0].reason
    before = len(served)
    again = batch(recordings, Setup(Config(), load_profile()), tmp_path / "out", 1)
    assert [o.fresh for o in again] == [True, False]
    assert len(served) == before
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert [name for name in names if name.endswith(".part")] == []
    assert "plain" in names


def test_any_store_that_fsspec_knows_will_do(logs: Path, tmp_path: Path) -> None:
    import fsspec

    store = fsspec.filesystem("memory")
    store.pipe_file("/bucket/a/one.mcap", (logs / "plain.mcap").read_bytes())
    store.pipe_file("/bucket/b/two.mcap", (logs / "camera.mcap").read_bytes())
    store.pipe_file("/bucket/b/notes.txt", b"no log")
    everything = ["memory:///bucket/a/one.mcap", "memory:///bucket/b/two.mcap"]
    assert [url.replace("memory:///", "memory://") for url in logs_at("memory://bucket")] == [
        url.replace("memory:///", "memory://") for url in everything
    ]
    assert len(logs_at("memory://bucket/*/t*.mcap")) == 1
    fetch("memory://bucket/b/two.mcap", load_profile(), tmp_path / "camera.mcap")
    same_roles(tmp_path / "camera.mcap", logs / "camera.mcap")
    tag = identity("memory://bucket/a/one.mcap")
    store.pipe_file("/bucket/a/one.mcap", b"another")
    assert identity("memory://bucket/a/one.mcap") != tag


def test_run_takes_a_url_and_results_at_one_are_used_like_a_folder(
    abyssnav: Any, logs: Path, tmp_path: Path
) -> None:
    (tmp_path / "few.toml").write_text('[output]\nfiles = ["tracks.parquet", "dive.rrd"]\n')
    out, url = tmp_path / "out", (tmp_path / "out" / "plain").as_uri()
    words = ("-o", out, "-c", tmp_path / "few.toml")
    assert abyssnav("run", (logs / "plain.mcap").as_uri(), *words, "--quiet").status == 0
    assert {p.name for p in (out / "plain").iterdir()} == {
        "tracks.parquet", "dive.rrd", "summary.json"
    }  # fmt: skip
    (tmp_path / "when.csv").write_text("time\n2013-06-05T02:03:00Z\n")
    near, far = (abyssnav("pose", p, "--at", tmp_path / "when.csv") for p in (out / "plain", url))
    assert far.status == 0
    assert "true" in far.out
    assert far.out == near.out
    lacking = abyssnav("export", url, "--to", "csv", "-o", tmp_path)
    assert lacking.status == 1
    assert lacking.err.startswith(f"abyssnav: {url}/")  # not the folder that it was fetched into
    nowhere = abyssnav("run", (tmp_path / "none.mcap").as_uri(), *words)
    assert (nowhere.status, "none.mcap: cannot be reached" in nowhere.err) == (1, True)


def test_a_batch_into_a_store_without_errors_and_tracks_still_says_what_it_did(
    abyssnav: Any, logs: Path, tmp_path: Path
) -> None:
    (tmp_path / "few.toml").write_text('[output]\nfiles = ["fixes.parquet"]\n')
    url = (tmp_path / "store").as_uri()
    ended = abyssnav("batch", logs / "plain.mcap", "-o", url, "-c", tmp_path / "few.toml")
    assert ended.status == 0
    assert "1 dive done" in ended.out
    written = {p.name for p in (tmp_path / "store").iterdir()}
    assert written == {"index.html", "dives.parquet", "batch.json", "plain"}
    assert "comparison.parquet" not in ended.out


def test_what_cannot_be_reached_is_refused_by_its_url() -> None:
    with pytest.raises(ReadError, match=r"memory://nowhere/\*: no \.mcap file there"):
        logs_at("memory://nowhere/*")
    with pytest.raises(ReadError, match=r"smoke://signal: cannot be reached: "):
        identity("smoke://signal")


def test_a_place_that_takes_nothing_is_refused(server: tuple[str, list[int]]) -> None:
    with pytest.raises(ReadError, match=r"http://.*/results: cannot be reached: "):
        try_to_write(f"{server[0]}/results")


def test_a_path_is_no_url() -> None:
    assert is_url("s3://bucket/dive.mcap")
    assert not is_url("dives/dive:7.mcap")


class Liar(Ranges):
    """Answers ranges as servers do that should not be trusted."""

    lies: str
    counted: list[int]

    def __init__(self, *words: Any, lies: str, counted: list[int], **more: Any) -> None:
        self.lies, self.counted = lies, counted
        super().__init__(*words, **more)

    def do_HEAD(self) -> None:
        if self.lies == "size":
            path = Path(self.translate_path(self.path))
            self.send_response(200)
            self.send_header("Content-Length", str(path.stat().st_size + 1000))
            self.end_headers()
            return
        super().do_HEAD()

    def do_GET(self) -> None:
        self.counted.append(1)
        asked = self.headers.get("Range", "")
        if self.lies.startswith("no ranges") or not asked:
            del self.headers["Range"]
            self._answer_whole() if "," in self.lies else super().do_GET()
        elif self.lies == "fails at first" and len(self.counted) % 2:
            self.send_error(503)
        elif self.lies == "always fails":
            self.send_error(500)
        elif self.lies == "hangs":
            time.sleep(1.0)
        elif self.lies in {"shifted", "short", "unplaced", "endless", "breaks off", "packed"}:
            self._answer_wrongly(*map(int, asked.removeprefix("bytes=").split("-")))
        else:
            super().do_GET()

    def _answer_wrongly(self, first: int, last: int) -> None:
        content = Path(self.translate_path(self.path)).read_bytes()
        shift = 7 if self.lies == "shifted" else 0
        part = content[first - shift : last + 1 - shift]
        part = part[:-3] if self.lies == "short" else part
        self.send_response(206)
        if self.lies == "packed":
            self.send_header("Content-Encoding", "gzip")
            part = gzip.compress(part[:100])
        if self.lies != "unplaced":
            place = f"bytes {first - shift}-{first - shift + len(part) - 1}/{len(content)}"
            self.send_header("Content-Range", place)
        if self.lies != "endless":
            more = 1000 if self.lies == "breaks off" else 0
            self.send_header("Content-Length", str(len(part) + more))
        self.end_headers()
        self._send(part)

    def _answer_whole(self) -> None:
        """More than the file, or less, where no parts are given."""
        content = Path(self.translate_path(self.path)).read_bytes()
        self.send_response(200)
        self.end_headers()
        self._send(content if "endless" in self.lies else content[:-5])

    def _send(self, part: bytes) -> None:
        self.close_connection = True
        with suppress(OSError):  # whoever asked has had enough
            self.wfile.write(part)
            for _ in range(200 if "endless" in self.lies else 0):
                self.wfile.write(bytes(1 << 20))


@pytest.fixture
def liar(
    logs: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Iterator[tuple[str, list[int], list[int]]]:
    monkeypatch.setattr("abyssnav.remote._PAUSES_S", (0.01, 0.01))
    served, counted = list[int](), list[int]()
    handler = functools.partial(
        Liar, lies=request.param, served=served, counted=counted, directory=str(logs)
    )
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as running:
        thread = threading.Thread(target=running.serve_forever, args=(0.02,))
        thread.start()
        yield f"http://127.0.0.1:{running.server_port}", served, counted
        running.shutdown()


@pytest.mark.parametrize("liar", ["no ranges"], indirect=True)
def test_from_a_server_without_ranges_the_file_is_taken_whole_and_once(
    liar: tuple[str, list[int], list[int]], logs: Path, tmp_path: Path
) -> None:
    url, _, counted = liar
    target = tmp_path / "camera.mcap"
    n_bytes = fetch(f"{url}/camera.mcap", load_profile(), target)
    assert target.read_bytes() == (logs / "camera.mcap").read_bytes()
    assert n_bytes == target.stat().st_size
    assert len(counted) == 2  # the first range, whose answer was not read, and the file


@pytest.mark.parametrize(
    "liar",
    ["shifted", "short", "unplaced", "size", "endless", "packed", "no ranges, endless",
     "no ranges, cut"],
    indirect=True,
)  # fmt: skip
def test_what_was_not_asked_for_is_refused(
    liar: tuple[str, list[int], list[int]], logs: Path, tmp_path: Path
) -> None:
    url, _, counted = liar
    with pytest.raises(ReadError, match=r"camera\.mcap: cannot be reached: .*asked for"):
        fetch(f"{url}/camera.mcap", load_profile(), tmp_path / "camera.mcap")
    assert len(counted) <= 6
    whole = (logs / "camera.mcap").stat().st_size
    assert (tmp_path / "camera.mcap").stat().st_size <= whole + 1000


@pytest.mark.parametrize("liar", ["always fails", "hangs", "breaks off"], indirect=True)
def test_what_never_comes_is_not_waited_for_for_ever(
    liar: tuple[str, list[int], list[int]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import aiohttp

    brief = aiohttp.ClientTimeout(total=2, sock_read=0.1)
    monkeypatch.setattr("abyssnav.strict_http._TIMEOUT", brief)
    monkeypatch.setattr("abyssnav.remote._PAUSES_S", (0.1, 0.2))
    url, _, counted = liar
    with pytest.raises(ReadError, match=r"plain\.mcap: cannot be reached: ") as refused:
        fetch(f"{url}/plain.mcap", load_profile(), tmp_path / "plain.mcap")
    assert "\n" not in str(refused.value)
    assert len(counted) <= 6  # three attempts; a connection that is lost is tried once more


def test_a_log_that_is_packed_as_a_whole_is_read_from_its_url(
    logs: Path, server: tuple[str, list[int]], tmp_path: Path
) -> None:
    import zstandard

    packed = zstandard.ZstdCompressor().compress((logs / "plain.mcap").read_bytes())
    (logs / "packed.mcap.zst").write_bytes(packed)
    try:
        recordings = find_recordings([f"{server[0]}/packed.mcap.zst"])
        (outcome,) = batch(recordings, Setup(Config(), load_profile()), tmp_path / "out", 1)
        (again,) = batch(recordings, Setup(Config(), load_profile()), tmp_path / "out", 1)
    finally:
        (logs / "packed.mcap.zst").unlink()
    assert (outcome.dive, outcome.status) == ("packed", "done")
    assert not again.fresh


@pytest.mark.parametrize("liar", ["fails at first"], indirect=True)
def test_what_fails_for_a_moment_is_asked_for_again(
    liar: tuple[str, list[int], list[int]], logs: Path, tmp_path: Path
) -> None:
    url, _, _ = liar
    fetch(f"{url}/plain.mcap", load_profile(), tmp_path / "plain.mcap")
    same_roles(tmp_path / "plain.mcap", logs / "plain.mcap")


def test_a_file_that_changes_at_its_url_is_another(logs: Path, tmp_path: Path) -> None:
    handler = functools.partial(Ranges, served=[], directory=str(tmp_path))
    log = tmp_path / "plain.mcap"
    log.write_bytes((logs / "plain.mcap").read_bytes())
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as running:
        threading.Thread(target=running.serve_forever, args=(0.02,)).start()
        url = f"http://127.0.0.1:{running.server_port}/plain.mcap"
        before = identity(url)
        assert identity(url) == before
        with log.open("ab") as file:
            file.write(b"more")
        assert identity(url) != before
        running.shutdown()
