# SPDX-License-Identifier: Apache-2.0
"""One simulated dive, made and processed once for all tests."""

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import pytest

from abyssnav.startup import tune_gc, use_one_blas_thread

tune_gc()
use_one_blas_thread()  # before NumPy: as the command does; two processes with two threads each spin

import pandas as pd  # noqa: F401  # pyarrow asks for it once a process, and `run` hides it

from abyssnav.config import Config
from abyssnav.profile import load_profile
from abyssnav.run import Result, Setup, run_dive
from abyssnav.simulate import load_scenario, simulate, write_log


@pytest.fixture(scope="session")
def dive_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An hour of bad acoustics, with truth."""
    path = tmp_path_factory.mktemp("logs") / "dive_7.mcap"
    scenario = msgspec.structs.replace(load_scenario("voyage_2"), duration_s=3600.0)
    write_log(simulate(scenario), path)
    return path


@pytest.fixture(scope="session")
def short_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Seven minutes of the same, for what any dive shows."""
    path = tmp_path_factory.mktemp("logs") / "short.mcap"
    scenario = msgspec.structs.replace(load_scenario("voyage_2"), duration_s=420.0)
    write_log(simulate(scenario), path)
    return path


@pytest.fixture(scope="session")
def result(dive_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Result:
    """What `run` makes of that dive with every default."""
    return run_dive([dive_log], Setup(Config(), load_profile()), tmp_path_factory.mktemp("out"))


class Ended(NamedTuple):
    """How a command ended, and what it said."""

    status: int
    out: str
    err: str


@pytest.fixture
def abyssnav(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., Ended]:
    """The command line, in this process: `abyssnav("run", log, "-o", out)`."""
    from abyssnav.cli import main

    def command(*words: object) -> Ended:
        monkeypatch.setattr("sys.argv", ["abyssnav", *map(str, words)])
        capsys.readouterr()
        try:
            main()
            status = 0
        except SystemExit as end:
            status = int(end.code or 0)
        said = capsys.readouterr()
        return Ended(status, said.out, said.err)

    return command


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """The machine's own Chromium, without a screen."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        pytest.skip("no Chromium on this machine")
    with playwright.sync_playwright() as engine:
        flags = ["--no-sandbox", "--disable-dev-shm-usage"]
        with engine.chromium.launch(executable_path=chromium, args=flags) as opened:
            yield opened
