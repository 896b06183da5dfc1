# SPDX-License-Identifier: Apache-2.0
"""Sample dives under every Python of this machine, with one set of package versions: same bytes?

For each of python3.11 ... python3.14 in the path: an environment of its own with the packages that
this one has, the sample dives run in it, and their files compared with this one's.  It asks a
registry for the packages.  Not compared: the Rerun recording, which numbers itself, and the time
and memory that a run took.
"""

import json
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterable
from importlib.metadata import distribution, version
from pathlib import Path

ROOT = Path(__file__).parent.parent
DIVES = ("clean", "voyage_1", "voyage_2", "cut_short")
PYTHONS = ("python3.11", "python3.12", "python3.13", "python3.14")


def needed(requirements: Iterable[str], known: set[str]) -> set[str]:
    """Names of the packages that some requirements name, and that those need."""
    for requirement in requirements:
        needs, _, marker = requirement.partition(";")
        (package,) = re.findall(r"^[\w.-]+", needs)
        if "extra" in marker or package in known:
            continue
        try:
            further = distribution(package).requires or ()
        except ModuleNotFoundError:  # of another system
            continue
        known.add(package)
        known |= needed(further, known)
    return known


def run_all(python: Path, out: Path) -> None:
    program = (
        f"import sys; sys.path.insert(0, {str(ROOT / 'pipeline')!r}); "
        "from abyssnav.__main__ import main; main()"
    )
    for dive in DIVES:
        log = ROOT / "sample_logs" / f"{dive}.mcap"
        command = [str(python), "-P", "-c", program, "run", str(log), "-o", str(out), "-q"]
        subprocess.run(command, check=True)


def contents(folder: Path) -> dict[str, bytes]:
    """Each file that should be the same, by its name."""
    files = {str(path.relative_to(folder)): path for path in folder.glob("*/*")}
    texts = {name: path.read_bytes() for name, path in files.items() if path.suffix != ".rrd"}
    for name, text in texts.items():
        if name.endswith("summary.json"):
            summary = json.loads(text)
            del summary["timings_s"], summary["peak_memory_mb"]
            texts[name] = json.dumps(summary).encode()
    return texts


def compare(name: str, folder: Path, packages: list[str], own: dict[str, bytes]) -> bool:
    python = folder / name / "bin" / "python"
    subprocess.run([name, "-m", "venv", str(folder / name)], check=True)
    install = [str(python), "-m", "pip", "install", "-qq", "--disable-pip-version-check"]
    subprocess.run([*install, *packages], check=True)
    run_all(python, folder / f"{name}.out")
    other = contents(folder / f"{name}.out")
    odd = sorted(file for file in own.keys() | other.keys() if own.get(file) != other.get(file))
    sys.stdout.write(f"{name}: {len(own) - len(odd)} of {len(own)} files the same {odd[:5]}\n")
    sys.stdout.flush()
    return not odd


def main() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    packages = [f"{name}=={version(name)}" for name in needed(project["dependencies"], set())]
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        run_all(Path(sys.executable), folder / "own")
        own = contents(folder / "own")
        present = [name for name in PYTHONS if shutil.which(name)]
        same = [compare(name, folder, packages, own) for name in present]
    sys.exit(not all(same))


if __name__ == "__main__":
    main()
