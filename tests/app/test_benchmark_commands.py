"""`failuretwin benchmark` and `data`: what they show and what they refuse."""

from __future__ import annotations

import pytest
from click.testing import CliRunner

from failuretwin.app.cli import cli
from failuretwin.app.reports.benchmark_page import (
    HEADLINES,
    bundled_entries,
    comparison_tables,
    coverage_table,
)
from failuretwin.core.errors import InputError
from failuretwin.decision.benchmark.tasks import TASKS


def test_the_list_names_every_task():
    shown = CliRunner().invoke(cli, ["benchmark", "list"]).output
    assert all(name in shown for name in TASKS)
    assert "module:Class" in shown


@pytest.mark.parametrize(
    ("words", "error"),
    [
        ("--tasks isolat", "unknown task 'isolat'. Did you mean 'isolate'?"),
        ("--arms ur10", "unknown arm 'ur10'"),
        ("--tracks P3", "unknown track 'P3'"),
        ("--tasks cold --tracks P2", "no case has all of these"),
    ],
)
def test_wrong_parts_are_refused(words, error, tmp_path):
    command = f"benchmark run --method chance --out {tmp_path / 'out'} {words}"
    found = CliRunner().invoke(cli, command.split(), catch_exceptions=True).exception
    assert isinstance(found, InputError)
    assert error in str(found)


def test_a_missing_recorded_set_is_named(tmp_path):
    command = f"benchmark run --method chance --out {tmp_path} --tasks real --data {tmp_path / 'd'}"
    found = CliRunner().invoke(cli, command.split()).exception
    assert "failuretwin data fetch real_robot_b_20241003" in str(found)


def test_every_task_has_its_figure_in_the_table():
    assert set(HEADLINES) == set(TASKS)


def test_cases_without_scores_are_counted():
    one = {"arm": "so101", "case": "class-P0"}
    headings = coverage_table([]).headings
    assert headings == ["entry", "armpi_fpv, of 15", "so101, of 12", "ur5e, of 12", "panda, of 12"]
    (row,) = coverage_table([{"method": "m", "scores": [one, one]}]).rows
    assert row == ("m", "0", "1", "0", "0")


def test_bundled_entries_fill_the_table():
    entries = bundled_entries()
    methods = {entry["method"] for entry in entries}
    assert {"chance", "bayes"} <= methods
    titles = [table.title for table in comparison_tables(entries)]
    assert [title.partition(":")[0] for title in titles] == list(HEADLINES)
