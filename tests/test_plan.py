# SPDX-License-Identifier: Apache-2.0
"""Plans: closed forms, agreement with simulated dives, files, and what is refused."""

import json
import re
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from abyssnav.align import align
from abyssnav.cli import app
from abyssnav.config import Config, Output
from abyssnav.navigate import navigate
from abyssnav.plan import expect, load_layout
from abyssnav.plan.expect import _bound, _extent, _lost_m2, expected_replies, planned_track
from abyssnav.plan.layout import Layout, PlannedTrack, beacons_of, origin_of
from abyssnav.simulate import load_scenario, simulate, stated_settings, to_log
from abyssnav.simulate import scenario as simulated

EXAMPLE = re.search(
    r"```toml\n(.*?)```",
    (Path(__file__).parent.parent / "docs" / "plan.md").read_text(encoding="utf-8"),
    re.DOTALL,
)[1]
#: A coarse map, so that a test is quick.
COARSE = "\n[map]\ncells = 4\n"


@pytest.fixture(scope="module")
def layout_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("layouts") / "survey.toml"
    path.write_text(EXAMPLE + COARSE, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def plan(layout_file):
    return expect(load_layout(layout_file), Config())


def layout_of(*waypoints_m, **parts):
    track = PlannedTrack(waypoints_m=waypoints_m, depth_m=4900.0, speed_mps=1.0)
    return Layout(track=track, **parts)


# --- the planned track and its replies ----------------------------------------------------------


def test_the_track_runs_along_its_waypoints_at_its_speed():
    track = planned_track(layout_of((0.0, 0.0), (0.0, 0.0), (0.0, 100.0), (50.0, 100.0)))
    assert track.t_s[-1] == 150.0
    np.testing.assert_allclose(track.position_enu_m[60], [0.0, 60.0, -4900.0])
    np.testing.assert_allclose(track.position_enu_m[120], [20.0, 100.0, -4900.0])
    assert track.heading_rad[50] == 0.0
    assert track.heading_rad[120] == pytest.approx(np.pi / 2)


def test_a_reply_that_half_of_the_pings_bring_is_half_the_information():
    layout = layout_of((0.0, 0.0), (0.0, 900.0), acoustics=simulated.Acoustics(detection=0.5))
    beacons = beacons_of(layout, with_beacons(Config()))
    track = planned_track(layout)
    half = expected_replies(layout, beacons, track, 99)
    whole = expected_replies(
        msgspec.structs.replace(layout, acoustics=simulated.Acoustics()), beacons, track, 99
    )
    np.testing.assert_allclose(half.sigma_s, whole.sigma_s * np.sqrt(2))
    np.testing.assert_allclose(whole.sigma_s, 0.002, rtol=2e-3)
    assert len(half) == len(whole) == 38 * 3


def test_of_the_nearest_two_beacons_no_other_answers():
    layout = layout_of((0.0, 500.0), (0.0, 900.0))
    beacons = beacons_of(layout, with_beacons(Config()))
    replies = expected_replies(layout, beacons, planned_track(layout), 2)
    assert set(replies.beacon) == {0, 1}


def test_pings_of_a_long_dive_are_put_together_without_losing_information():
    long = layout_of((0.0, 0.0), (0.0, 30_000.0))
    beacons = beacons_of(long, with_beacons(Config()))
    replies = expected_replies(long, beacons, planned_track(long), 99)
    near = replies[np.abs(replies.beacon_enu_m[:, 1] - replies.t_ping_s) < 1000]
    assert len(np.unique(replies.t_ping_s)) <= 400
    np.testing.assert_allclose(near.sigma_s, 0.002 / 2, rtol=2e-3)


def test_losses_of_bottom_lock_are_spread_evenly():
    lost = _lost_m2(simulated.Dvl(gaps_per_hour=2.0, gap_s=30.0), np.arange(0.0, 7201.0))
    assert lost[-1] == pytest.approx(4 * (0.1 * 29) ** 2)
    assert _lost_m2(simulated.Dvl(gaps_per_hour=0.0), np.arange(10.0)).max() == 0.0


def with_beacons(config):
    """Settings with the example's beacons, as calibrate would write them."""
    layout = msgspec.toml.decode(EXAMPLE)
    beacons = [{**b, "position_m": [float(x) for x in b["position_m"]]} for b in layout["beacon"]]
    return msgspec.structs.replace(
        config, beacon=msgspec.convert(beacons, type=Config.__annotations__["beacon"])
    )


# --- agreement with dives -----------------------------------------------------------------------


@pytest.mark.parametrize(("count", "detection"), [(4, 0.9), (3, 0.5)])
def test_a_plan_agrees_with_the_errors_of_simulated_dives(count, detection):
    """Ten dives of half an hour; ten layouts, of an hour, are compared in docs/plan.md."""
    scenario = msgspec.structs.replace(
        load_scenario("clean"),
        duration_s=1800.0,
        beacons=simulated.Beacons(count=count),
        acoustics=simulated.Acoustics(detection=detection),
    )
    planned_m, measured_m = [], []
    for seed in range(10):
        dive = simulate(scenario, seed)
        planned_m.append(planned_rms(dive))
        settings = msgspec.structs.replace(
            stated_settings(dive), output=Output(methods=("smoother",))
        )
        track = navigate(align(to_log(dive), settings), settings).tracks["smoother"]
        off_m = (track.position_enu_m - dive.position_at(track.t_s))[track.t_s > 300, :2]
        measured_m.append(np.sqrt(np.mean(np.sum(off_m**2, axis=1))))
    assert np.median(measured_m) == pytest.approx(np.median(planned_m), rel=0.2)


def planned_rms(dive):
    """What a plan of the dive's own track and beacons expects of the final track."""
    motion, scenario = dive.truth.motion, dive.scenario
    speed_mps = np.mean(np.hypot(*motion.velocity_enu_mps[:, :2].T))
    layout = Layout(
        track=PlannedTrack(
            waypoints_m=tuple(map(tuple, motion.position_enu_m[::200, :2].tolist())),
            depth_m=float(-np.median(motion.position_enu_m[:, 2])),
            speed_mps=float(speed_mps),
        ),
        acoustics=scenario.acoustics,
    )
    beacons = replace(dive.truth.beacons, sigma_m=np.full(len(dive.beacons), 0.2))
    return _bound(layout, beacons, planned_track(layout)).rms_m(300.0)[1]


# --- what a plan says ---------------------------------------------------------------------------


def test_fewer_beacons_are_worse_and_better_sensors_are_not(plan):
    radius = {change.what: change.radius_95_m for change in plan.changes}
    now = radius["as planned"]
    assert all(radius[f"without beacon {name}"] > now for name in ("north", "east", "south-west"))
    assert radius["a gyrocompass"] < now
    assert radius["a DVL of 0.1 %"] < now
    assert radius["a CTD cast of the day"] <= now * 1.001
    assert min(radius.values()) > 0.3


def test_along_the_track_two_beacons_are_worse_than_all_and_one_is_worst(plan):
    track = plan.track
    assert (track.radius_95_m <= track.filter_radius_95_m * (1 + 1e-6)).all()
    assert np.median(track.radius_95_m) < np.median(track.two_beacons_95_m)
    assert np.median(track.two_beacons_95_m) < np.median(track.one_beacon_95_m)
    assert plan.enough(track.radius_95_m) > plan.enough(track.one_beacon_95_m)
    assert plan.target_m == 1.5


def test_the_map_covers_beacons_and_track_and_is_worst_far_out(plan):
    cells, half = plan.cells, plan.side_m / 2
    low, high = _extent(plan.layout, plan.beacons)
    assert cells.east_m.min() - half == pytest.approx(low[0])
    assert cells.north_m.max() + half >= high[1] - 1e-6
    assert len(cells) == np.prod(plan.shape)
    assert (np.diff(cells.east_m.reshape(plan.shape), axis=1) > 0).all()
    assert (np.diff(cells.north_m.reshape(plan.shape), axis=0) > 0).all()
    middle = np.argmin(np.hypot(cells.east_m, cells.north_m))
    assert cells.radius_95_m[middle] < np.median(cells.radius_95_m)


def test_a_beacon_whose_sigma_is_not_stated_counts_with_half_a_metre():
    settings = with_beacons(Config())
    bare = msgspec.structs.replace(
        settings, beacon=tuple(msgspec.structs.replace(b, sigma_m=0.0) for b in settings.beacon)
    )
    layout = layout_of((0.0, 0.0), (0.0, 900.0))
    assert (beacons_of(layout, bare).sigma_m == 0.5).all()
    errors = msgspec.structs.replace(bare.errors, beacon_sigma_m=2.0)
    looser = msgspec.structs.replace(bare, errors=errors)
    assert (beacons_of(layout, looser).sigma_m == 2.0).all()


def test_beacons_by_latitude_and_longitude_are_placed_about_the_first():
    common = {"turn_around_s": 0.2, "longitude_deg": -154.0}
    given = [
        {"id": 1, "latitude_deg": 10.0, "depth_m": 50.0, **common},
        {"id": 2, "latitude_deg": 10.01, "depth_m": 60.0, **common},
    ]
    layout = layout_of(
        (0.0, 0.0), (0.0, 900.0), beacon=msgspec.convert(given, Layout.__annotations__["beacon"])
    )
    placed = beacons_of(layout, Config()).position_enu_m
    np.testing.assert_allclose(placed[0], [0.0, 0.0, -50.0], atol=1e-6)
    assert placed[1, 1] == pytest.approx(1106.0, abs=1.0)
    assert placed[1, 2] == -60.0
    assert origin_of(layout, Config()).latitude_deg == 10.0


# --- files --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def written(layout_file, tmp_path_factory):
    folder = tmp_path_factory.mktemp("plans") / "out"
    ended = CliRunner().invoke(app, ["plan", str(layout_file), "-o", str(folder)])
    assert ended.exit_code == 0, ended.output
    return folder, ended.output


def test_the_example_of_the_docs_makes_every_file(written):
    folder, said = written
    names = {path.name for path in folder.iterdir()}
    assert names == {"plan.parquet", "track.parquet", "plan.geojson", "plan.html", "plan.rrd"}
    assert "95 % of the final track within" in said
    assert "without beacon south-west" in said

    cells = pq.read_table(folder / "plan.parquet")
    assert cells.schema.metadata[b"origin"] == b"10.0,-154.0"
    assert cells.num_rows in {12, 16}
    track = pq.read_table(folder / "track.parquet").to_pandas()
    assert track["depth_m"].unique().tolist() == [4900.0]
    assert track["latitude_deg"].between(9.99, 10.01).all()
    for table in (cells.to_pandas(), track):
        assert (table["radius_95_m"] > 0).all()

    collection = json.loads((folder / "plan.geojson").read_text(encoding="utf-8"))
    kinds = [feature["properties"]["kind"] for feature in collection["features"]]
    assert kinds.count("cell") == cells.num_rows
    assert (kinds.count("track"), kinds.count("beacon")) == (1, 3)
    north = collection["features"][-3]
    assert north["properties"]["name"] == "north"
    np.testing.assert_allclose(north["geometry"]["coordinates"], [-154.0, 10.0181], atol=1e-3)

    page = (folder / "plan.html").read_text(encoding="utf-8")
    assert "$" not in page
    assert "://" not in page
    assert page.count("<rect") == cells.num_rows
    assert (folder / "plan.rrd").read_bytes()[:4] == b"RRF2"


def test_the_recording_holds_its_entities_and_a_row_for_each_instant(written):
    from rerun.chunk import RrdReader

    rows = {}
    for chunk in RrdReader(written[0] / "plan.rrd").stream():
        rows.setdefault(chunk.entity_path, []).append(chunk.to_record_batch().num_rows)
    assert {"/plan/map", "/plan/track", "/plan/beacons", "/report"} <= set(rows)
    track = pq.read_table(written[0] / "track.parquet")
    for path in ("/plan/vehicle", "/radius/final", "/radius/two_beacons"):
        assert track.num_rows in rows[path]


def test_without_an_origin_the_geojson_is_in_metres_and_says_so(abyssnav, tmp_path):
    path = tmp_path / "local.toml"
    text = re.sub(r"\[origin\].*?\n\n", "", EXAMPLE, flags=re.DOTALL)
    path.write_text(text + COARSE, encoding="utf-8")
    ended = abyssnav("plan", path, "-o", tmp_path / "out")
    assert "no origin: plan.geojson is in local metres" in ended.out
    collection = json.loads((tmp_path / "out" / "plan.geojson").read_text(encoding="utf-8"))
    assert "metres" in collection["coordinates"]
    assert collection["features"][-3]["geometry"]["coordinates"] == [0.0, 2000.0]
    track = pq.read_table(tmp_path / "out" / "track.parquet")
    assert track["latitude_deg"].null_count == track.num_rows


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda t: t.replace("speed_mps", "sped_mps"), "unknown key [track] sped_mps"),
        (lambda t: re.sub(r"waypoints_m = .*", "waypoints_m = [[0, 0]]", t), "needs two places"),
        (lambda t: re.sub(r"(?s)\[\[beacon\]\].*(?=\[acoustics\])", "", t), "no beacons"),
        (lambda t: t.replace("id = 2", "id = 1"), "[[beacon]]: 1 is there twice"),
        (lambda t: t.replace("position_m = [0, 2000, -4950]", ""), "[[beacon]] 1: give position_m"),
        (lambda t: t.replace("depth_m = 4900", "depth_m = -1"), "depth_m"),
        (lambda t: t + "[[", "not TOML"),
    ],
)
def test_a_layout_that_cannot_be_planned_is_refused_in_one_line(abyssnav, tmp_path, change, said):
    path = tmp_path / "survey.toml"
    path.write_text(change(EXAMPLE), encoding="utf-8")
    ended = abyssnav("plan", path, "-o", tmp_path / "out")
    assert ended.status == 1
    assert said in ended.err
    assert ended.err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_layout_that_is_not_there_is_refused(abyssnav, tmp_path):
    ended = abyssnav("plan", tmp_path / "none.toml", "-o", tmp_path / "out")
    assert "none.toml: cannot be read" in ended.err
