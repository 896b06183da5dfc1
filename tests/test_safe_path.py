# SPDX-License-Identifier: Apache-2.0
"""Files of the folder in which a person types the command are no modules of ours."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

COMMAND = [str(Path(sys.executable).with_name("abyssnav"))]


@pytest.fixture
def hostile_folder(tmp_path: Path) -> Path:
    """A folder whose files bear the names of modules and end whoever imports them."""
    folder = tmp_path / "mine"
    folder.mkdir()
    for name in ("pipeline", "abyssnav", "numpy", "rerun", "msgspec", "pyarrow", "distributed"):
        (folder / f"{name}.py").write_text(f"raise SystemExit('{name}.py was imported')\n")
    return folder


@pytest.mark.parametrize("words", [["run"], ["batch", "--jobs", "2"]], ids=["run", "batch"])
def test_modules_in_the_current_folder_change_nothing(
    hostile_folder: Path, short_log: Path, words: list[str]
) -> None:
    """The console script, its second process and its workers."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONSAFEPATH"}
    out = ["-o", str(hostile_folder / "out"), "--quiet"]
    ended = subprocess.run(
        [*COMMAND, words[0], str(short_log), *words[1:], *out],
        cwd=hostile_folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (ended.returncode, ended.stderr) == (0, "")
    (summary,) = (hostile_folder / "out").glob("*/summary.json")
    assert summary.stat().st_size > 0
