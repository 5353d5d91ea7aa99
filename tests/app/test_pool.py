"""`failuretwin calibrate --pool`: calibrations of a fleet into one file."""

from __future__ import annotations

import click
import numpy as np
import pytest
from click.testing import CliRunner

from calibration_files import read_calibration
from failuretwin.app.cli import cli
from failuretwin.connection.population import Population
from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.data_knowledge.store import save_run_set

ROBOT = """
name = "robot {i}"
source = "made up"
protocol = "P0c"
[settling]
bias = [0.0{i}, 0.0, -0.00{i}, 0.0]
friction = [0.00{i}, 0.005, 0.006, 0.007]
scatter = [0.00{i}, 0.004, 0.004, 0.004]
"""


@pytest.fixture
def fleet(tmp_path):
    """Three calibrations typed by hand."""
    paths = [tmp_path / f"robot_{i}.toml" for i in (1, 2, 3)]
    for i, path in enumerate(paths, 1):
        path.write_text(ROBOT.format(i=i), encoding="utf-8")
    return paths


def run(*arguments):
    given = [str(argument) for argument in arguments]
    return CliRunner().invoke(cli, given, catch_exceptions=False, standalone_mode=False)


def test_a_fleet_becomes_a_file_that_diagnoses(fleet, armpi, tmp_path):
    out, logs, found = tmp_path / "fleet.toml", tmp_path / "runs.nc", tmp_path / "found.toml"
    answer = run("calibrate", "--pool", *fleet, "--out", out)
    told = " ".join(answer.output.split())
    assert "armpi_fpv: population of 3 robots: robot 1, robot 2, robot 3" in told
    assert "95 % of such robots" in told
    assert f"written to {out}" in told
    assert "runs" not in answer.output.split("use it")[0]
    expected = Population.fit(fleet, armpi).imperfections
    assert read_calibration(out, armpi).sessions == ("robot 1", "robot 2", "robot 3")
    saved = read_calibration(out, armpi).imperfections
    np.testing.assert_allclose(saved.settling.bias, expected.settling.bias, rtol=1e-5)
    save_run_set(simulate(Plan(armpi, ["healthy"], 2, 3, expected)), logs)
    run("diagnose", logs, "--self-calibrate", "--calibration", out, "--out", found)
    learned = read_calibration(found, armpi).imperfections
    assert (learned.protocol, learned.source.endswith("; fleet")) == ("P1", True)


def test_the_name_can_be_chosen(fleet, armpi, tmp_path):
    out = tmp_path / "fleet.toml"
    run("calibrate", "--pool", *fleet, "--out", out, "--name", "hall 3")
    assert read_calibration(out, armpi).imperfections.name == "hall 3"


def test_what_cannot_be_pooled_leaves_no_file(fleet, tmp_path):
    out = tmp_path / "fleet.toml"
    with pytest.raises(InputError, match="of 1 calibrations: expected those of two robots"):
        run("calibrate", "--pool", fleet[0], "--out", out)
    with pytest.raises(InputError, match=r"robot_1\.toml: is given twice"):
        run("calibrate", "--pool", fleet[0], fleet[0], "--out", out)
    with pytest.raises(InputError, match=r"nothing\.toml: cannot be read"):
        run("calibrate", "--pool", fleet[0], tmp_path / "nothing.toml", "--out", out)
    for option in (("--hold-out", "robot"), ("--report", tmp_path / "page")):
        with pytest.raises(click.UsageError, match="--pool reads no logs"):
            run("calibrate", "--pool", *fleet, "--out", out, *option)
    assert not out.exists()
    with pytest.raises(InputError, match=r"robot_1\.toml: is one of the calibrations to pool"):
        run("calibrate", "--pool", *fleet, "--out", fleet[0], "--name", "robot 1")
