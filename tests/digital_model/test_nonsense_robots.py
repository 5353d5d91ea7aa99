"""Profiles, calibrations and URDFs that no robot can have are refused with the limit."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest
import tomli_w

from failuretwin import load_robot
from failuretwin.core.errors import InputError
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.robot import bundled_folder, bundled_robots
from failuretwin.digital_model.servo import ServoLoop
from failuretwin.digital_model.urdf.check import MOST_MOTORS, check_urdf
from failuretwin.digital_model.urdf.file import read_urdf
from failuretwin.digital_model.urdf.tool import choose_tool


def poles(P, I, tau):  # noqa: E741
    """Return the roots of s (tau s + 1)^2 + P s + I."""
    return np.roots([tau**2, 2.0 * tau, 1.0 + P, I])


@pytest.mark.parametrize("P", [0.0, 0.3, 5.0])
@pytest.mark.parametrize("tau", [0.001, 0.01, 0.3])
def test_loops_are_let_in_up_to_where_a_pole_crosses_over(P, tau):
    limit = 2.0 * (1.0 + P) / tau
    assert poles(P, 0.99 * limit, tau).real.max() < 0 < poles(P, 1.01 * limit, tau).real.max()
    ServoLoop(P, 0.99 * limit, tau)
    with pytest.raises(InputError, match="not stable"):
        ServoLoop(P, 1.01 * limit, tau)


@pytest.mark.parametrize(("P", "slowest_s"), [(0.0, 100.0), (3.0, 100.0)])
def test_a_loop_that_never_gets_there_is_refused(P, slowest_s):
    least = (1.0 + P) / slowest_s
    slow = -poles(P, least, 1e-4).real.max()
    assert slow == pytest.approx(1.0 / slowest_s, rel=0.01)
    ServoLoop(P, 1.01 * least, 1e-4)
    with pytest.raises(InputError, match="longer than 100 s to its target"):
        ServoLoop(P, 0.99 * least, 1e-4)


@pytest.fixture
def changed(tmp_path):
    """Write a bundled profile with one motor's entries changed; return its path."""

    def write(**entries):
        table = tomllib.loads((bundled_folder() / "armpi_fpv.toml").read_text())
        table["urdf"] = str(bundled_folder() / "armpi_fpv.urdf")
        table = {k: v for k, v in table.items() if k not in ("imperfections", "physics")}
        table["motors"][1] |= entries
        (tmp_path / "arm.toml").write_text(tomli_w.dumps(table))
        return tmp_path / "arm.toml"

    return write


@pytest.mark.parametrize(
    ("entries", "said"),
    [
        ({"loop": {"P": 0.0, "I": 0.0, "filter_s": 0.01}}, "I is 0, expected 0.01 to 200"),
        ({"loop": {"P": 0.3, "I": 40.0, "filter_s": 0.0}}, "filter_s is 0, expected a number from"),
        ({"loop": {"P": 0.3, "I": float("nan"), "filter_s": 0.01}}, "I is nan"),
        ({"speed_limit": 0.0}, "speed_limit is 0"),
        ({"speed_limit": -1.0}, "speed_limit is -1"),
        ({"movement_range": [0.0, float("inf")]}, "movement_range is [0, inf]"),
        ({"travel": [float("nan"), 1.0]}, "travel is [nan, 1.0]"),
        ({"home": float("nan")}, "home is nan"),
        ({"speed_limit": 10**400}, "speed_limit is a whole number of more than 300 digits"),
    ],
)
def test_a_motor_that_cannot_be_is_refused(changed, entries, said):
    with pytest.raises(InputError) as error:
        load_robot(changed(**entries))
    assert said in str(error.value)
    assert "motors[1]" in str(error.value)


@pytest.fixture
def calibration(tmp_path, measured_file):
    """Write the measured imperfections of the ArmPi with an entry of its settling changed."""

    def write(**entries):
        table = tomllib.loads(measured_file.read_text())
        table["settling"] |= entries
        (tmp_path / "cal.toml").write_text(tomli_w.dumps(table))
        return tmp_path / "cal.toml"

    return write


@pytest.mark.parametrize(
    ("entries", "said"),
    [
        ({"friction": [9.0, 0.0, 0.0, 0.0]}, "friction of 'motor_1' is 9, expected 0.116 at most"),
        ({"bias": [0.0, 0.0, -0.6, 0.0]}, "bias of 'motor_3' is -0.6"),
        ({"scatter": [0.0, 0.0, 0.0, 1.0]}, "scatter of 'motor_4' is 1"),
        ({"friction": [0.0, 0.13, 0.0, 0.0]}, "4.2% of where the motor may stand"),
        ({"compliance": [0.0, 500.0, 0.0, 0.0]}, "compliance times the largest load of 'motor_2'"),
    ],
)
def test_a_calibration_that_would_pass_for_a_fault_is_refused(calibration, armpi, entries, said):
    assert np.diff(armpi.travel[0])[0] / 8 == pytest.approx(np.deg2rad(160) / 8)
    with pytest.raises(InputError) as error:
        load_calibration(calibration(**entries), armpi)
    assert said in str(error.value)
    assert "of where the motor may stand" in str(error.value)
    assert "travel of its profile or the limits of its joint" in str(error.value)


def test_the_calibration_itself_is_let_in(calibration, armpi):
    load_calibration(calibration(), armpi)
    for name in bundled_robots():
        load_calibration(None, load_robot(name))


@pytest.mark.parametrize(("key", "most"), [("late_s", 60), ("delay_s", 60), ("lag_s", 5)])
def test_times_that_no_arm_takes_are_refused(calibration, armpi, key, most):
    path = calibration()
    table = tomllib.loads(path.read_text())
    table.setdefault("timing", {})[key] = [0.0, most + 1.0]
    path.write_text(tomli_w.dumps(table))
    with pytest.raises(InputError, match=f"{key} is .*{most}"):
        load_calibration(path, armpi)


def long_urdf(path, joints, type_="fixed"):
    """Write a chain of as many joints, whose last three turn; the tool is on the last."""
    lines = ['<robot name="snake"><link name="l0"/>']
    for k in range(joints):
        kind = "revolute" if k >= joints - 3 else type_
        lines.append(
            f'<link name="l{k + 1}"/><joint name="j{k}" type="{kind}"><parent link="l{k}"/>'
            f'<child link="l{k + 1}"/><origin xyz="0.01 0 0.01"/><axis xyz="0 1 0"/>'
            '<limit lower="-1" upper="1" velocity="1" effort="1"/></joint>'
        )
    path.write_text("".join(lines) + "</robot>")
    return path


def test_the_work_of_a_check_grows_as_the_joints_do(tmp_path, monkeypatch):
    """Steps are counted, not time: each joint is asked for a bounded number of times."""
    counts = []
    for joints in (200, 2000):
        urdf = read_urdf(long_urdf(tmp_path / f"{joints}.urdf", joints))
        asked = 0

        class Counting(dict):
            def get(self, key, default=None):
                nonlocal asked
                asked += 1
                return super().get(key, default)

        urdf.__dict__["_next"] = Counting(urdf._next)
        assert len(urdf.path("l0", f"l{joints}")) == joints
        choose_tool(urdf, "l0")
        counts.append(asked / joints)
    assert counts[1] == pytest.approx(counts[0], rel=0.02)


def test_a_long_chain_is_checked_and_one_of_too_many_motors_refused(tmp_path):
    report = check_urdf(long_urdf(tmp_path / "long.urdf", 5000))
    assert len(report.motors) == 2
    report = check_urdf(long_urdf(tmp_path / "snake.urdf", MOST_MOTORS + 1, "revolute"))
    assert f"{MOST_MOTORS + 1} joints on the way to the tool move" in report.having("error")[0]


@pytest.mark.parametrize("text", ['xyz="1e300 0 0"', 'xyz="nan 0 0"', 'rpy="0 0 1e9"'])
def test_places_that_no_arm_has_are_refused(tmp_path, text):
    path = long_urdf(tmp_path / "arm.urdf", 3)
    path.write_text(path.read_text().replace('xyz="0.01 0 0.01"', text, 1))
    with pytest.raises(InputError, match="expected three finite numbers within"):
        read_urdf(path)
