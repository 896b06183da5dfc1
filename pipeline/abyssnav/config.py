# SPDX-License-Identifier: Apache-2.0
"""Settings: every key with its default, unit and reason; unknown keys are refused."""

import difflib
import math
import re
import tomllib
from collections.abc import Iterator
from datetime import datetime
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from statistics import NormalDist
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin

import msgspec
from msgspec import Meta

from abyssnav.errors import ConfigError


class _Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pass


class Acoustics(_Settings, frozen=True):
    """The sound between vehicle and beacons."""

    #: Used when neither log nor config hold a profile.  The paper's nominal speed.
    #: Left out, it is 1500 m/s and hardly known.
    sound_speed_mps: float | None = None
    #: How wrong that speed or profile may be; left out, 1 m/s (a good CTD cast some days old), or
    #: 15 m/s where neither log nor settings give a speed or profile.
    sound_speed_sigma_mps: float | None = None
    #: Standard deviation of the two-way time: 1.5 m of one-way range.
    travel_time_sigma_s: float = 0.002
    #: Of the sound speed over depth where no profile is known: deep water's.  0 is the paper's
    #: constant.
    sound_speed_gradient_per_s: Annotated[float, Meta(ge=-0.1, le=0.1)] = 0.0165
    #: That the speed is for; left out, the mean depth of vehicle and beacons.
    sound_speed_depth_m: float | None = None
    #: Of the sea floor, for telling bottom bounces; nan: below the vehicle, by the DVL's altitude.
    floor_depth_m: float = math.nan


class Vehicle(_Settings, frozen=True):
    """Where the transducer sits."""

    #: Forward, starboard, down, from the navigated point; left out, none, and hardly known.
    transducer_offset_m: tuple[float, float, float] | None = None
    #: Of each axis of that; left out, 0.1 m where an offset is given and 1 m where none is.
    transducer_sigma_m: Annotated[float, Meta(ge=0)] | None = None

    @property
    def lever_arm_m(self) -> tuple[float, float, float]:
        """The offset, none where it is not given."""
        return self.transducer_offset_m or (0.0, 0.0, 0.0)

    @property
    def lever_sigma_m(self) -> float:
        """How well the offset is known."""
        if self.transducer_sigma_m is not None:
            return self.transducer_sigma_m
        return 1.0 if self.transducer_offset_m is None else 0.1


class StartRule(_Settings, frozen=True):
    """Where the methods begin: by M-of-N confirmation, Eqs. 4-5 (the paper gives no M and N).

    A start that is known (`position_m`) serves `ekf`, `smoother` and `dead_reckoning`.
    """

    m: int = 4
    n: int = 6
    v_min_mps: float = 0.0
    v_max_mps: float = 4.0
    a_max_mps2: float = 0.5
    #: Standard deviation of each axis at the start; larger lets a bottom bounce capture it.
    sigma_m: float = 10.0
    #: East and north of a start that is known.
    position_m: tuple[float, float] | None = None
    #: When the vehicle is there; left out, at the dive's first ping or position fix.
    at: datetime | None = None
    #: How `ekf` starts: `consensus` of single travel times, or the paper's `m_of_n`.
    ekf: Literal["consensus", "m_of_n"] = "consensus"


class Fix(_Settings, frozen=True):
    """Least-squares fix of one cycle."""

    #: Longest cycle, where a ping asks one beacon only.
    max_cycle_s: float = 60.0
    #: What `kf_fix` adds to each axis of a fix: the vehicle is not at rest between ping and reply.
    sigma_m: float = 2.0
    #: Gate of `kf_fix`: χ² of two degrees of freedom at 0.999.
    gamma: float = 13.8


class Gate(_Settings, frozen=True):
    """Chi-square gate on the normalised innovation squared, Eqs. 8-11."""

    #: 9.21 is the paper's number: P = 0.9976 for one degree of freedom.  inf = no gate.
    gamma: float = 9.21
    #: Length of the stretches in which the gate watches itself.
    stretch_s: float = 900.0
    #: Takes gamma's place when given, 0 < probability < 1; 0.998 gives 9.55.
    probability: float | None = None

    @property
    def threshold(self) -> float:
        """γ with P(χ²₁ ≤ γ) = probability, or `gamma` as it stands."""
        if self.probability is None:
            return self.gamma
        return NormalDist().inv_cdf(0.5 + 0.5 * self.probability) ** 2


class Process(_Settings, frozen=True):
    """Process noise of the two-state filters (Eq. 6) and of dead reckoning."""

    #: Heading error counted coherently over 60-190 s.  0.1 is finer but locks out at times.
    position_m2_per_s: float = 0.3
    #: Drift of the true velocity away from the one held while bottom lock is lost.
    gap_sigma_mps: float = 0.1
    #: Velocity stamps further apart than this are a gap, bridged as lost bottom lock.
    max_gap_s: float = 1.0


class SensorErrors(_Settings, frozen=True):
    """What `ekf` and `smoother` expect compass and DVL to do wrong, besides white noise."""

    #: Of each axis of a beacon's position whose sigma is 0 or not stated: a good survey by ranging
    #: from the surface.  0.001 for exact.
    beacon_sigma_m: Annotated[float, Meta(gt=0)] = 0.5
    #: Turn-around of each beacon, and one time common to all: clock, detector, cable.
    turn_around_sigma_s: float = 0.0003
    clock_sigma_s: float = 0.001
    #: Slow heading error (Gauss-Markov), and a constant one: compass or mounting of the DVL.
    heading_sigma_deg: float = 0.5
    heading_time_s: float = 600.0
    heading_offset_sigma_deg: float = 2.0
    #: First and second harmonic of the compass deviation; 0 leaves them out.
    deviation_sigma_deg: tuple[float, float] = (1.0, 0.4)
    dvl_scale_sigma: float = 0.004
    #: Slow error of the DVL, forward and starboard; how much larger it may be while bottom lock is
    #: lost is `process.gap_sigma_mps`.
    dvl_sigma_mps: float = 0.004
    dvl_time_s: float = 600.0
    #: Slow velocity in the earth frame, which a DVL on water track lacks.
    current_sigma_mps: float = 0.001
    current_time_s: float = 3600.0
    #: How the water changes during the dive.
    sound_slow_sigma_mps: float = 0.3
    sound_slow_time_s: float = 1800.0
    #: Process noise of the position: what the states above do not explain.
    position_m2_per_s: float = 0.001


class Output(_Settings, frozen=True):
    """What is written."""

    rate_hz: float = 1.0
    methods: tuple[str, ...] = ("all",)
    #: By name, `tracks.parquet` or `dive.rrd`; `summary.json` is always made.
    files: tuple[str, ...] = ("all",)


class BeaconSetting(_Settings, frozen=True):
    """One beacon, instead of the log's: ENU position, or latitude, longitude and depth."""

    id: int
    turn_around_s: float
    name: str = ""
    position_m: tuple[float, float, float] | None = None
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    depth_m: float | None = None
    sigma_m: float = 0.0
    #: From and until when it stands here, UTC; one number may come several times with these.
    from_: datetime | None = msgspec.field(name="from", default=None)
    until: datetime | None = None


class SoundSpeedSetting(_Settings, frozen=True):
    """Sound-speed profile, instead of the log's."""

    depth_m: tuple[float, ...]
    sound_speed_mps: tuple[float, ...]


class OriginSetting(_Settings, frozen=True):
    """Origin of the local frame, instead of the log's."""

    latitude_deg: float
    longitude_deg: float


class Config(_Settings, frozen=True):
    """All settings in force."""

    acoustics: Acoustics = Acoustics()
    vehicle: Vehicle = Vehicle()
    start: StartRule = StartRule()
    fix: Fix = Fix()
    gate: Gate = Gate()
    process: Process = Process()
    errors: SensorErrors = SensorErrors()
    output: Output = Output()
    beacon: tuple[BeaconSetting, ...] = ()
    sound_speed_profile: SoundSpeedSetting | None = None
    origin: OriginSetting | None = None


def schemas() -> Traversable:
    """Folder of message definitions, profiles and scenarios, in a wheel or a checkout."""
    inside = resources.files("abyssnav") / "schemas"
    return inside if inside.is_dir() else Path(__file__).parents[2] / "schemas"


S = TypeVar("S")


def settings_from_toml(text: str, where: str, kind: type[S]) -> S:
    """Decode TOML `text` into the settings struct `kind`.

    Raises
    ------
    ConfigError
        Not TOML, an unknown key (with the nearest known one), or a value of the wrong type; the
        message begins with `where`.
    """
    try:
        return msgspec.convert(tomllib.loads(text), kind)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{where}: not TOML: {error}") from None
    except msgspec.ValidationError as error:
        raise ConfigError(f"{where}: {_explain(str(error), kind)}") from None


def load_config(path: Path | None) -> Config:
    """Settings from a TOML file over the defaults; the defaults alone without a file.

    Raises
    ------
    ConfigError
        Unreadable file, unknown key, or a value out of its range.
    """
    if path is None:
        return Config()
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or error
        raise ConfigError(f"{path}: cannot be read: {why}") from None
    config = settings_from_toml(text, str(path), Config)
    for problem in _out_of_range(config):
        raise ConfigError(f"{path}: {problem}")
    return config


def on_earth(latitude_deg: float, longitude_deg: float) -> bool:
    """Whether there is such a place; longitudes may count to 180 or to 360."""
    return abs(latitude_deg) <= 90 and abs(longitude_deg) <= 360


def plain(settings: msgspec.Struct) -> dict[str, Any]:
    """Settings as plain values for JSON; infinities as the text `inf`, which TOML reads back."""

    def tame(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: tame(item) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return [tame(item) for item in value]
        return str(value) if isinstance(value, float) and not math.isfinite(value) else value

    return tame(msgspec.to_builtins(settings))  # type: ignore[no-any-return]


def _explain(message: str, kind: type[Any]) -> str:
    """Msgspec's message with what would have been right, where a key or a word is unknown."""
    word = re.search(r"Invalid enum value '([^']*)' - at `\$\.([^`]*)`", message)
    if word is not None:
        *tables, key = re.sub(r"\[[^]]*\]", "", word[2]).split(".")
        known = [str(known) for known in _choices(_hints_at(kind, tables)[key])]
        return f"[{'.'.join(tables)}] {key}: {word[1]!r} is none of {', '.join(known)}"
    unknown = re.search(r"unknown field `([^`]*)`(?: - at `\$\.?([^`]*)`)?", message)
    if unknown is None:
        return message
    key, path = unknown[1], re.sub(r"\[[^]]*\]", "", unknown[2] or "")
    known = _keys_at(kind, path.split(".") if path else [])
    nearest = difflib.get_close_matches(key, known, n=1, cutoff=0.0)
    place = f"[{path}] " if path else ""
    return f"unknown key {place}{key}" + (f"; nearest: {nearest[0]}" if nearest else "")


def _keys_at(kind: Any, path: list[str]) -> list[str]:
    """Return the keys of the struct that `path` leads to inside `kind`."""
    return list(_hints_at(kind, path))


def _hints_at(kind: Any, path: list[str]) -> dict[str, Any]:
    """Return key and type of the members of the struct that `path` leads to inside `kind`."""
    for part in path:
        kind = _struct_in(_hints_at(kind, [])[part])
    return {field.encode_name: field.type for field in msgspec.structs.fields(kind)}


def _choices(hint: Any) -> tuple[Any, ...]:
    """Return the values of the `Literal` in a hint."""
    if get_origin(hint) is Literal:
        return get_args(hint)
    return tuple(value for part in get_args(hint) for value in _choices(part))


def _struct_in(hint: Any) -> Any:
    """Return the struct inside `hint`, which may be optional, a tuple or a mapping of it."""
    if isinstance(hint, type) and issubclass(hint, msgspec.Struct):
        return hint
    inner = [_struct_in(part) for part in getattr(hint, "__args__", ()) if part is not Ellipsis]
    return next((struct for struct in inner if struct is not None), None)


def _out_of_range(config: Config) -> list[str]:
    """Name what no dive could be navigated with."""
    start, profile = config.start, config.sound_speed_profile
    rules = [
        (
            _positive(config.acoustics.sound_speed_mps),
            "[acoustics] sound_speed_mps must be above 0",
        ),
        (
            config.acoustics.travel_time_sigma_s > 0,
            "[acoustics] travel_time_sigma_s: not above 0",
        ),
        (
            (config.acoustics.sound_speed_sigma_mps or 0.0) >= 0,
            "[acoustics] sound_speed_sigma_mps: below 0",
        ),
        (3 <= start.m <= start.n, "[start] needs 3 <= m <= n: Eq. 5 compares three fixes"),
        (0 <= start.v_min_mps < start.v_max_mps, "[start] needs 0 <= v_min_mps < v_max_mps"),
        (start.a_max_mps2 > 0, "[start] a_max_mps2 must be above 0"),
        (start.sigma_m > 0, "[start] sigma_m must be above 0"),
        (config.fix.max_cycle_s > 0, "[fix] max_cycle_s must be above 0"),
        (config.fix.sigma_m >= 0, "[fix] sigma_m: below 0"),
        (config.fix.gamma > 0, "[fix] gamma must be above 0; inf for no gate"),
        (config.gate.stretch_s > 0, "[gate] stretch_s must be above 0"),
        (config.gate.gamma > 0, "[gate] gamma must be above 0; inf for no gate"),
        (0 < (config.gate.probability or 0.5) < 1, "[gate] probability must lie between 0 and 1"),
        (config.process.position_m2_per_s >= 0, "[process] position_m2_per_s: below 0"),
        (config.process.gap_sigma_mps > 0, "[process] gap_sigma_mps must be above 0"),
        (config.process.max_gap_s > 0, "[process] max_gap_s must be above 0"),
        (0 < config.output.rate_hz <= 1000, "[output] rate_hz must lie between 0 and 1000"),
        (
            profile is None
            or (
                len(profile.depth_m) == len(profile.sound_speed_mps) >= 1
                and all(a < b for a, b in zip(profile.depth_m, profile.depth_m[1:], strict=False))
                and min(profile.sound_speed_mps) > 0
            ),
            "[sound_speed_profile] needs rising depth_m and as many positive sound_speed_mps",
        ),
    ]
    problems = [problem for kept, problem in rules if not kept]
    return problems + [f"{what} is no latitude and longitude" for what in _nowhere(config)]


def _positive(value: float | None) -> bool:
    return value is None or value > 0


def _nowhere(config: Config) -> Iterator[str]:
    """Name places of the settings that are not on earth."""
    for beacon in config.beacon:
        place = beacon.latitude_deg or 0.0, beacon.longitude_deg or 0.0
        if not on_earth(*place):
            yield f"[[beacon]] {beacon.id}: {place[0]}, {place[1]}"
    origin = config.origin
    if origin is not None and not on_earth(origin.latitude_deg, origin.longitude_deg):
        yield f"[origin] {origin.latitude_deg}, {origin.longitude_deg}"
