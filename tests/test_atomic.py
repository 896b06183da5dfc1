# SPDX-License-Identifier: Apache-2.0
import subprocess
import sys
from pathlib import Path

import pytest

from abyssnav.atomic import atomic_directory, atomic_file, folder_name, keep_foreign_files
from abyssnav.errors import PipelineError


def publish(folder: Path, text: str) -> None:
    with atomic_directory(folder) as fresh:
        (fresh / "tracks").write_text(text)
        (fresh / "summary.json").write_text("{}")


def break_off(folder: Path) -> None:
    with atomic_directory(folder) as fresh:
        (fresh / "tracks").write_text("second")
        raise RuntimeError("half way")


def killed_while_publishing(folder: Path, where: str) -> None:
    """Another process publishes `new` and dies by SIGKILL at the line `where`."""
    program = f"""
import os, pathlib, signal, sys
from abyssnav import atomic
die = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
folder = pathlib.Path(sys.argv[1])
{where}
with atomic.atomic_directory(folder) as fresh:
    (fresh / "tracks").write_text("new")
    (fresh / "summary.json").write_text("{{}}")
    (die() if {where == ""} else None)
"""
    ended = subprocess.run([sys.executable, "-c", program, str(folder)], check=False)
    assert ended.returncode == -9


#: The instants of publishing at which a process can die, by what it does next.
INSTANTS = {
    "while_it_writes": "",
    "before_it_flushes": "atomic._flush = die",
    "before_the_first_rename": "atomic._replace = die",
    "between_the_renames": (
        "old, kept = pathlib.Path.rename, folder.with_name('.dive.old')\n"
        "def rename(a, b): return die() if kept.exists() else old(a, b)\n"
        "pathlib.Path.rename = rename"
    ),
    "before_the_old_one_goes": "atomic._sync = lambda p: die() if p == folder.parent else None",
}


def test_a_result_appears_whole_with_nothing_beside_it(tmp_path: Path) -> None:
    publish(tmp_path / "out" / "dive", "first")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["dive"]
    assert (tmp_path / "out" / "dive" / "tracks").read_text() == "first"


def test_nothing_is_seen_of_a_result_before_it_is_whole(tmp_path: Path) -> None:
    folder = tmp_path / "dive"
    publish(folder, "first")
    with atomic_directory(folder) as fresh:
        (fresh / "tracks").write_text("second")
        assert (folder / "tracks").read_text() == "first"
        (fresh / "summary.json").write_text("{}")
    assert (folder / "tracks").read_text() == "second"
    assert [path.name for path in tmp_path.iterdir()] == ["dive"]


def test_a_failure_leaves_the_older_result_and_no_debris(tmp_path: Path) -> None:
    folder = tmp_path / "dive"
    publish(folder, "first")
    with pytest.raises(RuntimeError, match="half way"):
        break_off(folder)
    assert (folder / "tracks").read_text() == "first"
    assert [path.name for path in tmp_path.iterdir()] == ["dive"]


@pytest.mark.parametrize("instant", INSTANTS)
def test_killed_at_any_instant_only_whole_results_remain(tmp_path: Path, instant: str) -> None:
    folder = tmp_path / "dive"
    publish(folder, "old")
    killed_while_publishing(folder, INSTANTS[instant])
    if folder.exists():
        assert (folder / "tracks").read_text() in {"old", "new"}
    publish(folder, "next")
    assert (folder / "tracks").read_text() == "next"
    assert [path.name for path in tmp_path.iterdir()] == ["dive"]


def test_killed_between_the_renames_the_old_result_comes_back(tmp_path: Path) -> None:
    folder = tmp_path / "dive"
    publish(folder, "old")
    killed_while_publishing(folder, INSTANTS["between_the_renames"])
    assert not folder.exists()
    with pytest.raises(RuntimeError, match="half way"):
        break_off(folder)
    assert (folder / "tracks").read_text() == "old"


def test_what_a_living_process_writes_is_left_alone(tmp_path: Path) -> None:
    folder = tmp_path / "dive"
    with atomic_directory(folder) as fresh:
        publish(folder, "other")
        assert fresh.is_dir()
        (fresh / "tracks").write_text("mine")
        (fresh / "summary.json").write_text("{}")
    assert (folder / "tracks").read_text() == "mine"


def test_a_dive_whose_name_begins_like_anothers_keeps_its_work(tmp_path: Path) -> None:
    with atomic_directory(tmp_path / "dive.2") as fresh:
        publish(tmp_path / "dive", "first")
        assert fresh.is_dir()
        (fresh / "summary.json").write_text("{}")
    assert (tmp_path / "dive.2").is_dir()


def test_a_folder_that_is_no_result_is_never_replaced(tmp_path: Path) -> None:
    (tmp_path / "dive").mkdir()
    (tmp_path / "dive" / "thesis.tex").write_text("years of work")
    with pytest.raises(PipelineError, match=r"dive: exists and is no result of abyssnav"):
        publish(tmp_path / "dive", "first")
    assert (tmp_path / "dive" / "thesis.tex").read_text() == "years of work"


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("a file")
    with pytest.raises(PipelineError, match=r"out.*: cannot be written: ") as refusal:
        publish(tmp_path / "out" / "dive", "first")
    assert "\n" not in str(refusal.value)


def test_others_may_read_a_result_as_far_as_the_umask_lets_them(tmp_path: Path) -> None:
    publish(tmp_path / "dive", "first")
    (tmp_path / "plain").mkdir()
    assert (tmp_path / "dive").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_file_appears_whole_or_the_older_one_stays(tmp_path: Path) -> None:
    path = tmp_path / "new" / "log.mcap"
    with atomic_file(path) as fresh:
        fresh.write_text("first")
        assert not path.exists()
    assert path.read_text() == "first"

    def broken() -> None:
        with atomic_file(path) as fresh:
            fresh.write_text("sec")
            raise RuntimeError("half way")

    with pytest.raises(RuntimeError, match="half way"):
        broken()
    assert path.read_text() == "first"
    assert [found.name for found in path.parent.iterdir()] == ["log.mcap"]


def test_a_file_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    def into_a_folder() -> None:
        with atomic_file(tmp_path) as fresh:
            fresh.write_text("first")

    with pytest.raises(PipelineError, match="cannot be written: "):
        into_a_folder()


def test_a_file_that_another_process_writes_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "dives.parquet"
    with atomic_file(path) as slow:
        slow.write_text("slow")
        with atomic_file(path) as quick:
            quick.write_text("quick")
        assert (slow.read_text(), path.read_text()) == ("slow", "quick")
    assert path.read_text() == "slow"
    assert list(tmp_path.iterdir()) == [path]


def test_what_people_put_into_a_result_survives_its_replacement(tmp_path: Path) -> None:
    folder = tmp_path / "dive"
    publish(folder, "first")
    (folder / "tracks.geojson").write_text("exported")
    (folder / "figures").mkdir()
    (folder / "figures" / "plan.png").write_text("drawn")
    with atomic_directory(folder) as fresh:
        (fresh / "tracks").write_text("second")
        (fresh / "summary.json").write_text("{}")
        assert keep_foreign_files(folder, fresh) == ["figures", "tracks.geojson"]
    assert (folder / "tracks").read_text() == "second"
    assert (folder / "tracks.geojson").read_text() == "exported"
    assert (folder / "figures" / "plan.png").read_text() == "drawn"


@pytest.mark.parametrize("stray", ["file", "link", "broken_link", "folder"])
def test_a_stray_leftover_blocks_no_dive(tmp_path: Path, stray: str) -> None:
    leftover, other = tmp_path / ".dive.00112233.part", tmp_path / "other"
    other.mkdir()
    (other / "thesis.tex").write_text("years of work")
    if stray == "file":
        leftover.write_text("of somebody")
    elif stray == "folder":
        leftover.mkdir()
    else:
        leftover.symlink_to(other if stray == "link" else tmp_path / "nowhere")
    publish(tmp_path / "dive", "first")
    assert (tmp_path / "dive" / "tracks").read_text() == "first"
    assert (other / "thesis.tex").read_text() == "years of work"
    assert leftover.exists() == (stray == "link")


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("dive 7", "dive 7"),
        ("", "%"),
        (".", "%2E"),
        ("..", "%2E%2E"),
        (".hidden", "%2Ehidden"),
        ("a/b", "a%2Fb"),
        ("bell\a", "bell%07"),
        ("caf\udce9", "caf%E9"),
    ],
)
def test_the_name_of_a_folder_can_be_borne_by_one(tmp_path: Path, text: str, name: str) -> None:
    assert folder_name(text) == name
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / name).mkdir()
    assert [path.name for path in (tmp_path / "out").iterdir()] == [name]
