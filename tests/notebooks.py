# SPDX-License-Identifier: Apache-2.0
"""Execute the notebooks of the documentation: `python tests/notebooks.py`."""

import os
import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient

ROOT = Path(__file__).parent.parent


def execute(path: Path) -> int:
    """Run all cells in the root of the checkout; how many there were."""
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(ROOT)}}).execute()
    return len(notebook.cells)


if __name__ == "__main__":
    os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    for path in sorted((ROOT / "docs/notebooks").glob("*.ipynb")):
        sys.stdout.write(f"{path.name}: {execute(path)} cells\n")
