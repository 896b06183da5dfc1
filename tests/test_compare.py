# SPDX-License-Identifier: Apache-2.0
import dataclasses
import json

import numpy as np
import pytest
from solutions import START_NS, make_solution

from abyssnav.compare import (
    compare,
    compare_dives,
    compare_places,
    describe,
    error_over_time,
    summarise,
    voyage_of,
)
from abyssnav.errors import ReadError
from abyssnav.tables import METHODS, Errors, Fixes, Reference, Track


def straight(t_s, north_m=0.0):
    """Track east at 1 m/s."""
    t_s = np.asarray(t_s, float)
    enu_m = np.column_stack([t_s, np.full_like(t_s, north_m), np.full_like(t_s, -100.0)])
    return Track(
        t_s,
        enu_m,
        np.tile(np.eye(2), (len(t_s), 1, 1)),
        np.zeros(len(t_s)),
        *np.full((5, len(t_s)), np.nan),
    )


def fixes_at(t_s, enu_m, consistent=True):
    n = len(t_s)
    cov_m2, whole = np.tile(np.eye(2), (n, 1, 1)), np.arange(n)
    consistent = np.broadcast_to(consistent, n)
    t_s, enu_m = np.asarray(t_s, float), np.asarray(enu_m, float)
    return Fixes(t_s, t_s, whole, whole, enu_m, cov_m2, whole, np.zeros(n), consistent)


def of_tracks(tracks, fixes):
    solution, _ = make_solution(duration_s=300.0)
    return dataclasses.replace(solution, tracks=tracks, fixes=fixes)


def row(comparison, method, reference):
    pairs = list(zip(comparison.method, comparison.reference, strict=True))
    return {k: v[pairs.index((method, reference))] for k, v in comparison.columns().items()}


def test_a_track_three_metres_north_of_its_fixes_is_three_metres_off():
    fixes = fixes_at([10.25, 20.5], [[10.25, 0, -50], [20.5, 0, -100]])
    solution = of_tracks({"ekf_gated": straight(np.arange(0.0, 31.0), north_m=3.0)}, fixes)
    found = row(compare(solution, None), "ekf_gated", "fix")
    assert found["n"] == 2
    assert found["mean_m"] == found["rms_m"] == found["max_m"] == 3.0
    assert found["std_m"] == 0.0


def test_a_fix_outside_the_track_is_not_compared_with_an_extrapolation():
    fixes = fixes_at([9.99, 10.0, 30.0, 30.01], np.zeros((4, 3)))
    solution = of_tracks({"ekf_gated": straight(np.arange(10.0, 31.0))}, fixes)
    assert error_over_time(solution, None)["ekf_gated", "fix"].t_s.tolist() == [10.0, 30.0]


def test_fixes_that_refute_themselves_are_left_out():
    fixes = fixes_at([10.0, 20.0], [[10, 1, -100], [20, 900, -100]], consistent=[True, False])
    solution = of_tracks({"ekf_gated": straight(np.arange(0.0, 31.0))}, fixes)
    assert row(compare(solution, None), "ekf_gated", "fix")["max_m"] == 1.0


def test_truth_is_interpolated_at_the_tracks_own_times_inside_its_span():
    solution = of_tracks({"ekf": straight(np.arange(0.0, 31.0))}, fixes_at([], np.empty((0, 3))))
    t_s = np.array([5.5, 12.5, 20.5])
    reference = Reference(
        START_NS + (t_s * 1e9).astype(np.int64),
        np.column_stack([t_s, np.full(3, 4.0), np.full(3, -100.0)]),
    )
    errors = error_over_time(solution, reference)["ekf", "truth"]
    assert errors.t_s.tolist() == list(range(6, 21))
    np.testing.assert_allclose(errors.distance_m, 4.0, atol=1e-12)


def test_fixes_are_compared_with_truth_but_not_with_themselves():
    solution, reference = make_solution(duration_s=3600.0)
    comparison = compare(solution, reference)
    pairs = list(zip(comparison.method, comparison.reference, strict=True))
    assert ("fix", "truth") in pairs
    assert ("fix", "fix") not in pairs
    assert [m for m, r in pairs if r == "truth"] == list(METHODS)


def test_without_a_reference_there_is_no_row_of_truth():
    solution, _ = make_solution(duration_s=600.0)
    assert set(compare(solution, None).reference) == {"fix"}


def test_a_reference_that_runs_back_repeats_and_has_holes_is_put_in_order():
    solution, reference = make_solution(duration_s=600.0)
    shuffled = np.random.default_rng(0).permutation(np.repeat(np.arange(len(reference)), 2))
    holed = reference.position_enu_m.copy()
    holed[100] = np.nan
    untidy = Reference(reference.time_ns, holed)[shuffled]
    tidy = reference[np.arange(len(reference)) != 100]
    got, expected = compare(solution, untidy), compare(solution, tidy)
    np.testing.assert_array_equal(got.rms_m, expected.rms_m)


def test_statistics_agree_with_their_definitions():
    d = np.random.default_rng(2).rayleigh(3.0, 1001)
    got = describe(d)
    assert got["median_m"] == np.sort(d)[500]
    assert got["p95_m"] == pytest.approx(np.sort(d)[950], abs=1e-12)
    assert got["rms_m"] ** 2 == pytest.approx(got["mean_m"] ** 2 + got["std_m"] ** 2, rel=1e-12)


def test_a_pair_without_distances_has_no_row():
    nothing = Errors(np.empty(0), np.empty(0))
    assert len(summarise({("ekf", "fix"): nothing})) == 0


def test_the_better_method_of_a_made_up_solution_comes_out_better():
    comparison = compare(*make_solution(duration_s=6 * 3600.0))
    ladder = ("ekf", "ekf_gated", "ekf_ungated", "dead_reckoning")
    rms_m = [row(comparison, method, "truth")["rms_m"] for method in ladder]
    assert rms_m == sorted(rms_m)


def write_errors(folder, distances_m, method="ekf_gated"):
    pd = pytest.importorskip("pandas")
    folder.mkdir(parents=True)
    table = pd.DataFrame({"distance_m": distances_m}).assign(method=method, reference="fix")
    table.to_parquet(folder / "errors.parquet")
    return folder


def test_pooling_two_dives_is_pooling_their_distances(tmp_path):
    a, b = np.array([1.0, 2.0, 9.0]), np.array([4.0])
    folders = [write_errors(tmp_path / "a", a), write_errors(tmp_path / "b", b)]
    pooled = compare_dives(folders, by="method").iloc[0]
    assert (pooled["dives"], pooled["n"]) == (2, 4)
    assert {k: pooled[k] for k in describe(a)} == describe(np.concatenate([a, b]))
    assert compare_dives(folders, by="dive")["dive"].tolist() == ["a", "b"]


def test_the_interval_of_the_mean_is_that_of_the_dives_not_of_their_samples(tmp_path):
    random = np.random.default_rng(3)
    means_m = random.normal(5.0, 1.0, 40)
    folders = [
        write_errors(tmp_path / f"dive_{k}", mean_m + random.normal(0.0, 0.1, 500))
        for k, mean_m in enumerate(means_m)
    ]
    pooled = compare_dives(folders, by="method").iloc[0]
    # dives of one length: the standard error is that of their means
    sigma_m = means_m.std() / np.sqrt(len(means_m))
    assert pooled["mean_low_m"] == pytest.approx(means_m.mean() - 1.96 * sigma_m, abs=0.1 * sigma_m)
    assert pooled["mean_high_m"] == pytest.approx(
        means_m.mean() + 1.96 * sigma_m, abs=0.1 * sigma_m
    )


def test_two_dives_have_no_interval(tmp_path):
    folders = [write_errors(tmp_path / name, [1.0, 2.0]) for name in "ab"]
    assert np.isnan(compare_dives(folders, by="method").iloc[0]["mean_low_m"])


@pytest.mark.parametrize(
    ("dive", "voyage"),
    [
        ("voyage_2", "voyage"),
        ("leg_2_007", "leg_2"),
        ("KR13-05.3", "KR13-05"),
        ("dive7", "dive7"),
        ("17", "17"),
        ("2024_noon", "2024_noon"),
    ],
)
def test_a_voyage_is_the_name_before_the_last_separator_and_number(dive, voyage):
    assert voyage_of(dive) == voyage


def test_by_voyage_each_pools_its_own_dives(tmp_path):
    folders = [
        write_errors(tmp_path / name, distances_m)
        for name, distances_m in (("b_1", [1.0]), ("a_1", [2.0, 4.0]), ("a_2", [9.0]), ("a_3", [5]))
    ]
    table = compare_dives(folders, by="voyage")
    assert table["voyage"].tolist() == ["a", "b"]
    assert table["dives"].tolist() == [3, 1]
    a = compare_dives(folders[1:], by="method").iloc[0]
    assert table.iloc[0].drop("voyage").to_dict() == a.to_dict()
    assert np.isnan(table.loc[1, "mean_low_m"])


def write_statistics(folder, beacon_id, replies, accepted, mean_nis, visible_m):
    pd = pytest.importorskip("pandas")
    folder.mkdir()
    columns = {"beacon_id": beacon_id, "replies": replies, "accepted": accepted}
    columns |= {"mean_nis": mean_nis, "smallest_visible_outlier_m": visible_m}
    table = pd.DataFrame(columns).assign(method="ekf_gated")
    table.to_parquet(folder / "statistics.parquet")
    return folder


def test_by_beacon_replies_are_pooled_as_if_they_were_of_one_dive(tmp_path):
    nan = float("nan")
    folders = [
        write_statistics(tmp_path / "a", [1, 2], [10, 4], [8, 0], [1.0, nan], [5.0, nan]),
        write_statistics(tmp_path / "b", [1], [30], [12], [2.0], [7.0]),
    ]
    one, two = compare_dives(folders, by="beacon").to_dict("records")
    assert (one["beacon_id"], one["dives"], one["replies"]) == (1, 2, 40)
    assert one["accepted"] == 20 / 40
    assert one["mean_nis"] == (8 * 1.0 + 12 * 2.0) / 20
    assert one["smallest_visible_outlier_m"] == 6.0
    assert np.isnan(one["accepted_low"])
    assert (two["replies"], two["accepted"]) == (4, 0.0)
    assert np.isnan(two["mean_nis"])


def test_the_interval_of_the_accepted_share_is_that_of_the_dives(tmp_path):
    random = np.random.default_rng(4)
    shares = random.normal(0.7, 0.05, 40)
    folders = [
        write_statistics(tmp_path / f"dive_{k}", [1], [1000], [round(1000 * share)], [1.0], [5.0])
        for k, share in enumerate(shares)
    ]
    (found,) = compare_dives(folders, by="beacon").to_dict("records")
    sigma = shares.std() / np.sqrt(len(shares))
    low, high = shares.mean() - 1.96 * sigma, shares.mean() + 1.96 * sigma
    assert found["accepted_low"] == pytest.approx(low, abs=0.1 * sigma)
    assert found["accepted_high"] == pytest.approx(high, abs=0.1 * sigma)


def test_dives_without_a_single_reply_have_no_row_of_a_beacon(tmp_path):
    silent = write_statistics(tmp_path / "silent", [], [], [], [], [])
    assert len(compare_dives([silent], by="beacon")) == 0


def test_an_older_result_without_statistics_is_named(tmp_path):
    with pytest.raises(ReadError, match=r"a.statistics\.parquet: not there"):
        compare_dives([write_errors(tmp_path / "a", [1.0])], by="beacon")


def test_by_beacon_the_gates_of_a_whole_dive_are_shown(abyssnav, result):
    ended = abyssnav("compare", result.folder, "--by", "beacon")
    assert ended.status == 0, ended.err
    statistics = result.solution.statistics["ekf_gated"]
    for beacon_id, replies in zip(statistics.beacon_id, statistics.replies, strict=True):
        line = [words.split() for words in ended.out.splitlines() if "ekf_gated" in words]
        assert [str(beacon_id), "1", "ekf_gated", f"{replies:,}"] in [words[:4] for words in line]
    assert max(map(len, ended.out.splitlines())) <= 100


def test_by_voyage_the_voyage_is_shown(abyssnav, result):
    ended = abyssnav("compare", result.folder, "--by", "voyage")
    assert ended.status == 0, ended.err
    assert ended.out.splitlines()[1] == "dive"
    assert "smoother" in ended.out
    assert max(map(len, ended.out.splitlines())) <= 100


def test_a_folder_that_is_no_dive_is_named(tmp_path):
    with pytest.raises(ReadError, match=r"nowhere.errors\.parquet: not there"):
        compare_dives([tmp_path / "nowhere"], by="method")
    with pytest.raises(ReadError, match="no dive to compare"):
        compare_dives([], by="method")


def test_a_fix_that_nothing_could_have_reached_is_no_reference():
    solution, reference = make_solution(duration_s=1800.0)
    fixes = solution.fixes
    far = np.flatnonzero(fixes.consistent)[5]
    moved_m = fixes.position_enu_m.copy()
    moved_m[far, 0] += 6000.0
    moved = dataclasses.replace(fixes, position_enu_m=moved_m)
    wild = dataclasses.replace(solution, fixes=moved)
    before, after = (error_over_time(s, reference)["ekf", "fix"] for s in (solution, wild))
    assert len(after) == len(before) - 1
    assert after.distance_m.max() < 100.0


def marked(folder, level):
    """A dive's folder with a verdict."""
    (folder / "summary.json").write_text(json.dumps({"verdict": {"level": level, "reasons": []}}))
    return folder


def test_an_unusable_dive_is_pooled_only_when_asked_for(tmp_path):
    for name, level, error_m in (("a", "good", 1.0), ("b", "check", 3.0), ("c", "unusable", 900.0)):
        marked(write_errors(tmp_path / "out" / name, [error_m]), level)
    table, left_out = compare_places([str(tmp_path / "out")], "method")
    assert left_out == ["c"]
    assert (table["dives"].tolist(), table["mean_m"].tolist()) == ([2], [2.0])
    table, left_out = compare_places([str(tmp_path / "out")], "method", everything=True)
    assert (left_out, table["dives"].tolist()) == ([], [3])
    alone, left_out = compare_places([str(tmp_path / "out" / "c")], "method")
    assert (left_out, alone["mean_m"].tolist()) == ([], [900.0])
    each, left_out = compare_places([str(tmp_path / "out")], "dive")
    assert (left_out, each["dive"].tolist()) == ([], ["a", "b", "c"])


def test_when_all_dives_are_unusable_it_says_what_to_do(tmp_path):
    for name in ("a", "b"):
        marked(write_errors(tmp_path / "out" / name, [1.0]), "unusable")
    with pytest.raises(ReadError, match="all 2 dives are unusable; --all"):
        compare_places([str(tmp_path / "out")], "method")


def test_the_command_gives_json_and_names_who_is_left_out(abyssnav, tmp_path):
    for name, level in (("a", "good"), ("b", "unusable")):
        marked(write_errors(tmp_path / "out" / name, [1.0]), level)
    ended = abyssnav("compare", tmp_path / "out", "--json")
    (row,) = json.loads(ended.out)
    assert (row["dives"], row["mean_m"], row["mean_low_m"]) == (1, 1.0, None)
    assert (
        "1 unusable dives left out (--all pools them too): b"
        in abyssnav("compare", tmp_path / "out").out
    )


def test_results_at_a_url_are_compared_like_those_in_a_folder(tmp_path):
    marked(write_errors(tmp_path / "out" / "a", [1.0]), "good")
    marked(write_errors(tmp_path / "out" / "b", [3.0]), "good")
    here, _ = compare_places([str(tmp_path / "out")], "dive")
    there, _ = compare_places([(tmp_path / "out").as_uri()], "dive")
    assert there.equals(here)
    with pytest.raises(ReadError, match="holds no result"):
        compare_places([(tmp_path / "nothing").as_uri()], "dive")
