# SPDX-License-Identifier: Apache-2.0
"""Full disks, signals and limits: one line, whole results or none, no traceback, nothing left."""

import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

COMMAND = [sys.executable, "-P", "-m", "abyssnav"]


def limited(kind: int, value: int, *words: str) -> "subprocess.CompletedProcess[str]":
    """A command run under a limit of `resource`."""
    return subprocess.run(
        [*COMMAND, *words],
        preexec_fn=lambda: resource.setrlimit(kind, (value, value)),
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
        env={**os.environ, "PYTHONFAULTHANDLER": ""},
    )


@pytest.mark.parametrize("bytes_at_most", [1 << 12, 1 << 18, 1 << 20, 3 << 19])
def test_a_disk_that_is_full_ends_the_run_in_words(
    short_log: Path, tmp_path: Path, bytes_at_most: int
) -> None:
    """No file may grow beyond the limit, as on a full disk: another writer fails first each time.

    Rerun's own writer waits for ever once it cannot write.
    """
    ended = limited(
        resource.RLIMIT_FSIZE,
        bytes_at_most,
        "run",
        str(short_log),
        "-o",
        str(tmp_path / "out"),
        "-q",
    )
    assert ended.returncode == 1
    (line,) = ended.stderr.splitlines()
    assert "cannot be written" in line
    assert list((tmp_path / "out").iterdir()) == []


#: How full the smallest disk is that a result fits on; `make check` tries many.
SHARES = [0.6, *(pytest.param(k / 24, marks=pytest.mark.slow) for k in range(1, 31))]


@pytest.fixture(scope="module")
def whole_result(short_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole")
    subprocess.run([*COMMAND, "run", str(short_log), "-o", str(out), "-q"], check=True)
    return out / "short"


def on_a_disk(
    share: float, result: Path, out: Path, *words: str
) -> "subprocess.CompletedProcess[str]":
    """A command with an output of so many results' size; what is on it is listed before it goes.

    It is of memory, mounted for this one process.
    """
    size = sum(-(-path.stat().st_size // 4096) + 1 for path in result.iterdir()) * 4096
    script = 'mount -t tmpfs -o size="$1" tmpfs "$2" && shift && d="$1" && shift && "$@"; s=$?; '
    script += 'find "$d" -mindepth 1 | sort; exit $s'
    out.mkdir()
    ended = subprocess.run(
        ["unshare", "-rm", "sh", "-c", script, "sh", str(int(share * size)), str(out),
         *COMMAND, *words, "-o", str(out), "-q"],
        capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    if "unshare" in ended.stderr or "mount" in ended.stderr:
        pytest.skip("no disk of one's own may be mounted here")
    return ended


@pytest.mark.parametrize("share", SHARES)
def test_on_a_disk_of_any_size_there_is_a_whole_result_or_none(
    short_log: Path, whole_result: Path, tmp_path: Path, share: float
) -> None:
    ended = on_a_disk(share, whole_result, tmp_path / "out", "run", str(short_log))
    present = {Path(line).name for line in ended.stdout.split()}
    if ended.returncode:
        assert ended.returncode == 1
        (line,) = ended.stderr.splitlines()
        assert "cannot be written: " in line
        assert line.endswith("No space left on device")
        assert present == set()
    else:
        assert present == {"short", *(path.name for path in whole_result.iterdir())}


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.004, 0.6, 1.3, 1.97])
def test_on_a_disk_of_any_size_a_batch_has_whole_results_and_a_line_for_each_other(
    short_log: Path, whole_result: Path, tmp_path: Path, share: float
) -> None:
    logs = [str(shutil.copy(short_log, tmp_path / f"{name}.mcap")) for name in "ab"]
    ended = on_a_disk(share, whole_result, tmp_path / "out", "batch", *logs)
    assert ended.returncode == 1
    assert all("cannot be written: " in line for line in ended.stderr.splitlines())
    places = [Path(line).relative_to(tmp_path / "out") for line in ended.stdout.split()]
    whole = [place.name for place in places if len(place.parts) == 1 and not place.suffix]
    files = {path.name for path in whole_result.iterdir()}
    assert all({p.name for p in places if p.parts[0] == d} == {d, *files} for d in whole)
    refused = [line for line in ended.stderr.splitlines() if line.startswith("REFUSED")]
    assert len(whole) + len(refused) == 2
    assert len(ended.stderr.splitlines()) <= len(refused) + 1  # that of the tables


@pytest.mark.slow
@pytest.mark.parametrize("share", [k / 24 for k in range(1, 26)])
def test_where_no_file_may_grow_beyond_any_limit_there_is_a_whole_result_or_none(
    short_log: Path, whole_result: Path, tmp_path: Path, share: float
) -> None:
    largest = max(path.stat().st_size for path in whole_result.iterdir())
    words = ("run", str(short_log), "-o", str(tmp_path / "out"), "-q")
    ended = limited(resource.RLIMIT_FSIZE, int(share * largest), *words)
    present = {path.name for path in (tmp_path / "out").glob("**/*")}
    if ended.returncode:
        (line,) = ended.stderr.splitlines()
        assert "cannot be written" in line
        assert present == set()
    else:
        assert present == {"short", *(path.name for path in whole_result.iterdir())}


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        (resource.RLIMIT_AS, 700 << 20),
        (resource.RLIMIT_AS, 1200 << 20),
        (resource.RLIMIT_NOFILE, 10),
    ],
    ids=["700 MB", "1200 MB", "10 files"],
)
@pytest.mark.parametrize("command", ["run", "batch"])
def test_too_little_of_the_machine_is_said_in_a_line(
    short_log: Path, tmp_path: Path, kind: int, value: int, command: str
) -> None:
    ended = limited(kind, value, command, str(short_log), "-o", str(tmp_path / "out"), "-q")
    assert ended.returncode in {0, 1}  # where a machine makes do with so little, that is good
    assert len(ended.stderr.splitlines()) == ended.returncode
    assert "Traceback" not in ended.stderr
    if (tmp_path / "out").is_dir():
        assert not [path for path in (tmp_path / "out").iterdir() if path.name.startswith(".")]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=["Ctrl-C", "SIGTERM"])
@pytest.mark.parametrize("after_s", [0.15, 0.4, 0.8])
@pytest.mark.parametrize("command", ["run", "batch"])
def test_stopped_at_any_instant_it_says_so_and_leaves_whole_results(
    short_log: Path, tmp_path: Path, command: str, after_s: float, number: int
) -> None:
    logs, out = tmp_path / "logs", tmp_path / "out"
    logs.mkdir()
    for name in ("a", "b", "c"):
        shutil.copy(short_log, logs / f"{name}.mcap")
    source = logs / "a.mcap" if command == "run" else logs
    with (tmp_path / "stderr").open("w") as file:  # workers that end later would hold a pipe
        process = subprocess.Popen(
            [*COMMAND, command, str(source), "-o", str(out), "-q"],
            stdout=subprocess.DEVNULL,
            stderr=file,
            start_new_session=True,
        )
    time.sleep(after_s)
    if number == signal.SIGINT:
        os.killpg(process.pid, number)  # a terminal's goes to all
    else:
        process.send_signal(number)
    process.wait(timeout=60)
    stderr = (tmp_path / "stderr").read_text("utf-8")
    if process.returncode < 0:  # before Python looked after signals, or after: all is written
        assert stderr == ""
        assert not out.exists() or (command == "run" and (out / "a" / "summary.json").is_file())
    elif process.returncode > 0:
        assert process.returncode == 128 + number
        assert [line[:19] for line in stderr.splitlines()] == ["abyssnav: stopped b"]
    if out.is_dir():
        folders = [path for path in out.iterdir() if path.is_dir()]
        assert all((path / "summary.json").is_file() for path in folders)


def test_a_log_cut_short_while_it_is_mapped_is_said_in_a_line(
    short_log: Path, tmp_path: Path
) -> None:
    """The file loses its end between the opening and the reading: the system raises SIGBUS."""
    log = tmp_path / "dive.mcap"
    shutil.copy(short_log, log)
    program = (
        "import os, sys; from abyssnav.formats.mcap import reader; from abyssnav.cli import main\n"
        "index_file = reader.index_file\n"
        "def cut(name, buffer): os.truncate(sys.argv[2], 5000); return index_file(name, buffer)\n"
        "reader.index_file = cut\n"
        "main()"
    )
    ended = subprocess.run(
        [sys.executable, "-P", "-c", program, "run", str(log), "-o", str(tmp_path / "out"), "-q"],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert ended.returncode == 1
    assert ended.stderr == "abyssnav: a log was cut short while it was read\n"
    assert not (tmp_path / "out").exists()


def test_no_warning_of_a_library_reaches_a_person() -> None:
    program = (
        "import warnings, abyssnav.cli, abyssnav.__main__ as command\n"
        "def warn(): warnings.warn('mean of empty slice', RuntimeWarning)\n"
        "abyssnav.cli.main = warn\n"
        "command.main()"
    )
    for options, lines in (([], 0), (["-W", "default"], 2)):
        ended = subprocess.run(
            [sys.executable, "-P", *options, "-c", program],
            capture_output=True, text=True, check=True, timeout=60,
        )  # fmt: skip
        assert len(ended.stderr.splitlines()) in {lines, lines // 2}
