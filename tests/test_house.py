# SPDX-License-Identifier: Apache-2.0
"""The rules of the house, held by reading the source."""

import ast
import graphlib
import re
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "pipeline" / "abyssnav"

#: A room is a module of the package or a folder of it.  It imports from rooms above it in this list
#: only; rooms of one line do not know each other.  A room on no floor is refused.
FLOORS = (
    {"errors", "startup", "version"},
    {"settings", "handover"},
    {"tables", "config", "atomic", "workers", "second_process"},
    {"profile", "geometry"},
    {"acoustics"},
    {"formats", "estimation", "strict_http"},
    {"remote"},
    {"results"},
    {"read", "align", "navigate", "compare", "diff", "simulate"},
    {"diagnose"},
    {"outputs", "score", "pose"},
    {"run", "plan"},
    {"batch", "library"},
    {"calibrate"},
    {"terminal", "__init__"},
    {"cli"},
    {"__main__"},
)
SPEAKERS = ("cli", "terminal", "__main__")


def modules(package: Path) -> Iterator[tuple[str, ast.Module]]:
    """Dotted name below the package, and syntax tree, of each module."""
    for path in sorted(package.rglob("*.py")):
        name = ".".join(path.relative_to(package).with_suffix("").parts)
        yield name.removesuffix(".__init__"), parsed(path.read_text(encoding="utf-8"))


@cache
def parsed(source: str) -> ast.Module:
    """The tree of a source that many rules read."""
    return ast.parse(source)


class RelativeImportError(Exception):
    """A name that does not say where it comes from."""


def imported_modules(tree: ast.Module, known: set[str]) -> set[str]:
    """Modules of the package that a module imports, wherever in it the import stands."""
    names = []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            if node.level:
                raise RelativeImportError(f"line {node.lineno}: relative import")
            names += [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
    inner = [name.split(".")[1:] for name in names if name.split(".")[0] == "abyssnav"]
    candidates = [[".".join(parts[:end]) for end in range(len(parts), 0, -1)] for parts in inner]
    return {next((c for c in names if c in known), "__init__") for names in candidates}


def breaches(package: Path) -> list[str]:
    """What breaks the order of the floors, and circles within a room."""
    floor = {room: level for level, rooms in enumerate(FLOORS) for room in rooms}
    trees = dict(modules(package))
    known = set(trees) | set(floor)
    bad, within = [], {}
    for here, tree in trees.items():
        room = here.split(".")[0]
        try:
            there = imported_modules(tree, known) - {here}
        except RelativeImportError as relative:
            bad.append(f"{here}: {relative}")
            continue
        within[here] = {name for name in there if name.split(".")[0] == room}
        rooms = {name.split(".")[0] for name in there} - {room}
        if room not in floor:
            bad.append(f"{here} is on no floor")
        else:
            bad += [f"{here} imports {r}" for r in sorted(rooms) if floor[r] >= floor[room]]
    try:
        graphlib.TopologicalSorter(within).prepare()
    except graphlib.CycleError as circle:
        bad.append("circle " + " ".join(circle.args[1]))
    return bad


def test_imports_go_down_only() -> None:
    assert breaches(PACKAGE) == []


@pytest.mark.parametrize(
    ("room", "line", "breach"),
    [
        ("errors", "from abyssnav import tables", "errors imports tables"),
        ("align", "def f():\n    from abyssnav.read import read", "align imports read"),
        (
            "estimation/dead_reckoning",
            "import abyssnav.formats.mcap.reader",
            "estimation.dead_reckoning imports formats",
        ),
        ("compare", "from . import tables", "compare: line 1: relative import"),
        ("helpers", "", "helpers is on no floor"),
    ],
)
def test_a_house_with_a_fault_is_refused(tmp_path: Path, room: str, line: str, breach: str) -> None:
    path = (tmp_path / room).with_suffix(".py")
    path.parent.mkdir(exist_ok=True)
    path.write_text(line)
    assert breaches(tmp_path) == [breach]


def test_two_modules_that_need_each_other_are_refused(tmp_path: Path) -> None:
    (tmp_path / "estimation").mkdir()
    (tmp_path / "estimation" / "fixes.py").write_text(
        "from abyssnav.estimation.dead_reckoning import dead_reckon"
    )
    (tmp_path / "estimation" / "dead_reckoning.py").write_text(
        "from abyssnav.estimation import fixes"
    )
    (breach,) = breaches(tmp_path)
    assert breach.startswith("circle estimation.")


def test_only_the_command_line_speaks_and_exits() -> None:
    loud = [
        f"{room}:{node.lineno}"
        for room, tree in modules(PACKAGE)
        if room not in SPEAKERS
        for node in ast.walk(tree)
        if (isinstance(node, ast.Name) and node.id in {"print", "exit", "quit", "SystemExit"})
        or (isinstance(node, ast.Attribute) and ast.unparse(node) in {"sys.exit", "os._exit"})
    ]
    assert loud == []


def test_there_is_no_bare_except_and_no_hasattr() -> None:
    bad = [
        f"{room}:{node.lineno}"
        for room, tree in modules(PACKAGE)
        for node in ast.walk(tree)
        if (isinstance(node, ast.ExceptHandler) and node.type is None)
        or (isinstance(node, ast.Name) and node.id == "hasattr")
    ]
    assert bad == []


def test_a_function_has_no_more_than_forty_five_lines() -> None:
    bad = []
    for room, tree in modules(PACKAGE):
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                body = node.body[1:] if ast.get_docstring(node) else node.body
                length = (node.end_lineno or 0) - body[0].lineno + 1 if body else 0
                bad += [f"{room}:{node.name}: {length} lines"] if length > 45 else []
    assert bad == []


def test_no_function_of_the_estimator_takes_more_than_five_parameters() -> None:
    many = set()
    for room, tree in modules(PACKAGE):
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef) and room.startswith(("estimation.", "navigate.")):
                args = node.args
                names = [a.arg for a in (*args.posonlyargs, *args.args, *args.kwonlyargs)]
                many |= {f"{room}:{node.name}"} if len({*names} - {"self"}) > 5 else set()
    assert many == set()


#: Names that say nothing of a quantity.
EMPTY_WORDS = frozenset(
    [
        "of",
        "at",
        "here",
        "there",
        "told",
        "found",
        "seen",
        "heard",
        "some",
        "each",
        "mine",
        "later",
        "beside",
    ]
)
#: The contract's own: the key `at` of a known start, the text `seen` of a reason.
FIXED_NAMES = frozenset({("config", "at"), ("tables", "seen")} | {("diagnose.cause", "seen")})


def empty_names(module: str, tree: ast.Module) -> list[str]:
    """Variables, parameters, imports, functions and classes that are called by an empty word."""
    names = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.append((node.lineno, node.id))
        elif isinstance(node, ast.arg):
            names.append((node.lineno, node.arg))
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.append((node.lineno, node.name))
        elif isinstance(node, ast.alias):
            names.append((node.lineno, node.asname or node.name))
    return [
        f"{module}:{line} {name}"
        for line, name in names
        if name in EMPTY_WORDS and (module, name) not in FIXED_NAMES
    ]


def test_nothing_is_called_by_an_empty_word() -> None:
    bad = [name for module, tree in modules(PACKAGE) for name in empty_names(module, tree)]
    assert bad == []


@pytest.mark.parametrize(
    "line",
    ["of = 1", "def f(at): ...", "def told(): ...", "from m import n as here", "a, each = b"],
)
def test_an_empty_word_is_refused(line: str) -> None:
    assert len(empty_names("batch", ast.parse(line))) == 1


def test_every_function_in_the_tests_runs() -> None:
    nodes = {
        path: list(ast.walk(parsed(path.read_text("utf-8"))))
        for path in (ROOT / "tests").glob("*.py")
    }
    used = {
        node.id if isinstance(node, ast.Name) else node.attr
        for tree in nodes.values()
        for node in tree
        if isinstance(node, ast.Name | ast.Attribute)
    }
    asked_for = {
        argument.arg
        for tree in nodes.values()
        for node in tree
        if isinstance(node, ast.FunctionDef)
        for argument in node.args.args
    }
    idle = []
    for path, tree in nodes.items():
        collected = path.name.startswith("test_")
        called_by_a_base = {
            method
            for kind in tree
            if isinstance(kind, ast.ClassDef) and kind.bases
            for method in kind.body
        }
        for node in tree:
            if not isinstance(node, ast.FunctionDef) or node in called_by_a_base:
                continue
            if re.match(r"pytest_|__\w+__$", node.name):
                continue
            fixture = any("fixture" in ast.unparse(mark) for mark in node.decorator_list)
            automatic = any("autouse=True" in ast.unparse(mark) for mark in node.decorator_list)
            runs = (
                (collected and node.name.startswith("test_"))
                or node.name in used
                or (fixture and (automatic or node.name in asked_for))
            )
            idle += [] if runs else [f"{path.name}:{node.name}"]
    assert idle == []


def house_files() -> Iterator[Path]:
    """Files of the project: neither what was made here nor what a tool left."""
    made = {"out", "dist", "build", "site", "__pycache__"}
    for path in ROOT.rglob("*"):
        parts = path.relative_to(ROOT).parts
        hidden = parts[0].startswith(".") and parts[0] not in {
            ".ci",
            ".github",
            ".gitignore",
            ".pre-commit-config.yaml",
        }
        if path.is_file() and not hidden and not made & set(parts):
            yield path


def test_no_file_names_a_registry_host_or_a_path_of_this_machine() -> None:
    host = rb"https?://[^\s\"']*(?:pypi|pythonhosted|/simple)|file://"
    place = rb"(?<![\w.~}])/(?:work|root|home|opt|tmp|mnt|Users)/\w"
    bad = [
        f"{path.relative_to(ROOT)}: {found[0]!r}"
        for path in house_files()
        for found in [re.search(host + rb"|" + place, path.read_bytes())]
        if found and path != Path(__file__)
    ]
    assert bad == []


def test_every_source_file_says_its_licence_in_its_first_lines() -> None:
    bad = [
        str(path.relative_to(ROOT))
        for path in house_files()
        if path.suffix in {".py", ".toml"} or path.name in {"Makefile", "run"}
        if b"# SPDX-License-Identifier: Apache-2.0" not in path.read_bytes()[:200]
    ]
    assert bad == []


def test_the_wheel_carries_every_schema(tmp_path: Path) -> None:
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    inside = {name for name in zipfile.ZipFile(wheel).namelist() if "/schemas/" in name}
    outside = {
        f"abyssnav/{path.relative_to(ROOT).as_posix()}"
        for path in (ROOT / "schemas").rglob("*")
        if path.is_file()
    }
    assert inside == outside
    assert outside


def test_the_readme_names_commands_options_and_targets_that_exist() -> None:
    from typer.main import get_command

    from abyssnav.cli import app

    command = get_command(app)
    commands = {**command.commands}  # type: ignore[attr-defined]
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^([a-z-]+):", makefile, re.MULTILINE))

    assert set(re.findall(r"\bmake ([a-z-]+)", "\n".join(code_in(text)))) <= targets
    named = set()
    for line in code_in(text):
        for name, rest in re.findall(r"(?<!import )\babyssnav ([a-z]+)([^\n#|]*)", line):
            assert name in commands, line
            named.add(name)
            known = {o for parameter in commands[name].params for o in parameter.opts}
            assert set(re.findall(r"(?<!\S)--?[a-z][a-z-]*", rest)) <= known | {"--help"}, line
    assert named == set(commands)


def test_every_command_and_every_option_has_help() -> None:
    from typer.main import get_command

    from abyssnav.cli import app

    for name, command in get_command(app).commands.items():  # type: ignore[attr-defined]
        assert command.help, name
        for parameter in command.params:
            assert getattr(parameter, "help", None), f"{name} {parameter.name}"


_UNIT = re.compile(r"_(s|ns|m|m2|mps|rad|deg|hz|db|dbar|pa|mb|px|bytes|m2_per_s|per_s)$")
_SHAPE = re.compile(r"\((\.\.\.|[a-z0-9]+|[a-z0-9.]+, ?[^)]*|[a-z0-9]+,)\)|Returns\n")


def without_shape_or_unit(module: str, tree: ast.Module, used: set[str]) -> list[str]:
    """Arrays that a function used by other rooms takes or gives without saying what they are."""
    bad = []
    for node in tree.body:
        if not isinstance(node, ast.FunctionDef) or node.name not in used:
            continue
        doc = ast.get_docstring(node) or ""
        for argument in (*node.args.args, *node.args.kwonlyargs):
            entry = re.search(rf"(^|\n)[\w, ]*\b{argument.arg}\b[\w, ]* : .", doc)
            if is_array(argument.annotation) and not entry and not _UNIT.search(argument.arg):
                bad.append(f"{module}.{node.name}({argument.arg})")
        if is_array(node.returns) and not _SHAPE.search(doc) and not _UNIT.search(node.name):
            bad.append(f"{module}.{node.name}")
    return bad


def is_array(annotation: ast.expr | None) -> bool:
    names = ast.walk(annotation) if annotation is not None else ()
    return any(isinstance(name, ast.Name) and name.id in {"Float", "Int", "Bool"} for name in names)


def used_by_other_rooms() -> set[str]:
    """Names that a room imports from another."""
    return {
        alias.name
        for module, tree in modules(PACKAGE)
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("abyssnav.")
        for alias in node.names
        if str(node.module).split(".")[1] != module.split(".")[0] and alias.name[0] != "_"
    }


def test_public_arrays_say_their_shape_and_unit() -> None:
    used = used_by_other_rooms()
    assert [
        bad for name, tree in modules(PACKAGE) for bad in without_shape_or_unit(name, tree, used)
    ] == []


@pytest.mark.parametrize(
    ("source", "bad"),
    [
        ('def turn(x: Float) -> None:\n    """Turn."""', ["m.turn(x)"]),
        ('def turn(angle_rad: Float) -> Float:\n    """Turn."""', ["m.turn"]),
        ('def turn(angle_rad: Float) -> Float:\n    """Turned (n, 3) m."""', []),
    ],
)
def test_an_array_without_shape_or_unit_is_refused(source: str, bad: list[str]) -> None:
    assert without_shape_or_unit("m", ast.parse(source), {"turn"}) == bad


def code_in(markdown: str) -> list[str]:
    """Lines of fenced blocks, and code within a line."""
    blocks = re.findall(r"```[a-z]*\n(.*?)```", markdown, re.DOTALL)
    rest = re.sub(r"```.*?```", "", markdown, flags=re.DOTALL)
    return [line for block in blocks for line in block.splitlines()] + re.findall(
        r"`([^`]+)`", rest
    )
