# SPDX-License-Identifier: Apache-2.0
# ruff: noqa: T201
"""How right calibrations are, over simulated voyages: one line a kind of unknown.

python tests/calibration.py all 1-30
"""

import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from voyages import compass_as_read, evidence, right_values, voyage

from abyssnav.align import align, reference
from abyssnav.calibrate import estimate, settings_text
from abyssnav.calibrate.evidence import evidence_of_log
from abyssnav.calibrate.verdicts import DETERMINED, NOT_DETERMINED
from abyssnav.compare import compare
from abyssnav.config import BeaconSetting, Calibration, Config, Vehicle, load_config, schemas
from abyssnav.navigate import navigate
from abyssnav.profile import load_profile
from abyssnav.read import read
from abyssnav.simulate import Simulation, stated_settings, write_log
from abyssnav.tables import Log

_LAWN, _FIVE = "lawn_mower", ("lawn_mower", "transit", "circle", "meander", "lawn_mower")
_ARM = {"vehicle.transducer_offset_m": (4.0, -3.0, 0.0), "vehicle.offset_stated": False}
#: Patterns of a voyage's dives, and the keys of its scenario that differ from `nominal`.
SETS: Mapping[str, tuple[tuple[str, ...], Mapping[str, Any]]] = {
    "all": (
        _FIVE,
        {"duration_s": 7200.0, "beacons.survey_sigma_m": 1.0, "beacons.stated_sigma_m": 1.0,
         "vehicle.transducer_offset_m": (1.5, -0.8, 0.5),
         "vehicle.stated_offset_m": (1.4, -0.75, 0.5)},
    ),
    "outside": (
        (_LAWN, "transit", _LAWN, "meander"),
        {"duration_s": 7200.0, "compass.bias_deg": 8.0, "dvl.scale": 0.02,
         "compass.deviation_sigma_deg": (3.0, 1.0), "beacons.survey_sigma_m": 0.5,
         "beacons.one_displaced_m": 6.0, "beacons.one_turn_around_error_s": 0.004, **_ARM},
    ),
    "line": (
        ("transit",),
        {"duration_s": 3600.0, "vehicle.transit_turn_deg": 0.01, "vehicle.leg_m": (4e3, 5e3)},
    ),
    "hover": (("hover",), {"duration_s": 3600.0}),
    "far": ((_LAWN,), {"duration_s": 7200.0, "vehicle.centre_m": (5000.0, 3000.0)}),
    "lever": ((_LAWN,), {"duration_s": 10800.0, **_ARM}),
    "late": ((_LAWN,) * 5, {"duration_s": 10800.0, "clocks.heading_s": 0.3}),
}  # fmt: skip

_THREE = {"beacons.survey_sigma_m": 3.0, "beacons.stated_sigma_m": 3.0}
#: Voyages whose beacons are to be repaired.
REPAIRED: Mapping[str, Mapping[str, Any]] = {
    "usbl": {**_THREE, "position.usbl_period_s": 20.0, "position.usbl_sigma_m": 3.0},
    "one": {"beacons.one_displaced_m": 3.0, "beacons.stated_sigma_m": 0.2},
    "all3": _THREE,
}
_USBL = """
[position]
topic = "/usbl"
position = ["pose.pose.position.x", "pose.pose.position.y"]
frame = "enu"
sigma = 3.0
"""


def run(name: str, seeds: range) -> None:
    """Print what came of a set."""
    patterns, keys = SETS[name]
    misses: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for seed in seeds:
        dives = voyage(keys, [{"vehicle.pattern": pattern} for pattern in patterns], seed)
        config = stated_settings(dives[0])
        if not any(dives[0].scenario.vehicle.transducer_offset_m):
            config = msgspec.structs.replace(config, vehicle=Vehicle())
        result = estimate([evidence(d, f"dive_{i}", config) for i, d in enumerate(dives)], config)
        right = right_values(dives[0], config)
        for e in result.estimates:
            if e.verdict != NOT_DETERMINED:
                miss = e.value - right[e.kind.name, e.unknown.beacon_id]
                misses.setdefault((e.kind.name, e.verdict), []).append((miss, e.sigma))
    every = []
    for (kind, verdict), rows in sorted(misses.items()):
        miss, sigma = np.array(rows).T
        every += list(np.abs(miss / sigma)) if verdict == DETERMINED else []
        print(
            f"{kind:22s} {verdict:11s} {len(rows):4d} rms {np.sqrt(np.mean(miss**2)):9.5f} "
            f"sigma {np.sqrt(np.mean(sigma**2)):9.5f} in sigmas {_rms(miss / sigma):5.2f}"
        )
    far = np.array(every or [0.0])
    print(
        f"determined {len(every)}: {np.mean(far < 2):.3f} within 2 sigma, {np.mean(far < 3):.3f} 3"
    )


def repair(name: str, seeds: range) -> None:
    """Print how far beacons are off before and after, and what that does to a further dive."""
    keys = {"duration_s": 7200.0, **REPAIRED[name]}
    patterns = [{"vehicle.pattern": pattern} for pattern in (*_FIVE, _LAWN)]
    rows = []
    for seed in seeds:
        dives = voyage(keys, patterns, seed)
        with tempfile.TemporaryDirectory() as folder:
            logs = [_log(dive, Path(folder) / f"dive_{i}.mcap") for i, dive in enumerate(dives)]
            used = [evidence_of_log(log, Config()) for log in logs[:-1]]
            path = Path(folder) / "calibration.toml"
            path.write_text(settings_text(estimate(used, Config())))
            calibrated = load_config(path)
        true_m, stated_m = dives[0].truth.beacons.position_enu_m, dives[0].beacons.position_enu_m
        after_m = align(logs[-1], calibrated).beacons.position_enu_m
        off_m = [np.hypot(*(place - true_m)[:, :2].T).max() for place in (stated_m, after_m)]
        smoother_m = [_smoother_rms(logs[-1], c) for c in (calibrated, _knowing(dives[-1]))]
        rows.append([*off_m, smoother_m[0] / smoother_m[1]])
        print(seed, "worst beacon {:.2f} -> {:.2f} m; smoother x {:.2f}".format(*rows[-1]))
    print("median", np.median(rows, axis=0).round(2), "worst", np.max(rows, axis=0).round(2))


def _log(dive: Simulation, path: Path) -> Log:
    write_log(dive, path)
    profile = path.with_suffix(".toml")
    default = (schemas() / "profiles" / "default.toml").read_text(encoding="utf-8")
    profile.write_text(default + (_USBL if dive.scenario.position.usbl_period_s else ""))
    return read([path], load_profile(str(profile)))


def _smoother_rms(log: Log, config: Config) -> float:
    table = compare(navigate(align(log, config), config), reference(log))
    rows = (table.method == "smoother") & (table.reference == "truth")
    return float(table.rms_m[rows][0])


def _knowing(dive: Simulation) -> Config:
    """Settings of who knows the truth of compass, DVL and beacons."""
    bias_deg, *harmonics_deg = compass_as_read(dive)
    known = dive.truth.beacons
    errors = msgspec.structs.replace(
        Config().errors, beacon_sigma_m=0.01, heading_offset_sigma_deg=0.02,
        deviation_sigma_deg=(0.02, 0.02), dvl_scale_sigma=1e-4, turn_around_sigma_s=1e-5,
        clock_sigma_s=1e-5,
    )  # fmt: skip
    return Config(
        errors=errors,
        calibration=Calibration(
            heading_bias_deg=bias_deg, deviation_deg=tuple(harmonics_deg),
            dvl_scale=dive.truth.dvl.scale,
        ),
        beacon=tuple(
            BeaconSetting(id=number, turn_around_s=time_s, position_m=tuple(place), sigma_m=0.01)
            for number, time_s, place in zip(
                known.id.tolist(), known.turn_around_s.tolist(), known.position_enu_m.tolist(),
                strict=True,
            )
        ),
    )  # fmt: skip


def _rms(values: Any) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


if __name__ == "__main__":
    first, _, last = sys.argv[2].partition("-")
    wanted = repair if sys.argv[1] in REPAIRED else run
    wanted(sys.argv[1], range(int(first), int(last or first) + 1))
