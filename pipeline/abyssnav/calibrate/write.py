# SPDX-License-Identifier: Apache-2.0
"""A calibration as files: settings and a page beside them."""

from pathlib import Path

from abyssnav.atomic import atomic_file
from abyssnav.calibrate.campaign import CalibrationResult
from abyssnav.calibrate.page import page
from abyssnav.calibrate.settings_file import settings_text


def write_calibration(result: CalibrationResult, path: Path) -> Path:
    """Write the settings to `path` and the page beside it, whose place is returned.

    Raises
    ------
    OSError
        A file cannot be written.
    """
    text = settings_text(result)
    page_path = path.with_suffix(".html")
    for place, content in ((path, text), (page_path, page(result, text))):
        with atomic_file(place) as fresh:
            fresh.write_text(content, encoding="utf-8")
    return page_path
