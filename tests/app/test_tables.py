from __future__ import annotations

import re

import pytest

from failuretwin.app import terminal
from failuretwin.app.terminal import Table, elapsed, figures_table, progress_bar, show, tell
from warm_command import remarks

COUNTS = figures_table(("motor [counts]", "n"), [("a:smile: [b]", "1"), ("c", "20")], "counted")


def test_a_table_on_a_terminal_shows_every_letter(capsys):
    show("first", COUNTS, Table(("x", "y"), [("1", "2")], header=False))
    assert [line.rstrip() for line in capsys.readouterr().out.splitlines()] == [
        "first",
        "counted",
        "motor [counts]   n",
        "a:smile: [b]     1",
        "c               20",
        "1  2",
    ]


def test_sentences_are_not_cut(capsys):
    show("word " * 100)
    assert len(capsys.readouterr().out.splitlines()) == 1


def test_a_table_on_a_page_is_the_same_value():
    jinja2 = pytest.importorskip("jinja2")
    page = '{% from "base.html.j2" import table %}{{ table(value) }}'
    pages = jinja2.Environment(loader=jinja2.PackageLoader("failuretwin.app", ""), autoescape=True)
    value = Table(("a<b", "n"), [("x&y", "1")], "lr", "title")
    assert pages.from_string(page).render(value=value).split("\n") == [
        "<h3>title</h3>",
        '<div class="scroll"><table>',
        '<tr><th>a&lt;b</th><th class="number">n</th></tr>',
        '<tr><td>x&amp;y</td><td class="number">1</td></tr>',
        "</table></div>",
    ]


@pytest.fixture
def clock(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(terminal.time, "monotonic", lambda: now[0])
    return now


def test_long_work_says_how_far_it_is_without_a_terminal(clock, capsys):
    with progress_bar("simulating", 100) as advance:
        for seconds, steps in ((4.0, 10), (2.0, 10), (3.0, 10), (3.0, 30), (8.0, 40)):
            clock[0] += seconds
            advance(steps)
    # told after 6 s and 12 s; 20 of 100 in 6 s leave 24 s, 60 of 100 in 12 s leave 8 s
    assert capsys.readouterr().err.splitlines() == [
        "simulating: 20 of 100, about 24 s left",
        "simulating: 60 of 100, about 8 s left",
    ]


def test_short_work_says_nothing(clock, capsys):
    with progress_bar("simulating", 10) as advance:
        for _ in range(10):
            clock[0] += 0.4
            advance(1)
    assert capsys.readouterr().err == ""


def test_work_of_unknown_length_says_that_it_goes_on(monkeypatch, capsys):
    monkeypatch.setattr(terminal, "REPORT_EVERY_S", 0.01)
    told = ""
    with elapsed("diagnosing"):
        while told.count("\n") < 3:
            told += capsys.readouterr().err
    assert re.fullmatch(r"(diagnosing: 0 s so far\n)+", told)
    assert remarks(told) == ""


def test_text_of_files_does_not_act_on_the_terminal(capsys):
    name = "run \x1b[31m[red]x\x9b2J"
    show(f"a {name}", Table(("run", name), [[name, "1"]], title=name))
    tell(name)
    tell(name, err=True)
    out, err = capsys.readouterr()
    assert "\x1b" not in out + err
    assert "\x9b" not in out + err
    assert out.count("run \\x1b[31m[red]x\\x9b2J") == 5
