# SPDX-License-Identifier: Apache-2.0
"""Full disks, signals and limits: one line, whole results or none, no traceback, nothing left."""

import os
import resource
import subprocess
import sys
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


@pytest.mark.parametrize("bytes_at_most", [1 << 12, 1 << 17, 1 << 18, 1 << 19])
def test_a_disk_that_is_full_ends_the_run_in_words(
    dive_log: Path, tmp_path: Path, bytes_at_most: int
) -> None:
    """No file may grow beyond the limit, as on a full disk: another writer fails first each time.

    Rerun's own writer waits for ever once it cannot write.
    """
    ended = limited(
        resource.RLIMIT_FSIZE,
        bytes_at_most,
        "run",
        str(dive_log),
        "-o",
        str(tmp_path / "out"),
        "-q",
    )
    assert ended.returncode == 1
    (line,) = ended.stderr.splitlines()
    assert "cannot be written" in line
    assert list((tmp_path / "out").iterdir()) == []
