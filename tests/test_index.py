# SPDX-License-Identifier: Apache-2.0
import json
import re
from pathlib import Path

import pytest
from solutions import judged, make_solution, make_summary
from test_report import NASTY, parsed

from abyssnav.compare import error_over_time, summarise
from abyssnav.outputs.files import write
from abyssnav.outputs.html import render
from abyssnav.outputs.html.index import write_index
from abyssnav.outputs.presentation import duration
from abyssnav.outputs.summary import write_summary
from abyssnav.tables import Evaluation

REASON = "The compass never changes."


def write_dive(folder, reference=None, level="good"):
    solution, truth = make_solution(duration_s=1200.0)
    solution = judged(solution, level)
    errors = error_over_time(solution, truth if reference else None)
    comparison = summarise(errors)
    folder.mkdir()
    write(Evaluation(solution, comparison, errors, None), folder)
    write_summary(make_summary(solution, comparison), folder)


@pytest.fixture
def batch(tmp_path):
    write_dive(tmp_path / "dive a", reference=True)
    write_dive(tmp_path / "dive_b", level="unusable")
    outcomes = [("dive a", "done", ""), ("dive_b", "done", ""), (NASTY, "refused", NASTY)]
    write_index(outcomes, tmp_path, tmp_path / "index.html")
    return tmp_path


def test_each_dive_has_a_row_with_its_errors(batch):
    page = parsed(batch / "index.html")
    head, *rows = page.tables["dives"]
    a, b, refused = rows
    summary = json.loads((batch / "dive a" / "summary.json").read_text("utf-8"))
    truth = summary["methods"]["ekf_gated"]["errors"]["truth"]
    assert a[head.index("ekf_gated")] == f"{truth['rms_m']:,.2f}"
    fix = json.loads((batch / "dive_b" / "summary.json").read_text("utf-8"))
    distance = fix["methods"]["ekf"]["errors"]["fix"]["rms_m"]
    assert b[head.index("ekf")] == f"({distance:,.2f})"
    assert a[2].startswith("GOOD")
    assert float(a[3]) == pytest.approx(a_radius_m(batch), abs=0.005)
    assert b[2] == f"UNUSABLE{REASON}"
    assert b[3] == "–"
    assert refused[1:] == [NASTY, f"REFUSED {NASTY}"]


def a_radius_m(batch):
    return json.loads((batch / "dive a" / "summary.json").read_text("utf-8"))["uncertainty_95_m"]


def test_the_levels_are_counted(batch):
    text = (batch / "index.html").read_text("utf-8")
    line = re.sub("<[^>]*>", "", text[text.index('class="counts">') :].split("</p>")[0])
    assert line.endswith("GOOD 1 CHECK 0 UNUSABLE 1 REFUSED 1")


def test_each_done_dive_has_a_plan_and_a_link_to_its_report(batch):
    text = (batch / "index.html").read_text("utf-8")
    length_s = json.loads((batch / "dive_b" / "summary.json").read_text("utf-8"))["duration_s"]
    assert text.count(f"<small>{duration(length_s)}</small>") == 2
    assert 'href="dive%20a/report.html"' in text
    assert text.count("<polyline") == 2
    assert "<script>alert" not in text
    assert text.count("</script>") == 1


def column_as_shown(page, place):
    cell = f"(r => r.cells[{place}] ? r.cells[{place}].innerText : '')"
    return page.evaluate(f"[...document.querySelectorAll('#dives tbody tr')].map({cell})")


def test_a_click_on_a_heading_sorts_by_it(browser, batch):
    heard = []
    with browser.new_page(viewport={"width": 1200, "height": 900}) as page:
        page.on("console", lambda message: heard.append(message.text))
        page.on("pageerror", lambda error: heard.append(str(error)))
        page.goto((batch / "index.html").as_uri())
        before = column_as_shown(page, 1)
        page.click("th:has-text('verdict')")
        assert column_as_shown(page, 1) == before
        page.click("th:has-text('verdict')")
        assert column_as_shown(page, 1) == before[::-1]
        page.click("th:has-text('95 %')")
        assert column_as_shown(page, 3)[0] not in ("–", "")
    assert heard == []


def test_it_fits_a_phone(browser, batch):
    with browser.new_page(viewport={"width": 390, "height": 844}) as page:
        page.goto((batch / "index.html").as_uri())
        assert page.evaluate("document.documentElement.scrollWidth") <= 390


def test_every_page_begins_with_the_one_head():
    package = Path(render.__file__).parents[2]
    pages = sorted(path for path in package.rglob("*.html") if path.name != "head.html")
    assert [page.name for page in pages] == [
        "calibrate.html",
        "index.html",
        "page.html",
        "plan.html",
    ]
    assert all(page.read_text("utf-8").startswith("$head<style>") for page in pages)
    assert "script-src" not in render.head("Plan of <a>")
    assert "<title>Plan of &lt;a&gt; - abyssnav</title>" in render.head("Plan of <a>")
