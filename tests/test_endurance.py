# SPDX-License-Identifier: Apache-2.0
"""Dive after dive in one process: memory, open files and temporary files stay what they were."""

import gc
import os
from pathlib import Path

import msgspec
import pytest

from abyssnav.config import Config
from abyssnav.errors import PipelineError
from abyssnav.profile import load_profile
from abyssnav.run import Setup, run_dive
from abyssnav.simulate import load_scenario, simulate, write_log

#: Rerun has two threads a recording, for ever if nobody ends them.
MOST_THREADS = 24
#: What a process may grow by between its sixth dive and its last.
MOST_GROWTH_MB = 30.0


def resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def open_files() -> set[str]:
    """What this process holds open, but for what it had and the directory that is just listed."""
    names = set()
    for number in os.listdir("/proc/self/fd"):
        try:
            names.add(os.readlink(f"/proc/self/fd/{number}"))
        except FileNotFoundError:
            continue
    return names


@pytest.mark.parametrize("dives", [12, pytest.param(160, marks=pytest.mark.slow)])
def test_dive_after_dive_takes_no_more_memory_handles_or_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, dives: int
) -> None:
    """Every fourth is refused: what an error holds would be held for ever."""
    scenario = msgspec.structs.replace(load_scenario("clean"), duration_s=240.0)
    write_log(simulate(scenario), tmp_path / "good.mcap")
    sound = (tmp_path / "good.mcap").read_bytes()
    (tmp_path / "bad.mcap").write_bytes(sound[:2000])
    config, profile = Config(), load_profile()
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    before, first_mb = open_files(), 0.0
    for k in range(dives):
        if k % 4:
            run_dive([tmp_path / "good.mcap"], Setup(config, profile), tmp_path / "out")
        else:
            with pytest.raises(PipelineError):
                run_dive([tmp_path / "bad.mcap"], Setup(config, profile), tmp_path / "out")
        if k == 5:
            gc.collect()
            first_mb = resident_mb()
    gc.collect()
    assert resident_mb() - first_mb < MOST_GROWTH_MB
    assert len(os.listdir("/proc/self/task")) < MOST_THREADS
    ours = [name for name in open_files() - before if str(tmp_path) in name]
    assert ours == []
    assert list((tmp_path / "temporary").iterdir()) == []
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["good"]
