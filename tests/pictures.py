# SPDX-License-Identifier: Apache-2.0
"""Pictures of a dive's recording and report, without a screen.

    python tests/pictures.py OUT/DIVE FOLDER

The recording and the messages need a Vulkan driver (Debian's `mesa-vulkan-drivers` draws in
software), the report Chromium and the package `playwright`, its print `pdftoppm`; Pillow makes the
pictures small.
"""

import argparse
import io
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from abyssnav.outputs.rerun.opening import opening_time_ns

SETTLE_S = 5.0
WIDTH_PX = 1600
#: Share of the width at which the panel of what is selected begins.
SELECTION_AT = 0.843


def bring_to_front(viewer: Any, kind: str) -> None:
    """Open the tab that holds the view of a kind."""
    blueprint = viewer.get_blueprint("recording").blueprint
    (view,) = (
        path
        for path, parts in blueprint.items()
        if parts.get("ViewBlueprint", {}).get("class_identifier") == kind
    )
    for parts in blueprint.values():
        tabs = parts.get("ContainerBlueprint", {})
        if view in tabs.get("contents", ()):
            tabs["active_tab"] = view
    viewer.set_blueprint(blueprint, "recording")


def watch_viewer(
    recording: Path, at_ns: int | None = None, tab: str = ""
) -> tuple[bytes, list[str]]:
    """Screenshot of the viewer as it opens, or at a time, and its warnings and errors."""
    from rerun.experimental import ViewerClient

    os.environ.setdefault("XDG_RUNTIME_DIR", tempfile.mkdtemp())
    os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with ViewerClient.spawn(headless=True, port=port, hide_welcome_screen=True) as viewer:
        viewer.open(str(recording.resolve()))
        time.sleep(SETTLE_S)
        if tab:
            bring_to_front(viewer, tab)
        if at_ns is not None:
            viewer.set_time("time", timestamp=np.datetime64(at_ns, "ns"), play_state="paused")
            time.sleep(1.0)
        png = viewer.take_screenshot()
        said = [entry.message for entry in viewer.get_logs() if entry.level in ("WARN", "ERROR")]
        return png, said


def browse(report: Path, draw: Callable[[Any], bytes], width_px: int, height_px: int) -> bytes:
    """What `draw` makes of the report, opened in a browser of that size with a light theme."""
    from playwright.sync_api import sync_playwright

    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    with sync_playwright() as engine:
        flags = ["--no-sandbox", "--disable-dev-shm-usage"]
        with engine.chromium.launch(executable_path=chromium, args=flags) as browser:
            page = browser.new_page(viewport={"width": width_px, "height": height_px})
            page.goto(report.resolve().as_uri())
            page.wait_for_selector("html[data-ready=yes]", state="attached")
            page.wait_for_timeout(1000)
            return draw(page)


def first_sheet(pdf: bytes) -> bytes:
    """The first page of a PDF as a picture, by poppler."""
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "report.pdf"
        path.write_bytes(pdf)
        command = ["pdftoppm", "-r", "100", "-singlefile", "-png", str(path), f"{place}/sheet"]
        subprocess.run(command, check=True)
        return (Path(place) / "sheet.png").read_bytes()


def without_selection(png: bytes) -> bytes:
    """The picture without the viewer's panel at the right: it shows where the file lies."""
    from PIL import Image

    out = io.BytesIO()
    with Image.open(io.BytesIO(png)) as whole:
        whole.crop((0, 0, round(SELECTION_AT * whole.width), whole.height)).save(out, "PNG")
    return out.getvalue()


def smaller(png: bytes) -> bytes:
    """The picture at most `WIDTH_PX` wide in 256 colours: a quarter of the bytes."""
    from PIL import Image

    with Image.open(io.BytesIO(png)) as whole:
        width_px = min(WIDTH_PX, whole.width)
        size = (width_px, round(whole.height * width_px / whole.width))
        small = whole.convert("RGB").resize(size, Image.Resampling.LANCZOS)
    # The default, median cut, turns thin lines grey: it spends its colours on the ground.
    few = small.quantize(256, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    out = io.BytesIO()
    few.save(out, "PNG", optimize=True)
    return out.getvalue()


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("dive", type=Path)
    arguments.add_argument("folder", type=Path)
    given = arguments.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    name = given.dive.resolve().name
    recording = smaller(watch_viewer(given.dive / "dive.rrd", opening_time_ns(given.dive))[0])
    (given.folder / f"{name}.png").write_bytes(recording)
    globe = watch_viewer(given.dive / "dive.rrd", opening_time_ns(given.dive), "Map")[0]
    (given.folder / f"{name}_map.png").write_bytes(smaller(globe))
    messages = without_selection(watch_viewer(given.dive / "solution.mcap")[0])
    (given.folder / f"{name}_mcap.png").write_bytes(smaller(messages))
    page = given.dive / "report.html"
    report = browse(page, lambda opened: opened.screenshot(), 1240, 1480)
    (given.folder / f"{name}_report.png").write_bytes(smaller(report))
    phone = browse(page, lambda opened: opened.screenshot(), 390, 1900)
    (given.folder / f"{name}_phone.png").write_bytes(smaller(phone))
    pdf = browse(page, lambda opened: opened.pdf(prefer_css_page_size=True), 1240, 1480)
    (given.folder / f"{name}_print.png").write_bytes(smaller(first_sheet(pdf)))


if __name__ == "__main__":
    main()
