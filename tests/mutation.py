# SPDX-License-Identifier: Apache-2.0
"""Mutation testing: which small falsifications do the tests not notice?

`python tests/mutation.py --sample 40 --seed 1` takes a sample of all places of the estimation, or
of the rooms named, where an operator, a comparison or a number can be changed, changes one at a
time in a copy of the checkout, and runs the tests of that module until one fails.  A mutant that
none of them notices has survived.
"""

import argparse
import ast
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

ROOT = Path(__file__).parent.parent
PACKAGE = Path("pipeline/abyssnav")
SWAPS: dict[type, type] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
    ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt,
    ast.Eq: ast.NotEq, ast.NotEq: ast.Eq, ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip


@dataclass(frozen=True)
class Mutant:
    """One change of one module."""

    module: str  #: its file, below the package
    line: int
    number: int  #: of the place in the module, in the order of the walk
    what: str


def places(tree: ast.Module) -> Iterator[tuple[ast.AST, str]]:
    """Nodes that can be changed, and what would be."""
    for node in ast.walk(tree):
        if isinstance(node, ast.BinOp | ast.BoolOp) and type(node.op) in SWAPS:
            yield node, f"{type(node.op).__name__} -> {SWAPS[type(node.op)].__name__}"
        elif isinstance(node, ast.Compare) and type(node.ops[0]) in SWAPS:
            yield node, f"{type(node.ops[0]).__name__} -> {SWAPS[type(node.ops[0])].__name__}"
        elif isinstance(node, ast.Constant) and type(node.value) is float and node.value:
            yield node, f"{node.value} -> {node.value * 1.5}"


def change(node: ast.AST) -> None:
    """Falsify the node where it stands."""
    if isinstance(node, ast.BinOp | ast.BoolOp):
        node.op = SWAPS[type(node.op)]()
    elif isinstance(node, ast.Compare):
        node.ops[0] = SWAPS[type(node.ops[0])]()
    elif isinstance(node, ast.Constant):
        assert isinstance(node.value, float)
        node.value *= 1.5


def all_mutants(rooms: Sequence[str]) -> list[Mutant]:
    """Every change that could be made in these folders of the package."""
    below = ROOT / PACKAGE
    return [
        Mutant(path.relative_to(below).as_posix(), getattr(node, "lineno", 0), number, what)
        for room in rooms
        for path in sorted((below / room).rglob("*.py"))
        for number, (node, what) in enumerate(places(ast.parse(path.read_text("utf-8"))))
    ]


def tests_of(module: str) -> list[str]:
    """The module's own tests first, then those that import it, then those of its room: four.

    Of the last those come first that import most of the room; what never does is not asked.
    """
    path = Path(module)
    dotted = ".".join(path.with_suffix("").parts).removesuffix(".__init__")
    room = path.parts[0]
    texts = {
        test.relative_to(ROOT).as_posix(): test.read_text("utf-8")
        for test in sorted((ROOT / "tests").glob("test_*.py"))
    }
    imports = {test: text.count(f"\nfrom abyssnav.{room}") for test, text in texts.items()}
    nearby = sorted((test for test in texts if imports[test]), key=lambda test: -imports[test])
    own = [f"tests/test_{name}.py" for name in (path.stem, room)]
    direct = [test for test in nearby if f"abyssnav.{dotted} import" in texts[test]]
    return list(dict.fromkeys([*(test for test in own if test in nearby), *direct, *nearby]))[:4]


def outcome(mutant: Mutant, tree: Path, limit_s: float) -> str:
    """`killed`, `survived` or `timeout` of one mutant in a copy of the checkout."""
    path = tree / PACKAGE / mutant.module
    source = path.read_text(encoding="utf-8")
    parsed = ast.parse(source)
    node, _ = list(places(parsed))[mutant.number]
    change(node)
    path.write_text(ast.unparse(parsed), encoding="utf-8")
    options = ["-q", "-x", "-m", "not slow and not network and not pages", "-p", "no:cacheprovider"]
    command = [sys.executable, "-P", "-m", "pytest", *options, *tests_of(mutant.module)]
    environment = {"PYTHONPATH": str(tree / "pipeline"), "PATH": "/usr/bin:/bin"}
    try:
        ended = subprocess.run(
            command, cwd=tree, env=environment, capture_output=True, timeout=limit_s, check=False
        )
    except subprocess.TimeoutExpired:
        return "timeout"
    finally:
        path.write_text(source, encoding="utf-8")
    return "survived" if ended.returncode == 0 else "killed"


def main() -> None:
    options = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    options.add_argument("rooms", nargs="*", default=["estimation"], help="of the package")
    options.add_argument("--sample", type=int, default=40)
    options.add_argument("--seed", type=int, default=1)
    options.add_argument("--minutes", type=float, default=10.0, help="stop after so many")
    given = options.parse_args()
    mutants = all_mutants(given.rooms)
    sample = random.Random(given.seed).sample(mutants, min(given.sample, len(mutants)))
    counts: dict[str, int] = {}
    began = perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        left_out = shutil.ignore_patterns(".git", ".venv", "out", "site", ".*_cache")
        shutil.copytree(ROOT, tree, ignore=left_out)
        for mutant in sample:
            if perf_counter() - began > given.minutes * 60:
                break
            result = outcome(mutant, tree, limit_s=120.0)
            counts[result] = counts.get(result, 0) + 1
            line = f"{result:9}{mutant.module}:{mutant.line}  {mutant.what}"
            sys.stdout.write(line + "\n")
            sys.stdout.flush()
    sys.stdout.write(f"{counts} of {len(mutants)} places\n")


if __name__ == "__main__":
    main()
