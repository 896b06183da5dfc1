# SPDX-License-Identifier: Apache-2.0
"""What README and docs tell a person to type: files to write, commands and scripts to run.

A fenced block whose first line (after a `#!`) is `# NAME.ext` or `-- NAME.ext` is a file that the
reader makes; of plain text that line is no part of it.  Blocks of `sh` are commands, of `python`
scripts; a comment `<!-- not run: REASON -->` above one says why no test runs it.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parent.parent
_FENCE = re.compile(
    r"(?:^<!-- not run: (?P<why>[^>]+) -->\n)?^```(?P<kind>\w*)\n(?P<text>.*?)^```$", re.M | re.S
)
_FILE = re.compile(r"(?:#!.*\n)?(?:#|--) (?P<name>[\w.-]+\.\w+)\n")


@dataclass(frozen=True)
class Block:
    """One fenced block of a page."""

    page: str
    kind: str
    text: str
    not_run: str  #: why no test runs it; empty: one does

    @property
    def file(self) -> str:
        """Name of the file that it is; empty when it is none."""
        match = _FILE.match(self.text)
        return match["name"] if match else ""

    def content(self) -> str:
        """What stands in that file."""
        return self.text.split("\n", 1)[1] if self.kind == "text" else self.text

    def commands(self) -> Iterator[str]:
        """Lines of a shell block without comments; a backslash joins two."""
        if self.kind == "sh":
            for line in self.text.replace("\\\n", " ").splitlines():
                command = re.sub(r"\s+#.*", "", line).strip()
                if command and not command.startswith("#"):
                    yield command


def pages() -> list[Path]:
    """README, and all pages but those that are made from the code."""
    found = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]
    return sorted(path for path in found if "Made from the code" not in path.read_text("utf-8"))


def blocks(path: Path) -> list[Block]:
    """The fenced blocks of a page, in order."""
    name = path.relative_to(ROOT).as_posix()
    text = path.read_text(encoding="utf-8")
    return [Block(name, m["kind"], m["text"], m["why"] or "") for m in _FENCE.finditer(text)]
