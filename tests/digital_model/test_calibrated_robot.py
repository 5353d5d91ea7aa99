"""A calibration file is a robot's own servo loops and what it does that their twin does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import failuretwin as ft
from failuretwin.core.errors import InputError
from failuretwin.digital_model.calibrated_robot import (
    CalibratedLoop,
    load_calibration,
    with_loops,
)
from failuretwin.digital_model.robot import load_robot
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.inference.observation.healthy_model import HealthyModel

LOOPS = (
    CalibratedLoop("motor_2", 0.05, 17.5, 0.012, 4.25),
    CalibratedLoop("motor_4", 0.1, 15.0, 0.02, 4.5),
)
TYPED = 'name = "typed"\nsource = "by hand"\n'
LOOP = '{{ motor = "motor_{}", P = 0.1, I = 20.0, filter_s = 0.01, speed_limit = 4.0 }}'
SLOW = f"""{TYPED}
[timing]
delay_s = [0.004, 0.008]
lag_s = [0.003, 0.003]
[calibration]
robot = "armpi_fpv"
failuretwin_version = "0.1.0"
loops = [{", ".join(LOOP.format(k) for k in (1, 2, 3, 4))}]
"""


@pytest.fixture
def slow(tmp_path):
    """A calibration whose motors all follow a ramp 50 ms late, and 9 ms on top of that."""
    path = tmp_path / "slow.toml"
    path.write_text(SLOW)
    return path


def test_only_motors_with_a_loop_change(armpi):
    robot = with_loops(armpi, LOOPS)
    assert robot.motors[0] == armpi.motors[0]
    assert robot.motors[1].loop.I == 17.5
    assert robot.motors[3].speed_limit == 4.5
    assert robot.motors[3].sense == armpi.motors[3].sense
    assert armpi.motors[1].loop.I > 40.0


def test_a_slower_loop_lags_by_one_over_its_gain(armpi):
    time = np.arange(200) * 0.01
    ramp = np.repeat(time[:, None], 4, axis=1)
    lag = (ramp - DigitalTwin(with_loops(armpi, LOOPS)).respond(ramp, time))[-1]
    assert lag == pytest.approx([1 / 40.5767970756214, 1 / 17.5, 1 / 34.9771849942388, 1 / 15.0])


def test_an_unknown_motor_is_named(armpi):
    with pytest.raises(InputError, match="unknown motor 'motor_7'"):
        with_loops(armpi, [replace(LOOPS[0], motor="motor_7")])


def test_a_healthy_robot_has_the_loops_of_its_file(slow, armpi):
    known = load_calibration(slow, armpi)
    assert [motor.loop.I for motor in known.robot.motors] == [20.0] * 4
    assert [motor.speed_limit for motor in known.robot.motors] == [4.0] * 4
    model = ft.BayesDiagnoser(known.twin, known.imperfections).healthy_model
    assert model.lag_s == pytest.approx(0.050 + 0.006 + 0.003)


def test_the_calibration_that_a_profile_names_brings_its_loops(slow, tmp_path, armpi):
    text = (armpi.folder / "armpi_fpv.toml").read_text()
    text = text.replace(armpi.profile.imperfections, slow.name)
    text = text.replace(armpi.profile.urdf, str(armpi.urdf_file))
    (tmp_path / "own.toml").write_text(text)
    robot = load_robot(tmp_path / "own.toml")
    assert load_calibration(None, robot) == load_calibration("armpi_fpv", robot)
    assert HealthyModel.of(DigitalTwin(robot), None).lag_s == pytest.approx(0.059)


def test_imperfections_without_a_calibration_bring_no_loops(armpi, tmp_path):
    assert load_calibration("none", armpi).robot is armpi
    path = tmp_path / "typed.toml"
    path.write_text(TYPED)
    assert load_calibration(path, armpi).robot is armpi


@pytest.mark.parametrize(
    ("table", "text"),
    [
        ("calibration = 3", "calibration is 3, expected a table"),
        ('[calibration]\nloops = "none"', "calibration: loops is 'none', expected a list"),
        ("[calibration]\nloops = [{ P = 0.1 }]", r"loops\[0\]: key 'motor' is missing"),
        ("[calibration]\nrobot = 'panda'", "is a calibration of robot 'panda', not of 'armpi_fpv'"),
    ],
)
def test_a_damaged_record_is_refused_with_its_place(armpi, tmp_path, table, text):
    path = tmp_path / "odd.toml"
    path.write_text(f"{TYPED}{table}\n")
    with pytest.raises(InputError, match=f"odd.toml: .*{text}"):
        load_calibration(path, armpi)
