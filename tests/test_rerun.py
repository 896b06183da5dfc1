# SPDX-License-Identifier: Apache-2.0
import dataclasses
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from solutions import (
    BEACONS_ENU_M,
    START_NS,
    judged,
    lawn_mower_enu_m,
    make_solution,
    stripped,
    unpositioned,
    with_positions,
    write_dive,
)

from abyssnav import __version__
from abyssnav.compare import error_over_time, summarise
from abyssnav.geometry import body_to_enu
from abyssnav.outputs.palette import ACCEPTED, POSITION, REFUSED_POSITION, REJECTED
from abyssnav.outputs.rerun import trim_for_view, view
from abyssnav.outputs.rerun.blueprint import scene_of
from abyssnav.outputs.rerun.opening import opening_time_ns, stand_at
from abyssnav.outputs.rerun.text import report_text
from abyssnav.tables import DECISIONS, METHODS, VERDICTS, Check, Evaluation

DURATION_S = 2400.0


def write_recording(path, solution, reference=None):
    errors = error_over_time(solution, reference)
    view(Evaluation(solution, summarise(errors), errors, reference), path)
    return path


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    solution, reference = make_solution(duration_s=DURATION_S)
    path = tmp_path_factory.mktemp("view") / "dive.rrd"
    return solution, reference, write_recording(path, solution, reference)


def batches(path):
    """Entity path -> its record batches."""
    from rerun.chunk import RrdReader

    found = {}
    for chunk in RrdReader(str(path)).stream():
        found.setdefault(chunk.entity_path, []).append(chunk.to_record_batch())
    return found


@pytest.fixture(scope="module")
def entities(recorded):
    return batches(recorded[2])


def column(found, name):
    """All rows of a component or timeline, nested lists flattened."""
    arrays = [b.column(name) for b in found if name in b.schema.names]
    parts = []
    for array in arrays:
        flat = array
        while str(flat.type).startswith(("list", "fixed_size_list")):
            flat = flat.flatten()
        parts.append(flat.to_numpy(zero_copy_only=False))
    return np.concatenate(parts)


def times_ns(found):
    return column(found, "time").astype("M8[ns]").astype(np.int64)


def test_every_entity_of_the_contract_is_there(recorded, entities):
    solution = recorded[0]
    expected = {"/dive/beacons", "/dive/fixes", "/depth", "/report"}
    for method in solution.tracks:
        expected |= {f"/dive/{method}", f"/dive/{method}/vehicle", f"/dive/{method}/uncertainty"}
    for method in solution.innovations:
        for beacon in solution.dive.beacons.name:
            for kind in ("accepted", "rejected", "bound"):
                expected.add(f"/innovation/{method}/{beacon}/{kind}")
    expected |= {f"/error/{method}" for method in METHODS}
    assert expected - set(entities) == set()


def test_the_vehicle_is_where_the_track_is_at_its_times(recorded, entities):
    track, found = recorded[0].tracks["ekf"], entities["/dive/ekf/vehicle"]
    got_m = column(found, "Points3D:positions").reshape(-1, 3)
    np.testing.assert_array_equal(got_m, track.position_enu_m.astype(np.float32))
    expected_ns = START_NS + np.rint(track.t_s * 1e9).astype(np.int64)
    np.testing.assert_array_equal(times_ns(found), expected_ns)


def test_a_track_is_one_static_line_through_all_its_points(recorded, entities):
    track, (batch,) = recorded[0].tracks["smoother"], entities["/dive/smoother"]
    assert "time" not in batch.schema.names
    strips = batch.column("LineStrips3D:strips").to_pylist()[0]
    assert max(len(strip) for strip in strips) <= 1001
    joined = np.concatenate([strips[0], *(strip[1:] for strip in strips[1:])])
    np.testing.assert_array_equal(joined, track.position_enu_m.astype(np.float32))


def test_accepted_and_rejected_replies_are_told_apart_beacon_by_beacon(recorded, entities):
    innovations = recorded[0].innovations["ekf_gated"]
    for beacon_id, name in zip(
        (11, 12, 13, 14), ("Alpha", "Bravo", "Charlie", "Delta"), strict=True
    ):
        mine = innovations[
            (innovations.beacon_id == beacon_id) & np.isfinite(innovations.innovation_s)
        ]
        taken = mine.decision == DECISIONS.index("accepted")
        for kind, rows in (("accepted", taken), ("rejected", ~taken)):
            found = entities[f"/innovation/ekf_gated/{name}/{kind}"]
            got_ms = column(found, "Scalars:scalars")
            np.testing.assert_array_equal(got_ms, 1e3 * mine.innovation_s[rows])
        bound = column(entities[f"/innovation/ekf_gated/{name}/bound"], "Scalars:scalars")
        expected = 1e3 * np.sqrt(9.21) * mine.innovation_sigma_s
        np.testing.assert_allclose(bound.reshape(-1, 2), np.column_stack([expected, -expected]))


def test_errors_are_against_truth_and_without_one_against_the_fixes(recorded, entities, tmp_path):
    solution, reference, _ = recorded
    got = column(entities["/error/ekf"], "Scalars:scalars")
    expected = error_over_time(solution, reference)["ekf", "truth"]
    np.testing.assert_array_equal(got, expected.distance_m)
    alone = batches(write_recording(tmp_path / "alone.rrd", solution))
    got = column(alone["/error/ekf"], "Scalars:scalars")
    expected = error_over_time(solution, None)["ekf", "fix"]
    np.testing.assert_array_equal(got, expected.distance_m)
    assert "/dive/reference" not in alone


def test_positions_of_another_kind_are_drawn_where_the_dive_has_them(recorded, entities, tmp_path):
    solution = with_positions(recorded[0])
    (batch,) = batches(write_recording(tmp_path / "positions.rrd", solution))["/dive/positions"]
    assert "time" not in batch.schema.names
    fixes = solution.positions["smoother"]
    enu_m = column([batch], "Points3D:positions").reshape(-1, 3)
    np.testing.assert_allclose(enu_m[:, :2], fixes.position_enu_m, atol=1e-3)
    np.testing.assert_allclose(enu_m[:, 2], -4900.0)
    colours = column([batch], "Points3D:colors")
    for rows, colour in ((fixes.decision == 0, POSITION), (fixes.decision != 0, REFUSED_POSITION)):
        assert set(colours[rows].tolist()) == {int(f"{colour[1:]}ff", 16)}
    words = report_text(solution, summarise({}))
    assert "turquoise" in words
    assert "| smoother | 90 | 81 | 9 |" in words
    assert "/dive/positions" not in entities
    assert "turquoise" not in report_text(recorded[0], summarise({}))


def test_many_positions_of_another_kind_are_thinned_but_not_those_refused(recorded, tmp_path):
    solution = with_positions(recorded[0], n=50_000)
    (batch,) = batches(write_recording(tmp_path / "many.rrd", solution))["/dive/positions"]
    colours = column([batch], "Points3D:colors")
    counts = [int((colours == int(f"{c[1:]}ff", 16)).sum()) for c in (POSITION, REFUSED_POSITION)]
    assert counts == [15_000, 5_000]  # of 45,000 one in three


def test_the_ellipse_holds_95_percent_of_its_covariance(recorded, entities):
    track, found = recorded[0].tracks["smoother"], entities["/dive/smoother/uncertainty"]
    half_m = column(found, "Ellipsoids3D:half_sizes").reshape(-1, 3)
    assert np.all((half_m[:, 2] > 0) & (half_m[:, 2] < 0.1))  # flat: a depth is as good as known
    x, y, z, w = column(found, "Ellipsoids3D:quaternions").reshape(-1, 4).T
    assert not np.any(x)
    assert not np.any(y)
    first_axis = np.column_stack([w**2 - z**2, 2 * w * z])
    second_axis = first_axis[:, ::-1] * [-1, 1]
    cov_m2 = track.position_cov_m2[:, :2, :2]
    for axis, half in ((first_axis, half_m[:, 0]), (second_axis, half_m[:, 1])):
        along_m2 = np.einsum("ni,nij,nj->n", axis, cov_m2, axis)
        # P(χ²₂ ≤ -2 ln 0.05) = 0.95
        np.testing.assert_allclose(half**2, -2 * np.log(0.05) * along_m2, rtol=1e-3)


def test_edge_markers_tell_accepted_from_rejected_in_every_method(tmp_path):
    solution, _ = make_solution(duration_s=DURATION_S)
    path = write_recording(tmp_path / "edges.rrd", solution)
    found = batches(path)
    limit_s = scene_of(solution, {}, []).innovation_limit_s
    for method, innovations in solution.innovations.items():
        nu_s, mine = innovations.innovation_s, innovations.beacon_id == 11
        taken = innovations.decision == DECISIONS.index("accepted")
        for prefix, rows, colour in (("", ~taken, REJECTED), ("accepted_", taken, ACCEPTED)):
            for edge, beyond in (("above", nu_s > limit_s), ("below", nu_s < -limit_s)):
                marks = found.get(f"/innovation/{method}/Alpha/{prefix}{edge}", [])
                drawn = sum(b.num_rows for b in marks if "Scalars:scalars" in b.schema.names)
                assert drawn == (mine & rows & beyond).sum()
                assert bool(marks) == bool(drawn)  # no entity where nothing is to be marked
                if not marks:
                    continue
                packed = int(column(marks, "SeriesPoints:colors")[0])
                assert packed == int(f"{colour[1:]}ff", 16)
    everything_believed = found["/innovation/ekf_ungated/Alpha/accepted_above"]
    assert any("Scalars:scalars" in b.schema.names for b in everything_believed)


def rings(found, path):
    """Circles of an entity that show something, and their times."""
    shown = [b for b in found[path] if "LineStrips3D:strips" in b.schema.names]
    rows = [(b, n) for b in shown for n in b.column("LineStrips3D:strips").to_pylist()]
    return np.array([strips[0] for _, strips in rows if strips])


def test_the_circle_of_an_accepted_reply_passes_through_the_vehicle(recorded, entities):
    solution = recorded[0]
    replies, innovations = solution.dive.replies, solution.innovations["ekf"]
    mine = (replies.beacon_id == 11) & np.isfinite(innovations.innovation_s)
    taken = innovations.decision == 0
    for path, rows in (
        ("/dive/ranges/Alpha", mine & taken),
        ("/dive/ranges/Alpha/rejected", mine & ~taken),
    ):
        circles_m = rings(entities, path)
        radius_m = np.linalg.norm(circles_m[:, :, :2] - BEACONS_ENU_M[0, :2], axis=2)
        np.testing.assert_allclose(radius_m, radius_m[:, :1].repeat(65, axis=1), atol=1e-3)
        place_m = lawn_mower_enu_m(replies.t_ping_s[rows])[:, :2]
        off_m = np.linalg.norm(place_m - BEACONS_ENU_M[0, :2], axis=1) - radius_m[:, 0]
        if path.endswith("rejected"):
            assert np.abs(off_m).min() > 15.0
        else:  # 2 ms of two-way time is 1.5 m of slant range; nearly horizontal here
            assert np.abs(off_m).max() < 10.0


def test_a_rejected_circle_is_gone_with_the_beacons_next_accepted_reply(recorded, entities):
    solution = recorded[0]
    innovations = solution.innovations["ekf"]
    mine = (innovations.beacon_id == 11) & np.isfinite(innovations.innovation_s)
    refused = innovations.decision[mine] != 0
    followed = refused[:-1] & ~refused[1:]
    found = entities["/dive/ranges/Alpha/rejected"]
    empty = [
        row
        for b in found
        if "LineStrips3D:strips" in b.schema.names
        for row in b.column("LineStrips3D:strips").to_pylist()
        if row == []
    ]
    assert len(empty) == followed.sum() > 0


def test_what_hangs_on_the_vehicle_turns_with_it(recorded, entities):
    track, found = recorded[0].tracks["smoother"], entities["/dive/smoother/vehicle"]
    place_m = column(found, "Transform3D:translation").reshape(-1, 3)
    np.testing.assert_allclose(place_m, track.position_enu_m, atol=1e-3)
    x, y, z, w = column(found, "Transform3D:quaternion").reshape(-1, 4).T
    ahead = np.column_stack([1 - 2 * (y**2 + z**2), 2 * (x * y + w * z), 2 * (x * z - w * y)])
    bow = body_to_enu(np.array([1.0, 0, 0]), track.roll_rad, track.pitch_rad, track.heading_rad)
    np.testing.assert_allclose(ahead, bow, atol=1e-6)
    above = np.column_stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x**2 + y**2)])
    down = body_to_enu(np.array([0, 0, 1.0]), track.roll_rad, track.pitch_rad, track.heading_rad)
    np.testing.assert_allclose(above, -down, atol=1e-6)


def test_timelines_are_utc_dive_time_and_ping(recorded, entities):
    found = entities["/dive/ekf/vehicle"]
    elapsed_ns = column(found, "dive_time").astype("m8[ns]").astype(np.int64)
    np.testing.assert_array_equal(times_ns(found) - elapsed_ns, START_NS)
    ping = column(found, "ping")
    assert (np.diff(ping) >= 0).all()
    replies = recorded[0].dive.replies
    sent = replies.t_ping_s <= 1200.0
    at = np.searchsorted(elapsed_ns, 1200 * 10**9)
    assert ping[at] == replies.ping_id[sent].max()


def test_the_gates_verdicts_and_bottom_lock_are_states_over_time(recorded, entities):
    watch = recorded[0].watch["ekf"]
    mine = watch[watch.beacon_id == 14]
    states = column(entities["/state/gate/Delta"], "StateChange:state")
    assert states.tolist() == [VERDICTS[k] for k in mine.verdict]
    assert states[-1] == "starving"
    assert column(entities["/state/DVL"], "StateChange:state").tolist() == ["bottom lock"]


def test_events_tell_starts_recoveries_and_losses_by_the_clock(tmp_path):
    solution, _ = make_solution(duration_s=1200.0)
    lost = (solution.dive.velocity.t_s < 500.0) | (solution.dive.velocity.t_s >= 530.0)
    velocity = dataclasses.replace(solution.dive.velocity, valid=lost)
    gap = dataclasses.replace(solution, dive=dataclasses.replace(solution.dive, velocity=velocity))
    found = batches(write_recording(tmp_path / "gap.rrd", gap))["/events"]
    lines = dict(zip(column(found, "TextLog:text"), column(found, "TextLog:level"), strict=True))
    assert lines["09:01:40 DVL: bottom lock lost"] == "WARN"
    assert lines["09:02:10 DVL: bottom lock again"] == "INFO"
    assert lines["09:10:00 ekf: recovered by consensus"] == "WARN"
    assert lines["08:55:20 ekf: start confirmed (m_of_n, 5 cycles)"] == "INFO"


def test_what_the_recording_does_not_show_need_not_be_handed_over(tmp_path):
    solution, reference = make_solution(duration_s=DURATION_S)
    valid = np.ones(len(solution.dive.velocity), dtype=bool)
    valid[40:90], valid[700] = False, False
    velocity = dataclasses.replace(solution.dive.velocity, valid=valid)
    solution = dataclasses.replace(
        solution, dive=dataclasses.replace(solution.dive, velocity=velocity)
    )
    less = trim_for_view(Evaluation(solution, summarise({}), {}, reference)).solution
    assert less.dive.velocity.t_s.tolist() == [0, 39, 40, 89, 90, 699, 700, 701, 2399]
    assert len(less.dive.heading) == 0
    whole, part = (
        batches(write_recording(tmp_path / f"{k}.rrd", given, reference))
        for k, given in enumerate((solution, less))
    )
    assert whole.keys() == part.keys()
    for entity in set(whole) - {"/__properties"}:
        assert sorted(b.num_rows for b in whole[entity]) == sorted(b.num_rows for b in part[entity])
    for entity in ("/events", "/state/DVL"):
        np.testing.assert_array_equal(times_ns(whole[entity]), times_ns(part[entity]))


def test_what_the_filter_learned_is_between_its_sigmas(recorded, entities):
    estimates = recorded[0].estimates["ekf"]
    value = column(entities["/estimate/heading_error_deg/ekf"], "Scalars:scalars")
    np.testing.assert_allclose(value, np.degrees(estimates.heading_error_rad))
    sigma = column(entities["/estimate/heading_error_deg/ekf/sigma"], "Scalars:scalars")
    width = np.degrees(estimates.heading_error_sigma_rad)
    np.testing.assert_allclose(sigma.reshape(-1, 2) - value[:, None], np.outer(width, [1, -1]))


def test_the_map_has_the_track_in_degrees_and_only_with_an_origin(recorded, entities, tmp_path):
    (batch,) = entities["/geo/ekf"]
    places = column([batch], "GeoLineStrings:line_strings").reshape(-1, 2)
    np.testing.assert_allclose(places.mean(axis=0), [42.5, 145.25], atol=0.05)
    assert len(column(entities["/geo/beacons"], "GeoPoints:positions").reshape(-1, 2)) == 4
    moving = column(entities["/geo/vehicle"], "GeoPoints:positions").reshape(-1, 2)
    best = column(entities["/geo/smoother"], "GeoLineStrings:line_strings").reshape(-1, 2)
    np.testing.assert_allclose(moving, best, atol=1e-9)
    solution, _ = make_solution(duration_s=300.0, origin=None)
    assert "/geo/ekf" not in batches(write_recording(tmp_path / "local.rrd", solution))


def test_the_blueprint_opens_on_plan_innovations_and_tables(recorded):
    from rerun.chunk import RrdReader

    reader, names, classes = RrdReader(str(recorded[2])), [], []
    for chunk in reader.stream(store=reader.blueprints()[0]):
        batch = chunk.to_record_batch()
        for wanted, out in (("display_name", names), ("class_identifier", classes)):
            if f"ViewBlueprint:{wanted}" in batch.schema.names:
                out.extend(batch.column(f"ViewBlueprint:{wanted}").flatten().to_pylist())
    assert {"Plan, north up", "3-D", "Error to truth [m]", "Verdict, guide, tables"} <= set(names)
    assert sum(name.startswith("Alpha") for name in names) == 3  # one a method
    assert {"3D", "TimeSeries", "TextDocument", "TextLog"} <= set(classes)


def test_a_catalog_can_be_asked_for_verdict_errors_radius_and_origin(recorded, tmp_path):
    solution, reference, path = recorded
    from rerun.chunk import RrdReader

    def properties(path):
        table = {}
        for chunk in RrdReader(str(path)).stream():
            batch = chunk.to_record_batch()
            for name in batch.schema.names if "__properties/dive" in chunk.entity_path else ():
                table[name] = batch.column(name).to_pylist()
        return {k: v[0][0] for k, v in table.items() if v and v[0] and k != "rerun.controls.RowId"}

    known = properties(path)
    errors = summarise(error_over_time(solution, reference))
    row = errors[(errors.method == "smoother") & (errors.reference == "truth")]
    assert known["rms_to_truth_m"] == row.rms_m[0]
    assert known["verdict"] == "good"
    assert known["abyssnav_version"] == __version__
    assert known["uncertainty_95_m"] == np.median(solution.accuracy.uncertainty_95_m)
    assert (known["origin_latitude_deg"], known["origin_longitude_deg"]) == (42.5, 145.25)
    lost = properties(write_recording(tmp_path / "bad.rrd", judged(solution, "unusable")))
    assert lost["verdict"] == "unusable"
    assert lost["cause"] == "heading_constant"
    assert "uncertainty_95_m" not in lost


def test_the_verdict_and_how_to_read_come_first(recorded):
    solution = judged(recorded[0], "check")
    words = report_text(solution, summarise(error_over_time(solution, None)))
    assert words.startswith("# ⚠ CHECK")
    reason = solution.verdict.reasons[0]
    places = [words.index(part) for part in (reason.cause, reason.seen, reason.advice)]
    assert places == sorted(places)
    assert words.index("How to read") < words.index("### Distance to the fix")
    assert "OpenStreetMap" in words
    lost = report_text(judged(recorded[0], "unusable"), summarise({}))
    assert "95 % within" not in lost


def test_dead_reckoning_from_an_invented_point_is_not_drawn_among_the_beacons(recorded, tmp_path):
    solution = unpositioned(recorded[0])
    path = write_recording(tmp_path / "anywhere.rrd", solution)
    from rerun.chunk import RrdReader

    reader = RrdReader(str(path))
    assert not any(chunk.entity_path.startswith("/geo") for chunk in reader.stream())
    contents = {}
    for chunk in reader.stream(store=reader.blueprints()[0]):
        batch = chunk.to_record_batch()
        for name, key in (("ViewBlueprint:display_name", 0), ("ViewContents:query", 1)):
            if name in batch.schema.names:
                view = chunk.entity_path.split("/")[2]
                contents.setdefault(view, {})[key] = batch.column(name).to_pylist()[0]
    queries = {entry[0][0]: entry.get(1) for entry in contents.values() if 0 in entry}
    shape, beacons = queries["Shape of the way, not its place"], queries["Beacons"]
    assert any("dead_reckoning" in line for line in shape)
    assert not any("beacons" in line for line in shape)
    assert not any("dead_reckoning" in line for line in beacons)
    words = report_text(solution, summarise({}))
    assert "No acoustic track" in words
    assert "arbitrary point" in words


def test_names_from_the_log_are_text_in_paths_and_tables(tmp_path):
    names = ("a/b c", "x|y", "", "<b>")
    solution, reference = make_solution(duration_s=900.0, beacon_names=names)
    found = batches(write_recording(tmp_path / "odd.rrd", solution, reference))
    assert len([p for p in found if p.startswith("/innovation/ekf/") and p.endswith("bound")]) == 4
    words = report_text(solution, summarise(error_over_time(solution, None)))
    assert "x\\|y" in words
    assert "<b>" not in words


def test_control_characters_of_a_log_are_shown_escaped(tmp_path):
    names = ("\x1b[2J", "line\nend", "Charlie", "Delta")
    solution, reference = make_solution(duration_s=900.0, beacon_names=names)
    words = report_text(solution, summarise(error_over_time(solution, reference)))
    assert "\x1b" not in words
    assert r"\\x1b\[2J" in words
    labels = column(
        batches(write_recording(tmp_path / "odd.rrd", solution))["/dive/beacons"],
        "Points3D:labels",
    )
    assert labels[1] == r"line\nend ±1 m"


def test_letters_that_the_viewer_cannot_draw_are_escaped(tmp_path):
    names = ("北", "Ωß", "😀", "Delta")
    solution, _ = make_solution(duration_s=600.0, name="潜龙", beacon_names=names)
    found = batches(write_recording(tmp_path / "far.rrd", solution))
    labels = column(found["/dive/beacons"], "Points3D:labels")
    assert labels.tolist() == [rf"{n} ±1 m" for n in (r"\u5317", "Ωß", r"\U0001f600", "Delta")]
    assert all(ord(letter) < 0x500 for path in found for letter in path)
    words = report_text(solution, summarise(error_over_time(solution, None)))
    assert "北" not in words
    assert "Ωß" in words


def test_beacons_of_one_name_keep_their_own_innovations(tmp_path):
    solution, _ = make_solution(duration_s=900.0, beacon_names=("A", "A", "B", "C"))
    found = batches(write_recording(tmp_path / "twins.rrd", solution))
    assert len([p for p in found if p.startswith("/innovation/ekf/") and p.endswith("bound")]) == 4


def test_a_dive_with_hardly_anything_in_it_is_still_a_recording(recorded, tmp_path):
    solution, _, _ = recorded
    bare = stripped(solution, replies=solution.dive.replies[:0], depth=solution.dive.depth[:1])
    found = batches(write_recording(tmp_path / "bare.rrd", bare))
    assert {"/dive/beacons", "/report", "/depth"} <= set(found)


def test_the_tables_tell_what_is_wrong_first(recorded):
    solution, reference, _ = recorded
    bad = Check("navigate", "gate is inert", 50.0, 20.0, "m", False, "beacon Alpha")
    solution = dataclasses.replace(solution, checks=(*solution.checks, bad))
    words = report_text(solution, summarise(error_over_time(solution, reference)))
    checks = words[words.index("### Checks") :]
    assert checks.index("gate is inert") < checks.index("replies gated")
    assert "**look**" in checks


def test_the_plan_frames_the_trusted_track_not_the_lost_one(recorded):
    solution, reference, _ = recorded
    lost = dataclasses.replace(
        solution.tracks["ekf_ungated"],
        position_enu_m=solution.tracks["ekf_ungated"].position_enu_m + 1e5,
    )
    wild = dataclasses.replace(solution, tracks={**solution.tracks, "ekf_ungated": lost})
    errors = error_over_time(wild, reference)
    scene = scene_of(wild, errors, ["Alpha"])
    assert max(scene.extent_m) < 5000.0
    assert scene.error_limit_m < 100.0


def test_the_plan_looks_at_the_height_of_the_track(recorded):
    solution, reference, _ = recorded
    afloat = dataclasses.replace(
        solution.tracks["smoother"],
        position_enu_m=solution.tracks["smoother"].position_enu_m * [1.0, 1.0, 0.0],
    )
    ship = dataclasses.replace(solution, tracks={"smoother": afloat})
    scene = scene_of(ship, error_over_time(ship, reference), ["Alpha"])
    assert scene.centre_enu_m[2] == 0.0
    assert scene.track_extent_m < scene.extent_m


def test_the_time_line_stands_at_the_end_and_does_not_play(recorded):
    from rerun.blueprint.components import PlayState
    from rerun.chunk import RrdReader

    reader, states = RrdReader(str(recorded[2])), []
    for chunk in reader.stream(store=reader.blueprints()[0]):
        batch = chunk.to_record_batch()
        if "TimePanelBlueprint:play_state" in batch.schema.names:
            states += batch.column("TimePanelBlueprint:play_state").flatten().to_pylist()
    assert [value for value in states if value is not None] == [PlayState.Following.value]


def test_the_instant_at_which_circles_meet_is_that_of_the_last_fullest_ping(tmp_path):
    solution, reference = make_solution(duration_s=900.0)
    folder = write_dive(tmp_path / "dive", solution, reference)
    rows = pd.read_parquet(folder / "innovations.parquet")
    taken = rows[(rows["method"] == "ekf") & rows["accepted"]]
    counts = taken.groupby("ping_id").size()
    last = taken[taken["ping_id"] == counts[counts == counts.max()].index[-1]]["time"].max()
    assert opening_time_ns(folder) == last.value + 1_000_000
    assert opening_time_ns(tmp_path) is None


@pytest.mark.slow
@pytest.mark.skipif(
    not list(Path("/usr/share/vulkan/icd.d").glob("*.json")), reason="no Vulkan driver"
)
def test_a_viewer_that_was_started_is_told_where_to_stand(recorded, tmp_path, monkeypatch):
    from rerun.experimental import ViewerClient

    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-P", "-m", "rerun", str(recorded[2]), "--bind", "127.0.0.1"]
    when_ns, url = START_NS + 400 * 10**9, f"rerun+http://127.0.0.1:{port}/proxy"
    with subprocess.Popen(
        [*command, "--port", str(port), "--headless"], stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL, start_new_session=True
    ) as viewer:  # fmt: skip
        try:
            assert stand_at(when_ns, url)
            state = ViewerClient.connect(url).get_state()
            assert [r.current_time for r in state.recordings] == [when_ns]
        finally:
            os.killpg(viewer.pid, signal.SIGTERM)


def test_rerun_itself_finds_no_fault(recorded):
    command = Path(sys.executable).parent / "rerun"
    done = subprocess.run(
        [command, "rrd", "verify", recorded[2]], check=False, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.skipif(
    not list(Path("/usr/share/vulkan/icd.d").glob("*.json")), reason="no Vulkan driver"
)
@pytest.mark.parametrize("kind", ["whole", "bare", "no reference", "unusable", "far letters"])
def test_the_viewer_opens_it_without_a_word(recorded, tmp_path, kind):
    from pictures import watch_viewer

    solution, _, path = recorded
    if kind == "bare":
        bare = stripped(
            solution, replies=solution.dive.replies[:0], beacons=solution.dive.beacons[:0]
        )
        path = write_recording(tmp_path / "bare.rrd", bare)
    if kind == "no reference":
        path = write_recording(tmp_path / "alone.rrd", solution)
    if kind == "unusable":
        path = write_recording(tmp_path / "anywhere.rrd", unpositioned(solution))
    if kind == "far letters":  # at the first that its font lacks, the viewer would end
        names = ("北一", "ŉ \U0001f600", "שלום", "Ωμέγα")
        odd, _ = make_solution(duration_s=600.0, name="潜龙 1", beacon_names=names)
        path = write_recording(tmp_path / "far.rrd", judged(odd, "check"))
    png, said = watch_viewer(path)
    assert png.startswith(b"\x89PNG")
    assert [line for line in said if "Software rasterizer" not in line] == []
