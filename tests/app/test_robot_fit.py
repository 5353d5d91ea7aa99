from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest

from failuretwin import Plan, load_robot, simulate
from failuretwin.app.cli import main
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.data_knowledge.store import load_run_set, save_run_set
from failuretwin.digital_model.profile_text import fitted_text

FEW = ("--hypotheses", "healthy,motor_1:stuck,motor_2:steady_state_error")
BASE = (0.4, -0.3, 0.2, 0.1, -0.2, 2.5)


@pytest.fixture
def run(monkeypatch, capsys):
    """Run the command line; return exit code, output and errors."""

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["failuretwin", *map(str, words)])
        try:
            main()
            code = 0
        except SystemExit as end:
            code = end.code
        return code, *capsys.readouterr()

    return run


@pytest.fixture
def tracked(tmp_path):
    """Write healthy runs that a tracker in a frame of its own has seen; return their file."""
    robot = load_robot("ur5e")
    profile = replace(robot.profile, base_xyz_rpy=BASE)
    path = tmp_path / "tracked.toml"
    text = fitted_text(robot.source.read_text(encoding="utf-8"), robot.source, path, profile)
    path.write_text(text, encoding="utf-8")
    runs = simulate(Plan(load_robot(path), (Hypothesis(()),), runs_per_class=8, seed=1))
    save_run_set(runs, tmp_path / "runs.nc")
    return tmp_path / "runs.nc"


def test_fit_writes_a_profile_that_puts_the_tool_where_it_is_seen(run, tracked, tmp_path):
    out = tmp_path / "mine.toml"
    code, said, err = run("robot", "fit", tracked, "--robot", "ur5e", "--out", out)

    assert (code, err) == (0, "")
    assert "40 settled poses" in said
    assert f"use it with --robot {out}" in said
    made = load_robot(out)
    np.testing.assert_allclose(made.profile.base_xyz_rpy, BASE, atol=2e-3)
    assert "failuretwin robot fit on 20" in made.profile.geometry.source
    assert run("diagnose", tracked, "--robot", out, *FEW)[0] == 0


def test_fit_overwrites_no_other_file(run, tracked, tmp_path):
    out = tmp_path / "mine.toml"
    out.write_text("mine", encoding="utf-8")
    code, _, err = run("robot", "fit", tracked, "--robot", "ur5e", "--out", out)
    assert (code, out.read_text(encoding="utf-8")) == (2, "mine")
    assert "exists already" in err


def test_diagnose_names_the_frame_that_nobody_told(run, tracked):
    few = tracked.with_name("few.nc")
    save_run_set(load_run_set(tracked).isel(run=slice(0, 2)), few)
    code, said, _ = run("diagnose", few, "--robot", "ur5e", *FEW)
    assert code == 0
    assert "in a frame turned by" in said
    assert "failuretwin robot fit" in said
