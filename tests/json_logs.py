# SPDX-License-Identifier: Apache-2.0
"""Logs of four seconds in JSON under any profile, to try one key at a time."""

from pathlib import Path
from typing import Any

import numpy as np
from vehicles import json_channel

from abyssnav.formats.mcap.writer import write_mcap
from abyssnav.profile import profile_from_toml
from abyssnav.read import read
from abyssnav.tables import Log

START_NS = 1_700_000_000_000_000_000
SENSORS = """
[heading]
topic = "h"
time = "log_time"
heading = { field = "deg", unit = "deg" }
[velocity]
topic = "v"
time = "log_time"
velocity = ["v[0]", "v[1]", "v[2]"]
frame = "frd"
[depth]
topic = "d"
time = "log_time"
"""


def log_of(tmp_path: Path, text: str, **topics: list[dict[str, Any]]) -> Log:
    """A JSON log under a profile: three sensors, and the topics given at a second each."""
    seconds = START_NS + 10**9 * np.arange(4)
    rows = {
        "h": [{"deg": 90.0 + k} for k in range(4)],
        "v": [{"v": [1.0, 0.5, 0.1], "dt": 200, "mode": 1} for _ in range(4)],
        "d": [{"depth": 100.0 + k} for k in range(4)],
        **topics,
    }
    write_mcap(
        tmp_path / "a.mcap",
        [json_channel(topic, seconds[: len(one)], one) for topic, one in rows.items()],
    )
    return read([tmp_path / "a.mcap"], profile_from_toml(text, "test"))
