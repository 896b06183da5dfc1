# SPDX-License-Identifier: Apache-2.0
"""The columns of the Parquet files: name, kind, unit and meaning, as they stand in the files."""

from typing import Final, NamedTuple


class Column(NamedTuple):
    """One column; `kind` is text, time, integer, number or flag."""

    name: str
    kind: str
    unit: str
    meaning: str


_METHOD: Final = Column("method", "text", "", "method that made the row")
_TIME: Final = Column("time", "time", "UTC", "instant the row is for")
_PING_ID: Final = Column("ping_id", "integer", "", "interrogation, by the log's own number")
_BEACON_ID: Final = Column("beacon_id", "integer", "", "beacon that replied")
_POSITION: Final = (
    Column("east_m", "number", "m", "east of the dive's origin"),
    Column("north_m", "number", "m", "north of the dive's origin"),
    Column("depth_m", "number", "m", "below the surface, positive down; measured"),
    Column("sigma_east_m", "number", "m", "standard deviation of east_m"),
    Column("sigma_north_m", "number", "m", "standard deviation of north_m"),
)
_ERRORS: Final = (
    Column("n", "integer", "", "number of distances"),
    Column("mean_m", "number", "m", "mean horizontal distance"),
    Column("std_m", "number", "m", "population standard deviation of the distance"),
    Column("rms_m", "number", "m", "root of the mean square"),
    Column("median_m", "number", "m", "median"),
    Column("p95_m", "number", "m", "95 % of the distances are below"),
    Column("max_m", "number", "m", "largest distance"),
)
_REFERENCE: Final = Column("reference", "text", "", "fix or truth")

#: File -> what a row is.
ROWS: Final = {
    "tracks": "one position of one method; rising time within a method",
    "fixes": "one least-squares position of one cycle",
    "innovations": "one reply as one method saw it; none left out",
    "statistics": "what one method's gate did with one beacon's replies",
    "gate": "what one method's gate could see of one beacon in one stretch of time",
    "accuracy": "how far one leg of the smoothed track can be trusted, judged without truth",
    "comparison": "horizontal distance of one method to one reference, over the dive",
    "errors": "horizontal distance of one method to one reference at one instant",
}
#: File -> its columns, in order.  A number that does not exist is null; no column holds NaN.
COLUMNS: Final = {
    "tracks": (
        _METHOD,
        _TIME,
        *_POSITION,
        Column("cov_east_north_m2", "number", "m^2", "covariance of east_m and north_m"),
        Column("heading_rad", "number", "rad", "clockwise from true north, 0 to 2 pi"),
        Column("latitude_deg", "number", "deg", "WGS 84; null when the dive has no origin"),
        Column("longitude_deg", "number", "deg", "WGS 84; null when the dive has no origin"),
        Column("roll_rad", "number", "rad", "starboard down"),
        Column("pitch_rad", "number", "rad", "bow up"),
        Column("forward_mps", "number", "m/s", "over ground, level, along the heading"),
        Column("starboard_mps", "number", "m/s", "over ground, level, across the heading"),
        Column("altitude_m", "number", "m", "above the floor; null when unknown"),
    ),
    "fixes": (
        Column("time", "time", "UTC", "last reply of the cycle"),
        Column("ping_id", "integer", "", "the cycle's last interrogation"),
        *_POSITION,
        Column("n_replies", "integer", "", "travel times used"),
        Column("rms_s", "number", "s", "root mean square residual of the two-way times"),
        Column("consistent", "flag", "", "rms_s below three standard deviations"),
    ),
    "innovations": (
        _METHOD,
        _PING_ID,
        _BEACON_ID,
        Column("ping_time", "time", "UTC", "the interrogation"),
        Column("time", "time", "UTC", "reply heard"),
        Column("travel_time_s", "number", "s", "two-way, turn-around included"),
        Column(
            "predicted_s", "number", "s", "the method's prediction; null: nothing to start from"
        ),
        Column("innovation_s", "number", "s", "travel_time_s - predicted_s"),
        Column("innovation_sigma_s", "number", "s", "standard deviation of innovation_s"),
        Column("nis", "number", "", "(innovation_s / innovation_sigma_s)^2, the gate's d^2"),
        Column("accepted", "flag", "", "the reply moved the estimate"),
        Column("decision", "text", "", "accepted, or why not"),
        Column("arrival", "text", "", "how the reply came: direct, multipath, outlier, unknown"),
        Column("explanation", "text", "", "what explains that: a bounce, a copy, another's answer"),
    ),
    "statistics": (
        _METHOD,
        _BEACON_ID,
        Column("replies", "integer", "", "replies heard"),
        Column("accepted", "integer", "", "moved the estimate"),
        Column("gated", "integer", "", "outside the gate"),
        Column("duplicate", "integer", "", "second reply of the beacon to one ping"),
        Column("unknown_beacon", "integer", "", "beacon without a position"),
        Column("before_start", "integer", "", "before the method's start was confirmed"),
        Column("not_physical", "integer", "", "explained by no position"),
        Column("mean_nis", "number", "", "mean nis of the accepted"),
        Column("nis_inside_95", "number", "", "share of the accepted below the 95 % bound"),
        Column("smallest_visible_outlier_m", "number", "m", "half c root(gamma S), median"),
        Column("largest_unseen_step_m", "number", "m", "what a passing outlier moves the track"),
        Column("verdict", "text", "", "the worst of its stretches in gate.parquet"),
    ),
    "gate": (
        _METHOD,
        _BEACON_ID,
        Column("begin", "time", "UTC", "beginning of the stretch"),
        Column("end", "time", "UTC", "its end"),
        Column("accepted", "integer", "", "replies that moved the estimate"),
        Column("gated", "integer", "", "replies outside the gate"),
        Column("smallest_visible_outlier_m", "number", "m", "half c root(gamma S), median"),
        Column("largest_unseen_step_m", "number", "m", "what a passing outlier moves the track"),
        Column("verdict", "text", "", "healthy, silent, inert, starving or captured"),
    ),
    "accuracy": (
        Column("begin", "time", "UTC", "beginning of the leg"),
        Column("end", "time", "UTC", "its end"),
        Column("course_deg", "number", "deg", "mean course, clockwise from true north"),
        Column("length_m", "number", "m", "distance run"),
        Column("n_replies", "integer", "", "replies that the smoother used"),
        Column("formal_95_m", "number", "m", "95 % radius by the smoother's covariance alone"),
        Column("left_out_m", "number", "m", "rms miss of a beacon's replies by a track without it"),
        Column("left_out_expected_m", "number", "m", "what covariances let one expect of it"),
        Column("filter_smoother_m", "number", "m", "rms distance of ekf from smoother"),
        Column("forward_backward_m", "number", "m", "rms distance of the filter run backwards"),
        Column("crossing_m", "number", "m", "rms change of residuals at self-crossings"),
        Column("uncertainty_95_m", "number", "m", "95 % horizontal radius to rely on"),
    ),
    "comparison": (_METHOD, _REFERENCE, *_ERRORS),
    "errors": (
        _METHOD,
        _REFERENCE,
        _TIME,
        Column("distance_m", "number", "m", "horizontal distance"),
    ),
}
