# SPDX-License-Identifier: Apache-2.0
"""Scenarios: every key of a simulated dive with its default, unit and reason.

The defaults are a 6,000 m vehicle 80 m above a rough floor at 5,000 m, four beacons about 2 km
away, a TCM-class compass and a DVL of 0.4 %; of the replies none is missing or grossly wrong.
Keys named `stated_` are what the log or the settings say; the others are what is true.
"""

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
import numpy as np
from msgspec import Meta

from abyssnav.config import schemas
from abyssnav.errors import ConfigError, nearest_names
from abyssnav.settings import settings_from_toml

Share = Annotated[float, Meta(ge=0, le=1)]
#: Metres, seconds, degrees: no dive has larger ones, and none has NaN or infinity.
Number = Annotated[float, Meta(ge=-1e7, le=1e7)]
Positive = Annotated[float, Meta(gt=0, le=1e7)]
NotNegative = Annotated[float, Meta(ge=0, le=1e7)]
Rate = Annotated[float, Meta(gt=0, le=1000)]
Span = tuple[Positive, Positive]
S = TypeVar("S", bound=msgspec.Struct)
Clock = Annotated[float, Meta(ge=-3600, le=3600)]


class _Part(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pass


class Vehicle(_Part, frozen=True):
    """How the vehicle runs."""

    #: Lawn-mower of parallel legs, transit of long legs with small turns, one circle, a meander
    #: whose turn rate wanders, or hovering on the spot.
    pattern: Literal["lawn_mower", "transit", "circle", "meander", "hover"] = "lawn_mower"
    #: Middle of the pattern, east and north of the origin, around which the beacons lie.
    centre_m: tuple[Number, Number] = (0.0, 0.0)
    #: Lowest and highest speed over ground; each leg has its own in between.
    speed_mps: Span = (1.1, 1.3)
    #: Shortest and longest leg; one length a dive.
    leg_m: Span = (900.0, 1600.0)
    #: Between the legs of a lawn-mower: a common side-scan swath.
    spacing_m: Positive = 150.0
    #: Of the circle.
    radius_m: Positive = 500.0
    #: In turns; 3 deg/s at 1.2 m/s is a radius of 23 m.
    turn_rate_deg_per_s: Annotated[float, Meta(gt=0, le=20)] = 3.0
    #: Largest change of course between the legs of a transit.
    transit_turn_deg: NotNegative = 30.0
    #: Of a meander: standard deviation of its turn rate, and for how long that stays alike.
    meander_deg_per_s: Annotated[float, Meta(gt=0, le=20)] = 0.5
    meander_time_s: Positive = 60.0
    #: How far hovering strays from its spot, standard deviation of each axis.
    hover_m: Positive = 1.0
    #: Time in which a turn or a change of speed sets in.
    settle_s: Positive = 10.0
    #: Above the floor; the vehicle follows the relief.
    altitude_m: Positive = 80.0
    #: Of the water, east and north: the vehicle crabs to keep its course.
    current_mps: tuple[Number, Number] = (0.04, -0.03)
    #: Transducer forward, starboard, down of the navigated point.
    transducer_offset_m: tuple[Number, Number, Number] = (0.0, 0.0, 0.0)
    #: What the settings say of that, where they say anything; not given: the truth.
    stated_offset_m: tuple[Number, Number, Number] | None = None
    offset_stated: bool = True
    #: The dive's first and last so many seconds lead in a spiral from and to that depth.
    descent_s: NotNegative = 0.0
    ascent_s: NotNegative = 0.0
    surface_m: NotNegative = 0.0
    #: So much of either way is spent there.
    surface_s: NotNegative = 0.0
    #: Of the spiral.
    spiral_m: Positive = 100.0


class Floor(_Part, frozen=True):
    """The sea floor."""

    #: Mean depth, within reach of a 6,000 m vehicle and of the recorded sound-speed profile.
    depth_m: Annotated[float, Meta(gt=0, le=6000)] = 5000.0
    #: The relief stays within plus and minus this.
    relief_m: NotNegative = 70.0
    #: Shortest wave of the relief; with 70 m the steepest slope stays below some 10 degrees.
    wavelength_m: Positive = 1500.0


class Beacons(_Part, frozen=True):
    """Transponders around the origin."""

    count: Annotated[int, Meta(ge=1, le=12)] = 4
    #: Evenly around the origin; on a line of twice `distance_m` that passes the origin at a quarter
    #: of it; or all within `cluster_m` of a place at that distance.
    layout: Literal["ring", "line", "cluster"] = "ring"
    #: Horizontal distance from the origin, each within 15 % of it.
    distance_m: Positive = 2000.0
    cluster_m: Positive = 400.0
    #: Shortest and longest mooring line: height above the floor.
    mooring_m: Span = (30.0, 80.0)
    #: Turn-around of the first beacon, and how much longer that of each next one is.
    turn_around_s: Positive = 0.2
    turn_around_step_s: NotNegative = 0.06
    #: How wrong the recorded positions are, standard deviation of each axis.
    survey_sigma_m: NotNegative = 0.2
    #: What the log says of that; not given: the truth; 0 is how a log says nothing.
    stated_sigma_m: NotNegative | None = None
    #: One beacon more, drawn by the seed, lies so far off to a side; one moves so far at a time.
    one_displaced_m: NotNegative = 0.0
    one_moved_m: NotNegative = 0.0
    one_moved_at_s: NotNegative = 0.0
    #: True minus recorded turn-around: each beacon's and all beacons' standard deviation, what is
    #: common to all, and what one beacon, drawn by the seed, has on top.
    turn_around_sigma_s: NotNegative = 0.0
    turn_around_common_sigma_s: NotNegative = 0.0
    turn_around_error_s: Number = 0.0
    one_turn_around_error_s: Number = 0.0


class Buoys(_Part, frozen=True):
    """Beacons that hang below drifting buoys, whose GNSS the log holds, instead of moored ones."""

    #: Mean speed, each to a side of its own; 0: the beacons are moored.
    drift_mps: NotNegative = 0.0
    #: Of the transducers below the surface.
    depth_m: Positive = 8.0
    #: Of the logged positions.
    period_s: Positive = 30.0
    gnss_sigma_m: NotNegative = 1.5


class Sound(_Part, frozen=True):
    """Sound speed, and how wrong the recorded one is."""

    #: Munk's canonical profile, one gradient, or one speed, which no log holds.
    profile: Literal["munk", "linear", "constant"] = "munk"
    #: The constant; of one gradient, the speed at the floor's mean depth.
    speed_mps: Positive = 1500.0
    gradient_per_s: Number = 0.0165
    #: Whether the log holds the profile.
    logged: bool = True
    #: The one speed of the settings where the log holds none; not given: right (but for the errors
    #: below) between the vehicle and the beacons.
    stated_speed_mps: Positive | None = None
    #: Recorded (or assumed) minus true: this much and a random part.  1 m/s is a cast days old.
    error_mps: Number = 0.0
    error_sigma_mps: NotNegative = 1.0
    #: By how much the recorded profile has the wrong shape, standard deviation over depth.
    shape_sigma_mps: NotNegative = 0.0
    #: Slow drift of the true speed (Gauss-Markov) and its correlation time.
    slow_sigma_mps: NotNegative = 0.0
    slow_time_s: Positive = 1800.0


class Compass(_Part, frozen=True):
    """Heading: reads true + bias + a₁ sin ψ + b₁ cos ψ + a₂ sin 2ψ + b₂ cos 2ψ + slow + white."""

    rate_hz: Rate = 10.0
    #: Mean and standard deviation of the bias: a constant heading offset.
    bias_deg: Number = 0.0
    bias_sigma_deg: NotNegative = 1.5
    #: Standard deviation of a₁, b₁ (hard iron) and of a₂, b₂ (soft iron).
    deviation_sigma_deg: tuple[NotNegative, NotNegative] = (1.0, 0.4)
    #: Slow drift (Gauss-Markov) and its correlation time.
    slow_sigma_deg: NotNegative = 0.3
    slow_time_s: Positive = 300.0
    white_sigma_deg: NotNegative = 0.3
    #: White noise of roll and pitch.
    tilt_sigma_deg: NotNegative = 0.1
    #: Steps of the output of a TCM5, tilt too.
    step_deg: NotNegative = 0.1
    #: From an instant on the heading is off by so much more.
    jump_deg: Number = 0.0
    jump_at_s: NotNegative = 0.0
    #: From an instant on the heading never changes.
    stuck_from_s: NotNegative | None = None


class WaterTrack(_Part, frozen=True):
    """A stretch in which the DVL's valid velocity is relative to the water."""

    from_s: NotNegative = 0.0
    for_s: NotNegative = 0.0
    #: Speed of that water; not given: `vehicle.current_mps`.
    current_mps: NotNegative | None = None
    #: Whereto it flows, clockwise from north; not given: drawn by the seed.
    direction_deg: Number | None = None


class Dvl(_Part, frozen=True):
    """Velocity over ground: reads (1 + scale) Rz(misalignment) v + slow + white."""

    rate_hz: Rate = 5.0
    #: Mean and standard deviation of the scale error.
    scale: Number = 0.0
    scale_sigma: NotNegative = 0.004
    #: Mounting angle about the down axis, mean and standard deviation.
    mount_deg: Number = 0.0
    misalignment_sigma_deg: NotNegative = 0.3
    #: Slow drift of each axis (Gauss-Markov) and its correlation time.
    slow_sigma_mps: NotNegative = 0.004
    slow_time_s: Positive = 300.0
    white_sigma_mps: NotNegative = 0.015
    step_mps: NotNegative = 0.001
    #: Loss of bottom lock: how often and how long.
    gaps_per_hour: NotNegative = 2.0
    gap_s: NotNegative = 30.0
    #: One more loss, from this time on for so long.
    lost_from_s: NotNegative = 0.0
    lost_for_s: NotNegative = 0.0
    #: Altitude up to which there is bottom lock.
    lock_range_m: Positive = 200.0
    water_track: tuple[WaterTrack, ...] = ()


class DepthSensor(_Part, frozen=True):
    """Depth: reads true + bias + white."""

    rate_hz: Rate = 1.0
    #: Mean and standard deviation of the bias.
    bias_m: Number = 0.0
    bias_sigma_m: NotNegative = 0.5
    white_sigma_m: NotNegative = 0.1
    step_m: NotNegative = 0.01


class Clocks(_Part, frozen=True):
    """How late each sensor's stamps are: stamp minus true time, up to an hour either way."""

    heading_s: Clock = 0.0
    velocity_s: Clock = 0.0
    depth_s: Clock = 0.0
    #: Of pings and replies alike: the travel time itself stays.
    travel_time_s: Clock = 0.0


class Window(_Part, frozen=True):
    """A stretch in which only some beacons are received."""

    from_s: NotNegative = 0.0
    for_s: NotNegative = 0.0
    #: Their ids, from 1; none: silence.
    beacons: tuple[int, ...] = ()


class GrossMix(_Part, frozen=True):
    """How grossly wrong replies come about; the weights need not add up to one."""

    #: Bounces off the floor (2-7 ms late: they pass a gate) and off the surface (seconds late).
    bottom: NotNegative = 0.10
    surface: NotNegative = 0.10
    #: Late copies, exponential.
    late: NotNegative = 0.35
    #: Any time within the listening window.
    uniform: NotNegative = 0.30
    #: Another beacon's answer under this beacon's name.
    wrong_beacon: NotNegative = 0.15


class Acoustics(_Part, frozen=True):
    """Pings and what is received of their replies."""

    #: The paper's period.
    ping_period_s: Positive = 24.0
    first_ping_s: NotNegative = 5.0
    #: Standard deviation of the two-way time's noise: 1.5 m of one-way range.
    sigma_s: NotNegative = 0.002
    #: What it grows by with range, as root of the sum of squares.
    range_sigma_s_per_km: NotNegative = 0.0
    #: Its shape: normal, Laplace's, Student's of four degrees of freedom, or skewed late (gamma of
    #: shape four).
    noise: Literal["normal", "laplace", "student", "skewed"] = "normal"
    #: What the settings say of it; not given: the truth without what range adds.
    stated_sigma_s: Positive | None = None
    #: Slow bias of each beacon's times (Gauss-Markov) and its correlation time.
    slow_sigma_s: NotNegative = 0.0
    slow_time_s: Positive = 600.0
    #: Share of replies received from close by, in good periods.
    detection: Share = 1.0
    #: Slant range at which half of that is left, and over which it falls off.
    half_range_m: Positive = 8000.0
    fall_off_m: Positive = 800.0
    #: Share of the received replies that are wrong, in good periods.
    gross: Share = 0.0
    #: Share of the pings in bad periods, and their mean length in pings.
    bad_share: Annotated[float, Meta(ge=0, lt=1)] = 0.0
    bad_pings: Annotated[float, Meta(ge=1, le=1e6)] = 8.0
    #: The same two in bad periods.
    bad_detection: Share = 1.0
    bad_gross: Share = 0.0
    mix: GrossMix = GrossMix()
    #: Mean lateness of a late copy.
    late_s: Positive = 0.08
    #: How long the vehicle listens: uniform errors end here.
    listening_s: Positive = 20.0
    #: Share of the received replies that are received once more, late.
    duplicates: Share = 0.0
    #: Stretches in which only some beacons are received.
    window: tuple[Window, ...] = ()


class Position(_Part, frozen=True):
    """Position fixes of another kind, on topics of their own."""

    #: GNSS (`/gnss/fix`) while the vehicle is no deeper than `gnss_above_m`; 0: none.
    gnss_period_s: NotNegative = 0.0
    gnss_sigma_m: NotNegative = 2.0
    gnss_above_m: NotNegative = 2.0
    #: USBL of a ship (`/usbl`); 0: none.  Its sigma, of each axis, and the share that is wrong by
    #: ten times that.
    usbl_period_s: NotNegative = 0.0
    usbl_sigma_m: NotNegative = 5.0
    usbl_gross: Share = 0.0


class Faults(_Part, frozen=True):
    """What a driver gets wrong."""

    #: Heading counted counter-clockwise.
    heading_reversed: bool = False
    #: A velocity without bottom lock is sent as a valid zero.
    zeros_when_lost: bool = False


class Decoy(_Part, frozen=True):
    """Replies that agree with each other on a place where the vehicle is not."""

    from_s: NotNegative = 0.0
    for_s: NotNegative = 0.0
    #: Share of the received replies of that stretch.
    share: Share = 0.5
    #: Of the place from the vehicle, east and north.
    offset_m: tuple[Number, Number] = (200.0, 100.0)


class Scenario(_Part, frozen=True):
    """One simulated dive; the same scenario gives the same bytes."""

    #: Of the random numbers.
    seed: Annotated[int, Meta(ge=0)] = 1
    #: Of what dives of one vehicle in one field have in common: the sensors' constant errors, the
    #: floor, beacons and their survey, what `vary` and `choose` draw.  Not given: the seed's own.
    voyage_seed: Annotated[int, Meta(ge=0)] | None = None
    #: Keys by their path (`"compass.bias_deg"`) and the range out of which the seed draws each.
    vary: dict[str, tuple[Number, Number]] = msgspec.field(default_factory=dict)
    #: Keys by their path and the values of which the seed takes one.
    choose: dict[str, tuple[Any, ...]] = msgspec.field(default_factory=dict)
    duration_s: Annotated[float, Meta(ge=60, le=7 * 86400)] = 10800.0
    start: Annotated[datetime, Meta(tz=True)] = datetime(2013, 6, 5, 2, 0, tzinfo=UTC)
    #: Of the local frame, in the Clarion-Clipperton zone.
    origin_latitude_deg: Annotated[float, Meta(ge=-90, le=90)] = 10.0
    origin_longitude_deg: Annotated[float, Meta(ge=-180, le=180)] = -154.0
    #: Of the true positions on the reference topic; rounded to a millimetre there.
    reference_rate_hz: Rate = 1.0
    vehicle: Vehicle = Vehicle()
    floor: Floor = Floor()
    beacons: Beacons = Beacons()
    buoys: Buoys = Buoys()
    sound: Sound = Sound()
    compass: Compass = Compass()
    dvl: Dvl = Dvl()
    depth: DepthSensor = DepthSensor()
    clocks: Clocks = Clocks()
    acoustics: Acoustics = Acoustics()
    position: Position = Position()
    faults: Faults = Faults()
    decoy: Decoy = Decoy()


def load_scenario(name_or_path: str | Path) -> Scenario:
    """Scenario of a TOML file, or a shipped one by its name.

    Raises
    ------
    ConfigError
        No such name (with the nearest) or file, an unknown key (with the nearest), or a value out
        of its range.
    """
    name, path = str(name_or_path), Path(name_or_path)
    if path.suffix == ".toml":
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"{name}: cannot be read: {error}") from None
    else:
        folder = schemas() / "scenarios"
        shipped = sorted(f.name.removesuffix(".toml") for f in folder.iterdir())
        if name not in shipped:
            nearest = nearest_names(name, shipped)
            raise ConfigError(f"no scenario '{name}'; nearest: {', '.join(nearest) or 'none'}")
        text = (folder / f"{name}.toml").read_text(encoding="utf-8")
    scenario = settings_from_toml(text, name, Scenario)
    try:
        problems = _out_of_range(draw(scenario))
    except ConfigError as error:
        problems = [str(error)]
    for problem in problems:
        raise ConfigError(f"{name}: {problem}")
    return scenario


def draw(scenario: Scenario) -> Scenario:
    """Scenario with one number for each key of `vary` and one value for each of `choose`.

    The seed decides, each key by itself: another key more moves none of the others.

    Raises
    ------
    ConfigError
        A path that leads to no key, or a value that the key does not take.
    """
    for paths in (scenario.vary, scenario.choose):
        for path, values in paths.items():
            rng = np.random.default_rng([_common_seed(scenario), *path.encode()])
            value = (
                rng.uniform(*sorted(values))
                if paths is scenario.vary
                else values[rng.integers(len(values))]
            )
            scenario = with_key(scenario, path, value)
    return scenario


def with_keys(scenario: Scenario, keys: Mapping[str, Any]) -> Scenario:
    """Copy of a scenario with other values at dotted paths; a key that is given is drawn no more.

    `vary.` or `choose.` before a path has it drawn, out of a range or from a choice.

    Raises
    ------
    ConfigError
        As of `draw`.
    """
    for path, value in keys.items():
        table, _, rest = path.partition(".")
        if table in ("vary", "choose"):
            scenario = with_key(scenario, table, {**getattr(scenario, table), rest: value})
            continue
        scenario = with_key(scenario, path, value)
        for draws in ("vary", "choose"):
            kept = {key: v for key, v in getattr(scenario, draws).items() if key != path}
            scenario = with_key(scenario, draws, kept)
    return scenario


def _common_seed(scenario: Scenario) -> int:
    return scenario.seed if scenario.voyage_seed is None else scenario.voyage_seed


def with_key(settings: S, path: str, value: Any) -> S:
    """Copy of a scenario, or of a part, with another value for the key at a dotted path.

    Raises
    ------
    ConfigError
        As of `draw`.
    """
    return _with_key(settings, path, path, value)


def _with_key(settings: S, path: str, whole: str, value: Any) -> S:
    """Copy with another value at what is left of the `whole` path."""
    name, _, rest = path.partition(".")
    fields = {field.name: field.type for field in msgspec.structs.fields(settings)}
    if name not in fields:
        nearest = nearest_names(name, fields)
        raise ConfigError(f"unknown key {whole}; nearest: {nearest[0]}")
    if rest:
        inner = getattr(settings, name)
        if not isinstance(inner, msgspec.Struct):
            raise ConfigError(f"unknown key {whole}: {name} has none")
        value = _with_key(inner, rest, whole, value)
    else:
        try:
            value = msgspec.convert(value, fields[name])
        except msgspec.ValidationError as error:
            raise ConfigError(f"{whole}: {error}") from None
    return msgspec.structs.replace(settings, **{name: value})


def _out_of_range(scenario: Scenario) -> list[str]:
    """Name what no dive could be made of."""
    vehicle, beacons, floor = scenario.vehicle, scenario.beacons, scenario.floor
    highest_m = max(vehicle.altitude_m, *beacons.mooring_m)
    rules = [
        (vehicle.speed_mps[0] <= vehicle.speed_mps[1], "[vehicle] speed_mps must not fall"),
        (vehicle.leg_m[0] <= vehicle.leg_m[1], "[vehicle] leg_m must not fall"),
        (beacons.mooring_m[0] <= beacons.mooring_m[1], "[beacons] mooring_m must not fall"),
        (
            highest_m < floor.depth_m - floor.relief_m,
            f"[floor] depth_m {floor.depth_m:g}: too shallow for vehicle and beacons",
        ),
        (
            floor.depth_m + floor.relief_m <= 6100,
            "[floor] depth_m and relief_m reach below the profile's 6,100 m",
        ),
        (
            vehicle.descent_s + vehicle.ascent_s <= scenario.duration_s,
            "[vehicle] descent_s and ascent_s: longer than the dive",
        ),
        (
            all(not 0 < way <= vehicle.surface_s for way in (vehicle.descent_s, vehicle.ascent_s)),
            "[vehicle] surface_s: longer than a way down or up",
        ),
        (
            any(msgspec.structs.astuple(scenario.acoustics.mix)),
            "[acoustics.mix] needs a weight above 0",
        ),
    ]
    return [problem for kept, problem in rules if not kept]
