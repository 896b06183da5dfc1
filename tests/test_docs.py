# SPDX-License-Identifier: Apache-2.0
"""What README and docs tell a person to type does what they say."""

import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import msgspec
import pyarrow.parquet as pq
import pytest
from pages import ROOT, Block, blocks, pages

from abyssnav.simulate import load_scenario, simulate, write_log

#: Checked by name only: they install, build, or take minutes; .ci/run does most of them.
NAMED_ONLY = re.compile(
    r"make |pip install |\.ci/run|export PATH|\.venv/bin/abyssnav view|(OMP_\w+=1 )?python tests/"
)
#: Run by bash where they are installed; the others would be skipped in silence, so they are listed.
PROGRAMS = {"cp": "cp", "ls": "ls", "evo_ape": "evo_ape"}


@pytest.fixture(scope="session")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as a reader of the pages has it: a dive, a split one, a cruise, results."""
    desk = tmp_path_factory.mktemp("desk")
    (desk / "sample_logs").symlink_to(ROOT / "sample_logs")
    (desk / "schemas").symlink_to(ROOT / "schemas")
    short = msgspec.structs.replace(load_scenario("clean"), duration_s=900.0)
    write_log(simulate(short), desk / "dive7.mcap")
    (desk / "cruise").mkdir()
    for seed in (1, 2):
        leg = msgspec.structs.replace(short, seed=seed)
        write_log(simulate(leg), desk / "cruise" / f"leg_{seed}.mcap")
    return desk


RUNNABLE = [path for path in pages() if any(b.kind in ("sh", "python") for b in blocks(path))]


@pytest.mark.pages
@pytest.mark.parametrize("page", RUNNABLE, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_what_a_page_says_runs(
    page: Path, desk: Path, abyssnav: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(desk)
    prepare(page, desk, abyssnav)
    names: dict[str, Any] = {"__name__": "page"}
    for block in blocks(page):
        if block.file:
            (desk / block.file).write_text(block.content(), encoding="utf-8")
        if block.not_run:
            continue
        for command in block.commands():
            type_in(command, desk, abyssnav)
        if block.kind == "python":
            exec(compile(block.text, str(page), "exec"), names)


@pytest.mark.pages
@pytest.mark.parametrize("dive", ["clean", "voyage_1", "voyage_2"])
def test_the_figures_of_sample_dives_are_those_of_the_code(
    dive: str, abyssnav: Any, tmp_path: Path
) -> None:
    """Of the README to the digits shown, of the first dive's page to the last word."""
    ended = abyssnav("run", ROOT / "sample_logs" / f"{dive}.mcap", "-o", tmp_path)
    rows = pq.read_table(tmp_path / dive / "comparison.parquet").to_pylist()
    rms_m = {row["method"]: row["rms_m"] for row in rows if row["reference"] == "truth"}
    columns = ("dead_reckoning", "fix", "ekf_ungated", "ekf_gated", "ekf", "smoother")
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    (line,) = re.findall(rf"^\| `{dive}`:[^|]*\|(.*)\|[^|]*\|$", text, re.MULTILINE)
    for method, cell in zip(columns, line.split("|"), strict=True):
        digits = len(cell.strip().partition(".")[2])
        assert float(cell.replace(",", "")) == pytest.approx(rms_m[method], abs=10**-digits)
    (shown,) = [
        block.text for block in blocks(ROOT / "docs/tutorial/first_dive.md")
        if "95 % within" in block.text
    ]  # fmt: skip
    if dive in shown:
        said = [line.rstrip() for line in ended.out.splitlines()]
        assert [line for line in shown.splitlines() if line and line not in said] == []


def prepare(page: Path, desk: Path, abyssnav: Any) -> None:
    """What the page takes for granted: `out/dive7` and `results` of an earlier page."""
    text = page.read_text(encoding="utf-8")
    if "out/dive7" in text and not (desk / "out" / "dive7").exists():
        assert abyssnav("run", "dive7.mcap", "-q").status == 0
    if "results" in text and not (desk / "results").exists():
        assert abyssnav("batch", "cruise/", "-o", "results", "-q").status == 0
    if "split/" in text and not (desk / "split").exists():
        split(desk)


def split(desk: Path) -> None:
    """The dive in two files, by the official library."""
    from mcap.reader import make_reader
    from mcap.writer import Writer

    (desk / "split").mkdir()
    with (desk / "dive7.mcap").open("rb") as given:
        messages = list(make_reader(given).iter_messages())
    middle = len(messages) // 2
    for name, part in (("dive_a", messages[:middle]), ("dive_b", messages[middle:])):
        with (desk / "split" / f"{name}.mcap").open("wb") as made:
            writer = Writer(made)
            writer.start(profile="ros2", library="")
            known: dict[int, int] = {}
            for schema, channel, message in part:
                assert schema is not None
                if channel.id not in known:
                    number = writer.register_schema(schema.name, schema.encoding, schema.data)
                    known[channel.id] = writer.register_channel(
                        channel.topic, channel.message_encoding, number
                    )
                writer.add_message(
                    known[channel.id], message.log_time, message.data, message.publish_time
                )
            writer.finish()


def type_in(command: str, desk: Path, abyssnav: Any) -> None:
    """Run one command as the reader would; what installs or opens windows is checked by name."""
    if NAMED_ONLY.match(command):
        check_name(command)
        return
    words = shlex.split(command)
    if words[0] == "abyssnav" and not set("|<>*") & set(command):
        ended = abyssnav(*words[1:])
        assert ended.status == 0, f"{command}: {ended.err}"
        return
    program = words[0]
    assert program == "abyssnav" or program in PROGRAMS, f"no test can run {command!r}"
    path = f"{Path(sys.executable).parent}:/usr/bin:/bin"
    shell = ["bash", "-euo", "pipefail", "-c", command]
    environment = {"PATH": path, "HOME": str(desk)}
    done = subprocess.run(
        shell, cwd=desk, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{command}: {done.stderr}"


def check_name(command: str) -> None:
    """The target, the extra or the package that a command names is there."""
    if command.startswith("make "):
        makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
        targets = set(re.findall(r"^([a-z-]+):", makefile, re.MULTILINE))
        assert set(command.split()[1:]) <= targets, command
    script = re.search(r"python (tests/\w+\.py)", command)
    assert script is None or (ROOT / script[1]).is_file(), command
    extra = re.search(r"abyssnav\[(\w+)\]", command)
    if extra:
        project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
        assert extra[1] in project["optional-dependencies"], command


@pytest.mark.parametrize("page", pages(), ids=lambda path: path.relative_to(ROOT).as_posix())
def test_what_is_not_run_names_commands_that_exist(page: Path) -> None:
    from typer.main import get_command

    from abyssnav.cli import app

    commands: dict[str, Any] = get_command(app).commands  # type: ignore[attr-defined]
    for block in blocks(page):
        for command in block.commands():
            check_name(command)
            for name, rest in re.findall(r"\babyssnav ([a-z]+)([^\n#|]*)", command):
                assert name in commands, command
                known = {o for parameter in commands[name].params for o in parameter.opts}
                used = set(re.findall(r"(?<!\S)--?[a-z][a-z-]*", rest))
                assert used <= known | {"--help"}, command


def test_profiles_and_settings_of_the_pages_load(tmp_path: Path) -> None:
    """Every TOML file that a page shows is one that abyssnav takes."""
    from abyssnav.config import load_config
    from abyssnav.plan import load_layout
    from abyssnav.profile import load_profile

    shown = [b for page in pages() for b in blocks(page) if b.kind == "toml"]
    assert len(shown) > 8
    for block in shown:
        path = tmp_path / "shown.toml"
        path.write_text(block.text, encoding="utf-8")
        tables = set(tomllib.loads(block.text))
        if "track" in tables:
            load_layout(path)
        elif tables & {"heading", "velocity", "depth", "travel_time", "position"}:
            load_profile(completed(block, path))
        else:
            load_config(path)


def completed(block: Block, path: Path) -> Path:
    """A profile of which the page shows some tables, with those of the default for the rest."""
    default = (ROOT / "schemas/profiles/default.toml").read_text(encoding="utf-8")
    shown = set(tomllib.loads(block.text))
    rest = [
        part for part in re.split(r"(?m)^(?=\[)", default)[1:]
        if part.split("]")[0].lstrip("[") not in shown
    ]  # fmt: skip
    path.write_text(block.text + "\n" + "\n".join(rest), encoding="utf-8")
    return path


def test_links_of_the_readme_lead_somewhere() -> None:
    for page in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"):
        for target in re.findall(r"\]\(([^)#]+)", page.read_text(encoding="utf-8")):
            assert target.startswith("https://") or (ROOT / target).exists(), f"{page}: {target}"


@pytest.mark.parametrize("page", pages(), ids=lambda path: path.relative_to(ROOT).as_posix())
def test_files_that_a_page_names_are_there(page: Path) -> None:
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    for name in re.findall(r"`((?:\w+/)+\w+\.py)`", text):
        places = (ROOT / name, ROOT / "pipeline/abyssnav" / name)
        assert any(place.is_file() for place in places), f"{page.name}: {name}"


def test_the_readme_fits_three_screens() -> None:
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 120


def test_the_dockerfile_names_what_is_there() -> None:
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    for source in re.findall(r"^COPY ([^\n]+)", text, re.MULTILINE):
        for name in source.split()[:-1]:
            assert name.startswith("--") or (ROOT / name).exists(), name


def test_every_yaml_of_the_pages_is_yaml() -> None:
    yaml = pytest.importorskip("yaml")
    shown = [b for page in pages() for b in blocks(page) if b.kind == "yaml"]
    assert shown
    for block in shown:
        assert yaml.safe_load(block.text)["kind"] == "Job"


@pytest.mark.pages
def test_the_script_for_arrays_runs_as_a_task(desk: Path, abyssnav: Any) -> None:
    """Without a queue: bash runs it with the number that Slurm would give."""
    page = ROOT / "docs/how_to/slurm.md"
    (script,) = [b for b in blocks(page) if b.file == "cruise.sbatch"]
    (desk / "cruise.sbatch").write_text(script.text, encoding="utf-8")
    (desk / "dives.txt").write_text("cruise/leg_1.mcap\ncruise/leg_2.mcap\n", encoding="utf-8")
    command = shutil.which("abyssnav", path=str(Path(sys.executable).parent))
    if command is None:
        pytest.skip("abyssnav is not installed beside this Python")
    environment = {
        "PATH": f"{Path(sys.executable).parent}:/usr/bin:/bin",
        "PYTHONPATH": str(ROOT / "pipeline"),
        "SLURM_ARRAY_TASK_ID": "2",
    }
    subprocess.run(["bash", "cruise.sbatch"], cwd=desk, env=environment, check=True)
    assert (desk / "results" / "leg_2" / "summary.json").is_file()
