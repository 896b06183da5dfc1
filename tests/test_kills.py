# SPDX-License-Identifier: Apache-2.0
"""Processes ended at random instants: whole results, one line, nothing left, and no orphan.

Whoever is ended: the command, its second process, a worker, or what workers are forked from.
"""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec
import pytest
from test_batch import same_bytes

from abyssnav.simulate import load_scenario, simulate, write_log

COMMAND = [sys.executable, "-P", "-m", "abyssnav"]
NAMES = ("a", "b", "c")
#: From before the imports until after the last file; a run of these takes one to three seconds.
LATEST_S = {"run": 2.0, "batch": 5.0}


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    scenario = msgspec.structs.replace(load_scenario("voyage_2"), duration_s=420.0)
    write_log(simulate(scenario), folder / "a.mcap")
    for name in NAMES[1:]:
        shutil.copy(folder / "a.mcap", folder / f"{name}.mcap")
    return folder


@pytest.fixture(scope="module")
def undisturbed(logs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("undisturbed")
    subprocess.run(words_of("batch", logs, out), check=True)
    return out


def words_of(command: str, logs: Path, out: Path) -> list[str]:
    source = logs / "a.mcap" if command == "run" else logs
    more = ["-j", "2"] if command == "batch" else []
    return [*COMMAND, command, str(source), "-o", str(out), "-q", *more]


class Ended(NamedTuple):
    status: int
    err: str
    left: list[int]  #: processes of it that still live


def kill_somebody(words: Sequence[str], after_s: float, number: int, whom: str) -> Ended:
    """Start a command, and after a while send a signal to it or to one that it has started."""
    process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True, start_new_session=True)
    time.sleep(after_s)
    family = descendants(process.pid)
    others = [pid for pid in family if pid != process.pid]
    victim = process.pid if whom == "command" else random.choice(others or [process.pid])
    if process.poll() is None:
        os.kill(victim, number)
    _, err = process.communicate(timeout=60)
    for _ in range(100):
        left = [pid for pid in family if is_alive(pid)]
        if not left:
            break
        time.sleep(0.1)
    return Ended(process.returncode, err, left)


def descendants(pid: int) -> list[int]:
    try:
        words = Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii").split()
    except OSError:
        return []
    return [pid, *(further for word in words for further in descendants(int(word)))]


def is_alive(pid: int) -> bool:
    try:
        status = Path(f"/proc/{pid}/stat").read_text(encoding="ascii")
    except OSError:
        return False
    return status.rsplit(")", 1)[1].split()[0] != "Z"


def whole(out: Path, undisturbed: Path) -> list[str]:
    """Assert that every result is a whole one, and give the names of what is half way."""
    if not out.is_dir():
        return []
    for folder in out.iterdir():
        if folder.is_dir() and not folder.name.startswith("."):
            assert {path.name for path in folder.iterdir()} == {
                path.name for path in (undisturbed / "a").iterdir()
            }
    return [path.name for path in out.iterdir() if path.name.startswith(".")]


def is_told(line: str) -> bool:
    """A line of a batch's table, of the program itself, or of a dive whose process was ended."""
    return "abyssnav" in line or ": " in line or "its process was ended by SIG" in line


CASES = [
    ("run", "command", signal.SIGKILL),
    ("run", "command", signal.SIGTERM),
    ("run", "command", signal.SIGINT),
    ("run", "other", signal.SIGKILL),
    ("run", "other", signal.SIGTERM),
    ("batch", "command", signal.SIGKILL),
    ("batch", "command", signal.SIGTERM),
    ("batch", "command", signal.SIGINT),
    ("batch", "other", signal.SIGKILL),
    ("batch", "other", signal.SIGTERM),
]
#: `make test` has the others elsewhere: signals to the command, and whole batches that are killed.
SHORT = [CASES[0], CASES[3], CASES[8]]


@pytest.mark.parametrize(
    ("command", "whom", "number", "times"),
    [
        *((*case, 1) for case in SHORT),
        *(pytest.param(*case, 15, marks=pytest.mark.slow) for case in CASES),
    ],
)
def test_whoever_is_killed_whenever_results_are_whole_and_the_next_run_makes_the_rest(
    logs: Path, undisturbed: Path, tmp_path: Path, command: str, whom: str, number: int, times: int
) -> None:
    random.seed(f"{command} {whom} {number} {times}")
    words = words_of(command, logs, tmp_path)
    for _ in range(times):
        after_s = random.uniform(0.1, LATEST_S[command])
        ended = kill_somebody(words, after_s, number, whom)
        assert "Traceback" not in ended.err
        assert ended.left == [], (after_s, ended)
        half_way = whole(tmp_path, undisturbed)
        if ended.status >= 0:  # it could still say something, and clear up
            assert half_way == [], (after_s, ended)
            lines = ended.err.splitlines()
            assert len(lines) == (ended.status > 0) or command == "batch"
            assert [line for line in lines if not is_told(line)] == []
            assert len(lines) <= len(NAMES)
    if command == "run":
        subprocess.run(words, check=True)
        same_bytes(tmp_path / "a", undisturbed / "a")
        assert [path.name for path in tmp_path.iterdir()] == ["a"]
    else:
        subprocess.run(words, check=True)
        same_bytes(tmp_path, undisturbed)
        assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]
