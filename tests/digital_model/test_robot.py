from __future__ import annotations

import shutil

import numpy as np
import pytest

from failuretwin import DigitalTwin, load_robot
from failuretwin.core.errors import InputError
from failuretwin.digital_model.robot import bundled_folder, bundled_robots

PROFILE = (bundled_folder() / "armpi_fpv.toml").read_text(encoding="utf-8")


@pytest.fixture
def profile(tmp_path):
    """Write the bundled profile with pieces of its text replaced, and return the path."""
    shutil.copy(bundled_folder() / "armpi_fpv.urdf", tmp_path)

    def write(*replacements):
        text = PROFILE
        for old, new in replacements:
            assert old in text
            text = text.replace(old, new, 1)
        path = tmp_path / "mine.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def motor_table(number):
    start = PROFILE.index(f'[[motors]]\nname = "motor_{number}"')
    end = PROFILE.find("[[motors]]", start + 1)
    return PROFILE[start : end if end >= 0 else len(PROFILE)]


@pytest.mark.parametrize("name", bundled_robots())
def test_bundled_robots_load(name):
    robot = load_robot(name)
    assert robot.name == name
    assert len(robot.chain.joints) == len(robot.motors)


def test_armpi_has_the_motors_of_the_real_arm(armpi):
    assert armpi.motor_names == ["motor_1", "motor_2", "motor_3", "motor_4"]
    assert [m.log_column for m in armpi.motors] == ["motor_6", "motor_5", "motor_4", "motor_3"]
    np.testing.assert_array_equal(armpi.sense, [1, 1, -1, 1])
    np.testing.assert_array_equal(armpi.sensor_sense, np.ones(4))
    assert armpi.servo_units.to_rad(500) == pytest.approx(0.0)
    assert np.rad2deg(armpi.motors[0].movement_range).tolist() == pytest.approx([-80, 80])
    assert np.rad2deg([m.speed_limit for m in armpi.motors]) == pytest.approx(272.0)
    assert armpi.imperfections_file.is_file()


def test_robot_loads_from_a_path(profile, armpi):
    for path in (profile(), str(profile())):
        assert load_robot(path).profile == armpi.profile


def test_senses_cannot_be_changed(armpi):
    for values in (armpi.sense, armpi.sensor_sense):
        with pytest.raises(ValueError, match="read-only"):
            values[0] = 5.0


def test_a_sensor_on_the_tool_sees_the_physical_pose(profile, armpi):
    twin = DigitalTwin(load_robot(profile(('sensor_pose = "log"', 'sensor_pose = "physical"'))))
    angles = np.random.default_rng(1).uniform(-1, 1, (10, 4))
    physical = angles * [1, 1, -1, 1]

    point, jacobian = twin.path_and_jacobian(angles)

    np.testing.assert_allclose(twin.path(angles), armpi.chain.position(physical), atol=1e-15)
    np.testing.assert_allclose(point, twin.path(angles), atol=1e-15)
    for motor, nudge in enumerate(1e-6 * np.eye(4)):
        slope = (twin.path(angles + nudge) - twin.path(angles - nudge)) / 2e-6
        np.testing.assert_allclose(jacobian[..., motor], slope, atol=1e-9)


def test_published_sensor_applies_kinematics_to_logged_angles(twin, armpi):
    angles = np.random.default_rng(2).uniform(-1, 1, (10, 4))
    point, jacobian = twin.path_and_jacobian(angles)

    np.testing.assert_array_equal(twin.path(angles), armpi.chain.position(angles))
    np.testing.assert_array_equal(point, armpi.chain.position(angles))
    np.testing.assert_array_equal(jacobian, armpi.chain.position_and_jacobian(angles)[1])


def test_unknown_robot_names_the_nearest():
    with pytest.raises(InputError) as error:
        load_robot("armpi_fvp")
    assert str(error.value) == (
        "unknown robot 'armpi_fvp'. Did you mean 'armpi_fpv'? "
        f"Valid: {', '.join(bundled_robots())}. Or give the path of a profile that ends in .toml."
    )


def test_missing_profile_is_named(tmp_path):
    with pytest.raises(InputError, match=r"mine\.toml: cannot be read"):
        load_robot(tmp_path / "mine.toml")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("base_link =", "base_lnk =", "unknown key 'base_lnk'. Did you mean 'base_link'? Valid: "),
        ("sense = -1.0", "sence = -1.0", "unknown key 'sence'. Did you mean 'sense'? Valid: "),
        ("filter_s = 0.01", "filter = 0.01", "unknown key 'filter'. Did you mean 'filter_s'?"),
        ("speed_limit = 4.7", "speed_limit = true #", "speed_limit is True, expected a number."),
        ("sense = -1.0", "sense = 0.5", "motor 'motor_3': sense is 0.5, expected 1 or -1."),
        ("sense = -1.0", "sense = -2.0", "motor 'motor_3': sense is -2.0, expected 1 or -1."),
        ('sensor_pose = "log"', 'sensor_pose = "logs"', "'logs'. Did you mean 'log'?"),
        ('name = "motor_2"', 'name = "motor_1"', "motor name 'motor_1' is used twice."),
        ('joint = "joint2"', 'joint = "joint1"', "joint 'joint1' is used twice."),
        ('joint = "joint4"', 'joint = "camera_joint"', "'camera_joint'. Valid: joint1, joint2,"),
        ('joint = "joint4"', 'joint = "joint44"', "'joint44'. Did you mean 'joint4'?"),
        (
            'tool_link = "link5"',
            'tool_link = "link6"',
            "unknown link 'link6'. Did you mean 'link5'?",
        ),
    ],
)
def test_wrong_profiles_say_what_is_expected(profile, old, new, message):
    path = profile((old, new))
    with pytest.raises(InputError) as error:
        load_robot(path)
    assert message in str(error.value)


def test_missing_urdf_is_named(profile, tmp_path):
    path = profile(('urdf = "armpi_fpv.urdf"', 'urdf = "arm.urdf"'))
    with pytest.raises(InputError) as error:
        load_robot(path)
    assert (
        str(error.value) == f"{tmp_path / 'arm.urdf'}: cannot be read (No such file or directory)."
    )


def test_motors_out_of_order_are_refused(profile):
    second, third = motor_table(2), motor_table(3)
    path = profile((second + third, third + second))
    with pytest.raises(InputError) as error:
        load_robot(path)
    assert str(error.value) == (
        f"{path}: motors are listed for joints joint1, joint3, joint2, joint4; from base to tool "
        "the order is joint1, joint2, joint3, joint4. List the motors in that order."
    )


def test_a_fixed_joint_cannot_have_a_motor(profile):
    path = profile(
        ('tool_link = "link5"', 'tool_link = "grasp_point"'),
        ('joint = "joint4"', 'joint = "grasp_joint"'),
    )
    with pytest.raises(InputError) as error:
        load_robot(path)
    assert "joint 'grasp_joint' is fixed, so no motor can move it." in str(error.value)
    assert "Expected one of revolute, continuous, prismatic." in str(error.value)


def test_a_profile_without_motors_is_refused(profile):
    motors = PROFILE[PROFILE.index("[[motors]]") :]
    path = profile((motors, ""), ('sensor_pose = "log"', 'sensor_pose = "log"\nmotors = []'))
    with pytest.raises(InputError, match="profile 'armpi_fpv' has no motors"):
        load_robot(path)


def test_a_robot_without_servo_units_says_how_to_add_them(profile):
    units = PROFILE[PROFILE.index("[servo_units]") : PROFILE.index("[[motors]]")]
    robot = load_robot(profile((units, "")))
    with pytest.raises(InputError, match=r"no servo units\. Add a \[servo_units\] table"):
        _ = robot.servo_units


def test_a_motor_that_cannot_move_the_tool_is_refused(armpi, tmp_path):
    profile = (armpi.folder / "armpi_fpv.toml").read_text()
    (tmp_path / "armpi_fpv.urdf").write_text((armpi.folder / "armpi_fpv.urdf").read_text())
    motor = profile[profile.rindex("[[motors]]") :].replace("motor_4", "motor_5")
    (tmp_path / "five.toml").write_text(f"{profile}\n{motor.replace('joint4', 'joint5')}")

    with pytest.raises(InputError, match=r"motor 'motor_5' \(joint5\) cannot move the tool point"):
        load_robot(tmp_path / "five.toml")
