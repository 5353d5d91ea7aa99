"""Code of the pages that are no tutorials: it runs, where the reader has logs and calibrations."""

from __future__ import annotations

import re
import shlex
import shutil
from importlib.resources import files
from pathlib import Path

import click
import numpy as np
import pytest

import executed
import failuretwin as ft
from failuretwin.app.cli import cli

ROOT = Path(__file__).parents[2]
PAGES = [*sorted((ROOT / "docs").glob("*.md")), ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
TRAINS = 'if __name__ == "__main__":  # other processes'
"""Begins a block that takes ten minutes; `ft.train` has tests of its own."""
WHOLE = ("store.md", "benchmark.md")
"""Their commands and code are run together, by `docs/conftest.py`."""
GIVEN = {"time": 0.0, "commands": np.zeros((1000, 4)), "points": np.full((1000, 3), 0.1)}
"""What a page says the reader has."""
CALIBRATIONS = {
    "my_robot.toml": "armpi_fpv.toml",
    "robot_1.toml": "armpi_fpv.toml",
    "robot_2.toml": "armpi_fpv_a_2024.toml",
    "robot_3.toml": "armpi_fpv_b_2024-05.toml",
}
"""The reader's calibrations, and the bundled ones that stand in for them."""


def blocks(page, *languages):
    return [code for kind, code in BLOCK.findall(page.read_text("utf-8")) if kind in languages]


@pytest.fixture(scope="module")
def home(tmp_path_factory, write_session):
    """A folder with all files that the pages take for granted."""
    home = tmp_path_factory.mktemp("reader")
    for folder in ("LOGS", "path/to/sessions"):
        write_session(home / folder / "one")
    for seed in range(1):
        write_session(home / "monday" / f"session_{seed}", seed=seed)
        write_session(home / "tuesday" / f"session_{seed}", seed=9 + seed)
    bundled = files("failuretwin.digital_model") / "robots" / "calibrations"
    for name, known in CALIBRATIONS.items():
        shutil.copy(str(bundled / known), home / name)
    ft.simulate(ft.Plan("armpi_fpv", imperfections="armpi_fpv")).to_netcdf(home / "runs.nc")
    return home


@pytest.mark.parametrize(
    "page",
    [p for p in PAGES if blocks(p, "python") and p.name not in WHOLE],
    ids=lambda p: p.name,
)
def test_python_of_a_page_runs(page, home, failuretwin, capsys, monkeypatch):
    monkeypatch.setenv("PAGER", "cat")
    namespace = {"__name__": __name__, **GIVEN}
    with executed.in_a_folder_of_its_own():
        shutil.copytree(home, Path.cwd(), dirs_exist_ok=True)
        if page.name == "metrics.md":
            failuretwin("diagnose", "runs.nc", "--json", "results.jsonl", folder=Path.cwd())
        for code in blocks(page, "python"):
            if TRAINS not in code:
                short = code.replace("runs_per_class=100_000", "runs_per_class=10")
                exec(compile(short, page.name, "exec"), namespace)
    assert "Traceback" not in capsys.readouterr().out


def commands_on(page):
    """Return the commands of a page as words, without what stands in brackets or behind `#`."""
    text = re.sub(r"\\\n\s*", "", "\n".join(blocks(page, "", "sh", "console")))
    for line in text.splitlines():
        if line.startswith("failuretwin "):
            words = shlex.split(re.sub(r"[\[\]|]", " ", line), comments=True)
            yield [word for word in words if word not in ("&", "...")]


def options_that_do_not_exist(words):
    """Return the options in the words of a command that it does not have."""
    command, rest = cli, words[1:]
    while isinstance(command, click.Group) and rest and rest[0] in command.commands:
        command, rest = command.commands[rest[0]], rest[1:]
    assert not isinstance(command, click.Group) or rest[0].startswith("-"), words
    known = {name for option in command.params for name in (*option.opts, *option.secondary_opts)}
    return [word for word in rest if word.startswith("--") and word not in known | {"--help"}]


EVERY_PAGE = [*PAGES, *sorted((ROOT / "docs").glob("*/*.md"))]


@pytest.mark.parametrize("page", EVERY_PAGE, ids=lambda page: page.name)
def test_commands_of_a_page_exist_with_their_options(page):
    for words in commands_on(page):
        assert options_that_do_not_exist(words) == [], words


def test_an_option_that_does_not_exist_is_noticed():
    words = shlex.split("failuretwin diagnose LOGS --self-calibrate --self-colibrate --json a")
    assert options_that_do_not_exist(words) == ["--self-colibrate"]
    with pytest.raises(AssertionError):
        options_that_do_not_exist(["failuretwin", "dignose"])
