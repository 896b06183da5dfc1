# SPDX-License-Identifier: Apache-2.0
"""The frozen tables that the stages hand on: `Log` as recorded, `Dive` on one clock, `Solution`.

A table is NumPy columns of one length behind read-only views; `table[rows]` takes a mask, a slice
or an index array.  A stage takes one holder and returns a new one, so a wrong order does not
type-check.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from abyssnav.errors import printable
from abyssnav.handover import arrow_table, data_frame, dataset

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]
Text = NDArray[np.str_]
Columns = Mapping[str, NDArray[Any]]


@dataclass(frozen=True, eq=False)
class Table:
    """Columns of one length, read only."""

    def __post_init__(self) -> None:
        length = None
        for column in fields(self):
            values = np.asarray(getattr(self, column.name)).view()
            values.flags.writeable = False
            object.__setattr__(self, column.name, values)
            length = len(values) if length is None else length
            if len(values) != length:
                raise ValueError(
                    f"{type(self).__name__}.{column.name} has {len(values)} rows, "
                    f"{fields(self)[0].name} has {length}"
                )

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))

    def __getitem__(self, rows: Any) -> Self:
        taken = object.__new__(type(self))  # lengths agree already, so nothing is checked again
        for name, column in vars(self).items():
            part = column[rows]
            part.flags.writeable = False
            taken.__dict__[name] = part
        return taken

    def columns(self) -> dict[str, NDArray[Any]]:
        """Name -> column, in the order of declaration."""
        return {c.name: getattr(self, c.name) for c in fields(self)}

    def __arrow_c_stream__(self, requested_schema: object = None) -> object:
        """Columns by Arrow's PyCapsule interface: for `polars.DataFrame(table)` and the like.

        Numbers are shared, not copied; (n, 3) and (n, 2, 2) are lists of fixed size.
        """
        return arrow_table(self.columns()).__arrow_c_stream__(requested_schema)

    def to_pandas(self) -> "pd.DataFrame":
        """As a data frame that shares the memory: `position_enu_m` is `position_east_m` and so on.

        >>> import numpy as np
        >>> Depth(np.arange(2.0), np.array([10.0, 11.0])).to_pandas()
           t_s  depth_m
        0  0.0     10.0
        1  1.0     11.0
        """
        return data_frame(self.columns())

    def to_xarray(self) -> "xr.Dataset":
        """As an xarray dataset over `row` that shares the memory; xarray is not installed by us."""
        return dataset(self.columns())


@dataclass(frozen=True)
class Column:
    """How a table's column stands in files: name, unit, kind and meaning, said for all of them."""

    name: str  #: with its unit; empty: as in the table
    unit: str
    meaning: str
    kind: str = ""  #: text, time, integer, number or flag; empty: by the type of the column
    words: tuple[str, ...] = ()  #: what the places that the column holds stand for
    value: Callable[[NDArray[Any]], NDArray[Any]] | None = None  #: from the table's; None: as it is


def stored(*columns: Column, **options: Any) -> Any:
    """Field of a table that stands in files as these columns, in this order; or in none."""
    return field(metadata={"stored": columns}, **options)


def column(unit: str, meaning: str, name: str = "", words: tuple[str, ...] = ()) -> Any:
    """Field of a table that stands in files as one column."""
    return stored(Column(name, unit, meaning, words=words))


def instant(meaning: str, name: str = "time") -> Any:
    """Field of seconds since the dive's start that stands in files as UTC."""
    return stored(Column(name, "UTC", meaning, "time"))


def stored_columns(table: type[Table]) -> list[tuple[str, Column]]:
    """Each column that files have of a table, after the field that it comes from."""
    kinds = {str(Float): "number", str(Int): "integer", str(Bool): "flag", str(Text): "text"}
    return [
        (
            f.name,
            replace(
                stored_column,
                name=stored_column.name or f.name,
                kind=stored_column.kind or ("text" if stored_column.words else kinds[str(f.type)]),
            ),
        )
        for f in fields(table)
        for stored_column in f.metadata.get("stored", ())
    ]


def _axis(place: int, sign: float = 1.0) -> Callable[[NDArray[Any]], NDArray[Any]]:
    return lambda vectors: sign * vectors[:, place]


def _sigma(axis: int) -> Callable[[NDArray[Any]], NDArray[Any]]:
    return lambda cov: np.sqrt(cov[:, axis, axis])


_HORIZONTAL = (
    Column("east_m", "m", "east of the dive's origin", value=_axis(0)),
    Column("north_m", "m", "north of the dive's origin", value=_axis(1)),
)
_ENU = (
    *_HORIZONTAL,
    Column("depth_m", "m", "below the surface, positive down; measured", value=_axis(2, -1.0)),
)
_SIGMAS = (
    Column("sigma_east_m", "m", "standard deviation of east_m", value=_sigma(0)),
    Column("sigma_north_m", "m", "standard deviation of north_m", value=_sigma(1)),
)


# --- findings ---------------------------------------------------------------------------------


#: Name of the check that finds replies stamped after the recorder had them.
REPLIES_AHEAD = "replies_ahead_of_recorder"


@dataclass(frozen=True)
class Check:
    """One finding: a value against its limit, or something that happened.

    `ok` is False when a person should look.  `detail` says where, in words.
    """

    stage: str
    name: str
    value: float
    limit: float
    unit: str
    ok: bool
    detail: str = ""
    bound: str = "max"  #: whether `limit` is the least (`min`) or the most (`max`) that is good


@dataclass(frozen=True)
class Finding:
    """What a reader met in a file: damage, repairs it did not make, things it left out."""

    what: str
    where: str
    detail: str

    def __post_init__(self) -> None:
        for name in ("what", "where", "detail"):
            object.__setattr__(self, name, printable(getattr(self, name)))


# --- as recorded ------------------------------------------------------------------------------


@dataclass(frozen=True)
class InputFile:
    """One file of the dive, for the record."""

    name: str
    bytes: int
    messages: Mapping[str, int]  #: topic -> number of messages read


@dataclass(frozen=True, eq=False)
class Log:
    """A dive as recorded: our names and units, the vehicle's own times; nothing judged yet.

    `roles` maps a role to its columns, one row a message (`time_ns` int64 UTC is in each):

    - heading      roll_rad, pitch_rad, heading_rad
    - velocity     velocity_body_mps (n, 3) forward, starboard, down, or velocity_enu_mps; valid;
                   may have altitude_m, water_track, offset_m (n, 3)
    - depth        depth_m; or pressure_dbar, without the air's, of which the origin's latitude
                   makes depth
    - travel_time  ping_time_ns, ping_id, beacon_id, travel_time_s, snr_db; may have turn_around_s
                   of the reply, without_turn_around, derived (1: ping time, 2: reply's), counted
    - beacons      message, id, name, position_enu_m (n, 3), or latitude_deg, longitude_deg,
                   depth_m; turn_around_s, sigma_m, origin_latitude_deg, origin_longitude_deg;
                   one row a beacon and message
    - sound_speed  message, depth_m, sound_speed_mps; one row a level and message.  Samples have no
                   message, means no depth_m
    - position     latitude_deg, longitude_deg, or position_enu_m (n, 2); cov_m2 (n, 2, 2); may have
                   offset_m (n, 3)
    - altitude     altitude_m
    - reference    position_enu_m (n, 3)
    """

    name: str
    inputs: tuple[InputFile, ...]
    profile: str
    topics: Mapping[str, str]  #: role -> topic
    roles: Mapping[str, Columns]
    findings: tuple[Finding, ...] = ()
    #: role -> s by which the recorder's time follows its stamps: the least of a sensor, the median
    #: of travel_time and its `ping`
    recorded_after_s: Mapping[str, float] = field(default_factory=dict)


# --- one clock --------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Velocity(Table):
    """Velocity over ground at the DVL's own times, with the attitude of the same instants."""

    t_s: Float
    velocity_body_mps: Float  #: (n, 3) forward, starboard, down
    valid: Bool  #: bottom lock
    roll_rad: Float
    pitch_rad: Float
    heading_rad: Float  #: unwrapped, clockwise from true north


@dataclass(frozen=True, eq=False)
class Heading(Table):
    """Attitude at the compass's own times."""

    t_s: Float
    roll_rad: Float
    pitch_rad: Float
    heading_rad: Float  #: unwrapped, clockwise from true north


@dataclass(frozen=True, eq=False)
class Depth(Table):
    """Depth of the navigated point."""

    t_s: Float
    depth_m: Float


@dataclass(frozen=True, eq=False)
class Replies(Table):
    """One row a reply, in the order heard."""

    ping_id: Int
    beacon_id: Int
    beacon: Int  #: row of `Beacons`, -1 when the id is unknown
    t_ping_s: Float
    t_reply_s: Float  #: the message's stamp: reply heard
    travel_time_s: Float  #: two-way, turn-around included
    snr_db: Float
    depth_ping_m: Float
    depth_reply_m: Float
    lever_ping_enu_m: Float  #: (n, 3) transducer minus navigated point, attitude of the ping
    lever_reply_enu_m: Float  #: (n, 3) the same at the reply
    beacon_enu_m: Float  #: (n, 3) the beacon as it answered; NaN when the id is unknown
    turn_around_s: Float  #: the beacon's in this very reply; NaN when the id is unknown
    beacon_sigma_m: Float  #: of a moving beacon's place, each reply's own; 0 for one that stays


@dataclass(frozen=True, eq=False)
class Beacons(Table):
    """Transponders on the sea floor."""

    id: Int = column("", "number that its replies carry", "beacon_id")
    name: Text = column("", "what people call it")
    #: (b, 3); of one that moves, at the first reply
    position_enu_m: Float = stored(
        *_HORIZONTAL, Column("depth_m", "m", "below the surface, positive down", value=_axis(2, -1))
    )
    turn_around_s: Float = column("s", "from interrogation to reply, in the beacon")
    sigma_m: Float = column("m", "standard deviation of each axis, as stated; 0: not stated")
    #: Whether it has several places in this dive; left out: none has.
    moving: Bool = stored(
        Column("", "", "it moves in this dive: the position is that at the first reply"),
        default_factory=lambda: np.zeros(0, dtype=np.bool_),
    )

    def __post_init__(self) -> None:
        if len(self.moving) == 0:
            object.__setattr__(self, "moving", np.zeros(len(self.id), dtype=np.bool_))
        super().__post_init__()


@dataclass(frozen=True, eq=False)
class Positions(Table):
    """Fixes of another kind, GNSS at the surface or USBL: what the antenna measured."""

    t_s: Float
    position_enu_m: Float  #: (n, 2) east, north of the antenna or transponder
    position_cov_m2: Float  #: (n, 2, 2)
    lever_enu_m: Float  #: (n, 3) antenna minus navigated point, with the attitude of the instant

    @property
    def vehicle_enu_m(self) -> Float:
        """East and north (n, 2) of the navigated point: the position less the lever arm."""
        return np.asarray(self.position_enu_m - self.lever_enu_m[:, :2])


@dataclass(frozen=True, eq=False)
class SoundSpeed(Table):
    """Sound speed over depth, piecewise linear; a constant is two rows of one speed."""

    depth_m: Float
    sound_speed_mps: Float


@dataclass(frozen=True)
class SoundSpeedErrors:
    """How wrong the sound speed may be: standard deviations."""

    sigma_mps: float = 1.0
    gradient_sigma_per_s: float = 0.0  #: of the gradient assumed where no profile is known
    depth_m: float | None = None  #: that a single speed is for; None: a profile is known


@dataclass(frozen=True)
class Origin:
    """Where the local frame's zero lies, WGS 84."""

    latitude_deg: float
    longitude_deg: float
    source: str = "log"  #: settings, log, beacon or position: what said so


@dataclass(frozen=True, eq=False)
class Geodetic(Table):
    """Places on the globe."""

    latitude_deg: Float = column("deg", "WGS 84; null when the dive has no origin")
    longitude_deg: Float = column("deg", "WGS 84; null when the dive has no origin")


@dataclass(frozen=True, eq=False)
class Dive:
    """A dive on one clock, checked: seconds since `start_ns`, sorted, metres, radians."""

    name: str
    start_ns: int
    origin: Origin | None
    heading: Heading
    velocity: Velocity
    depth: Depth
    replies: Replies
    beacons: Beacons
    sound_speed: SoundSpeed
    checks: tuple[Check, ...] = ()
    floor: Depth | None = None  #: of the floor below the vehicle, where the DVL tells its altitude
    positions: Positions | None = None  #: GNSS or USBL, where the profile has that role
    water: SoundSpeedErrors = SoundSpeedErrors()

    @property
    def duration_s(self) -> float:
        """From the first to the last message of what the dive is navigated with."""
        tables = (self.heading, self.velocity, self.depth)
        times = [table.t_s for table in tables if len(table)]
        outside = self.replies.t_reply_s if len(self.replies) else None
        if outside is None and self.positions is not None:
            outside = self.positions.t_s
        times += [outside] if outside is not None else []
        if not times:
            return 0.0
        return float(max(t.max() for t in times) - min(t.min() for t in times))


def to_utc_ns(start_ns: int, t_s: Float) -> Int:
    """UTC in nanoseconds of seconds since a dive's start."""
    return start_ns + np.rint(np.asarray(t_s) * 1e9).astype(np.int64)


def utc_text(time_ns: Int, unit: Literal["s", "ms", "us", "ns"] = "ms") -> list[str]:
    """Instants in UTC nanoseconds as ISO 8601 with a Z."""
    texts = np.datetime_as_string(np.asarray(time_ns, np.int64).view("M8[ns]"), unit=unit)
    return [f"{text}Z" for text in texts.tolist()]


@dataclass(frozen=True, eq=False)
class Reference(Table):
    """Independent positions, for evaluation only; no estimator sees them."""

    time_ns: Int = stored(Column("time", "UTC", "instant the row is for", "time"))
    position_enu_m: Float = stored(
        *_HORIZONTAL, Column("depth_m", "m", "below the surface, positive down", value=_axis(2, -1))
    )  #: (n, 3)


# --- estimates --------------------------------------------------------------------------------

#: What became of a reply.  `accepted` means that it moved the estimate.
DECISIONS = ("accepted", "gated", "duplicate", "unknown_beacon", "before_start", "not_physical")
#: How a reply came.
ARRIVALS = ("unknown", "direct", "multipath", "outlier")
#: What explains the class: a bounce, a copy, another's answer, nothing.
EXPLANATIONS = ("", "direct", "surface", "bottom", "late_copy", "wrong_beacon", "previous_ping")
#: What the gate's self-watch says of a beacon and a stretch of time, from good to bad.
VERDICTS = ("healthy", "silent", "inert", "starving", "captured")
#: Every method, in the order in which people read them.
METHODS = ("dead_reckoning", "fix", "kf_fix", "ekf_ungated", "ekf_gated", "ekf", "smoother")
#: Methods that run only when they are named.
OPTIONAL_METHODS = ("ekf_huber",)


def usual_step_s(t_s: Float) -> float:
    """Median step of rising instants (n,), of the first thousand; NaN of fewer than two."""
    return float(np.median(np.diff(t_s[:1001]))) if len(t_s) > 1 else np.nan


def in_order(methods: Iterable[str]) -> list[str]:
    """Methods in the order in which people read them, unknown ones last."""
    order, known = (*METHODS, *OPTIONAL_METHODS), set(methods)
    return [m for m in order if m in known] + sorted(known.difference(order))


@dataclass(frozen=True, eq=False)
class Track(Table):
    """Positions of one method on the output grid."""

    t_s: Float = instant("instant the row is for")
    position_enu_m: Float = stored(*_ENU)  #: (n, 3)
    position_cov_m2: Float = stored(
        *_SIGMAS,
        Column(
            "cov_east_north_m2",
            "m^2",
            "covariance of east_m and north_m",
            value=lambda cov: cov[:, 0, 1],
        ),
    )  #: (n, 2, 2) east, north
    heading_rad: Float = stored(
        Column(
            "",
            "rad",
            "clockwise from true north, 0 to 2 pi, as the method believes it",
            value=lambda heading_rad: heading_rad % (2 * np.pi),
        )
    )
    roll_rad: Float = column("rad", "starboard down")
    pitch_rad: Float = column("rad", "bow up")
    forward_mps: Float = column("m/s", "over ground, level, along the heading")
    starboard_mps: Float = column("m/s", "over ground, level, across the heading")
    altitude_m: Float = column("m", "above the floor; null when unknown")


@dataclass(frozen=True, eq=False)
class Fixes(Table):
    """Least-squares positions, one a cycle, stamped at the cycle's last reply."""

    t_s: Float = instant("last reply of the cycle")
    t_mid_s: Float = (
        stored()
    )  #: mean of the replies' mid-flight instants, where the position fits best
    ping_id: Int = column("", "the cycle's last interrogation")
    cycle: Int = stored()  #: running number of the cycle, those without a fix counted
    position_enu_m: Float = stored(*_ENU)  #: (n, 3)
    position_cov_m2: Float = stored(*_SIGMAS)  #: (n, 2, 2)
    n_replies: Int = column("", "travel times used")
    rms_s: Float = column("s", "root mean square residual of the two-way times")
    consistent: Bool = column("", "rms_s below three standard deviations")


def _decision(meaning: str) -> Any:
    return stored(
        Column("accepted", "", "it moved the estimate", "flag", value=lambda places: places == 0),
        Column("", "", meaning, words=DECISIONS),
    )


@dataclass(frozen=True, eq=False)
class Innovations(Table):
    """One row a reply, none left out; NaN where there was nothing to predict from."""

    ping_id: Int = column("", "interrogation, by the log's own number")
    beacon_id: Int = column("", "beacon that replied")
    t_ping_s: Float = instant("the interrogation", "ping_time")
    t_reply_s: Float = instant("reply heard")
    travel_time_s: Float = column("s", "two-way, turn-around included")
    predicted_s: Float = column("s", "the method's prediction; null: nothing to start from")
    innovation_s: Float = column("s", "travel_time_s - predicted_s")
    innovation_sigma_s: Float = column("s", "standard deviation of innovation_s")
    nis: Float = column("", "(innovation_s / innovation_sigma_s)^2, the gate's d^2")
    decision: Int = _decision("accepted, or why not")  #: place in `DECISIONS`
    #: place in `ARRIVALS`
    arrival: Int = column(
        "", "how the reply came: direct, multipath, outlier, unknown", "", ARRIVALS
    )
    #: place in `EXPLANATIONS`
    explanation: Int = column(
        "", "what explains that: a bounce, a copy, another's answer", "", EXPLANATIONS
    )


@dataclass(frozen=True, eq=False)
class PositionInnovations(Table):
    """One row a position of another kind (`Positions`), none left out, as one method met it."""

    t_s: Float = instant("instant the row is for")
    position_enu_m: Float = stored(
        Column("east_m", "m", "east as measured, of the navigated point", value=_axis(0)),
        Column("north_m", "m", "north as measured, of the navigated point", value=_axis(1)),
    )  #: (n, 2)
    sigma_enu_m: Float = stored(
        Column(
            "sigma_east_m", "m", "its standard deviation, as the method took it", value=_axis(0)
        ),
        Column(
            "sigma_north_m", "m", "its standard deviation, as the method took it", value=_axis(1)
        ),
    )  #: (n, 2)
    innovation_enu_m: Float = stored(
        Column("innovation_east_m", "m", "measured less predicted; null: no start", value=_axis(0)),
        Column(
            "innovation_north_m", "m", "measured less predicted; null: no start", value=_axis(1)
        ),
    )  #: (n, 2)
    nis: Float = column("", "normalised innovation squared, two degrees of freedom")
    decision: Int = _decision("accepted, or why not")  #: place in `DECISIONS`


@dataclass(frozen=True, eq=False)
class GateStatistics(Table):
    """What a method's gate did, by beacon."""

    beacon_id: Int = column("", "beacon that replied")
    replies: Int = column("", "replies heard")
    accepted: Int = column("", "moved the estimate")
    gated: Int = column("", "outside the gate")
    duplicate: Int = column("", "second reply of the beacon to one ping")
    unknown_beacon: Int = column("", "beacon without a position")
    before_start: Int = column("", "before the method's start was confirmed")
    not_physical: Int = column("", "explained by no position")
    mean_nis: Float = column("", "mean nis of the accepted")
    nis_inside_95: Float = column("", "share of the accepted below the 95 % bound of chi-square")
    smallest_visible_outlier_m: Float = column(
        "m", "minimal detectable bias of one-way range, half c root(gamma S): median; inf: no gate"
    )
    largest_unseen_step_m: Float = column(
        "m", "external reliability: what the largest outlier that passes moves the track"
    )
    verdict: Int = column("", "the worst of its stretches in gate.parquet", "", VERDICTS)


@dataclass(frozen=True, eq=False)
class GateIntegrity(Table):
    """What a method's gate could have seen, by beacon and stretch of time."""

    beacon_id: Int = column("", "beacon that replied")
    t_begin_s: Float = instant("beginning of the stretch", "begin_time")
    t_end_s: Float = instant("its end", "end_time")
    accepted: Int = column("", "replies that moved the estimate")
    gated: Int = column("", "replies outside the gate")
    smallest_visible_outlier_m: Float = column(
        "m", "minimal detectable bias of one-way range, half c root(gamma S): median"
    )
    largest_unseen_step_m: Float = column(
        "m", "external reliability: what the largest outlier that passes moves the track"
    )
    verdict: Int = column("", "healthy, silent, inert, starving or captured", "", VERDICTS)


@dataclass(frozen=True, eq=False)
class LegAccuracy(Table):
    """How far a leg of the track can be trusted, judged without truth."""

    t_begin_s: Float = instant("beginning of the leg", "begin_time")
    t_end_s: Float = instant("its end", "end_time")
    #: mean, clockwise from true north
    course_rad: Float = stored(
        Column("course_deg", "deg", "mean course, clockwise from true north", value=np.degrees)
    )
    length_m: Float = column("m", "distance run")
    n_replies: Int = column("", "replies that the smoother used")
    formal_95_m: Float = column("m", "95 % radius by the smoother's covariance alone")
    left_out_m: Float = column("m", "rms miss of a beacon's replies by a track made without it")
    left_out_expected_m: Float = column("m", "what the covariances let one expect of left_out_m")
    filter_smoother_m: Float = column("m", "rms distance of ekf from smoother")
    forward_backward_m: Float = column(
        "m", "rms distance of the places that past and future replies alone tell"
    )
    crossing_m: Float = column("m", "rms change of residuals where the track crosses itself")
    uncertainty_95_m: Float = column("m", "95 % horizontal radius to rely on")


@dataclass(frozen=True)
class Learned:
    """A parameter estimated with the track, its prior beside it."""

    name: str
    value: float
    sigma: float
    prior: float
    prior_sigma: float
    unit: str
    beacon_id: int | None = None  #: of which beacon, where it is one's


_AS_SMOOTHED = "as the smoother leaves it; null without a smoother"


@dataclass(frozen=True)
class CauseWeight:
    """A hypothesis of what is wrong with beacons, clocks or lever arm, and its weight."""

    name: str  #: one of `CAUSES`; "" where nothing is wrong
    beacon_id: int | None  #: of which beacon, where it is one's
    weight: float  #: probability given the data; those of a dive add up to one
    log_gain: float  #: log evidence over that of nothing being wrong, its prior included
    since_s: float | None = None  #: from when on, where not from the beginning


@dataclass(frozen=True, eq=False)
class BeaconEstimates(Table):
    """Beacons as the smoother leaves them, one row a beacon of the dive."""

    id: Int
    #: (b, 3)
    position_enu_m: Float = stored(
        Column("estimated_east_m", "m", _AS_SMOOTHED, value=_axis(0)),
        Column("estimated_north_m", "m", _AS_SMOOTHED, value=_axis(1)),
        Column("estimated_depth_m", "m", _AS_SMOOTHED, value=_axis(2, -1)),
    )
    #: (b, 3) of each axis
    sigma_enu_m: Float = stored(
        Column("estimated_sigma_east_m", "m", "its standard deviation", value=_axis(0)),
        Column("estimated_sigma_north_m", "m", "its standard deviation", value=_axis(1)),
        Column("estimated_sigma_depth_m", "m", "its standard deviation", value=_axis(2)),
    )
    turn_around_s: Float = column("s", _AS_SMOOTHED, "estimated_turn_around_s")
    turn_around_sigma_s: Float = column(
        "s", "its standard deviation", "estimated_sigma_turn_around_s"
    )


#: How far a dive's tracks can be relied on, from good to bad.
LEVELS = ("good", "check", "unusable")
#: Names of what can be wrong with a dive; the contract's list.
CAUSES = (
    "heading_constant", "heading_sense", "heading_reference", "heading_unit", "heading_offset",
    "declination", "dvl_mount", "dvl_frame", "dvl_sign", "dvl_scale", "dvl_unit", "water_track",
    "zeros_when_lost", "time_one_way", "turn_around_removed", "time_unit", "turn_around",
    "beacon_ids", "beacon_moved", "sound_speed", "lever_arm", "depth", "clock_offset",
    "no_overlap", "sensor_lost", "too_few_beacons", "geometry", "noise", "no_acoustics",
)  # fmt: skip


@dataclass(frozen=True)
class Reason:
    """Why a dive is not simply good, in the surveyor's words."""

    name: str  #: one of `CAUSES`
    cause: str  #: the likeliest cause, a sentence
    seen: str  #: what was seen, with numbers, a sentence
    advice: str  #: what to do, a sentence


@dataclass(frozen=True)
class Verdict:
    """Whether a dive's tracks can be relied on, and why not."""

    level: str  #: one of `LEVELS`
    reasons: tuple[Reason, ...] = ()  #: most likely first


@dataclass(frozen=True, eq=False)
class SensorEstimates(Table):
    """What a filter learned of compass, DVL and sound, one row an update."""

    t_s: Float
    heading_error_rad: Float  #: compass reads true plus this, deviation included
    heading_error_sigma_rad: Float  #: of the slowly drifting part
    dvl_scale: Float  #: DVL reads (1 + s) times true
    dvl_scale_sigma: Float
    sound_speed_scale: Float  #: k = speed used over true speed, less one
    sound_speed_scale_sigma: Float


@dataclass(frozen=True)
class Event:
    """Something that happened during the dive, for the log that people read."""

    t_s: float
    method: str
    what: str


@dataclass(frozen=True)
class Start:
    """Where, when and by which rule a method began."""

    t_s: float
    east_m: float
    north_m: float
    cycles: int  #: cycles it took
    how: str  #: `m_of_n`, `consensus`, `settings` or `position`


@dataclass(frozen=True, eq=False)
class Solution:
    """All that the methods made of one dive."""

    dive: Dive
    tracks: Mapping[str, Track]
    fixes: Fixes
    innovations: Mapping[str, Innovations]
    statistics: Mapping[str, GateStatistics]
    starts: Mapping[str, Start]
    gamma: float  #: threshold of the gated methods
    estimates: Mapping[str, SensorEstimates] = field(default_factory=dict)
    watch: Mapping[str, GateIntegrity] = field(default_factory=dict)
    accuracy: LegAccuracy | None = None
    events: tuple[Event, ...] = ()
    checks: tuple[Check, ...] = field(default=())
    learned: tuple[Learned, ...] = ()
    beacons: BeaconEstimates | None = None  #: by the smoother
    causes: tuple[CauseWeight, ...] = ()  #: weighed by the smoother; none in a short dive
    verdict: Verdict = Verdict("good")
    positions: Mapping[str, PositionInnovations] = field(default_factory=dict)  #: by method


@dataclass(frozen=True, eq=False)
class Comparison(Table):
    """Horizontal distance of each method to a reference: the paper's Tables 1-2, and truth."""

    method: Text = column("", "method that is compared")
    reference: Text = column("", "fix or truth")
    n: Int = column("", "number of distances")
    mean_m: Float = column("m", "mean horizontal distance")
    std_m: Float = column("m", "population standard deviation of the distance")
    rms_m: Float = column("m", "root of the mean square")
    median_m: Float = column("m", "median")
    p95_m: Float = column("m", "95 % of the distances are below")
    max_m: Float = column("m", "largest distance")


@dataclass(frozen=True, eq=False)
class Errors(Table):
    """Horizontal distance of one method to one reference over time."""

    t_s: Float = instant("instant the row is for")
    distance_m: Float = column("m", "horizontal distance")


#: (method, `fix` or `truth`) -> distances over time.
ErrorTables = Mapping[tuple[str, str], Errors]


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A solution and how far it is from the fixes and the log's reference: what outputs show."""

    solution: Solution
    comparison: Comparison
    errors: ErrorTables
    reference: Reference | None  #: for `reference.parquet` and pictures; no estimate has used it
