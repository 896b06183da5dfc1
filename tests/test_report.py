# SPDX-License-Identifier: Apache-2.0
import base64
import csv
import dataclasses
import gzip
import hashlib
import html
import json
import math
import re
import shutil
import subprocess
from contextlib import contextmanager
from html.parser import HTMLParser
from importlib import resources

import numpy as np
import pytest
from solutions import (
    judged,
    make_log,
    make_solution,
    make_summary,
    stripped,
    unpositioned,
    with_positions,
)

from abyssnav.compare import error_over_time, summarise
from abyssnav.config import Attribution, Config
from abyssnav.geometry import geodetic_to_enu
from abyssnav.outputs.files import write
from abyssnav.outputs.html import plotting_script, report, script_json
from abyssnav.outputs.html.data import ACCEPTED_POINTS, plot_data
from abyssnav.outputs.html.plan import TRACK_POINTS, band_half_width_m
from abyssnav.outputs.html.thinning import keep_corners, keep_extremes
from abyssnav.outputs.palette import level_colour
from abyssnav.outputs.presentation import LEVEL_WORDS, position_fixes
from abyssnav.tables import (
    ARRIVALS,
    DECISIONS,
    EXPLANATIONS,
    LEVELS,
    Check,
    Evaluation,
    Finding,
    Learned,
)

NASTY = "</script><script>alert('x')</script><b>&amp;"


def write_report(path, solution, reference=None):
    errors = error_over_time(solution, reference)
    comparison = summarise(errors)
    summary = make_summary(solution, comparison)
    report(Evaluation(solution, comparison, errors, reference), summary, path)
    return path


@pytest.fixture(scope="module")
def dive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    names = ("Alpha", NASTY, "Charlie", "Delta")
    solution, reference = make_solution(duration_s=3600.0, name=NASTY, beacon_names=names)
    bad = Check("align", "velocity_gap", 31.0, 1.0, "s", False, f"at {NASTY}")
    solution = dataclasses.replace(solution, checks=(*solution.checks, bad))
    errors = error_over_time(solution, reference)
    write(Evaluation(solution, summarise(errors), errors, None), folder)
    return solution, write_report(folder / "report.html", solution, reference)


def test_the_head_says_who_made_the_data_where_the_settings_do(tmp_path):
    solution, _ = make_solution(duration_s=1200.0)
    given = Config(attribution=Attribution(creator_name=NASTY, license="CC-BY-4.0"))
    comparison = summarise({})
    summary = make_summary(solution, comparison, config=given)
    report(Evaluation(solution, comparison, {}, None), summary, tmp_path / "page.html")
    head = re.search(r"<header>.*</header>", (tmp_path / "page.html").read_text("utf-8"))[0]
    assert f"<span>{html.escape(NASTY)} · CC-BY-4.0</span>" in head


class Tables(HTMLParser):
    """Cells of each table of a page, by its id, and the elements that were opened."""

    def __init__(self):
        super().__init__()
        self.tables, self.opened, self._cell = {}, [], None

    def handle_starttag(self, tag, attrs):
        self.opened.append(tag)
        if tag == "table":
            self._rows = self.tables.setdefault(dict(attrs)["id"], [])
        elif tag == "tr":
            self._rows.append([])
        elif tag in ("td", "th"):
            self._cell = ""

    def handle_data(self, data):
        if self._cell is not None:
            self._cell += data

    def handle_endtag(self, tag):
        if tag in ("td", "th"):
            self._rows[-1].append(self._cell)
            self._cell = None


def parsed(path):
    page = Tables()
    page.feed(path.read_text(encoding="utf-8"))
    return page


def test_the_tables_hold_the_numbers_of_comparison_csv(dive):
    tables = parsed(dive[1]).tables
    with (dive[1].parent / "comparison.csv").open() as file:
        rows = list(csv.DictReader(file))
    for name in ("truth", "fix"):
        expected = [row for row in rows if row["reference"] == name]
        shown = tables[f"comparison-{name}"][1:]
        assert [row[0] for row in shown] == [row["method"] for row in expected]
        for got, wanted in zip(shown, expected, strict=True):
            assert int(got[1].replace(",", "")) == int(wanted["n"])
            numbers = [
                wanted[k] for k in ("mean_m", "std_m", "rms_m", "median_m", "p95_m", "max_m")
            ]
            assert got[2:] == [f"{float(x):.3f}" for x in numbers]


def test_the_gate_tables_hold_the_statistics(dive):
    statistics = dive[0].statistics["ekf_gated"]
    shown = parsed(dive[1]).tables["gate-ekf_gated"][1:]
    assert [int(row[3]) for row in shown] == statistics.gated.tolist()
    assert shown[1][0] == NASTY


def test_arrivals_are_counted_by_beacon_class_and_reason(dive):
    head, *rows = parsed(dive[1]).tables["arrivals"]
    innovations = dive[0].innovations["ekf"]
    for row, beacon_id in zip(rows, np.unique(innovations.beacon_id), strict=True):
        mine = innovations[innovations.beacon_id == beacon_id]
        for name in ARRIVALS:
            assert int(row[head.index(name)]) == (mine.arrival == ARRIVALS.index(name)).sum()
        late = EXPLANATIONS.index("late_copy")
        assert int(row[head.index("late copy")]) == (mine.explanation == late).sum()


def test_positions_of_another_kind_are_counted_by_method(dive, tmp_path):
    solution = with_positions(dive[0])
    page = parsed(write_report(tmp_path / "positions.html", solution))
    assert page.tables["positions"][1:] == [
        ["ekf", "90", "79", "11"],
        ["smoother", "90", "81", "9"],
    ]
    assert ["positions", "90"] in [row[:2] for row in page.tables["sensors"]]
    without = parsed(dive[1]).tables
    assert "positions" not in without
    assert "positions" not in [row[0] for row in without["sensors"]]


def test_positions_of_another_kind_are_thinned_but_for_those_not_accepted(dive):
    fixes = with_positions(dive[0], n=20_000).positions["smoother"]
    shown = plot_data(with_positions(dive[0], n=20_000), {}, None)["positions"]
    decision = np.frombuffer(base64.b64decode(shown["decision"]), "u1")
    t_s, east_m = (np.frombuffer(base64.b64decode(shown[k]), "<f4") for k in ("t", "x"))
    assert (decision != 0).sum() == (fixes.decision != 0).sum()
    assert ACCEPTED_POINTS / 2 < (decision == 0).sum() <= ACCEPTED_POINTS
    rows = np.searchsorted(fixes.t_s.astype("f4"), t_s)
    np.testing.assert_allclose(east_m, fixes.position_enu_m[rows, 0], atol=1e-3)
    assert plot_data(dive[0], {}, None)["positions"] is None


def test_positions_that_no_method_met_are_not_shown_as_accepted(dive):
    solution = dataclasses.replace(with_positions(dive[0]), positions={})
    fixes = position_fixes(solution)
    met = with_positions(dive[0]).positions["ekf"]
    np.testing.assert_allclose(fixes.position_enu_m, met.position_enu_m)
    assert {DECISIONS[k] for k in fixes.decision} == {"before_start"}


def test_the_accuracy_of_each_leg_is_told(dive):
    head, *rows = parsed(dive[1]).tables["accuracy"]
    legs = dive[0].accuracy
    place = head.index("95 % radius [m]")
    assert [float(row[place]) for row in rows] == legs.uncertainty_95_m.round(2).tolist()
    assert {row[head.index("at crossings")] for row in rows} == {"–"}
    assert "2.1 m, worst leg 2.2 m" in dive[1].read_text("utf-8")


def test_beacons_origin_and_water_are_those_of_the_dive(dive, tmp_path):
    solution, path = dive
    beacons, origin = solution.dive.beacons, solution.dive.origin
    head, *rows = parsed(path).tables["beacons"]
    assert [row[0] for row in rows] == beacons.name.tolist()

    def column(name):
        return np.array([float(row[head.index(name)].replace(",", "")) for row in rows])

    depth_m = column("depth [m]")
    enu_m = np.column_stack([column("east [m]"), column("north [m]"), -depth_m])
    np.testing.assert_allclose(enu_m, beacons.position_enu_m, atol=0.0051)
    place = (column("latitude [°]"), column("longitude [°]"), -depth_m)
    back_m = geodetic_to_enu(origin.latitude_deg, origin.longitude_deg, *place)
    np.testing.assert_allclose(back_m[:, :2], enu_m[:, :2], atol=3.0)  # of the tangent plane
    assert column("turn-around [s]") == pytest.approx(beacons.turn_around_s, abs=1e-4)
    assert f"{origin.latitude_deg:.7f}°" in path.read_text("utf-8")

    local = dataclasses.replace(solution, dive=dataclasses.replace(solution.dive, origin=None))
    page = write_report(tmp_path / "local.html", local)
    assert "latitude [°]" not in parsed(page).tables["beacons"][0]
    assert "no origin" in page.read_text("utf-8")


def test_what_the_reader_met_and_what_happened_is_told(dive, tmp_path):
    assert parsed(dive[1]).tables["events"][1] == [
        "0 h 16 min 40 s",
        "ekf",
        "recovered by consensus",
    ]
    assert "findings" not in parsed(dive[1]).tables
    log = make_log(dive[0])
    cut = dataclasses.replace(log, findings=(Finding("cut short", f"a{NASTY}", "12 bytes"),))
    comparison = summarise(error_over_time(dive[0], None))
    summary = make_summary(dive[0], comparison, cut)
    report(Evaluation(dive[0], comparison, {}, None), summary, tmp_path / "cut.html")
    table = parsed(tmp_path / "cut.html").tables["findings"]
    assert table[1] == ["cut short", f"a{NASTY}", "12 bytes"]


def test_a_method_of_ones_own_has_its_place_in_the_page(tmp_path):
    solution, reference = make_solution(duration_s=600.0)
    tracks = {**solution.tracks, "ekf_huber": solution.tracks["ekf"]}
    more = dataclasses.replace(solution, tracks=tracks)
    page = parsed(write_report(tmp_path / "more.html", more, reference))
    assert [row[0] for row in page.tables["comparison-truth"]][-1] == "ekf_huber"


def test_names_from_the_log_are_text_and_nothing_else(dive):
    text = dive[1].read_text(encoding="utf-8")
    assert "<script>alert" not in text
    assert text.count("</script>") == 4
    assert parsed(dive[1]).opened.count("script") == 4


@pytest.mark.parametrize("level", LEVELS)
def test_the_verdict_comes_first_in_colour_and_words_with_its_reasons(dive, tmp_path, level):
    solution = judged(dive[0], level)
    text = write_report(tmp_path / "page.html", solution).read_text("utf-8")
    body = text[text.index("<header>") : text.index('<script id="data"')]
    assert body.index('id="verdict"') < body.index('class="tiles"') < body.index('id="plan"')
    word, sentence = LEVEL_WORDS[level]
    assert f'style="background:{level_colour(level)}">{word}</b> {sentence}' in body
    for reason in solution.verdict.reasons:
        for part in (reason.cause, reason.seen, reason.advice):
            assert part in body


def test_an_unusable_dive_has_no_radius_anywhere(dive, tmp_path):
    path = write_report(tmp_path / "page.html", judged(dive[0], "unusable"))
    text = path.read_text("utf-8")
    assert "95 % within" not in text[: text.index('<script id="data"')]
    head, *rows = parsed(path).tables["accuracy"]
    assert {row[head.index("95 % radius [m]")] for row in rows} == {"–"}
    assert page_data(path)["plan"]["band"] is None


def page_data(path):
    text = path.read_text("utf-8")
    block = text[text.index('type="application/json">') + len('type="application/json">') :]
    return json.loads(block[: block.index("</script>")])


def test_a_limit_says_whether_it_is_the_least_or_the_most(dive, tmp_path):
    checks = (
        Check("navigate", "fixes", 3.0, 10.0, "", False, bound="min"),
        Check("align", "gap", 7.0, 5.0, "s", False),
    )
    bounded = dataclasses.replace(dive[0], checks=checks)
    head, *rows = parsed(write_report(tmp_path / "page.html", bounded)).tables["checks"]
    limits = {row[head.index("check")]: row[head.index("limit")] for row in rows}
    assert limits["fixes"] == "at least 10"
    assert limits["gap"] == "at most 5"


def test_dead_reckoning_from_an_invented_point_is_not_shown_as_positioned(dive, tmp_path):
    _, reference = make_solution(duration_s=3600.0)
    path = write_report(tmp_path / "page.html", unpositioned(dive[0]), reference)
    text = path.read_text("utf-8")
    body = text[text.index("<header>") : text.index('<script id="data"')]
    assert "No acoustic track: dead reckoning only, from an arbitrary point." in body
    assert "the shape of the way, not where it lies" in body
    data = page_data(path)
    assert data["beacons"] == []
    assert data["reference"] is None
    assert data["plan"]["positioned"] is False
    assert data["plan"]["band"] is None
    assert "Alpha" not in body[body.index('id="overview"') : body.index('id="plan"')]


def test_learned_parameters_stand_beside_their_priors(dive, tmp_path):
    learned = (
        Learned("turn_around_s", 0.2051, 0.0002, 0.2, 0.001, "s", beacon_id=11),
        Learned("dvl_scale", 0.004, 0.001, 0.0, 0.004, ""),
    )
    wise = dataclasses.replace(dive[0], learned=learned)
    rows = parsed(write_report(tmp_path / "page.html", wise)).tables["learned"][1:]
    assert rows[0] == ["turn around s", "Alpha", "0.2051", "0.0002", "0.2", "0.001", "s", "5.1"]
    assert rows[1][1] == ""
    assert rows[1][-1] == "1.0"


def test_control_characters_of_a_log_are_shown_escaped(tmp_path):
    solution, _ = make_solution(duration_s=600.0, name="a\x1b[31mb", beacon_names=("\x07", "B\n"))
    text = write_report(tmp_path / "page.html", solution).read_text("utf-8")
    assert "\x1b" not in text
    assert "\x07" not in text
    assert r"a\x1b[31mb" in text
    assert parsed(tmp_path / "page.html").tables["beacons"][2][0] == r"B\n"


def test_the_plan_is_framed_on_the_track_that_stands_for_the_dive(dive, tmp_path):
    solution = dive[0]
    lost = solution.tracks["ekf_ungated"]
    far = dataclasses.replace(lost, position_enu_m=lost.position_enu_m + 1e5)
    wild = dataclasses.replace(solution, tracks={**solution.tracks, "ekf_ungated": far})
    west, east, south, north = page_data(write_report(tmp_path / "w.html", wild))["plan"]["frame"]
    enu_m = solution.tracks["smoother"].position_enu_m
    assert west < enu_m[:, 0].min() < enu_m[:, 0].max() < east < 1e4
    assert south < enu_m[:, 1].min() < enu_m[:, 1].max() < north < 1e4


def test_the_band_is_as_wide_as_the_radius_of_the_leg(dive):
    solution = dive[0]
    track = solution.tracks["smoother"]
    half_m = band_half_width_m(solution, track)
    legs = solution.accuracy
    for begin_s, end_s, radius_m in zip(
        legs.t_begin_s, legs.t_end_s, legs.uncertainty_95_m, strict=True
    ):
        inside = (track.t_s >= begin_s) & (track.t_s < end_s)
        assert (half_m[inside] == radius_m).all()
    formal = dataclasses.replace(solution, accuracy=None)
    east = band_half_width_m(formal, track[track.t_s < 1000.0])[100:900]
    cov_m2 = track.position_cov_m2[0]  # on a leg to the east the band is as wide as north's
    np.testing.assert_allclose(np.median(east), np.sqrt(5.991 * cov_m2[1, 1]), rtol=0.02)


def test_marks_of_time_stand_on_the_track_at_round_minutes(dive):
    marks = page_data(dive[1])["plan"]["marks"]
    assert 5 <= len(marks["label"]) <= 14
    track, start_s = dive[0].tracks["smoother"], dive[0].dive.start_ns / 1e9
    hour, minute = map(int, marks["label"][3].split(":"))
    t_s = (hour * 3600 + minute * 60 - start_s) % 86400
    place = [np.interp(t_s, track.t_s, track.position_enu_m[:, k]) for k in (0, 1)]
    np.testing.assert_allclose([marks["x"][3], marks["y"][3]], place, atol=0.01)


def test_json_in_a_script_element_cannot_end_it():
    assert "<" not in script_json({"name": NASTY, "line": "\u2028"})
    with pytest.raises(ValueError, match="not JSON compliant"):
        script_json({"value": math.nan})


def test_the_plotting_script_is_the_one_its_licence_note_names():
    here = resources.files("abyssnav.outputs.html")
    script = gzip.decompress((here / "plotly-basic.min.js.gz").read_bytes())
    note = (here / "plotly-LICENSE.txt").read_text("utf-8")
    assert hashlib.sha256(script).hexdigest() in note
    assert b"</script" not in script


def test_a_thinned_curve_keeps_its_extremes_and_ends():
    values = np.sin(np.arange(100_003) / 900.0)
    values[[777, 54_321]] = [5.0, -7.0]
    kept = keep_extremes(values, 4000)
    assert len(kept) <= 4100
    assert {0, 777, 54_321, 100_002} <= set(kept.tolist())
    assert (np.diff(kept) > 0).all()
    assert keep_extremes(values[:4000], 4000).tolist() == list(range(4000))


def test_a_thinned_track_keeps_its_corners():
    leg = np.arange(0.0, 500.0)
    flat = np.zeros_like(leg)
    east_m = np.concatenate([leg, flat + 500, 500 - leg, flat])
    north_m = np.concatenate([flat, leg, flat + 500, 500 - leg])
    enu_m = np.tile(np.column_stack([east_m, north_m, 0 * east_m]), (6, 1))
    kept = enu_m[keep_corners(enu_m, 600)]
    corners = {(0.0, 0.0), (500.0, 0.0), (500.0, 500.0), (0.0, 500.0)}
    assert len(kept) <= 650
    near = [min(math.dist(corner, place) for place in kept[:, :2]) for corner in corners]
    assert max(near) <= 1.5


def test_a_report_of_a_day_stays_below_five_megabytes(tmp_path):
    path = write_report(tmp_path / "day.html", *make_solution(duration_s=86400.0))
    assert path.stat().st_size < 5_000_000


def test_a_dive_with_hardly_anything_in_it_has_a_report(tmp_path):
    solution, _ = make_solution(duration_s=600.0)
    bare = stripped(solution, replies=solution.dive.replies[:0], depth=solution.dive.depth[:0])
    assert "Plan" in write_report(tmp_path / "bare.html", bare).read_text("utf-8")


def test_settings_that_nobody_gave_are_left_out(dive):
    names = {row[0] for row in parsed(dive[1]).tables["settings"]}
    assert {"gate.gamma", "output.rate_hz"} <= names
    assert not {"attribution.license", "origin", "beacon", "gate.probability"} & names


# --- in a browser -----------------------------------------------------------------------------


@contextmanager
def open_report(browser, path):
    """The page; what it said and asked for while it was open is asserted to be nothing."""
    heard = []
    with browser.new_page(viewport={"width": 1200, "height": 900}) as page:
        page.on("console", lambda message: heard.append(message.text))
        page.on("pageerror", lambda error: heard.append(str(error)))
        page.on("dialog", lambda dialog: heard.append(dialog.message))
        page.on("request", lambda request: heard.append(request.url))
        page.goto(path.as_uri())
        page.wait_for_selector("html[data-ready=yes]", state="attached")
        yield page
    outside = [line for line in heard if not line.startswith(("blob:", "data:"))]
    assert outside == [path.as_uri()]


@pytest.fixture
def opened(browser, dive):
    """A page of its own, for what clicks and zooms."""
    with open_report(browser, dive[1]) as page:
        yield page


@pytest.fixture(scope="module")
def untouched(browser, dive):
    """The page as it opens, for all that only look: drawing it takes more than a second."""
    with open_report(browser, dive[1]) as page:
        yield page


def drawn(page, figure):
    """Names of the traces of a figure, and how many points each draws."""
    script = "id => document.getElementById(id).data.map(t => [t.name, t.x.length])"
    return page.evaluate(script, figure)


def test_every_plot_is_drawn_from_the_dive(untouched, dive):
    solution = dive[0]
    traces = dict(drawn(untouched, "plan"))
    named = {"truth", "fix", "beacons", "95 % band", "time, UTC", "start, end"}
    assert set(solution.tracks) | named <= set(traces)
    assert traces["fix"] == solution.fixes.consistent.sum()
    assert dict(drawn(untouched, "error-truth")).keys() == set(solution.tracks) | {"fix"}
    innovations = solution.innovations["ekf"]
    rejected = (innovations.decision != 0) & np.isfinite(innovations.innovation_s)
    counts = [n for name, n in drawn(untouched, "innovations") if name == "rejected"]
    assert sum(counts) == rejected.sum()
    watch = solution.watch["ekf"]
    assert sum(n for _, n in drawn(untouched, "watch")) == 2 * len(watch)
    symbols = "document.getElementById('watch').data.flatMap(t => t.marker.symbol)"
    assert untouched.evaluate(symbols).count("x") == 2 * (watch.verdict > 0).sum()
    for figure in ("error-fix", "nis", "profile", "estimates"):
        assert drawn(untouched, figure)
    assert untouched.locator(".main-svg").count() >= 6


def test_the_plan_tells_accepted_positions_from_the_others_by_symbol(browser, dive, tmp_path):
    path = write_report(tmp_path / "positions.html", with_positions(dive[0]))
    script = """() => document.getElementById("plan").data.map(
        t => [t.name, t.x.length, t.marker && t.marker.symbol])"""
    with browser.new_page(viewport={"width": 1200, "height": 900}) as page:
        page.goto(path.as_uri())
        page.wait_for_selector("html[data-ready=yes]", state="attached")
        expected = [["position", 81, "diamond"], ["position, not accepted", 9, "x-thin"]]
        shown = [trace for trace in page.evaluate(script) if trace[0].startswith("position")]
        assert shown == expected


def test_the_hover_tells_utc_dive_time_depth_and_ping(untouched):
    hover = untouched.evaluate(
        "document.getElementById('plan').data.find(t => t.name === 'ekf').text"
    )
    expected = r"2025-10-09 08:55:20 UTC<br>dive 0:02:00<br>depth 4900\.0 m<br>ping \d+"
    assert re.fullmatch(expected, hover[0])


def test_the_gate_of_another_method_is_a_choice_away(opened):
    before = opened.evaluate("document.getElementById('innovations').data.map(t => t.x.length)")
    opened.select_option("#innovation-method", "ekf_ungated")
    after = opened.evaluate("document.getElementById('innovations').data.map(t => t.x.length)")
    assert before != after


def test_the_track_can_be_coloured_by_its_error_and_keeps_its_zoom(opened, dive):
    read = "document.getElementById('plan')._fullLayout.xaxis.range"
    box, whole = opened.locator("#plan .nsewdrag").first.bounding_box(), opened.evaluate(read)
    for move, share in ((None, 0.4), (opened.mouse.down, 0.6), (opened.mouse.up, 0.6)):
        if move:
            move()
        opened.mouse.move(box["x"] + share * box["width"], box["y"] + share * box["height"])
    opened.wait_for_function(f"{read}[0] !== {whole[0]}")
    zoomed = opened.evaluate(read)
    opened.select_option("#plan-colour", label="error")
    find = "document.getElementById('plan').data.find(t => t.name === 'error')"
    x, values = opened.evaluate(f"[{find}.x, {find}.marker.color]")
    track = dive[0].tracks["smoother"]
    thin = track[keep_corners(track.position_enu_m, TRACK_POINTS)]
    np.testing.assert_allclose(x, thin.position_enu_m[:, 0], rtol=1e-6)
    assert len(values) == len(x)
    np.testing.assert_allclose(opened.evaluate(read), zoomed, rtol=0.05)
    count = "document.getElementById('plan').on('plotly_relayout', () => { window.drawn += 1; })"
    opened.evaluate(f"() => {{ window.drawn = 0; {count}; }}")
    opened.select_option("#plan-colour", label="method")
    assert opened.evaluate(f"{find} === undefined")
    assert 0 < opened.evaluate("window.drawn") < 5  # was 450, each moving the axes by a hair


def test_shares_histograms_and_sigmas_are_those_of_the_dive(opened, dive):
    solution = dive[0]
    opened.select_option("#error-form", "shares")
    opened.select_option("#innovation-form", "histogram")
    read = "id => document.getElementById(id).data.map(t => [t.name, t.x, t.y])"
    named = {name: (x, y) for name, x, y in opened.evaluate(read, "error-truth")}
    with (dive[1].parent / "comparison.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["reference"] == "truth"]
    for row in rows:
        x, y = named[row["method"]]
        assert y[100] == pytest.approx(0.5)
        assert x[100] == pytest.approx(float(row["median_m"]), rel=1e-5)
    bars = [(n, y) for n, _, y in opened.evaluate(read, "innovations") if n != "expected, normal"]
    known = np.isfinite(solution.innovations["ekf"].innovation_s)
    accepted = solution.innovations["ekf"].decision == 0
    for name, rows in (("accepted", known & accepted), ("rejected", known & ~accepted)):
        assert sum(sum(y) for n, y in bars if n == name) == rows.sum()
    sigma = {name for name, _, _ in opened.evaluate(read, "sigma")}
    assert sigma == set(solution.tracks) | {"radius to rely on"}


def test_only_the_best_track_is_shown_at_first_the_others_are_a_click_away(untouched):
    script = "document.getElementById('plan').data.map(t => [t.name, t.visible])"
    hidden = {name for name, state in untouched.evaluate(script) if state == "legendonly"}
    assert {"dead_reckoning", "kf_fix", "ekf_ungated", "ekf_gated", "ekf"} <= hidden
    assert not {"smoother", "truth", "fix", "beacons", "95 % band"} & hidden


def test_the_scale_bar_follows_the_zoom(opened):
    read = "document.getElementById('plan').layout.annotations[0].text"
    before = opened.evaluate(read)
    opened.evaluate(
        "Plotly.relayout('plan', {'xaxis.range': [0, 40], 'yaxis.range': [0, 40]}).then(() => 0)"
    )
    opened.wait_for_function(f"{read} !== {before!r}")
    length_m = float(re.search(r"(\d+(?:\.\d+)?) m", opened.evaluate(read))[1])
    assert 4 <= length_m <= 20


def test_no_control_of_the_page_leads_off_it(opened):
    """Every button of every plot is pressed, and everything that could be sent is watched."""
    titles = opened.evaluate(
        "[...document.querySelectorAll('.modebar-btn')].map(b => b.dataset.title)"
    )
    assert len(titles) >= 20
    assert set(titles) == {"Download plot as a PNG", "Zoom", "Pan", "Reset axes"}
    opened.evaluate(
        "window.asked = []; window.open = (a) => { asked.push(a); return null; };"
        "HTMLFormElement.prototype.submit = function () { asked.push(this.action); }; 0"
    )
    pages = []
    opened.context.on("page", lambda page: pages.append(page.url))
    for button in opened.query_selector_all(".modebar-btn, button"):
        button.evaluate("b => b.click()")
    links = opened.evaluate(
        "[...document.querySelectorAll('a[href], form, iframe, link, img[src^=http]')].length"
    )
    opened.evaluate(
        "Promise.allSettled([...document.querySelectorAll('.js-plotly-plot')].map("
        "  async (p) => Plotly.Plots.sendDataToCloud(p, p._context.plotlyServerURL)))"
    )
    opened.wait_for_timeout(300)
    assert opened.evaluate("asked") == []
    assert pages == []
    assert links == 0
    servers = (
        "[...document.querySelectorAll('.js-plotly-plot')].map(p => p._context.plotlyServerURL)"
    )
    assert set(opened.evaluate(servers)) == {""}


def test_the_page_holds_no_address_that_a_script_could_open(dive):
    assert "cloud.plotly" not in plotting_script()
    assert "cdn.plot" not in plotting_script()
    text = dive[1].read_text("utf-8")
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)[1]
    for rule in ("default-src 'none'", "form-action 'none'", "base-uri 'none'"):
        assert rule in policy


def test_a_phone_shows_it_without_scrolling_sideways(browser, dive):
    with browser.new_page(viewport={"width": 390, "height": 844}) as page:
        page.goto(dive[1].as_uri())
        page.wait_for_selector("html[data-ready=yes]", state="attached")
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        small = page.evaluate(
            "[...document.querySelectorAll('p, b, td, figcaption, li')]"
            ".filter(e => parseFloat(getComputedStyle(e).fontSize) < 12).length"
        )
        assert small == 0


def test_light_and_dark_are_one_click_apart(opened):
    def colours():
        return opened.evaluate(
            "[getComputedStyle(document.body).backgroundColor,"
            " document.getElementById('plan').layout.paper_bgcolor,"
            " document.getElementById('nis').data.find(t => t.line).line.color]"
        )

    light = colours()
    opened.click("#theme")
    dark = colours()
    assert light == ["rgb(255, 255, 255)", "#ffffff", "#14202b"]
    assert dark == ["rgb(13, 17, 23)", "#0d1117", "#e4eaef"]


def sheets(pdf, folder):
    """Words of each printed sheet, by poppler."""
    if shutil.which("pdftotext") is None:
        pytest.skip("no pdftotext on this machine")
    (folder / "print.pdf").write_bytes(pdf)
    command = ["pdftotext", "-layout", folder / "print.pdf", "-"]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return done.stdout.split("\f")[:-1]


def test_printing_fits_the_plan_to_the_sheet_and_leaves_the_screen_as_it_was(opened):
    read = (
        "(({xaxis, yaxis, width}) => [...xaxis.range, ...yaxis.range, width])"
        "(document.getElementById('plan')._fullLayout)"
    )
    wanted = "JSON.parse(document.getElementById('data').textContent).plan.frame"
    west, east, south, north = opened.evaluate(wanted)
    on_screen = opened.evaluate(read)
    for _ in range(2):
        opened.evaluate("dispatchEvent(new Event('beforeprint'))")
        left, right, bottom, top, width_px = opened.evaluate(read)
        looser = min((right - left) / (east - west), (top - bottom) / (north - south))
        assert looser == pytest.approx(1.0, abs=0.02)
        assert width_px == 680
        opened.evaluate("dispatchEvent(new Event('afterprint'))")
    np.testing.assert_allclose(opened.evaluate(read), on_screen, rtol=0.02)


def test_it_prints_on_a4_a_summary_first_and_no_heading_alone(opened, tmp_path):
    pdf = opened.pdf(prefer_css_page_size=True)
    assert opened.evaluate("document.documentElement.dataset.theme") == "light"
    pages = sheets(pdf, tmp_path)
    assert 3 <= len(pages) <= 15
    assert "GOOD" in pages[0]
    assert "Depth, altitude, heading, speed" in pages[1].strip().splitlines()[0]
    headings = opened.evaluate("[...document.querySelectorAll('h2')].map(h => h.textContent)")
    for page in pages:
        lines = [line.strip() for line in page.splitlines() if line.strip()]
        assert lines[-1] not in headings
