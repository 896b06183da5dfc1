# SPDX-License-Identifier: Apache-2.0
"""A solution as ROS 2 messages: `solution.mcap` for Foxglove, Lichtblick, rviz and `ros2 bag`."""

import re
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np

from abyssnav.formats.mcap.writer import Channel, ros2_channel, write_mcap
from abyssnav.formats.schema import our_definition
from abyssnav.geometry import quaternion_xyzw, to_body
from abyssnav.outputs.palette import BEACON, REFERENCE, method_colour, rgb
from abyssnav.outputs.parquet import geodetic, rows_of
from abyssnav.outputs.presentation import best_method, is_positioned, lost_methods
from abyssnav.tables import (
    Dive,
    Fixes,
    Float,
    GateStatistics,
    Geodetic,
    Innovations,
    Int,
    Reference,
    Solution,
    Table,
    Track,
    to_utc_ns,
    usual_step_s,
)

#: Variance of what a method does not estimate: height, attitude, velocity.  Zero would mean sure.
NOT_ESTIMATED: Final = 1e6
#: What moves on a map or carries an ellipse has a row in ten seconds, which halves a day's file.
_MAP_PERIOD_S: Final = 10.0
#: Poses with their covariances pack to a seventh: about a megabyte a chunk, and half the indexes.
_CHUNK_BYTES: Final = 1 << 23
_MOST_POSES: Final = 5_000
_MOST_MAP_POINTS: Final = 2_000
_COVARIANCE_KNOWN: Final = 3  # sensor_msgs/NavSatFix.COVARIANCE_TYPE_KNOWN
#: A point of the cloud: place, and colour as PCL packs it.
_POINT: Final = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])
_UINT32, _FLOAT32 = 6, 7  # sensor_msgs/PointField
_SPHERE, _TEXT = 2, 9  # visualization_msgs/Marker
#: The method whose pose is the vehicle's in the tree of frames.
_VEHICLE: Final = "smoother"


def write_mcap_file(solution: Solution, reference: Reference | None, path: Path) -> None:
    """One MCAP file, profile ros2, encoding CDR: tracks, fixes, innovations, statistics, beacons.

    Viewers get a path and poses of each method, the tree of frames, beacons as markers and, where
    there is an origin, a map.
    """
    dive = solution.dive
    channels = [_beacons(dive), _beacon_markers(dive), _fixes(solution.fixes, dive.start_ns)]
    motions: list[_Motion] = []
    for method, track in sorted(solution.tracks.items()):
        motions.append(_motion(track, motions))
        channels += _of_track(method, track, motions[-1], dive)
    if reference is not None:
        channels.append(_path("reference", reference.position_enu_m, reference.time_ns, dive, None))
    channels.append(_cloud(solution, reference))
    if dive.origin is not None:
        channels.append(_map(solution, reference))
    for method, innovations in sorted(solution.innovations.items()):
        channels.append(_innovation(method, innovations, dive.start_ns))
    last_ns = to_utc_ns(dive.start_ns, np.append(0.0, dive.replies.t_reply_s)[-1:])
    for method, statistics in sorted(solution.statistics.items()):
        channels.append(_statistics(method, statistics, last_ns))
    write_mcap(path, channels, chunk_bytes=_CHUNK_BYTES, level=-1)


# --- tracks -----------------------------------------------------------------------------------


class _Motion(NamedTuple):
    """Attitude and velocity of a track as ROS has them."""

    level: list[Float]  #: what both were turned from
    quat_xyzw: Float
    flu_mps: Float  #: forward, port, up, in the vehicle's own frame


def _motion(track: Track, known: Iterable[_Motion]) -> _Motion:
    """The paper's methods differ in place alone: what is known is not turned again."""
    down_mps = np.zeros(len(track))
    if len(track) > 1:
        down_mps = -np.gradient(track.position_enu_m[:, 2], track.t_s)
    attitude = [track.roll_rad, track.pitch_rad, track.heading_rad]
    level = [*attitude, track.forward_mps, track.starboard_mps, down_mps]
    for motion in known:
        if all(map(partial(np.array_equal, equal_nan=True), level, motion.level)):
            return motion
    body_mps = to_body(np.column_stack(level[3:]), track.roll_rad, track.pitch_rad)
    return _Motion(level, quaternion_xyzw(*attitude), body_mps * [1.0, -1.0, -1.0])


def _of_track(method: str, track: Track, motion: _Motion, dive: Dive) -> list[Channel]:
    """All topics of one method's track."""
    time_ns, enu_m = to_utc_ns(dive.start_ns, track.t_s), track.position_enu_m
    quat_xyzw, thin = motion.quat_xyzw, _for_a_map(track)
    channels = [
        _odometry(method, track, motion, time_ns),
        _path(method, enu_m, time_ns, dive, quat_xyzw),
        _pose(f"/abyssnav/{method}/pose", track[thin], quat_xyzw[thin], time_ns[thin]),
    ]
    if method == _VEHICLE:
        channels.append(_frames(enu_m, quat_xyzw, time_ns))
    if dive.origin is not None:
        channels.append(_navsatfix(method, track[thin], time_ns[thin], dive))
    return channels


def _for_a_map(track: Track) -> slice:
    """Rows of a track that a map shows."""
    every = _MAP_PERIOD_S / usual_step_s(track.t_s) if len(track) > 1 else 1.0
    return slice(None, None, max(1, round(every)))


def _odometry(method: str, track: Track, motion: _Motion, time_ns: Int) -> Channel:
    """Pose in `map`, velocity in the vehicle's own frame."""
    columns: dict[str, Any] = {
        **_header(time_ns, "map"),
        "child_frame_id": "base_link",
        **_pose_fields("pose.pose", track.position_enu_m, motion.quat_xyzw),
        **_pose_covariance(track.position_cov_m2),
        **_vector("twist.twist.linear", motion.flu_mps),
        "twist.covariance": NOT_ESTIMATED * np.eye(6).ravel(),
    }
    return ros2_channel(f"/abyssnav/{method}/odometry", "nav_msgs/msg/Odometry", time_ns, columns)


def _path(name: str, enu_m: Float, time_ns: Int, dive: Dive, quat_xyzw: Float | None) -> Channel:
    """The whole line in one message at the dive's start, for viewers."""
    rows = np.linspace(0, len(enu_m) - 1, min(len(enu_m), _MOST_POSES)).astype(np.int64)
    quat_xyzw = np.tile([0.0, 0.0, 0.0, 1.0], (len(enu_m), 1)) if quat_xyzw is None else quat_xyzw
    poses = _pose_fields("poses.pose", enu_m[rows], quat_xyzw[rows])
    columns: dict[str, Any] = {
        **_header(_start(dive), "map"),
        "poses.header.stamp": time_ns[rows][None],
        "poses.header.frame_id": "map",
        **{field: values[None] for field, values in poses.items()},
    }
    return ros2_channel(f"/abyssnav/{name}/path", "nav_msgs/msg/Path", _start(dive), columns)


def _pose(topic: str, rows: Track | Fixes, quat_xyzw: Float, time_ns: Int) -> Channel:
    columns: dict[str, Any] = {
        **_header(time_ns, "map"),
        **_pose_fields("pose.pose", rows.position_enu_m, quat_xyzw),
        **_pose_covariance(rows.position_cov_m2),
    }
    return ros2_channel(topic, "geometry_msgs/msg/PoseWithCovarianceStamped", time_ns, columns)


def _frames(enu_m: Float, quat_xyzw: Float, time_ns: Int) -> Channel:
    columns: dict[str, Any] = {
        "transforms.header.stamp": time_ns[:, None],
        "transforms.header.frame_id": "map",
        "transforms.child_frame_id": "base_link",
    }
    columns |= {
        field: values[:, None]
        for field, values in (
            _vector("transforms.transform.translation", enu_m)
            | _vector("transforms.transform.rotation", quat_xyzw)
        ).items()
    }
    return ros2_channel("/tf", "tf2_msgs/msg/TFMessage", time_ns, columns)


def _navsatfix(method: str, track: Track, time_ns: Int, dive: Dive) -> Channel:
    place = geodetic(dive, track.position_enu_m)
    columns: dict[str, Any] = {
        **_header(time_ns, "base_link"),
        "latitude": place.latitude_deg,
        "longitude": place.longitude_deg,
        "altitude": track.position_enu_m[:, 2],
        "position_covariance": NOT_ESTIMATED * np.diag([0.0, 0.0, 1.0]).ravel(),
        **_horizontal(track.position_cov_m2, "position_covariance", 3),
        "position_covariance_type": _COVARIANCE_KNOWN,
    }
    topic = f"/abyssnav/{method}/navsatfix"
    return ros2_channel(topic, "sensor_msgs/msg/NavSatFix", time_ns, columns)


# --- what stands still ------------------------------------------------------------------------


def _fixes(fixes: Fixes, start_ns: int) -> Channel:
    level = np.tile([0.0, 0.0, 0.0, 1.0], (len(fixes), 1))
    return _pose("/abyssnav/fix", fixes, level, to_utc_ns(start_ns, fixes.t_s))


def _beacons(dive: Dive) -> Channel:
    beacons, origin = dive.beacons, dive.origin
    columns: dict[str, Any] = {
        **_header(_start(dive), "map"),
        "origin_latitude": origin.latitude_deg if origin else np.nan,
        "origin_longitude": origin.longitude_deg if origin else np.nan,
        "beacons.id": beacons.id[None, :],
        "beacons.name": [beacons.name.tolist()],
        **{k: v[None] for k, v in _vector("beacons.position", beacons.position_enu_m).items()},
        "beacons.turn_around_time": beacons.turn_around_s[None, :],
        "beacons.position_sigma": beacons.sigma_m[None, :],
    }
    return ros2_channel("/lbl/beacons", "abyssnav_msgs/msg/BeaconArray", _start(dive), columns)


def _beacon_markers(dive: Dive) -> Channel:
    """A ball and a name at each beacon, of a size that is seen on the dive's extent."""
    beacons, n = dive.beacons, len(dive.beacons)
    place_m = np.tile(beacons.position_enu_m, (2, 1)).copy()
    extent_m = float(np.ptp(beacons.position_enu_m[:, :2], axis=0).max()) if n else 0.0
    size_m = max(extent_m / 80.0, 1.0)
    place_m[n:, 2] += 2 * size_m
    red, green, blue = rgb(BEACON)
    colour = np.array([red, green, blue, 255]) / 255.0
    columns: dict[str, Any] = {
        "markers.header.stamp": np.full(2 * n, dive.start_ns),
        "markers.id": np.arange(2 * n),
        "markers.type": np.repeat([_SPHERE, _TEXT], n),
        **_vector("markers.pose.position", place_m),
        "markers.pose.orientation.w": np.ones(2 * n),
        **_vector("markers.scale", np.full((2 * n, 3), size_m)),
        **{f"markers.color.{k}": np.full(2 * n, v) for k, v in zip("rgba", colour, strict=True)},
    }
    columns = {field: values[None] for field, values in columns.items()}
    columns["markers.header.frame_id"] = "map"
    columns["markers.ns"] = "beacons"
    columns["markers.text"] = [[""] * n + beacons.name.tolist()]
    kind = "visualization_msgs/msg/MarkerArray"
    return ros2_channel("/abyssnav/beacons", kind, _start(dive), columns)


def _cloud(solution: Solution, reference: Reference | None) -> Channel:
    """Beacons, consistent fixes, reference and the best track as one cloud at the dive's start.

    Viewers that know neither paths nor markers show points: Rerun's own MCAP loader is one.
    """
    dive, best = solution.dive, best_method(solution)
    parts = [(dive.beacons.position_enu_m, BEACON)]
    if is_positioned(solution):
        fixes = solution.fixes
        parts.append((fixes[fixes.consistent].position_enu_m, method_colour("fix")))
        if reference is not None:
            parts.append((_few(reference.position_enu_m), REFERENCE))
        if best:
            parts.append((_few(solution.tracks[best].position_enu_m), method_colour(best)))
    points = np.zeros(sum(len(enu_m) for enu_m, _ in parts), _POINT)
    for k, axis in enumerate("xyz"):
        points[axis] = np.concatenate([enu_m[:, k] for enu_m, _ in parts])
    points["rgb"] = np.concatenate([np.full(len(enu_m), _packed(c)) for enu_m, c in parts])
    names = list(_POINT.names or ())
    columns: dict[str, Any] = {
        **_header(_start(dive), "map"),
        "height": 1,
        "width": len(points),
        "fields.name": [names],
        "fields.offset": 4 * np.arange(len(names))[None],
        "fields.datatype": np.array([[_FLOAT32, _FLOAT32, _FLOAT32, _UINT32]]),
        "fields.count": np.ones((1, len(names))),
        "point_step": _POINT.itemsize,
        "row_step": points.nbytes,
        "data": np.frombuffer(points.tobytes(), np.uint8)[None],
        "is_dense": True,
    }
    kind = "sensor_msgs/msg/PointCloud2"
    return ros2_channel("/abyssnav/points", kind, _start(dive), columns)


def _few(enu_m: Float) -> Float:
    return enu_m[:: max(1, -(-len(enu_m) // _MOST_POSES))]


def _packed(colour: str) -> np.uint32:
    """Red, green and blue in the bytes that viewers look for behind the name `rgb`."""
    red, green, blue = rgb(colour)
    return np.uint32(red << 16 | green << 8 | blue)


def _map(solution: Solution, reference: Reference | None) -> Channel:
    """Tracks that did not run away, the reference and the beacons as one GeoJSON layer."""
    dive, unwanted = solution.dive, set(lost_methods(solution))
    if not is_positioned(solution):
        unwanted |= solution.tracks.keys()
    lines = {
        method: (track.position_enu_m, method_colour(method))
        for method, track in sorted(solution.tracks.items())
        if len(track) > 1 and method not in unwanted
    }
    if reference is not None:
        lines["reference"] = (reference.position_enu_m, REFERENCE)
    features = [
        _feature(
            {"name": name, "style": {"color": colour}},
            "LineString",
            _lon_lat(geodetic(dive, enu_m[_rows_of_a_line(len(enu_m))])),
        )
        for name, (enu_m, colour) in lines.items()
    ]
    beacons = zip(
        dive.beacons.name.tolist(),
        _lon_lat(geodetic(dive, dive.beacons.position_enu_m)),
        strict=True,
    )
    style = {"color": BEACON}
    features += [_feature({"name": n, "style": style}, "Point", place) for n, place in beacons]
    text = msgspec.json.encode({"type": "FeatureCollection", "features": features}).decode()
    start_ns = _start(dive)
    return ros2_channel("/abyssnav/map", "foxglove_msgs/msg/GeoJSON", start_ns, {"geojson": text})


def _rows_of_a_line(n: int) -> slice:
    return slice(None, None, max(1, -(-n // _MOST_MAP_POINTS)))


def _lon_lat(place: Geodetic) -> list[list[float]]:
    degrees = np.column_stack([place.longitude_deg, place.latitude_deg]).round(8)
    return degrees.tolist()  # type: ignore[no-any-return]


def _feature(properties: dict[str, Any], kind: str, coordinates: list[Any]) -> dict[str, Any]:
    geometry = {"type": kind, "coordinates": coordinates}
    return {"type": "Feature", "properties": properties, "geometry": geometry}


# --- replies ----------------------------------------------------------------------------------


def _innovation(method: str, innovations: Innovations, start_ns: int) -> Channel:
    time_ns = to_utc_ns(start_ns, innovations.t_reply_s)
    kind = "abyssnav_msgs/msg/TravelTimeInnovation"
    columns = _header(time_ns, "map") | _message_fields(innovations, kind, start_ns)
    return ros2_channel(f"/abyssnav/{method}/innovation", kind, time_ns, columns)


def _statistics(method: str, statistics: GateStatistics, time_ns: Int) -> Channel:
    fields = _message_fields(statistics, "abyssnav_msgs/msg/BeaconGateStatistics", 0)
    fields = {
        name: np.array(values[1])[values[0]] if isinstance(values, tuple) else values
        for name, values in fields.items()
    }
    columns = {
        **_header(time_ns, "map"),
        "method": method,
        **{f"beacons.{name}": values[None, :] for name, values in fields.items()},
    }
    kind = "abyssnav_msgs/msg/GateStatistics"
    return ros2_channel(f"/abyssnav/{method}/statistics", kind, time_ns, columns)


def _message_fields(table: Table, kind: str, start_ns: int) -> dict[str, Any]:
    """Columns of files as the fields of a message, whose names leave the unit out."""
    definition = our_definition(kind)
    known = {field.name for field in definition.types[definition.root]}
    fields = {re.sub("_(s|m)$", "", name): v for name, v in rows_of(start_ns, table).items()}
    return {name: values for name, values in fields.items() if name in known}


# --- parts of messages ------------------------------------------------------------------------


def _start(dive: Dive) -> Int:
    return np.array([dive.start_ns], dtype=np.int64)


def _header(time_ns: Int, frame: str) -> dict[str, Any]:
    return {"header.stamp": time_ns, "header.frame_id": frame}


def _vector(path: str, values: Float) -> dict[str, Float]:
    return {f"{path}.{k}": values[:, i] for i, k in enumerate("xyzw"[: values.shape[1]])}


def _pose_fields(path: str, enu_m: Float, quat_xyzw: Float) -> dict[str, Float]:
    return _vector(f"{path}.position", enu_m) | _vector(f"{path}.orientation", quat_xyzw)


def _pose_covariance(cov_m2: Float) -> dict[str, Float]:
    """Row-major 6 x 6 of x, y, z and rotations, from the horizontal 2 x 2."""
    not_estimated = NOT_ESTIMATED * np.diag([0.0, 0.0, 1.0, 1.0, 1.0, 1.0]).ravel()
    return {"pose.covariance": not_estimated, **_horizontal(cov_m2, "pose.covariance", 6)}


def _horizontal(cov_m2: Float, path: str, size: int) -> dict[str, Float]:
    """The four elements of a row-major covariance that a method estimates."""
    places = {(0, 0): 0, (0, 1): 1, (1, 0): size, (1, 1): size + 1}
    return {f"{path}[{k}]": cov_m2[:, row, column] for (row, column), k in places.items()}
