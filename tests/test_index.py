# SPDX-License-Identifier: Apache-2.0
import json

import pytest
from solutions import make_solution, make_summary
from test_report import NASTY, parsed

from abyssnav.compare import error_over_time, summarise
from abyssnav.outputs.files import write
from abyssnav.outputs.html.index import write_index
from abyssnav.outputs.html.words import duration
from abyssnav.outputs.summary import write_summary


def write_dive(folder, reference=None, **of):
    solution, truth = make_solution(duration_s=1200.0, **of)
    errors = error_over_time(solution, truth if reference else None)
    comparison = summarise(errors)
    folder.mkdir()
    write(solution, comparison, errors, None, folder)
    write_summary(make_summary(solution, comparison), folder)


@pytest.fixture
def batch(tmp_path):
    write_dive(tmp_path / "dive a", reference=True)
    write_dive(tmp_path / "dive_b")
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
    assert a[2] == "velocity gap"
    assert refused[1:] == [NASTY, f"refused: {NASTY}"]


def test_each_done_dive_has_a_plan_and_a_link_to_its_report(batch):
    text = (batch / "index.html").read_text("utf-8")
    length_s = json.loads((batch / "dive_b" / "summary.json").read_text("utf-8"))["duration_s"]
    assert text.count(f"<span>{duration(length_s)}</span>") == 2
    assert 'href="dive%20a/report.html"' in text
    assert text.count("<polyline") == 2
    assert "<script" not in text
