from __future__ import annotations

import tomllib
from dataclasses import replace

import numpy as np
import pytest

from failuretwin.connection.calibration.result import (
    Calibration,
    LoopFit,
    calibrated_robot,
    load_calibration,
    robot_as_calibrated,
    save_calibration,
    with_loops,
)
from failuretwin.core.errors import InputError
from failuretwin.digital_model.nonidealities import generic_imperfections
from failuretwin.digital_model.twin import DigitalTwin

LOOPS = (LoopFit("motor_2", 0.05, 17.5, 0.012, 4.25), LoopFit("motor_4", 0.1, 15.0, 0.02, 4.5))


@pytest.fixture
def calibration(armpi):
    return Calibration(generic_imperfections(armpi), (), ("s",), 1, 5, True, loops=LOOPS)


def test_only_motors_with_a_loop_change(armpi, calibration):
    robot = calibrated_robot(armpi, calibration)
    assert robot.motors[0] == armpi.motors[0]
    assert robot.motors[1].loop.I == 17.5
    assert robot.motors[3].speed_limit == 4.5
    assert robot.motors[3].sense == armpi.motors[3].sense
    assert armpi.motors[1].loop.I > 40.0


def test_a_slower_loop_lags_by_one_over_its_gain(armpi, calibration):
    time = np.arange(200) * 0.01
    ramp = np.repeat(time[:, None], 4, axis=1)
    lag = (ramp - DigitalTwin(calibrated_robot(armpi, calibration)).respond(ramp, time))[-1]
    assert lag == pytest.approx([1 / 40.5767970756214, 1 / 17.5, 1 / 34.9771849942388, 1 / 15.0])


def test_an_unknown_motor_is_named(armpi):
    with pytest.raises(InputError, match="unknown motor 'motor_7'"):
        with_loops(armpi, [replace(LOOPS[0], motor="motor_7")])


def test_the_file_keeps_the_loops(tmp_path, armpi, calibration):
    path = tmp_path / "own.toml"
    save_calibration(calibration, armpi, path)
    assert tomllib.loads(path.read_text())["calibration"]["loops"][0]["speed_limit"] == 4.25
    assert load_calibration(path, armpi).loops == LOOPS
    assert robot_as_calibrated(armpi, str(path)).motors[1].loop.I == 17.5


def test_imperfections_without_a_calibration_bring_no_loops(armpi, tmp_path):
    assert robot_as_calibrated(armpi, "none") is armpi
    path = tmp_path / "typed.toml"
    path.write_text('name = "typed"\nsource = "by hand"\n')
    assert robot_as_calibrated(armpi, str(path)) is armpi
