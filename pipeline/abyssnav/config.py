# SPDX-License-Identifier: Apache-2.0
"""Settings: every key with its default, unit and reason; unknown keys are refused."""

import math
from collections.abc import Mapping
from datetime import datetime
from importlib import resources
from importlib.resources.abc import Traversable
from itertools import pairwise
from pathlib import Path
from statistics import NormalDist
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from abyssnav.errors import ConfigError
from abyssnav.settings import (
    Finite,
    Latitude,
    Longitude,
    NotNegative,
    Positive,
    Settings,
    Share,
    SigmaDegrees,
    settings_from_tables,
    tables_from_toml,
)

#: Natural water has 1400 to 1600 m/s; tanks and units that were mistaken are not far from it.
Speed = Annotated[float, Meta(ge=100, le=10_000)]
Degrees = Annotated[float, Meta(ge=-360, le=360)]
#: How late a stamp may be, s: an hour, as of a wrong time zone.
Late = Annotated[float, Meta(ge=-3600, le=3600)]
#: A gate's threshold; inf for no gate.
Gamma = Annotated[float, Meta(gt=0)]


class Acoustics(Settings, frozen=True):
    """The sound between vehicle and beacons."""

    #: Used when neither log nor config hold a profile.  The paper's nominal speed.
    #: Left out, it is 1500 m/s and hardly known.
    sound_speed_mps: Speed | None = None
    #: How wrong that speed or profile may be; left out, 1 m/s (a good CTD cast some days old), or
    #: 15 m/s where neither log nor settings give a speed or profile.
    sound_speed_sigma_mps: NotNegative | None = None
    #: Standard deviation of the two-way time: 1.5 m of one-way range.
    travel_time_sigma_s: Annotated[float, Meta(gt=0, le=10)] = 0.002
    #: Of the sound speed over depth where no profile is known: deep water's.  0 is the paper's
    #: constant.
    sound_speed_gradient_per_s: Annotated[float, Meta(ge=-0.1, le=0.1)] = 0.0165
    #: That the speed is for; left out, the mean depth of vehicle and beacons.
    sound_speed_depth_m: Finite | None = None
    #: Of the sea floor, for telling bottom bounces; left out, below the vehicle by
    #: the DVL's altitude.
    floor_depth_m: Finite | None = None


class Vehicle(Settings, frozen=True):
    """Where the transducer sits."""

    #: Forward, starboard, down, from the navigated point; left out, none, and hardly known.
    transducer_offset_m: tuple[Finite, Finite, Finite] | None = None
    #: Of each axis of that; left out, 0.1 m where an offset is given and 1 m where none is.
    transducer_sigma_m: NotNegative | None = None

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


class StartRule(Settings, frozen=True):
    """Where the methods begin: by M-of-N confirmation, Eqs. 4-5 (the paper gives no M and N).

    A start that is known (`position_m`) serves `ekf`, `smoother` and `dead_reckoning`.
    """

    #: The start is confirmed by this many fixes that fit together ...
    m: Annotated[int, Meta(ge=3, le=1000)] = 4
    #: ... among this many ping cycles in a row.
    n: Annotated[int, Meta(ge=3, le=1000)] = 6
    #: Slowest believable speed between two fixes.
    v_min_mps: NotNegative = 0.0
    #: Fastest believable speed between two fixes.
    v_max_mps: Positive = 4.0
    #: Largest believable acceleration between three fixes.
    a_max_mps2: Positive = 0.5
    #: Standard deviation of each axis at the start; larger lets a bottom bounce capture it.
    sigma_m: Positive = 10.0
    #: East and north of a start that is known, for `ekf`, `smoother` and `dead_reckoning`; its
    #: sigma is then `sigma_m`.
    position_m: tuple[Finite, Finite] | None = None
    #: When the vehicle is there; left out, at the dive's first ping or position fix.
    at: datetime | None = None
    #: How `ekf` starts: `consensus` of single travel times, or the paper's `m_of_n`.
    ekf: Literal["consensus", "m_of_n"] = "consensus"


class Fix(Settings, frozen=True):
    """Least-squares fix of one cycle."""

    #: Longest cycle, where a ping asks one beacon only.
    max_cycle_s: Positive = 60.0
    #: What `kf_fix` adds to each axis of a fix: the vehicle is not at rest between ping and reply.
    sigma_m: NotNegative = 2.0
    #: Gate of `kf_fix`: χ² of two degrees of freedom at 0.999.
    gamma: Gamma = 13.8


class Gate(Settings, frozen=True):
    """Chi-square gate on the normalised innovation squared, Eqs. 8-11."""

    #: 9.21 is the paper's number: P = 0.9976 for one degree of freedom.  inf = no gate.
    gamma: Gamma = 9.21
    #: Length of the stretches in which the gate watches itself.
    stretch_s: Positive = 900.0
    #: Takes gamma's place when given, 0 < probability < 1; 0.998 gives 9.55.
    probability: Share | None = None

    @property
    def threshold(self) -> float:
        """γ with P(χ²₁ ≤ γ) = probability, or `gamma` as it stands."""
        if self.probability is None:
            return self.gamma
        return NormalDist().inv_cdf(0.5 + 0.5 * self.probability) ** 2


class Process(Settings, frozen=True):
    """Process noise of the two-state filters (Eq. 6) and of dead reckoning."""

    #: Heading error counted coherently over 60-190 s.  0.1 is finer but locks out at times.
    position_m2_per_s: NotNegative = 0.3
    #: Drift of the true velocity away from the one held while bottom lock is lost.
    gap_sigma_mps: Positive = 0.1
    #: Velocity stamps further apart than this are a gap, bridged as lost bottom lock.
    max_gap_s: Positive = 1.0


class SensorErrors(Settings, frozen=True):
    """What `ekf` and `smoother` expect compass and DVL to do wrong, besides white noise."""

    #: Of each axis of a beacon's position whose sigma is 0 or not stated: a good survey by ranging
    #: from the surface.  0.001 for exact.
    beacon_sigma_m: Positive = 0.5
    #: Of each beacon's turn-around.
    turn_around_sigma_s: NotNegative = 0.0003
    #: Of a time common to all beacons: clock, detector, cable.
    clock_sigma_s: NotNegative = 0.001
    #: Slow heading error (Gauss-Markov).
    heading_sigma_deg: SigmaDegrees = 0.5
    #: How slowly it drifts.
    heading_time_s: Positive = 600.0
    #: Constant heading error, or the DVL's mounting angle.
    heading_offset_sigma_deg: SigmaDegrees = 2.0
    #: First and second harmonic of the compass deviation; 0 leaves them out.
    deviation_sigma_deg: tuple[SigmaDegrees, SigmaDegrees] = (1.0, 0.4)
    #: Scale error of the DVL.
    dvl_scale_sigma: Annotated[float, Meta(ge=0, le=1)] = 0.004
    #: Slow error of the DVL, forward and starboard; how much larger it may be while bottom lock is
    #: lost is `process.gap_sigma_mps`.
    dvl_sigma_mps: NotNegative = 0.004
    #: How slowly it drifts.
    dvl_time_s: Positive = 600.0
    #: Slow velocity in the earth frame, which a DVL on water track lacks.
    current_sigma_mps: NotNegative = 0.001
    #: How slowly it drifts.
    current_time_s: Positive = 3600.0
    #: How the sound speed changes during the dive.
    sound_slow_sigma_mps: NotNegative = 0.3
    #: How slowly.
    sound_slow_time_s: Positive = 1800.0
    #: Process noise of the position: what the states above do not explain.
    position_m2_per_s: NotNegative = 0.001


class Latency(Settings, frozen=True):
    """How late the stamps are: stamp less true time, s."""

    #: Of the compass.
    heading: Late = 0.0
    #: Of the DVL.
    velocity: Late = 0.0
    #: Of pings and replies alike: the travel time itself stays.
    travel_time: Late = 0.0


class Calibration(Settings, frozen=True):
    """Errors of the sensors that are known, as `abyssnav calibrate` writes them.

    They are taken out before anything is navigated; how well they are known stands under
    `[errors]`.
    """

    #: Compass reading less true heading, the same on every heading.
    heading_bias_deg: Degrees = 0.0
    #: And by heading: a1 sin ψ + b1 cos ψ + a2 sin 2ψ + b2 cos 2ψ, with ψ as read.
    deviation_deg: tuple[Degrees, Degrees, Degrees, Degrees] = (0.0, 0.0, 0.0, 0.0)
    #: The DVL reads 1 + dvl_scale times the true velocity.
    dvl_scale: Annotated[float, Meta(ge=-0.9, le=9)] = 0.0
    #: Of the DVL, on top of the profile's: Rz Ry Rx takes its vectors to the vehicle's.
    mount_rpy_deg: tuple[Degrees, Degrees, Degrees] = (0.0, 0.0, 0.0)
    #: How late the stamps of each are; taken off.
    latency_s: Latency = Latency()
    #: Speed or profile as logged or set over the true one, less one.
    sound_speed_scale: Annotated[float, Meta(ge=-0.2, le=0.2)] = 0.0


class Output(Settings, frozen=True):
    """What is written."""

    #: Rows a second in `tracks.parquet`; never moves an estimate.
    rate_hz: Annotated[float, Meta(ge=1e-4, le=1000)] = 1.0
    #: Methods to run, by name, or all.
    methods: Annotated[tuple[str, ...], Meta(min_length=1)] = ("all",)
    #: By name, `tracks.parquet` or `dive.rrd`; `summary.json` is always made.
    files: Annotated[tuple[str, ...], Meta(min_length=1)] = ("all",)


class Attribution(Settings, frozen=True):
    """Who made the data and how they may be used, by the names of ACDD 1.3; no program can know it.

    What is given stands in the report and among the attributes of netCDF; the rest is left out.
    """

    #: Person, group or institution principally responsible.
    creator_name: str = ""
    #: Which of these it is.
    creator_type: Literal["", "person", "group", "institution", "position"] = ""
    #: Of the creator.
    creator_email: str = ""
    #: Of the creator: a page, or an ORCID.
    creator_url: str = ""
    #: Where the data were made.
    institution: str = ""
    #: Scientific or commercial project.
    project: str = ""
    #: Larger undertaking that the project is part of.
    program: str = ""
    #: Terms of use: a URL, the name of a standard licence, or words.
    license: str = ""
    #: Who supported it.
    acknowledgement: str = ""
    #: Who hands the data out.
    publisher_name: str = ""
    #: Of the publisher.
    publisher_email: str = ""
    #: Of the publisher.
    publisher_url: str = ""
    #: For whom the dive's name is an identifier, as a reverse domain: `org.example`.
    naming_authority: str = ""


class BeaconSetting(Settings, frozen=True):
    """One beacon, instead of the log's: ENU position, or latitude, longitude and depth."""

    #: Number that its replies carry.
    id: Annotated[int, Meta(ge=-(1 << 31), le=(1 << 32) - 1)]
    #: From interrogation to reply, in the beacon.
    turn_around_s: Annotated[float, Meta(ge=-100, le=1000)]
    #: As people know it.
    name: str = ""
    #: East, north, up from the origin.
    position_m: tuple[Finite, Finite, Finite] | None = None
    #: WGS 84, with longitude and depth, in place of `position_m`.
    latitude_deg: Latitude | None = None
    #: WGS 84.
    longitude_deg: Longitude | None = None
    #: Positive down.
    depth_m: Finite | None = None
    #: Standard deviation of each axis of its position; 0: not stated.
    sigma_m: NotNegative = 0.0
    #: From when it stands here, UTC; one number may come several times with these.
    from_: datetime | None = msgspec.field(name="from", default=None)
    #: Until when.
    until: datetime | None = None


class SoundSpeedSetting(Settings, frozen=True):
    """Sound-speed profile, instead of the log's."""

    #: Rising.
    depth_m: Annotated[tuple[Finite, ...], Meta(min_length=1)]
    #: At each of those depths; linear between.
    sound_speed_mps: Annotated[tuple[Speed, ...], Meta(min_length=1)]


class OriginSetting(Settings, frozen=True):
    """Origin of the local frame, instead of the log's."""

    #: WGS 84.
    latitude_deg: Latitude
    #: WGS 84.
    longitude_deg: Longitude


class Config(Settings, frozen=True):
    """All settings in force."""

    acoustics: Acoustics = Acoustics()
    vehicle: Vehicle = Vehicle()
    start: StartRule = StartRule()
    fix: Fix = Fix()
    gate: Gate = Gate()
    process: Process = Process()
    errors: SensorErrors = SensorErrors()
    calibration: Calibration = Calibration()
    output: Output = Output()
    attribution: Attribution = Attribution()
    beacon: tuple[BeaconSetting, ...] = ()
    sound_speed_profile: SoundSpeedSetting | None = None
    origin: OriginSetting | None = None


def schemas() -> Traversable:
    """Folder of message definitions, profiles and scenarios, in a wheel or a checkout."""
    inside = resources.files("abyssnav") / "schemas"
    return inside if inside.is_dir() else Path(__file__).parents[2] / "schemas"


def load_config(*paths: Path | None) -> Config:
    """Settings from TOML files over the defaults, of which the later wins key by key.

    An array of tables (`[[beacon]]`) takes the place of an earlier one as a whole.

    Raises
    ------
    ConfigError
        Unreadable file, unknown key, a value out of its range, or values that contradict.
    """
    merged: dict[str, Any] = {}
    config, where = Config(), "settings"
    for path in paths:
        if path is None:
            continue
        where = str(path)
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            why = getattr(error, "strerror", None) or error
            raise ConfigError(f"{path}: cannot be read: {why}") from None
        merged = _overlaid(merged, tables_from_toml(text, where))
        config = settings_from_tables(merged, where, Config)
    return _consistent(config, where)


def config_from_tables(below: Config, tables: Mapping[str, Any], where: str) -> Config:
    """Settings with these tables, as TOML would have them, written over them key by key.

    Raises
    ------
    ConfigError
        As of `load_config`; the message begins with `where`.
    """
    merged = _overlaid(msgspec.to_builtins(below), tables)
    return _consistent(settings_from_tables(merged, where, Config), where)


def _consistent(config: Config, where: str) -> Config:
    for problem in _contradictions(config):
        raise ConfigError(f"{where}: {problem}")
    return config


def _overlaid(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Tables with those above written over them, key by key."""
    merged = dict(below)
    for key, value in above.items():
        earlier = merged.get(key)
        both = isinstance(earlier, Mapping) and isinstance(value, Mapping)
        merged[key] = _overlaid(earlier, value) if both else value  # type: ignore[arg-type]
    return merged


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


def _contradictions(config: Config) -> list[str]:
    """Name settings that are right one by one and not together."""
    start, profile = config.start, config.sound_speed_profile
    rules = [
        (start.m <= start.n, "[start] needs 3 <= m <= n: Eq. 5 compares three fixes"),
        (start.v_min_mps < start.v_max_mps, "[start] needs 0 <= v_min_mps < v_max_mps"),
        (
            profile is None
            or (
                len(profile.depth_m) == len(profile.sound_speed_mps)
                and all(a < b for a, b in pairwise(profile.depth_m))
            ),
            "[sound_speed_profile] needs rising depth_m and as many sound_speed_mps",
        ),
    ]
    return [problem for kept, problem in rules if not kept]
