# SPDX-License-Identifier: Apache-2.0
"""The library: what the commands do, with paths, names and keywords as people have them.

    >>> import abyssnav as an
    >>> log = an.read("sample_logs/clean.mcap")
    >>> dive = an.align(log)
    >>> solution = an.navigate(dive, output={"methods": ["dead_reckoning", "smoother"]})
    >>> solution.verdict.level
    'good'
    >>> errors = an.compare(solution, log).to_pandas()
    >>> rms_m = errors[errors.reference == "truth"].set_index("method").rms_m
    >>> bool(rms_m["smoother"] < 1.0 < rms_m["dead_reckoning"])
    True

Everything is lazy: a function imports what it needs when it is called.
"""

from collections.abc import Iterable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from abyssnav.config import Config
from abyssnav.profile import Profile
from abyssnav.tables import Comparison, Dive, Int, Log, Reference, Solution

if TYPE_CHECKING:
    from abyssnav.pose import Poses
    from abyssnav.read import Inspection
    from abyssnav.run import Result

#: One path.
AnyPath = str | PathLike[str]
#: A log: its file, its directory, or the files of a split recording.
LogPaths = AnyPath | Sequence[AnyPath]
#: Settings: a struct, a TOML file, or several of which the later wins.
AnySettings = Config | AnyPath | Sequence[AnyPath] | None
#: A profile: a struct, a shipped one's name, or a TOML file.
AnyProfile = Profile | AnyPath


def load_settings(
    settings: AnySettings = None, *, beacons: AnyPath | None = None, **tables: Any
) -> Config:
    """Settings from a struct or TOML files, with tables of them given as keywords on top.

    >>> import abyssnav as an
    >>> an.load_settings(gate={"gamma": 6.63}, output={"rate_hz": 2.0}).gate.gamma
    6.63

    Parameters
    ----------
    beacons : table of the beacons, in place of the settings' and the log's (`--beacons`)
    tables : by the names of the settings' tables: a mapping of what differs, or the struct

    Raises
    ------
    ConfigError
        A file that cannot be read, an unknown key (the nearest is named), a value out of its range.
    """
    import msgspec

    from abyssnav.config import config_from_tables, load_config
    from abyssnav.read.beacon_file import beacons_from_file

    config = settings if isinstance(settings, Config) else load_config(*_paths(settings))
    if tables:
        plain = {name: _plain(value) for name, value in tables.items()}
        config = config_from_tables(config, plain, "settings")
    if beacons is not None:
        config = msgspec.structs.replace(config, beacon=beacons_from_file(Path(beacons)))
    return config


def load_profile(profile: AnyProfile = "default") -> Profile:
    """Profile by a shipped one's name or from a TOML file; a struct is given back.

    >>> import abyssnav as an
    >>> an.load_profile("twist").velocity.topic
    '/dvl/twist'

    Raises
    ------
    ConfigError
        No such profile (the nearest is named), or one that no log could be read with.
    """
    from abyssnav.profile import load_profile as load

    return profile if isinstance(profile, Profile) else load(Path(profile))


def inspect(
    log: LogPaths, profile: AnyProfile = "default", settings: AnySettings = None, **tables: Any
) -> "Inspection":
    """What is in a log: topics, roles, clocks, conventions, damage; and a profile proposed.

    >>> import abyssnav as an
    >>> an.inspect("sample_logs/clean.mcap").roles["velocity"]
    '/dvl'

    Raises
    ------
    ReadError
        No such file, or one that is not MCAP.
    ConfigError
        As of `load_settings` and `load_profile`.
    """
    from abyssnav.diagnose import with_conventions
    from abyssnav.read import inspect as look

    paths, vehicle = _paths(log), load_profile(profile)
    config = load_settings(settings, **tables)
    return with_conventions(look(paths, vehicle, config), paths, vehicle, config)


def read(log: LogPaths, profile: AnyProfile = "default") -> Log:
    """A dive as recorded, in our names and units; nothing judged.

    >>> import abyssnav as an
    >>> log = an.read("sample_logs/clean.mcap")
    >>> log.name, sorted(log.roles)[:3]
    ('clean', ['beacons', 'depth', 'heading'])
    >>> log.roles["depth"]["depth_m"].shape
    (1800,)

    Parameters
    ----------
    log : a file, a directory, or the files of one split recording

    Raises
    ------
    ReadError
        No file, a file that is not MCAP, files of different dives, a required role without
        messages.
    """
    from abyssnav.read import read as read_log

    return read_log(_paths(log), load_profile(profile))


def align(log: Log, settings: AnySettings = None, **tables: Any) -> Dive:
    """A dive on one clock: seconds since its start, metres ENU, radians; what was odd as checks.

    >>> import abyssnav as an
    >>> dive = an.align(an.read("sample_logs/clean.mcap"), acoustics={"sound_speed_sigma_mps": 0.5})
    >>> len(dive.beacons), round(dive.duration_s)
    (4, 1800)

    Raises
    ------
    ClockError, SolveError
        The log's times or numbers cannot be navigated with.
    ConfigError
        As of `load_settings`, and beacons that cannot be placed.
    """
    from abyssnav.align import align as align_log

    return align_log(log, load_settings(settings, **tables))


def navigate(dive: Dive, settings: AnySettings = None, **tables: Any) -> Solution:
    """Tracks, fixes and innovations by every method asked for, and the verdict on them.

    >>> import abyssnav as an
    >>> dive = an.align(an.read("sample_logs/clean.mcap"))
    >>> solution = an.navigate(dive, output={"methods": ["dead_reckoning", "fix"]})
    >>> sorted(solution.tracks)
    ['dead_reckoning']
    >>> solution.fixes.position_enu_m.shape[1]
    3

    Raises
    ------
    ConfigError
        As of `load_settings`, and an unknown name in `output.methods`.
    """
    from abyssnav.diagnose import with_verdict
    from abyssnav.navigate import navigate as estimate

    config = load_settings(settings, **tables)
    return with_verdict(estimate(dive, config), config)


def compare(solution: Solution, reference: Log | Reference | None = None) -> Comparison:
    """Horizontal error of each method: to the fixes and, where there is one, to the reference.

    >>> import abyssnav as an
    >>> log = an.read("sample_logs/clean.mcap")
    >>> solution = an.navigate(an.align(log), output={"methods": ["dead_reckoning", "fix"]})
    >>> table = an.compare(solution, log)
    >>> [f"{m} to {r}" for m, r in zip(table.method, table.reference)]
    ['dead_reckoning to fix', 'dead_reckoning to truth', 'fix to truth']

    Parameters
    ----------
    reference : the log that holds one, or one of your own: times (n,) ns UTC, positions (n, 3) m,
        ENU from the dive's origin
    """
    from abyssnav.compare import compare as compare_with

    return compare_with(solution, _reference(reference))


def write(
    solution: Solution,
    folder: AnyPath,
    reference: Log | Reference | None = None,
    files: Iterable[str] = ("all",),
) -> list[Path]:
    """Tables, messages and recording of a solution, into a folder that is made if need be.

    Each file takes the place of an older one.  A whole result, with report and summary, published
    at once or not at all, is `run_dive`'s.

    >>> import abyssnav as an
    >>> dive = an.align(an.read("sample_logs/clean.mcap"))
    >>> solution = an.navigate(dive, output={"methods": ["dead_reckoning", "fix"]})
    >>> [path.name for path in an.write(solution, folder, files=["tracks.parquet"])]
    ['tracks.parquet']

    Parameters
    ----------
    files : names of those to make; `all`: every one that needs a solution only

    Returns
    -------
    paths : of the files written, sorted

    Raises
    ------
    ConfigError
        A name that is no file of ours, one that `run_dive` alone makes, or the recording by its
        name where no viewer is installed.
    """
    from abyssnav.outputs.files import write_solution

    return write_solution(solution, _reference(reference), Path(folder), tuple(files))


def pose(
    track: Solution | AnyPath,
    times: Any,
    method: str | None = None,
    *,
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    mount_rpy_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> "Poses":
    """Position, attitude, speed and covariance at any instants, of the vehicle or of a sensor.

    >>> import abyssnav as an
    >>> dive = an.align(an.read("sample_logs/clean.mcap"))
    >>> solution = an.navigate(dive, output={"methods": ["dead_reckoning", "fix"]})
    >>> poses = an.pose(solution, dive.start_ns + 600_000_000_000, offset_m=(0.4, 0.0, 0.9))
    >>> poses.method, poses.inside.tolist(), poses.track.position_enu_m.shape
    ('dead_reckoning', [True], (1, 3))

    Parameters
    ----------
    track : a solution, or the folder of a result (`out/dive7`)
    times : UTC: integers of nanoseconds, datetimes, `datetime64`, or text of them; one or many
    method : whose track; the smoother's, or the best that there is, if not given
    offset_m : the sensor from the navigated point: forward, starboard, down
    mount_rpy_deg : how it is turned on the vehicle: roll, pitch, yaw

    Raises
    ------
    ReadError
        No result of a dive, or no such method.
    """
    from abyssnav.pose import Mounting, poses_at, poses_of_solution

    mounting = Mounting(offset_m, mount_rpy_deg)
    if isinstance(track, Solution):
        return poses_of_solution(track, _time_ns(times), method, mounting)
    return poses_at(Path(track) / "tracks.parquet", _time_ns(times), method, mounting)


def run_dive(
    log: LogPaths,
    out: AnyPath = "out",
    profile: AnyProfile = "default",
    settings: AnySettings = None,
    **tables: Any,
) -> "Result":
    """What `abyssnav run` does: one dive, all stages, into `out`/<dive>, whole or not at all.

    >>> import abyssnav as an
    >>> few = {"methods": ["dead_reckoning", "fix"], "files": ["tracks.parquet"]}
    >>> result = an.run_dive("sample_logs/clean.mcap", folder, output=few)
    >>> result.folder.name, sorted(path.name for path in result.folder.iterdir())
    ('clean', ['summary.json', 'tracks.parquet'])

    Raises
    ------
    PipelineError
        The dive cannot be read, navigated or written; `out`/<dive> is as it was.
    """
    from abyssnav.run import Setup
    from abyssnav.run import run_dive as run

    config = load_settings(settings, **tables)
    return run(_paths(log), Setup(config, load_profile(profile)), Path(out))


def _paths(paths: LogPaths | AnySettings) -> list[Path]:
    if paths is None or isinstance(paths, Config):
        return []
    if isinstance(paths, str | PathLike):
        return [Path(paths)]
    return [Path(path) for path in paths]


def _reference(given: Log | Reference | None) -> Reference | None:
    """The reference itself, or that of the log that holds one."""
    from abyssnav.align import reference

    return reference(given) if isinstance(given, Log) else given


def _plain(value: Any) -> Any:
    """A table of settings, given as mapping or struct, as TOML would have it."""
    import msgspec

    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, msgspec.Struct):
        return {
            field.encode_name: _plain(item)
            for field in msgspec.structs.fields(value)
            if (item := getattr(value, field.name)) is not None
        }
    return value


def _time_ns(times: Any) -> Int:
    """Instants as UTC in nanoseconds; text and datetimes that name a zone are brought to UTC."""
    import numpy as np
    import pandas as pd

    values = np.atleast_1d(np.asarray(times))
    if values.dtype.kind in "iu":
        return values.astype(np.int64)
    if values.dtype.kind == "M":
        return values.astype("M8[ns]").astype(np.int64)
    utc = pd.to_datetime(values.tolist(), utc=True, format="ISO8601")
    return np.asarray(utc.as_unit("ns").asi8, dtype=np.int64)
