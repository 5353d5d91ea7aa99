"""Curves that a log states seldom, joined by lines: no verdict, and no long search."""

from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import failuretwin as ft
from failuretwin.app.commands.options import RobotOptions
from failuretwin.app.reports.isolability_report import isolability_summary, onset_lines
from failuretwin.connection.tracked_diagnosis import History, begin, diagnose_tracked
from failuretwin.core.runs import concatenate, run_set
from failuretwin.digital_model.robot import load_robot
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.inference.set_up_weighing import SetUpWeighing

ROBOT = load_robot("armpi_fpv")
TOOL = ("tool_x_m", "tool_y_m", "tool_z_m")
STEP_S = 0.01
OFFERED = ("healthy", "motor_2:stuck", "motor_2:steady_state_error")


def curve(seconds, seed=7):
    """A smooth curve through random points."""
    time = STEP_S * np.arange(round(seconds / STEP_S) + 1)
    at = np.arange(0.0, seconds + 1.0, 0.9)
    points = np.random.default_rng(seed).uniform(-0.7, 0.7, (len(at), 4))
    return CubicSpline(at, points)(time)


def logged(folder, followed, command, every_s):
    """A log of a tool at 25 Hz whose command (time, motor) is told so seldom."""
    time, tool = STEP_S * np.arange(len(followed)), DigitalTwin(ROBOT).path(followed)
    rows = [",".join(["time_s", *(f"command_{n}_rad" for n in ROBOT.motor_names), *TOOL])]
    for i in range(0, len(time), 4):
        is_told = i % round(every_s / STEP_S) == 0
        told = [f"{q:.6f}" for q in command[i]] if is_told else [""] * command.shape[1]
        rows.append(",".join([f"{time[i]:.3f}", *told, *(f"{x:.6f}" for x in tool[i])]))
    (folder / "log.csv").write_text("\n".join(rows))
    return ft.read_runs(folder / "log.csv", ROBOT)


@pytest.mark.parametrize(
    ("fault", "every_s"), [("healthy", 0.4), ("healthy", 1.0), ("stuck", 1.0), ("off", 1.0)]
)
def test_curves_told_seldom_are_undecided_without_a_search(fault, every_s, tmp_path, monkeypatch):
    """Also those of a log: its commands are the corners, and nothing else is looked for."""
    command, half = curve(12.0), 600
    followed = command.copy()
    if fault != "healthy":
        followed[half:, 1] = followed[half, 1] if fault == "stuck" else followed[half:, 1] + 0.12
    runs = logged(tmp_path, followed, command, every_s)
    at = np.arange(0, len(command) - 100, round(every_s / STEP_S))
    np.testing.assert_allclose(runs["command"].values[0, at], command[at], atol=3e-3)
    monkeypatch.setattr(SetUpWeighing, "searched", None)
    (found,) = ft.diagnose(runs, ROBOT, "generic")
    assert found.diagnosis is None
    assert "commands are too far apart" in found.verdict
    assert "readings" not in found.verdict
    assert found.explanation == ("Log again, with commands at 10 Hz or more.",)
    assert isolability_summary(runs, ft.BayesDiagnoser(ROBOT, "generic")) == []


@pytest.mark.parametrize("seed", [4, 26])
def test_strokes_that_are_told_all_along_are_judged(seed):
    """All motors turn least in the middle of a stroke: that is no corner of their commands."""
    rng, time = np.random.default_rng(seed), 0.008 * np.arange(1251)
    ends = np.r_[0.0, np.cumsum(rng.uniform(1.0, 2.0, 14))]
    goals = rng.uniform(-0.7, 0.7, (15, 4))
    stroke = np.searchsorted(ends, time, side="right") - 1
    share = ((time - ends[stroke]) / np.diff(ends)[stroke])[:, None]
    share = 0.5 * share + 0.5 * share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    command = goals[stroke] + share * (goals[stroke + 1] - goals[stroke])
    followed = command.copy()
    followed[270:, 0] = followed[270, 0]
    tool = DigitalTwin(ROBOT).path(followed)
    tool[np.arange(len(tool)) % 12 > 0] = np.nan
    runs = run_set(time, command, tool)
    (found,) = ft.diagnose(runs, ROBOT, "generic", hypotheses=(*OFFERED, "motor_1:stuck"))
    assert found.diagnosis == "motor_1:stuck"


@pytest.mark.parametrize("together", ["as a folder", "as a life"])
def test_runs_told_seldom_are_undecided_together_too(together, tmp_path):
    parts = []
    for number in range(2):
        folder = tmp_path / str(number)
        folder.mkdir()
        way = curve(12.0, seed=number)
        parts.append(logged(folder, way, way, 1.0).assign_coords(run=[f"run {number}"]))
    runs = concatenate(parts)
    if together == "as a folder":
        found = ft.SelfCalibratingDiagnoser(ROBOT, hypotheses=OFFERED).diagnose(runs)
    else:
        diagnoser = ft.BayesDiagnoser(ROBOT, "generic", hypotheses=OFFERED)
        found = diagnose_tracked(runs, diagnoser, History(begin(diagnoser, True), True)).diagnoses
    assert [one.diagnosis for one in found] == [None, None]
    for one in found:
        assert "commands are too far apart" in one.verdict
        assert one.explanation == ("Log again, with commands at 10 Hz or more.",)


def test_for_curves_the_command_is_named_that_works_out_what_they_tell_apart(tmp_path):
    runs = logged(tmp_path, curve(12.0), curve(12.0), 0.04)
    options = RobotOptions("my arm.toml", seed=0, calibration=Path("cal.toml")).words
    (line,) = isolability_summary(runs, ft.BayesDiagnoser(ROBOT, "generic"), options)
    command = "isolability --motions LOG --robot 'my arm.toml' --calibration cal.toml`"
    assert f"`failuretwin {command}" in line
    assert RobotOptions("armpi_fpv", seed=0).words == ""


def test_sizes_of_motions_without_rests_are_of_errors_from_the_start():
    time = STEP_S * np.arange(601)
    rests = np.outer(np.clip(time - 1.0, 0.0, 1.0), [0.5, -0.4, 0.3, 0.2])
    for command, count in ((curve(6.0), 1), (rests, 0)):
        found = ft.isolability(ROBOT, command, time, "generic", ["motor_2:stuck"])
        assert found.on_the_way == bool(count)
        assert len(onset_lines(found)) == count
