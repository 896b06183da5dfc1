# SPDX-License-Identifier: Apache-2.0
"""The command line: the only room that prints and exits.

Nothing heavy is imported before a command needs it, so that `--help` comes at once.

Typer makes an option of each parameter, so commands alone have as many as they have options (it
flattens no dataclass).  What several commands take has one name below (`ConfigFiles`, `Jobs` ...).
"""

import io
import os
import signal
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from abyssnav.errors import PipelineError, UnknownMethodError, printable
from abyssnav.startup import (
    block_pandas_import,
    importable,
    tune_gc,
    tune_malloc,
    use_one_blas_thread,
    use_one_memory_pool,
)
from abyssnav.version import __version__

if TYPE_CHECKING:
    from abyssnav.config import Config
    from abyssnav.profile import Profile

app = typer.Typer(
    name="abyssnav",
    help="Turns an AUV's raw dive log (MCAP) into tracks, with the errors of every method beside.",
    no_args_is_help=True,
    add_completion=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

LogPaths = Annotated[
    list[Path],
    typer.Argument(
        metavar="LOG...", help="MCAP file, or the files or directory of one split recording."
    ),
]


def _complete_profile(incomplete: str) -> list[str]:
    """Shipped profiles, for the shell; it completes files by itself."""
    return _shipped("profiles", incomplete)


def _complete_scenario(incomplete: str) -> list[str]:
    """Shipped scenarios, for the shell."""
    return _shipped("scenarios", incomplete)


def _shipped(kind: str, incomplete: str) -> list[str]:
    """Names of the TOML files of a kind in `schemas` that begin so."""
    from abyssnav.config import schemas

    names = sorted(file.name.removesuffix(".toml") for file in (schemas() / kind).iterdir())
    return [name for name in names if name.startswith(incomplete)]


ConfigFiles = Annotated[
    list[Path] | None,
    typer.Option(
        "--config", "-c", metavar="FILE", help="Settings (TOML) that differ; of several the later."
    ),
]
ProfileName = Annotated[
    str,
    typer.Option(
        "--profile",
        "-p",
        metavar="FILE|NAME",
        help="Which topics and fields play which role.",
        autocompletion=_complete_profile,
    ),
]
BeaconsFile = Annotated[
    Path | None,
    typer.Option(
        "--beacons",
        metavar="FILE",
        help="Table of the beacons, in place of the settings' and the log's: id or name, "
        "latitude_deg longitude_deg depth_m or east_m north_m up_m, turn_around_s, sigma_m.",
    ),
]

Jobs = Annotated[
    int,
    typer.Option("--jobs", "-j", min=0, help="Dives at a time; 0: what cores and memory bear."),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        "--scheduler", metavar="ADDRESS", help="Dask scheduler whose workers do the work."
    ),
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but refusals.")]
AsJson = Annotated[bool, typer.Option("--json", help="One JSON value in place of the tables.")]


#: Exit status of a dive that was done, but whose tracks are not to be relied on.
_UNUSABLE = 3
#: What the second process needs, in the order in which it needs it.
_SECOND_PROCESS_IMPORTS = (
    "abyssnav.navigate",
    "pyarrow",
    "rerun",
    "rerun.blueprint",
    "abyssnav.outputs.rerun",
)


class By(StrEnum):
    """What a row of the comparison stands for."""

    method = "method"
    dive = "dive"
    voyage = "voyage"
    beacon = "beacon"


class Cluster(StrEnum):
    """A cluster that `batch` starts by itself."""

    local = "local"


def main() -> None:
    """Run the command line; every refusal is one line on stderr and status 1."""
    use_one_blas_thread()
    use_one_memory_pool()
    tune_gc()
    _handler = _explain_bus_errors()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal need not know a log's letters
    try:
        app(prog_name="abyssnav")
    except PipelineError as refusal:
        _refuse(str(refusal))
    except OSError as error:
        _refuse(f"{error.filename or 'input or output'}: {error.strerror or error}")
    except MemoryError:
        _refuse("out of memory: is the file what it says it is?")
    except Exception as fault:
        behind = fault.__cause__
        if behind is not None and not isinstance(behind, Exception):
            raise behind from None  # a signal: Python 3.11 wraps what rises from __set_name__
        if os.environ.get("ABYSSNAV_TRACEBACK"):
            raise
        _refuse(
            f"fault in abyssnav itself: {type(fault).__name__}: {fault} "
            "(ABYSSNAV_TRACEBACK=1 shows where; please report it)"
        )


def _explain_bus_errors() -> object:
    """Have a line said where a mapped log is cut short while it is read, before the process ends.

    The system then ends a process by SIGBUS, which Python cannot handle: its own handlers wait for
    the interpreter's next step, and the faulting one never ends.

    Returns
    -------
    handler : to be kept as long as it shall serve; the system has its address only
    """
    import ctypes

    handler_type = ctypes.CFUNCTYPE(None, ctypes.c_int)

    def say_so(_: int) -> None:
        os.write(2, b"abyssnav: a log was cut short while it was read\n")
        os._exit(1)

    handler = handler_type(say_so)
    with suppress(AttributeError, OSError):
        ctypes.CDLL(None).signal(int(signal.SIGBUS), handler)
    return handler


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"abyssnav {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool,
        typer.Option("--version", help="Show the version.", is_eager=True, callback=_show_version),
    ] = False,
) -> None:
    pass


@app.command("inspect")
def inspect_log(
    log: LogPaths,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False,
    verify: Annotated[
        bool, typer.Option("--verify", help="Read sound files with the official library too.")
    ] = False,
    profile_out: Annotated[
        Path | None,
        typer.Option("--profile-out", metavar="FILE", help="Write the proposed profile (TOML)."),
    ] = None,
    config: ConfigFiles = None,
    profile: ProfileName = "default",
    beacons: BeaconsFile = None,
) -> None:
    """Show what is in a log: topics, roles, clocks, conventions, damage; propose a profile."""
    from abyssnav.diagnose import with_conventions
    from abyssnav.read import inspect

    settings, vehicle = _settings(config, profile, beacons)
    inspection = inspect(log, vehicle, settings, verify=verify)
    inspection = with_conventions(inspection, log, vehicle, settings)
    if profile_out is not None:
        profile_out.write_text(inspection.proposal, encoding="utf-8")
    if as_json:
        import json

        typer.echo(json.dumps(inspection.plain(), indent=2))
        return
    from abyssnav.terminal import show_inspection

    show_inspection(inspection)


@app.command()
def run(
    log: Annotated[
        list[str],
        typer.Argument(
            metavar="LOG|URL...", help="MCAP file, or the files or directory of one recording."
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="OUT", help="Folder of the results.")
    ] = Path("out"),
    quiet: Quiet = False,
    as_json: AsJson = False,
    config: ConfigFiles = None,
    profile: ProfileName = "default",
    beacons: BeaconsFile = None,
) -> None:
    """Process one dive, all stages, into OUT/<dive>/."""
    from abyssnav.second_process import second_process
    from abyssnav.workers import cores

    tune_malloc()
    second = second_process(importable(_SECOND_PROCESS_IMPORTS)) if cores() > 1 else nullcontext()
    with block_pandas_import(), second as executor:
        from abyssnav.remote import local_logs
        from abyssnav.run import Setup, run_dive
        from abyssnav.terminal import show_result, stages

        settings, vehicle = _settings(config, profile, beacons)
        with stages(quiet=quiet) as tell, local_logs(log, vehicle) as logs:
            result = run_dive(logs, Setup(settings, vehicle), output, tell, executor=executor)
    if as_json:
        typer.echo((result.folder / "summary.json").read_text(encoding="utf-8"))
    elif not quiet:
        show_result(result)
    if result.solution.verdict.level == "unusable":
        raise typer.Exit(_UNUSABLE)


@app.command("batch")
def batch_dives(
    logs: Annotated[
        list[str],
        typer.Argument(metavar="LOG|DIR|GLOB|URL...", help="Logs, or where they are."),
    ],
    output: Annotated[
        str,
        typer.Option("--output", "-o", metavar="OUT|URL", help="Folder or URL of the results."),
    ],
    jobs: Jobs = 0,
    scheduler: Scheduler = None,
    cluster: Annotated[
        Cluster | None,
        typer.Option("--cluster", help="A Dask cluster of --jobs workers on this machine."),
    ] = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
    config: ConfigFiles = None,
    profile: ProfileName = "default",
    beacons: BeaconsFile = None,
) -> None:
    """Process many dives; skip what is done, never stop at a bad one."""
    from abyssnav.batch import batch, find_recordings, jobs_that_fit
    from abyssnav.run import Setup
    from abyssnav.terminal import dives, show_batch

    setup = Setup(*_settings(config, profile, beacons))
    recordings = find_recordings(logs, output)
    with dives(len(recordings), quiet=quiet) as tell:
        workers = jobs or jobs_that_fit(recordings)
        address = "" if cluster and scheduler is None else scheduler
        outcomes = batch(recordings, setup, output, workers, tell, address)
    if as_json:
        import json
        from dataclasses import asdict

        typer.echo(json.dumps([asdict(outcome) for outcome in outcomes], indent=2))
    elif not quiet:
        show_batch(outcomes, output.rstrip("/"))
    if any(outcome.status == "refused" for outcome in outcomes):
        raise typer.Exit(1)
    if any(outcome.verdict == "unusable" for outcome in outcomes):
        raise typer.Exit(_UNUSABLE)


@app.command("compare")
def compare_results(
    out: Annotated[
        list[str], typer.Argument(metavar="OUT|URL...", help="Folder of one dive, or of many.")
    ],
    by: Annotated[
        By,
        typer.Option("--by", help="Pool all dives, keep each, pool by voyage, or show the gates."),
    ] = By.method,
    everything: Annotated[
        bool, typer.Option("--all", help="Pool dives that are unusable too.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Compare the methods with the fixes and with truth."""
    from abyssnav.compare import compare_places
    from abyssnav.terminal import show_comparison, show_gates, show_left_out

    table, left_out = compare_places(out, by.value, everything=everything)
    if as_json:
        typer.echo(table.to_json(orient="records", indent=2, double_precision=15))
        return
    (show_gates if by is By.beacon else show_comparison)(table)
    show_left_out(left_out)


@app.command("diff")
def diff_results(
    before: Annotated[
        str, typer.Argument(metavar="OUT_A|URL", help="One dive's folder, or many's.")
    ],
    after: Annotated[
        str, typer.Argument(metavar="OUT_B|URL", help="The same dives, done otherwise.")
    ],
    as_json: AsJson = False,
) -> None:
    """Tell which replies changed verdict and where tracks moved."""
    from abyssnav.diff import diff
    from abyssnav.terminal import show_difference

    difference = diff(before, after)
    if as_json:
        typer.echo(difference.to_json())
        return
    show_difference(difference)


@app.command("calibrate")
def calibrate_vehicle(
    logs: Annotated[
        list[str],
        typer.Argument(metavar="LOG...", help="Logs of one vehicle's dives, or where they are."),
    ],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="FILE", help="The settings (TOML) to write."),
    ],
    jobs: Jobs = 0,
    scheduler: Scheduler = None,
    quiet: Quiet = False,
    config: ConfigFiles = None,
    profile: ProfileName = "default",
    beacons: BeaconsFile = None,
) -> None:
    """Calibrate beacons, sound speed, compass, DVL, lever arm and clocks from the dives."""
    from abyssnav.batch import find_recordings, jobs_that_fit
    from abyssnav.calibrate import calibrate, write_calibration
    from abyssnav.terminal import dives_of_calibration, show_calibration

    settings, vehicle = _settings(config, profile, beacons)
    recordings = find_recordings(logs)
    workers = jobs or jobs_that_fit(recordings)
    tell = dives_of_calibration(quiet=quiet)
    result = calibrate(recordings, settings, vehicle, workers, tell, scheduler)
    page = write_calibration(result, output)
    if not quiet:
        show_calibration(result, output, page)


@app.command("plan")
def plan_dive(
    layout: Annotated[
        Path, typer.Argument(metavar="LAYOUT", help="Beacons, track and sensors (TOML).")
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="OUT", help="Folder of the plan.")
    ],
    config: ConfigFiles = None,
) -> None:
    """Tell the 95 % radius to expect of a beacon layout, on a map and along a planned track."""
    from abyssnav.config import load_config
    from abyssnav.plan import expect, load_layout, write_plan
    from abyssnav.terminal import show_plan

    plan = expect(load_layout(layout), load_config(*config or ()))
    write_plan(plan, output, layout.stem)
    show_plan(plan, output)


@app.command("score")
def score_track(
    log: Annotated[
        Path,
        typer.Argument(metavar="LOG", help="A log that holds a reference; or a folder of them."),
    ],
    track: Annotated[
        Path,
        typer.Argument(
            metavar="TRACK",
            help="Anybody's track: CSV or Parquet (time, east_m, north_m; with sigma_east_m, "
            "sigma_north_m, cov_east_north_m2 where known), or TUM; or a folder of them, one a "
            "log, of its name.",
        ),
    ],
    method: Annotated[
        str | None, typer.Option("--method", "-m", help="Whose track, of a file that holds more.")
    ] = None,
    from_s: Annotated[
        float, typer.Option("--from-s", min=0.0, help="Seconds of the dive that do not count.")
    ] = 0.0,
    as_json: AsJson = False,
) -> None:
    """Score anybody's track against a log's reference, or many against a benchmark's."""
    from abyssnav.score import Options, pool, score, score_folder

    options = Options(method, from_s)
    if log.is_dir():
        rows = score_folder(log, track, options)
        kinds = pool(rows)
        plain = {"dives": [row.plain() for row in rows], "kinds": [kind.plain() for kind in kinds]}
    else:
        result = score(log, track, options)
        plain = result.plain()
    if as_json:
        import json

        typer.echo(json.dumps(plain, indent=2))
        return
    from abyssnav.terminal import show_score, show_scores

    if log.is_dir():
        show_scores(rows, kinds)
    else:
        show_score(result)


@app.command("simulate")
def simulate_dive(
    scenario: Annotated[
        str,
        typer.Argument(
            metavar="SCENARIO",
            help="Scenario (TOML), or a shipped one's name; or benchmark, benchmark_scored.",
            autocompletion=_complete_scenario,
        ),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", metavar="LOG.mcap", help="The log to write; a benchmark's folder."
        ),
    ],
) -> None:
    """Make the log of a dive whose truth is known, or the dives of the benchmark.

    Beside a log lie the settings that it needs; beside a benchmark's, what scoring needs.
    """
    from abyssnav.atomic import atomic_file
    from abyssnav.simulate import (
        SETS,
        benchmark_dives,
        load_scenario,
        settings_toml,
        simulate,
        write_benchmark,
        write_log,
    )

    if scenario in SETS:
        write_benchmark(output, benchmark_dives(scenario), lambda dive: typer.echo(f"wrote {dive}"))
        return
    dive = simulate(load_scenario(scenario))
    with atomic_file(output) as fresh:
        write_log(dive, fresh)
    typer.echo(f"wrote {output}")
    if settings := settings_toml(dive):
        settings_path = output.with_suffix(".settings.toml")
        with atomic_file(settings_path) as fresh:
            fresh.write_text(settings, encoding="utf-8")
        typer.echo(f"wrote {settings_path}: give it to abyssnav run with --config")


def _methods(unfinished: str) -> list[str]:
    """Names of methods for the shell."""
    from abyssnav.tables import METHODS, OPTIONAL_METHODS

    return [name for name in (*METHODS, *OPTIONAL_METHODS) if name.startswith(unfinished)]


@contextmanager
def _wrong_method_is_wrong_usage() -> Iterator[None]:
    """A method that a dive lacks is a refusal, unless no dive has it: then the name was wrong.

    Raises
    ------
    BadParameter
        In the place of the refusal.
    """
    try:
        yield
    except UnknownMethodError as refusal:
        if refusal.method in _methods(""):
            raise
        raise typer.BadParameter(str(refusal), param_hint="--method") from None


@app.command("pose")
def poses_at_instants(
    dive: Annotated[str, typer.Argument(metavar="OUT/DIVE|URL", help="Folder of one result.")],
    at_file: Annotated[
        Path,
        typer.Option(
            "--at", metavar="FILE", help="CSV or Parquet with a column of times, or an MCAP file."
        ),
    ],
    topic: Annotated[
        str | None, typer.Option("--topic", help="Whose stamps, of an MCAP file.")
    ] = None,
    time_column: Annotated[
        str | None, typer.Option("--time-column", metavar="NAME", help="Which column, of a table.")
    ] = None,
    method: Annotated[
        str | None,
        typer.Option(
            "--method",
            "-m",
            autocompletion=_methods,
            help="Whose track; the smoother's if not given.",
        ),
    ] = None,
    offset_m: Annotated[
        str,
        typer.Option(
            "--offset-m", metavar="F,S,D", help="The sensor's place: forward, starboard, down."
        ),
    ] = "0,0,0",
    mount_rpy_deg: Annotated[
        str,
        typer.Option(
            "--mount-rpy-deg", metavar="R,P,Y", help="How it is turned: roll, pitch, yaw."
        ),
    ] = "0,0,0",
    photogrammetry: Annotated[
        Path | None,
        typer.Option(
            "--photogrammetry",
            metavar="FILE",
            help="Write label, latitude, longitude, height, yaw, pitch, roll and accuracies too.",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="FILE", help=".csv or .parquet; CSV on stdout if not given."
        ),
    ] = None,
) -> None:
    """Position, attitude, velocity and covariance at given instants, of the vehicle or a sensor."""
    from abyssnav.pose import Mounting, poses_of_dive, read_instants, write_all
    from abyssnav.terminal import show_poses

    tune_malloc()
    mounting = Mounting(_triple("--offset-m", offset_m), _triple("--mount-rpy-deg", mount_rpy_deg))
    with block_pandas_import(), _wrong_method_is_wrong_usage():
        instants = read_instants(at_file, topic, time_column)
        poses = poses_of_dive(dive, instants, method, mounting)
        write_all(poses, instants, output, photogrammetry)
    show_poses(poses, instants, [path for path in (output, photogrammetry) if path is not None])


def _formats(unfinished: str) -> list[str]:
    from abyssnav.outputs.export import FORMATS

    return [name for name in FORMATS if name.startswith(unfinished)]


@app.command("export")
def export_dive(
    dive: Annotated[str, typer.Argument(metavar="OUT/DIVE|URL", help="Folder of one result.")],
    to: Annotated[
        str,
        typer.Option(
            "--to",
            metavar="FORMAT",
            autocompletion=_formats,
            help="geojson kmz gpx gpkg csv tum netcdf nve sbet rosbag2 png svg.",
        ),
    ],
    method: Annotated[
        list[str] | None,
        typer.Option(
            "--method",
            "-m",
            autocompletion=_methods,
            help="Whose track, again for more; or all; the smoother's if none.",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="FOLDER", help="Where to; OUT/DIVE/export if not given."
        ),
    ] = None,
    surface_height_m: Annotated[
        float | None,
        typer.Option(
            "--surface-height-m",
            metavar="H",
            help="Height of the water's surface above the WGS 84 ellipsoid, which sbet needs.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write a dive's track as files that other tools open, with what stands beside it."""
    from abyssnav.outputs.export import FORMATS, export

    if to not in FORMATS:
        raise _wrong_choice("--to", to, FORMATS)
    with block_pandas_import(), _wrong_method_is_wrong_usage():
        paths = export(dive, to, method or (), output, surface_height_m)
    if as_json:
        import json

        typer.echo(json.dumps([str(path) for path in paths]))
        return
    for path in paths:
        typer.echo(f"wrote {path}")


@app.command("view")
def view_dive(
    dive: Annotated[str, typer.Argument(metavar="OUT/DIVE|URL", help="Folder of one result.")],
    web: Annotated[
        bool, typer.Option("--web", help="Serve it to a browser on this machine instead.")
    ] = False,
) -> None:
    """Open a dive's recording in the Rerun viewer."""
    from abyssnav.remote import is_url
    from abyssnav.results import one_dive

    recording = Path(dive) if dive.endswith(".rrd") else Path(dive) / "dive.rrd"
    if not (is_url(dive) or recording.is_file()):
        raise PipelineError(f"{recording}: no recording there; abyssnav run makes one")
    if not (web or _has_screen()):
        raise PipelineError(
            f"no screen to open {dive} on: abyssnav view --web {dive} serves it to a browser, or "
            "copy the file to a machine with a screen"
        )
    if not importable(["rerun"]):
        raise PipelineError(f"{dive}: the viewer is not installed: pip install rerun-sdk")
    if not is_url(dive):
        raise typer.Exit(_open_viewer(recording, web))
    files = ("dive.rrd", "innovations.parquet")
    with one_dive(dive.removesuffix("/dive.rrd"), files) as folder:
        if not (folder / "dive.rrd").is_file():
            raise PipelineError(f"{dive}: no recording there; abyssnav run makes one")
        raise typer.Exit(_open_viewer(folder / "dive.rrd", web))


#: Ports of this machine on which `view --web` serves the recording, and the viewer's page.
_RECORDING_PORT, _PAGE_PORT = 9876, 9090


def _open_viewer(recording: Path, web: bool) -> int:
    """Run the viewer, reachable from this machine only; its exit status.

    On a screen it stands where all circles of a ping meet, as soon as it can be told.
    """
    import subprocess
    from threading import Thread

    from abyssnav.outputs.rerun.opening import opening_time_ns, stand_at

    viewer = [sys.executable, "-P", "-m", "rerun"]
    # Left alone, the viewer tells its makers how it is used.
    subprocess.run([*viewer, "analytics", "disable"], check=False, stdout=subprocess.DEVNULL)
    options = ["--bind", "127.0.0.1"]
    if web:
        options += ["--serve-web", "--port", f"{_RECORDING_PORT}"]
        options += ["--web-viewer-port", f"{_PAGE_PORT}"]
        source = f"rerun%2Bhttp%3A%2F%2F127.0.0.1%3A{_RECORDING_PORT}%2Fproxy"
        typer.echo(f"open http://127.0.0.1:{_PAGE_PORT}/?url={source} in a browser; Ctrl-C ends it")
    elif (time_ns := opening_time_ns(recording.parent)) is not None:
        Thread(target=stand_at, args=(time_ns,), daemon=True).start()
    try:
        return subprocess.run([*viewer, str(recording), *options], check=False).returncode
    except KeyboardInterrupt:
        return 0


def _has_screen() -> bool:
    """Whether a window can be opened: everywhere but on a Linux without a display."""
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    return sys.platform != "linux" or bool(display)


def _settings(
    config: list[Path] | None, profile: str, beacons: Path | None
) -> "tuple[Config, Profile]":
    """Settings, with the beacons of a table in place of theirs, and profile."""
    from abyssnav.library import load_settings
    from abyssnav.profile import load_profile

    return load_settings(config, beacons=beacons), load_profile(profile)


def _wrong_choice(option: str, name: str, known: Iterable[str]) -> typer.BadParameter:
    from abyssnav.errors import nearest_hint

    return typer.BadParameter(f"no {name!r}{nearest_hint(name, known)}", param_hint=option)


def _triple(option: str, text: str) -> tuple[float, float, float]:
    try:
        first, second, third = (float(part) for part in text.split(","))
    except ValueError:
        raise typer.BadParameter(
            f"three numbers with commas between, not {text!r}", param_hint=option
        ) from None
    return first, second, third


def _refuse(line: str) -> None:
    typer.echo("abyssnav: " + printable(" ".join(line.split())), err=True)
    sys.exit(1)
