# SPDX-License-Identifier: Apache-2.0
"""Navigation for sonar processing: MB-System's format 9, and SBET where its fields are true."""

from pathlib import Path
from typing import Final

import numpy as np

from abyssnav.errors import ConfigError
from abyssnav.outputs.export.source import Exported
from abyssnav.tables import Int, utc_text

_KMH_PER_MPS: Final = 3.6


def write_nve(source: Exported, folder: Path) -> list[Path]:
    """One file a method in MB-System's navigation format 9, comment lines first.

    Year, month, day, hour, minute and second; the same in seconds since 1970; longitude and
    latitude in degrees; heading in degrees; speed over ground in km/h; draft, that is the depth, in
    metres; roll (starboard down) and pitch (bow up) in degrees; heave, which is in the depth, 0.
    """
    source.need_origin("nve")
    paths = []
    for method, track in source.tracks.items():
        speed_kmh = _KMH_PER_MPS * np.hypot(track["forward_mps"], track["starboard_mps"])
        degrees = [np.degrees(track[f"{name}_rad"]) for name in ("heading", "roll", "pitch")]
        numbers = np.column_stack(
            [track["longitude_deg"], track["latitude_deg"], degrees[0], speed_kmh,
             track["depth_m"], degrees[1], degrees[2]]
        )  # fmt: skip
        paths.append(folder / f"{source.name}_{method}.nve")
        with paths[-1].open("w", encoding="ascii") as file:
            file.write(f"# abyssnav {source.version}, dive {source.name!a}, {method}\n")
            file.write("# yyyy mm dd hh mm ss.ssssss epoch lon lat heading km/h draft roll pitch ")
            file.write("heave; draft: m below the water's surface\n")
            stamps, epochs = _stamps(track["time_ns"])
            for stamp, epoch, row in zip(stamps, epochs, numbers.tolist(), strict=True):
                place = "{:.9f} {:.9f} {:.4f} {:.4f} {:.4f} {:.4f} {:.4f}".format(*row)
                file.write(f"{stamp} {epoch} {place} 0.000\n")
    return paths


def _stamps(time_ns: Int) -> tuple[list[str], list[str]]:
    """`yyyy mm dd hh mm ss.ssssss`, and seconds since 1970."""
    rounded_ns = (time_ns + 500) // 1000 * 1000
    texts = utc_text(rounded_ns, "us")
    blanks = str.maketrans({"-": " ", "T": " ", ":": " ", "Z": ""})
    whole_s, rest_ns = np.divmod(rounded_ns, 1_000_000_000)
    epochs = [
        f"{s}.{us:06d}" for s, us in zip(whole_s.tolist(), (rest_ns // 1000).tolist(), strict=True)
    ]
    return [text.translate(blanks) for text in texts], epochs


def write_sbet(source: Exported, _: Path) -> list[Path]:
    """Refuse: an SBET states what no dive here measured.

    Raises
    ------
    ConfigError
        Always: its altitude is above the ellipsoid, while a dive knows its depth below the water's
        surface; and its accelerations and angular rates are those of an inertial unit.
    """
    raise ConfigError(
        f"{source.name}: no SBET: it holds heights above the ellipsoid, accelerations and angular "
        "rates, none of which the dive measured; nve, csv and abyssnav pose hold what is known"
    )
