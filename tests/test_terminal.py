# SPDX-License-Identifier: Apache-2.0
"""What a person sees: nothing cut at 80 columns, verdicts in words, strangers' letters escaped."""

import re
from pathlib import Path

import pandas as pd
import pytest
from rich.cells import cell_len
from solutions import judged, make_solution

from abyssnav.batch import Outcome
from abyssnav.compare import error_over_time, summarise
from abyssnav.outputs.palette import level_colour
from abyssnav.outputs.presentation import LEVEL_WORDS
from abyssnav.run import Result
from abyssnav.tables import LEVELS, Check
from abyssnav.terminal import dives, show_batch, show_comparison, show_result


def shown(capsys, show, *arguments):
    capsys.readouterr()
    show(*arguments)
    return capsys.readouterr().out


def result_of(solution, reference, folder):
    folder.mkdir()
    (folder / "summary.json").write_text("{}")
    comparison = summarise(error_over_time(solution, reference))
    return Result(folder, solution, comparison, 1200.0, {})


@pytest.fixture(params=[80, 100])
def columns(request, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(request.param))
    return request.param


@pytest.mark.parametrize("level", LEVELS)
def test_a_result_is_whole_at_any_width(capsys, tmp_path, columns, level):
    solution, reference = make_solution(duration_s=1200.0)
    result = result_of(judged(solution, level), reference, tmp_path / "d")
    text = shown(capsys, show_result, result)
    table = text[: text.index("wrote")]
    assert max(cell_len(line) for line in table.splitlines()) <= columns
    assert "…" not in text
    word, sentence = LEVEL_WORDS[level]
    flat = " ".join(text.split())
    assert f"{word} {sentence}" in flat
    for reason in result.solution.verdict.reasons:
        for part in (reason.cause, reason.seen, reason.advice):
            assert part in flat
    for name in ("mean_m", "rms_m", "p95_m", "max_m"):
        figure = getattr(result.comparison, name)[result.comparison.reference == "truth"][-1]
        assert f"{figure:,.2f}" in text or f"{figure:,.0f}" in text
    assert ("95 % within" in flat) == (level != "unusable")


def test_many_columns_go_into_several_tables_each_with_its_names(capsys, columns):
    figures = {
        f"{name}_m": [1234.5, 2.0] for name in ("mean", "std", "rms", "median", "p95", "max")
    }
    table = pd.DataFrame(
        {
            "dive": ["a_dive_of_a_very_long_name_" * 3] * 2,
            "method": ["ekf_ungated", "smoother"],
            "reference": ["truth", "truth"],
            "n": [100_000, 2],
            **figures,
            "mean_low_m": [1000.0, 1.5],
            "mean_high_m": [1500.0, 2.5],
        }
    )
    text = shown(capsys, show_comparison, table)
    assert max(cell_len(line) for line in text.splitlines()) <= columns
    assert text.count("1,234") == 6 or text.count("1,235") == 6
    assert "1,000 - 1,500" in text
    assert "…" not in text


def test_a_limit_says_whether_it_is_the_least_or_the_most(capsys, tmp_path):
    solution, reference = make_solution(duration_s=1200.0)
    bad = Check("navigate", "fixes", 3.0, 10.0, "", False, bound="min")
    solution = type(solution)(**{**vars(solution), "checks": (bad,)})
    text = shown(capsys, show_result, result_of(solution, reference, tmp_path / "d"))
    assert "fixes 3, limit at least 10" in text
    assert re.search(r"velocity gap 31 s, limit\s+at most 1", text)


def test_a_batch_has_a_line_a_dive_with_verdict_and_radius(capsys, tmp_path):
    outcomes = [
        Outcome("a", "done", verdict="good", uncertainty_95_m=2.13),
        Outcome("b", "done", verdict="unusable", fresh=False),
        Outcome("c\x1b[2J", "refused", "no topic '\x07'"),
    ]
    with dives(3) as on_outcome:
        for outcome in outcomes:
            on_outcome(outcome)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "GOOD      a  95 % within 2.13 m"
    assert lines[1] == "UNUSABLE  b    (as it was)"
    assert lines[2] == r"REFUSED   c\x1b[2J  no topic '\x07'"
    pd.DataFrame({"method": ["ekf"], "rms_m": [1.0]}).to_parquet(tmp_path / "comparison.parquet")
    text = shown(capsys, show_batch, outcomes, str(tmp_path))
    assert "GOOD 1  CHECK 0  UNUSABLE 1" in text


def test_a_logs_letters_move_no_cursor(capsys, tmp_path):
    solution, reference = make_solution(duration_s=600.0, name="dive\x1b[2J\n")
    bad = Check("align", "gap", 1.0, 0.0, "s", False, "topic /x\x1b]0;title\x07")
    solution = type(solution)(**{**vars(solution), "checks": (bad,)})
    folder = tmp_path / "d\x1b[31m"
    text = shown(capsys, show_result, result_of(solution, reference, folder))
    assert not [letter for letter in text if not letter.isprintable() and letter != "\n"]
    assert r"dive\x1b[2J\n" in text
    assert str(Path(folder.name)).replace("\x1b", r"\x1b") in text


@pytest.mark.parametrize("level", LEVELS)
def test_the_colour_of_a_level_bears_white_letters(level):
    from test_palette import contrast

    from abyssnav.outputs.palette import rgb

    assert contrast(rgb(level_colour(level)), (255, 255, 255)) > 4.5
