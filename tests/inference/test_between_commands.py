"""Curves that a log states once a second, joined by lines: no verdict, and no long search."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import failuretwin as ft
from failuretwin.digital_model.robot import load_robot
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.inference.set_up_weighing import SetUpWeighing

ROBOT = load_robot("armpi_fpv")
TOOL = ("tool_x_m", "tool_y_m", "tool_z_m")
STEP_S = 0.01


def curve(seconds):
    """A smooth curve through random points."""
    time = STEP_S * np.arange(round(seconds / STEP_S) + 1)
    at = np.arange(0.0, seconds + 1.0, 0.9)
    points = np.random.default_rng(7).uniform(-0.7, 0.7, (len(at), 4))
    return CubicSpline(at, points)(time)


@pytest.mark.parametrize("fault", ["healthy", "stuck", "off"])
def test_curves_told_once_a_second_are_undecided_without_a_search(fault, tmp_path, monkeypatch):
    """Also those of a log: its commands are the corners, and nothing else is looked for."""
    followed, half = curve(12.0), 600
    if fault != "healthy":
        followed[half:, 1] = followed[half, 1] if fault == "stuck" else followed[half:, 1] + 0.12
    time, tool = STEP_S * np.arange(len(followed)), DigitalTwin(ROBOT).path(followed)
    command = curve(12.0)
    rows = [",".join(["time_s", *(f"command_{n}_rad" for n in ROBOT.motor_names), *TOOL])]
    for i in range(0, len(time), 4):
        told = [f"{q:.6f}" for q in command[i]] if i % 100 == 0 else [""] * command.shape[1]
        rows.append(",".join([f"{time[i]:.3f}", *told, *(f"{x:.6f}" for x in tool[i])]))
    (tmp_path / "log.csv").write_text("\n".join(rows))
    runs = ft.read_runs(tmp_path / "log.csv", ROBOT)
    at = np.arange(0, len(time) - 100, 100)
    np.testing.assert_allclose(runs["command"].values[0, at], command[at], atol=3e-3)
    monkeypatch.setattr(SetUpWeighing, "searched", None)
    (found,) = ft.diagnose(runs, ROBOT, "generic")
    assert found.diagnosis is None
    assert "commands too far apart" in found.verdict
