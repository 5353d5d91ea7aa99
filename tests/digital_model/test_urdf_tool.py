from __future__ import annotations

import numpy as np
import pytest

from failuretwin.digital_model.urdf.check import check_urdf
from failuretwin.digital_model.urdf.file import read_urdf
from failuretwin.digital_model.urdf.tool import is_beside


def joint(parent, child, type_="revolute", xyz="0.2 0 0", axis="0 1 0"):
    return (
        f'<link name="{child}"/><joint name="{child}_joint" type="{type_}">'
        f'<parent link="{parent}"/>'
        f'<child link="{child}"/><origin xyz="{xyz}"/><axis xyz="{axis}"/>'
        '<limit lower="-1" upper="1" velocity="1" effort="1"/></joint>'
    )


def arm(*parts, root="base"):
    return f'<robot name="arm"><link name="{root}"/>{"".join(parts)}</robot>'


TWO_JOINTS = joint("base", "upper", axis="0 0 1") + joint("upper", "fore")


@pytest.fixture
def check(tmp_path):
    def check(text, **options):
        path = tmp_path / "arm.urdf"
        path.write_text(text, encoding="utf-8")
        return check_urdf(path, **options)

    return check


@pytest.mark.parametrize(
    ("parts", "tool"),
    [
        (
            [
                joint("fore", "tool0", "fixed"),
                joint("fore", "finger_1"),
                joint("finger_1", "finger_2"),
            ],
            "tool0",
        ),
        (
            [joint("fore", "camera_link", "fixed", "0.5 0 0"), joint("fore", "wrist", "fixed")],
            "wrist",
        ),
        ([joint("fore", "imu", "fixed", "0.5 0 0")], "fore"),
        ([joint("fore", "left_finger"), joint("fore", "right_finger")], "fore"),
        (
            [joint("fore", "panda_hand", "fixed"), joint("panda_hand", "panda_leftfinger")],
            "panda_hand",
        ),
        ([joint("fore", "arm_tcp", "fixed"), joint("fore", "flange", "fixed")], "arm_tcp"),
        ([joint("fore", "ee_link", "fixed"), joint("fore", "gripper", "fixed")], "ee_link"),
        (
            [joint("fore", "EndEffector", "fixed"), joint("fore", "longer", "fixed", "0.9 0 0")],
            "EndEffector",
        ),
        # A jaw that turns against the hand, by whatever name.
        (
            [joint("fore", "gripperStator", "fixed"), joint("gripperStator", "gripperMover")],
            "gripperStator",
        ),
        (
            [
                joint("fore", "back_tcp", "fixed", "0.02 0 0"),
                joint("fore", "gripper_tcp", "fixed", "0.06 0 0"),
                joint("fore", "gripper"),
                joint("gripper", "gripper_tcp2", "fixed", "0.05 0 0"),
            ],
            "gripper_tcp",
        ),
        (
            [joint("fore", "hand", "fixed"), joint("hand", "grasptarget", "fixed")],
            "grasptarget",
        ),
        (
            [joint("upper", "elbow_tip_link", "fixed"), joint("fore", "hand_link")],
            "hand_link",
        ),
        # A surer name, and names on every link.
        ([joint("fore", "hand", "fixed"), joint("hand", "arm_tcp")], "arm_tcp"),
        (
            [
                joint("upper", "tip_1", "fixed"),
                joint("fore", "tip_2", "fixed"),
                joint("fore", "last"),
                joint("last", "tip_3", "fixed"),
            ],
            "tip_3",
        ),
        ([joint("base", "longer", xyz="0.9 0 0")], "fore"),
    ],
)
def test_the_tool_is_chosen_by_name_and_never_a_finger_or_a_camera(check, parts, tool):
    assert check(arm(TWO_JOINTS, *parts)).tool_link == tool


@pytest.mark.parametrize("name", ["knee", "steel", "committee", "speed_link"])
def test_a_name_counts_as_a_word_alone(check, name):
    assert check(arm(TWO_JOINTS, joint("fore", name, "fixed"))).tool_link == name
    assert not is_beside(name)


def test_two_arms_are_asked_for(check):
    arms = [
        joint("base", f"{side}_upper", axis="0 0 1")
        + joint(f"{side}_upper", f"{side}_fore")
        + joint(f"{side}_fore", f"{side}_tool0", "fixed")
        for side in ("left", "right")
    ]
    report = check(arm(*arms))
    assert report.having("error") == [
        "several arms could carry the tool: left_tool0 (2 moving), right_tool0 (2 moving). Say "
        "which is meant with --tool LINK."
    ]
    assert check(arm(*arms), tool="right_tool0").having("error") == []


def test_the_base_may_be_any_link_that_is_fixed_to_the_foot(tmp_path, check):
    plate = joint("world", "plate", "fixed", "0 0 -0.1") + joint("world", "base", "fixed", "0 0 1")
    text = arm(plate, TWO_JOINTS, joint("fore", "tool0", "fixed"), root="world")
    assert check(text, base="plate").base_link == "plate"

    chain = read_urdf(tmp_path / "arm.urdf").chain("plate", "tool0", ["upper_joint", "fore_joint"])
    # From the plate up 0.1 m to the world, 1 m to the base, and 0.6 m along x.
    np.testing.assert_allclose(chain.position(np.zeros(2)), [0.6, 0.0, 1.1], atol=1e-12)


def test_a_joint_below_the_noise_of_the_sensor_is_left_out(check):
    roll = joint("fore", "roll", axis="1 0 0") + joint("roll", "tool0", "fixed", "0.1 0.00015 0")
    report = check(arm(TWO_JOINTS, roll))
    assert [motor.joint.name for motor in report.motors] == ["upper_joint", "fore_joint"]
    assert any(
        "'roll_joint' moves the tool by 0.15 mm for each rad at most, less than the sensor's noise "
        "of 0.5 mm"
        in note
        and "A marker off its axis would show it" in note
        for note in report.having("note")
    )
    assert len(check(arm(TWO_JOINTS, roll), noise_m=1e-4).motors) == 3
