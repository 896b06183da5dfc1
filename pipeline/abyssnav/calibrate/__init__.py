# SPDX-License-Identifier: Apache-2.0
"""`calibrate`: what is wrong with sensors and beacons, from the dives themselves."""

from abyssnav.calibrate.campaign import CalibrationResult, calibrate, estimate
from abyssnav.calibrate.page import page
from abyssnav.calibrate.settings_file import settings_text
from abyssnav.calibrate.write import write_calibration

__all__ = [
    "CalibrationResult",
    "calibrate",
    "estimate",
    "page",
    "settings_text",
    "write_calibration",
]
