# SPDX-License-Identifier: Apache-2.0
"""The table of faults in the docs names tests that are there, and all of those made for faults."""

import ast
import re
from pathlib import Path

import abyssnav

TESTS = Path(__file__).parent
TABLE = TESTS.parent / "docs" / "faults.md"
#: Files that hold nothing but faults: each of their tests is in the table.
WHOLE = (
    "test_endurance", "test_fuzz_formats", "test_hostile_logs", "test_hostile_machine",
    "test_kills", "test_metamorphic", "test_numbers", "test_safe_path",
)  # fmt: skip
#: The only module that unpickles, from the pipe to a process that it started itself.
UNPICKLES = "second_process.py"


def names_of_tests(name: str) -> set[str]:
    tree = ast.parse((TESTS / f"{name}.py").read_text(encoding="utf-8"))
    functions = [node.name for node in tree.body if isinstance(node, ast.FunctionDef)]
    return {function for function in functions if function.startswith("test_")}


def test_every_fault_in_the_table_has_its_test_and_every_such_test_its_fault() -> None:
    named = re.findall(r"\| `(test_\w+)`: `(test_\w+)` \|$", TABLE.read_text("utf-8"), re.MULTILINE)
    rows = [line for line in TABLE.read_text("utf-8").splitlines() if line.startswith("| ")]
    assert len(named) == len(rows) - rows.count("| fault | what happens | test |")
    assert len(named) == len(set(named))
    missing = [(file, test) for file, test in named if test not in names_of_tests(file)]
    assert missing == []
    left_out = {(file, test) for file in WHOLE for test in names_of_tests(file)} - set(named)
    assert left_out == set()


def test_nothing_that_came_from_a_file_or_a_network_is_unpickled_or_evaluated() -> None:
    for path in Path(abyssnav.__file__).parent.rglob("*.py"):
        nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
        imports = [node for node in nodes if isinstance(node, ast.Import | ast.ImportFrom)]
        names = {alias.name for node in imports for alias in node.names}
        unsafe = names & {"pickle", "marshal", "shelve", "dill", "cloudpickle", "yaml"}
        assert unsafe <= ({"pickle"} if path.name == UNPICKLES else set()), path
        called = [node.func for node in nodes if isinstance(node, ast.Call)]
        functions = {function.id for function in called if isinstance(function, ast.Name)}
        assert not functions & {"eval", "exec", "compile"}, path
        keywords = {node.arg for node in nodes if isinstance(node, ast.keyword)}
        assert "allow_pickle" not in keywords, path
