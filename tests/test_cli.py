# SPDX-License-Identifier: Apache-2.0
"""What a person types and reads: statuses, single lines, tables."""

import json
import os
import pty
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from abyssnav import __version__
from abyssnav.outputs.rerun.opening import opening_time_ns
from abyssnav.run import Result


def copy_without(source: Path, target: Path, topics: set[str]) -> Path:
    """The same log without some topics, by the official library."""
    with source.open("rb") as given, target.open("wb") as made:
        writer = Writer(made)
        writer.start(profile="ros2", library="")
        schemas: dict[int, int] = {}
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(given).iter_messages(log_time_order=False):
            if channel.topic in topics:
                continue
            assert schema is not None
            if schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(
                    schema.name, schema.encoding, schema.data
                )
            if channel.id not in channels:
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schemas[schema.id]
                )
            writer.add_message(
                channels[channel.id], message.log_time, message.data, message.publish_time
            )
        writer.finish()
    return target


def settings(folder: Path, text: str) -> Path:
    path = folder / "settings.toml"
    path.write_text(text, encoding="utf-8")
    return path


def beacons(*ids: int) -> str:
    return "".join(
        f"[[beacon]]\nid = {i}\nturn_around_s = 0.1\n"
        f"position_m = [{1000.0 * n}, {500.0 * n * n}, -6000.0]\n"
        for n, i in enumerate(ids)
    )


def assert_refused(ended: Any, *words: str) -> None:
    assert ended.status == 1
    assert ended.err.count("\n") >= 1
    line = ended.err.splitlines()[-1]
    assert line.startswith("abyssnav: ")
    assert "Traceback" not in ended.err
    assert "fault in abyssnav" not in line
    for word in words:
        assert word in line


def test_version_and_help_say_what_they_are(abyssnav: Any) -> None:
    assert abyssnav("--version").out == f"abyssnav {__version__}\n"
    assert abyssnav("--help").out.startswith("Usage: abyssnav")
    assert abyssnav("run", "--help").status == 0


def test_help_imports_nothing_heavy() -> None:
    program = (
        "import sys; sys.argv = ['abyssnav', '--help']\n"
        "from abyssnav.cli import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "print(sorted({'numpy', 'pandas', 'rerun', 'pyarrow', 'scipy', 'rich.console'}"
        " & set(sys.modules)))"
    )
    said = subprocess.run(
        [sys.executable, "-c", program], check=True, capture_output=True, text=True
    )
    assert said.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize(
    "words", [[], ["rn"], ["run"], ["run", "--fast", "log"], ["compare", ".", "--by", "colour"]]
)
def test_wrong_usage_ends_2(abyssnav: Any, words: list[str]) -> None:
    ended = abyssnav(*words)
    assert ended.status == 2
    assert "Usage" in ended.out + ended.err


def test_run_ends_with_the_table_and_the_paths(
    abyssnav: Any, dive_log: Path, tmp_path: Path
) -> None:
    ended = abyssnav("run", dive_log, "-o", tmp_path)
    assert ended.status == 0
    for stage in ("read", "align", "navigate", "compare", "write", "view"):
        assert stage in ended.err
    for word in ("dead_reckoning", "kf_fix", "ekf_ungated", "ekf_gated", "to fix", "to truth"):
        assert word in ended.out
    for path in (tmp_path / "dive_7").iterdir():
        assert str(path) in ended.out
    table = ended.out[: ended.out.index("wrote")]
    assert max(map(len, table.splitlines())) <= 100


def test_progress_on_a_terminal_shows_each_stage(short_log: Path, tmp_path: Path) -> None:
    ours, theirs = pty.openpty()
    command = [sys.executable, "-m", "abyssnav", "run", str(short_log), "-o", str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=theirs) as process:
        os.close(theirs)
        shown = b""
        try:
            while piece := os.read(ours, 4096):
                shown += piece
        except OSError:  # Linux says EIO where the other end has closed.
            pass
        os.close(ours)
    assert process.returncode == 0
    assert b"navigate ..." in shown


def test_compare_pools_or_keeps_the_dives(abyssnav: Any, result: Result) -> None:
    pooled = abyssnav("compare", result.folder.parent)
    assert pooled.status == 0
    assert "ekf_gated" in pooled.out
    by_dive = abyssnav("compare", result.folder, "--by", "dive")
    assert by_dive.status == 0
    assert "dive_7" in by_dive.out
    assert max(map(len, (pooled.out + by_dive.out).splitlines())) <= 100


def test_inspect_shows_topics_and_roles(abyssnav: Any, short_log: Path) -> None:
    ended = abyssnav("inspect", short_log)
    assert ended.status == 0
    for word in ("/lbl/travel_time", "sensor_msgs/Imu", "heading"):
        assert word in ended.out
    found = json.loads(abyssnav("inspect", short_log, "--json").out)
    assert found["roles"]["travel_time"] == "/lbl/travel_time"
    assert {"topic", "type", "encoding", "messages", "first_ns", "last_ns"} <= set(
        found["topics"][0]
    )


def test_inspect_takes_any_mcap_and_refuses_what_is_none(abyssnav: Any, tmp_path: Path) -> None:
    empty = tmp_path / "empty.mcap"
    with empty.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.finish()
    assert json.loads(abyssnav("inspect", empty, "--json").out)["topics"] == []
    assert abyssnav("inspect", empty).status == 0
    (tmp_path / "text.mcap").write_text("a poem")
    assert_refused(abyssnav("inspect", tmp_path / "text.mcap"), "text.mcap")


def test_inspect_says_what_to_do_with_a_damaged_log(
    abyssnav: Any, short_log: Path, tmp_path: Path
) -> None:
    whole = short_log.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) // 2])
    cut = abyssnav("inspect", tmp_path / "cut.mcap").out.splitlines()
    start = next(k for k, line in enumerate(cut) if line.startswith("! cut short"))
    told = [line for line in cut[start + 1 :] if not line.startswith("  ")]
    assert "abyssnav run uses all that could be read" in " ".join(told)
    assert "abyssnav run uses" not in abyssnav("inspect", short_log).out


def test_simulate_writes_a_log_that_run_takes(abyssnav: Any, tmp_path: Path) -> None:
    log = tmp_path / "new" / "clean.mcap"
    assert abyssnav("simulate", "clean", "-o", log).status == 0
    assert [path.name for path in log.parent.iterdir()] == ["clean.mcap"]
    assert abyssnav("run", log, "-o", tmp_path / "out").status == 0


def test_an_unknown_scenario_is_refused(abyssnav: Any, tmp_path: Path) -> None:
    assert_refused(abyssnav("simulate", "voyage_9", "-o", tmp_path / "x.mcap"), "voyage_9")
    assert not (tmp_path / "x.mcap").exists()


def test_a_missing_role_is_refused(abyssnav: Any, short_log: Path, tmp_path: Path) -> None:
    log = copy_without(short_log, tmp_path / "no_depth.mcap", {"/depth"})
    assert_refused(abyssnav("run", log, "-o", tmp_path / "out"), "/depth", "no_depth")
    assert not (tmp_path / "out").exists()


def test_a_log_without_our_messages_is_refused(
    abyssnav: Any, short_log: Path, tmp_path: Path
) -> None:
    ours = {"/depth", "/imu", "/dvl", "/lbl/travel_time"}
    log = copy_without(short_log, tmp_path / "empty.mcap", ours)
    assert_refused(abyssnav("run", log, "-o", tmp_path / "out"), "empty")


def test_replies_of_unknown_beacons_only_are_refused(
    abyssnav: Any, short_log: Path, tmp_path: Path
) -> None:
    config = settings(tmp_path, beacons(101, 102, 103))
    ended = abyssnav("run", short_log, "-o", tmp_path / "out", "--config", config)
    assert_refused(ended, "beacon", "101")


def test_a_single_beacon_is_refused(abyssnav: Any, short_log: Path, tmp_path: Path) -> None:
    config = settings(tmp_path, beacons(1))
    ended = abyssnav("run", short_log, "-o", tmp_path / "out", "--config", config)
    assert_refused(ended, "1 beacon", "needs 3")


def test_without_a_confirmed_start_there_is_dead_reckoning_and_a_finding(
    abyssnav: Any, dive_log: Path, tmp_path: Path
) -> None:
    config = settings(tmp_path, "[start]\nv_max_mps = 0.001\n")
    ended = abyssnav("run", dive_log, "-o", tmp_path / "out", "--config", config)
    assert ended.status == 0
    assert "no start confirmed" in ended.out
    summary = json.loads((tmp_path / "out" / "dive_7" / "summary.json").read_text("utf-8"))
    assert not all(check["ok"] for check in summary["checks"] if "start" in check["name"])
    assert "ekf_gated" not in summary["starts"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["run", "nowhere.mcap"], "nowhere.mcap"),
        (["inspect", "nowhere.mcap"], "nowhere.mcap"),
        (["view", "nowhere"], "nowhere"),
        (["compare", "nowhere"], "nowhere"),
    ],
)
def test_a_file_that_is_not_there_is_refused_by_name(
    abyssnav: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert_refused(abyssnav(*words), said)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_without_results_is_refused(abyssnav: Any, tmp_path: Path) -> None:
    assert_refused(abyssnav("compare", tmp_path), "holds no result")


def test_a_misspelt_setting_or_profile_is_refused(
    abyssnav: Any, short_log: Path, tmp_path: Path
) -> None:
    config = settings(tmp_path, "[gate]\ngama = 9\n")
    assert_refused(abyssnav("run", short_log, "--config", config), "gama", "nearest: gamma")
    assert_refused(abyssnav("run", short_log, "--profile", "defualt"), "defualt", "default")


def test_a_fault_of_our_own_is_one_line_too(
    abyssnav: Any, short_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("a\nb")

    monkeypatch.setattr("abyssnav.run.navigate", broken)
    ended = abyssnav("run", short_log, "-o", tmp_path)
    assert ended.status == 1
    assert "fault in abyssnav itself: ZeroDivisionError: a b" in ended.err
    assert "Traceback" not in ended.err


def test_an_interrupt_leaves_no_debris(
    abyssnav: Any, short_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("abyssnav.run.write", interrupted)
    ended = abyssnav("run", short_log, "-o", tmp_path)
    assert ended.status == 130
    assert "Traceback" not in ended.err
    assert list(tmp_path.iterdir()) == []


def test_export_writes_what_other_tools_open(abyssnav: Any, result: Result, tmp_path: Path) -> None:
    ended = abyssnav("export", result.folder, "--to", "csv", "-o", tmp_path)
    assert ended.status == 0
    assert all(str(path) in ended.out for path in tmp_path.iterdir())
    assert list(tmp_path.iterdir())
    unknown = abyssnav("export", result.folder, "--to", "doc")
    assert (unknown.status, "no 'doc'; nearest: csv" in unknown.err) == (2, True)
    nobody = abyssnav("export", result.folder, "--to", "csv", "--method", "smother")
    assert (nobody.status, "nearest: smoother" in nobody.err) == (2, True)
    without = abyssnav("export", result.folder, "--to", "csv", "--method", "fix")
    assert without.status == 1  # a method, but none with a track


def test_view_opens_the_recording_on_this_machine_only(
    abyssnav: Any, result: Result, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[list[str]] = []

    def started(command: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        asked.append(command)
        return subprocess.CompletedProcess(command, 0)

    stood: list[int] = []
    before = set(threading.enumerate())
    monkeypatch.setattr("abyssnav.outputs.rerun.opening.stand_at", stood.append)
    monkeypatch.setattr("subprocess.run", started)
    monkeypatch.setenv("DISPLAY", ":0")
    assert abyssnav("view", result.folder).status == 0
    for thread in {*threading.enumerate()} - before:  # the one that tells the viewer
        thread.join(timeout=5.0)
    assert stood == [opening_time_ns(result.folder)]
    (*_, usage, off), (*_, recording, bind, address) = asked
    assert [usage, off] == ["analytics", "disable"]
    assert recording == str(result.folder / "dive.rrd")
    assert [bind, address] == ["--bind", "127.0.0.1"]


def test_view_without_a_screen_says_in_one_line_what_to_do_and_serves_a_browser(
    abyssnav: Any, result: Result, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[list[str]] = []

    def started(command: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        asked.append(command)
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr("subprocess.run", started)
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert_refused(abyssnav("view", result.folder), "no screen", f"view --web {result.folder}")
    assert asked == []
    ended = abyssnav("view", "--web", result.folder)
    assert ended.status == 0
    assert ended.out.startswith("open http://127.0.0.1:9090/?url=")
    assert ended.out.count("\n") == 1
    assert asked[-1][asked[-1].index("--bind") + 1] == "127.0.0.1"
    assert "--serve-web" in asked[-1]


def test_h_is_help(abyssnav: Any) -> None:
    for words in ([], ["run"], ["export"], ["view"]):
        assert abyssnav(*words, "-h") == abyssnav(*words, "--help")
        assert abyssnav(*words, "-h").status == 0


@pytest.mark.parametrize(
    ("typed", "expected"),
    [
        ("export x --to ge", "geojson"),
        ("simulate voy", "voyage_1 voyage_2"),
        ("run x --profile twi", "twist"),
        ("export x --to csv --method smo", "smoother"),
    ],
)
def test_the_shell_completes_choices(typed: str, expected: str) -> None:
    words = f"abyssnav {typed}"
    asked = {"_ABYSSNAV_COMPLETE": "complete_bash", "COMP_WORDS": words}
    asked["COMP_CWORD"] = str(len(words.split()) - 1)
    said = subprocess.run(
        [sys.executable, "-c", "from abyssnav.cli import main; main()"],
        check=False,
        capture_output=True,
        text=True,
        env={**os.environ, **asked},
    )
    assert said.stdout.split() == expected.split()


def test_quiet_says_nothing_and_json_one_value(
    abyssnav: Any, short_log: Path, tmp_path: Path
) -> None:
    assert abyssnav("run", short_log, "--output", tmp_path, "--quiet") == (0, "", "")
    told = abyssnav("run", short_log, "--output", tmp_path, "--json", "--quiet")
    assert json.loads(told.out)["methods"]["smoother"]["replies"] > 0
    folder = tmp_path / "logs"
    folder.mkdir()
    (folder / "no.mcap").write_bytes(b"not MCAP")
    many = abyssnav("batch", folder, "--output", tmp_path / "many", "--json", "--quiet")
    assert many.status == 1
    assert [row["status"] for row in json.loads(many.out)] == ["refused"]
    assert many.err.startswith("REFUSED   no  ")
    assert "not MCAP" in many.err
    assert len(many.err.splitlines()) == 1


def test_the_shell_completes_commands() -> None:
    asked = {"_ABYSSNAV_COMPLETE": "complete_bash", "COMP_WORDS": "abyssnav ru", "COMP_CWORD": "1"}
    said = subprocess.run(
        [sys.executable, "-c", "from abyssnav.cli import main; main()"],
        check=False,
        capture_output=True,
        text=True,
        env={**os.environ, **asked},
    )
    assert said.stdout.split() == ["run"]


def test_a_signal_that_an_import_wraps_is_still_a_signal() -> None:
    """What rises while a class is made, as a signal may, Python 3.11 gives on as a RuntimeError."""
    program = """if True:
        import os, signal
        import abyssnav.cli
        from abyssnav.__main__ import main
        class Signalling:
            def __set_name__(self, owner, name):
                os.kill(os.getpid(), signal.SIGTERM)
        abyssnav.cli.app = lambda **_: type("Made", (), {"attribute": Signalling()})
        main()"""
    ended = subprocess.run(
        [sys.executable, "-P", "-c", program], check=False, capture_output=True, text=True
    )
    assert (ended.returncode, ended.stderr) == (
        128 + signal.SIGTERM, "abyssnav: stopped by SIGTERM\n",
    )  # fmt: skip
