# SPDX-License-Identifier: Apache-2.0
"""Navigation for sonar processing: MB-System's format 9, and SBET where its fields are true."""

from pathlib import Path
from typing import Final

import numpy as np

from abyssnav.errors import ConfigError
from abyssnav.geometry import enu_to_body
from abyssnav.outputs.export.source import Exported, Table
from abyssnav.outputs.export.tabular import write_companions
from abyssnav.tables import Float, Int, utc_text

_KMH_PER_MPS: Final = 3.6


def write_nve(source: Exported, folder: Path) -> list[Path]:
    """One file a method in MB-System's navigation format 9, comment lines first; CSV of the rest.

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
    return [*paths, *write_companions(source, folder)]


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


#: An SBET has no header: what its seventeen numbers are stands in a text beside it.
_SBET_NOTE: Final = """\
SBET of dive {dive}, method {method}, by abyssnav {version}
{rows} records of 17 little-endian doubles, 136 bytes each, no header:
 1    time: GPS seconds since {week} (start of the GPS week of the first record;
      running on beyond 604800); UTC is {leap_s} s behind GPS time
 2,3  latitude, longitude, rad, WGS 84
 4    height above the ellipsoid, m: {surface_m} m of the water's surface, as given, less the depth
 5-7  velocity north, east, down, m/s (wander angle 0): over ground as the method estimates it;
      down by differences of the depth
 8-10 roll (starboard down), pitch (bow up), true heading, rad
11    wander angle, rad: 0
12-14 acceleration forward, starboard, down, m/s^2: differences of the velocity, turned into the
      vehicle's axes; without gravity; not measured by an accelerometer
15-17 angular rate about forward, starboard, down, rad/s: differences of the attitude, against the
      local level; without the Earth's rotation; not measured by a gyroscope
Differences are central, over the two neighbours of a row: means over {span_s:g} s.
"""
#: Instants, UTC, at which GPS time moved ahead of UTC by one second more.
_LEAPS: Final = np.array(
    ["1981-07", "1982-07", "1983-07", "1985-07", "1988-01", "1990-01", "1991-01", "1992-07",
     "1993-07", "1994-07", "1996-01", "1997-07", "1999-01", "2006-01", "2009-01", "2012-07",
     "2015-07", "2017-01"], "M8[ns]",
).view(np.int64)  # fmt: skip
_GPS_EPOCH_NS: Final = int(np.datetime64("1980-01-06", "ns").view(np.int64))
_WEEK_NS: Final = 7 * 86_400 * 10**9


def write_sbet(source: Exported, folder: Path) -> list[Path]:
    """One SBET a method, and a text beside it that says where each of its 17 fields comes from.

    Raises
    ------
    ConfigError
        A field that the dive cannot say truly: its height above the ellipsoid without that of the
        water's surface, its place without an origin, attitude or velocity that is not known in
        every row.
    """
    source.need_origin("SBET")
    if source.surface_height_m is None:
        raise ConfigError(
            f"{source.name}: SBET holds heights above the ellipsoid, and a dive knows its depth "
            "below the water's surface: give that surface's height by --surface-height-m"
        )
    paths = []
    for method, track in source.tracks.items():
        _refuse_unknown(source.name, method, track)
        leap_s = int(np.searchsorted(_LEAPS, track["time_ns"][0], side="right"))
        since_ns = track["time_ns"] + leap_s * 10**9 - _GPS_EPOCH_NS
        week_ns = since_ns[0] // _WEEK_NS * _WEEK_NS
        time_s = (since_ns - week_ns) / 1e9
        records = np.column_stack([time_s, *_sbet_fields(track, source.surface_height_m)])
        paths += [folder / f"{source.name}_{method}{end}" for end in (".sbet", "_sbet.txt")]
        paths[-2].write_bytes(records.astype("<f8").tobytes())
        note = _SBET_NOTE.format(
            dive=source.name, method=method, version=source.version, rows=len(time_s),
            week=utc_text(np.array([week_ns + _GPS_EPOCH_NS]), "s")[0].removesuffix("Z"),
            leap_s=leap_s, surface_m=source.surface_height_m,
            span_s=2 * float(np.median(np.diff(time_s))),
        )  # fmt: skip
        paths[-1].write_text(note, encoding="utf-8")
    return [*paths, *write_companions(source, folder)]


def _refuse_unknown(dive: str, method: str, track: Table) -> None:
    names = ("roll_rad", "pitch_rad", "heading_rad", "forward_mps", "starboard_mps")
    n_rows = len(track["time_ns"])
    if n_rows < 2 or track["time_ns"][0] < _GPS_EPOCH_NS:
        raise ConfigError(f"{dive}: no SBET of {method}: fewer than two rows, or before GPS time")
    for name in names:
        if unknown := int(np.isnan(track[name]).sum()):
            raise ConfigError(
                f"{dive}: no SBET of {method}: {name} is not known in {unknown:,} of {n_rows:,} "
                "rows; nve, csv and abyssnav pose hold what is known"
            )


def _sbet_fields(track: Table, surface_height_m: float) -> list[Float]:
    """All but the time: place, velocity, attitude, wander angle, acceleration, angular rate.

    With φ, θ, ψ roll, pitch and heading, the rates about the vehicle's axes are
        p = φ' - ψ' sin θ,  q = θ' cos φ + ψ' cos θ sin φ,  r = ψ' cos θ cos φ - θ' sin φ.
    """
    t_s = (track["time_ns"] - track["time_ns"][0]) / 1e9
    roll_rad, pitch_rad, heading_rad = (track[f"{k}_rad"] for k in ("roll", "pitch", "heading"))
    sin, cos = np.sin(heading_rad), np.cos(heading_rad)
    forward_mps, starboard_mps = track["forward_mps"], track["starboard_mps"]
    north_mps = forward_mps * cos - starboard_mps * sin
    east_mps = forward_mps * sin + starboard_mps * cos
    down_mps = np.gradient(track["depth_m"], t_s)
    change = [np.gradient(v, t_s) for v in (east_mps, north_mps, -down_mps)]
    acceleration = enu_to_body(np.column_stack(change), roll_rad, pitch_rad, heading_rad)
    rolling, pitching, turning = (
        np.gradient(np.unwrap(angle), t_s) for angle in (roll_rad, pitch_rad, heading_rad)
    )
    rates = (
        rolling - turning * np.sin(pitch_rad),
        pitching * np.cos(roll_rad) + turning * np.cos(pitch_rad) * np.sin(roll_rad),
        turning * np.cos(pitch_rad) * np.cos(roll_rad) - pitching * np.sin(roll_rad),
    )
    place = np.radians(track["latitude_deg"]), np.radians(track["longitude_deg"])
    height_m = surface_height_m - track["depth_m"]
    velocity = (north_mps, east_mps, down_mps)
    attitude = (roll_rad, pitch_rad, heading_rad, np.zeros(len(t_s)))
    return [*place, height_m, *velocity, *attitude, *acceleration.T, *rates]
