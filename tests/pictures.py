# SPDX-License-Identifier: Apache-2.0
"""Pictures of a recording, without a screen: python tests/pictures.py OUT/DIVE FOLDER [--views].

Needs a Vulkan driver; Debian's `mesa-vulkan-drivers` draws in software.
"""

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

SETTLE_S = 4.0


def picture_recording(recording: Path, folder: Path, views: bool) -> list[Path]:
    """Screenshot of the viewer as it opens, and of each visible view when asked."""
    from rerun.experimental import ViewerClient

    os.environ.setdefault("XDG_RUNTIME_DIR", tempfile.mkdtemp())
    os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    made = []
    with ViewerClient.spawn(headless=True, port=9899, hide_welcome_screen=True) as viewer:
        viewer.open(str(recording.resolve()))
        time.sleep(SETTLE_S)
        made.append(_write(folder / "recording.png", viewer.take_screenshot()))
        for view in viewer.get_state().views if views else ():
            try:
                png = viewer.take_screenshot(view.view_id)
            except ConnectionError:  # on a tab that is not open
                continue
            name = "".join(c if c.isalnum() else "_" for c in view.name)
            made.append(_write(folder / f"view_{name}.png", png))
    return made


def _write(path: Path, png: bytes) -> Path:
    path.write_bytes(png)
    return path


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("recording", type=Path)
    arguments.add_argument("folder", type=Path)
    arguments.add_argument("--views", action="store_true")
    given = arguments.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    for path in picture_recording(given.recording, given.folder, given.views):
        sys.stdout.write(f"{path}\n")
