"""What arms of a kind are like before one is calibrated: class, figures, sag by its masses."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from failuretwin import load_robot
from failuretwin.core.errors import InputError
from failuretwin.digital_model.arm_classes import class_name, generic_imperfections
from failuretwin.digital_model.calibrated_robot import load_calibration

TWO_LINKS = """<robot name="two">
<link name="base"/><link name="upper">{upper}</link><link name="lower">{lower}</link>
<link name="tip"/>
<joint name="j1" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="1" velocity="5"/></joint>
<joint name="j2" type="revolute"><parent link="upper"/><child link="lower"/>
<origin xyz="0.2 0 0"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="1" velocity="5"/></joint>
<joint name="end" type="fixed"><parent link="lower"/><child link="tip"/><origin xyz="{tip} 0 0"/>
</joint></robot>"""
MASS = (
    '<inertial><origin xyz="{at} 0 0"/><mass value="{kg}"/>'
    '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>'
)
MOTOR = """
[[motors]]
name = "motor_{k}"
joint = "j{k}"
loop = {{ P = 0.3, I = 40.0, filter_s = 0.01 }}
speed_limit = 5.0
movement_range = [{low}, {high}]
"""
RANGES = ((-1.0, 1.9), (-0.5, 1.2))


def two_links(folder, kind="", upper=0.8, lower=0.3, tip=0.15):
    """Return an arm of two links that lie level at zero, with these masses [kg]."""
    text = TWO_LINKS.format(
        upper=MASS.format(at=0.1, kg=upper), lower=MASS.format(at=0.05, kg=lower), tip=tip
    )
    (folder / "two.urdf").write_text(text)
    head = 'name = "two"\nurdf = "two.urdf"\nbase_link = "base"\ntool_link = "tip"\n'
    head += f'arm_class = "{kind}"\n' if kind else ""
    motors = [MOTOR.format(k=k, low=low, high=high) for k, (low, high) in enumerate(RANGES, 1)]
    (folder / "two.toml").write_text(head + "".join(motors))
    return load_robot(folder / "two.toml")


def rms_moment(upper=0.8, lower=0.3):
    """Weights times level arms by hand, over poses of the ranges, (2,) [N m]."""
    rng = np.random.default_rng(3)
    first, second = (rng.uniform(*ends, 100_000) for ends in RANGES)
    last = lower * 0.05 * np.cos(first + second)
    shoulder = upper * 0.1 * np.cos(first) + lower * 0.2 * np.cos(first) + last
    return 9.81 * np.sqrt([np.mean(shoulder**2), np.mean(last**2)])


FIGURES = {
    "hobby servo": (0.0065, 0.015, 0.007, 0.005, 0.006, 5.0, 0.03, 0.005),
    "industrial": (0.003, 0.001, 0.0003, 0.0003, 0.0004, 4.0, 0.003, 0.0003),
    "cable-driven": (0.02, 0.02, 0.015, 0.01, 0.01, 4.0, 0.01, 0.001),
}
"""Bias, sag, friction and its spread, scatter [rad]; tail; losses of one motor and of two."""


@pytest.mark.parametrize("kind", FIGURES)
def test_figures_of_a_class(tmp_path, kind):
    found = generic_imperfections(two_links(tmp_path, kind))
    bias, sag, friction, spread, scatter, tail, lost, together = FIGURES[kind]
    settling, variation = found.settling, found.variation
    assert settling.bias == (0.0, 0.0)
    assert settling.friction == (friction, friction)
    assert settling.scatter == (scatter, scatter)
    assert (settling.tail_dof, settling.payload) == (tail, 0.0)
    np.testing.assert_allclose(settling.compliance, sag / rms_moment(), rtol=0.05)
    assert variation.bias == (bias, bias)
    assert variation.friction == (spread, spread)
    assert variation.compliance == (1.0, 1.0)
    assert (variation.scatter, variation.rates) == ((), 0.0)
    rates = {e.motors: (e.rate, e.rate_when_late) for e in found.lost_commands}
    assert rates == {
        ("motor_1",): (lost, lost),
        ("motor_2",): (lost, lost),
        ("motor_1", "motor_2"): (together, together),
    }
    assert (found.name, found.protocol) == ("generic, not calibrated", "P0")
    assert found.source == f"class of arm: {kind}"
    assert kind in settling.source


def test_every_two_motors_may_lose_a_command_together(armpi):
    names = [f"motor_{k}" for k in range(1, 5)]
    found = [e.motors for e in generic_imperfections(armpi).lost_commands]
    assert found == [*((name,) for name in names), *combinations(names, 2)]


def test_twice_the_mass_gives_way_the_same(tmp_path):
    """A heavier arm has stronger motors: sag is what is taken, not compliance."""
    light = generic_imperfections(two_links(tmp_path)).settling
    heavy = generic_imperfections(two_links(tmp_path, upper=1.6, lower=0.6)).settling
    np.testing.assert_allclose(heavy.compliance, np.divide(light.compliance, 2.0), rtol=1e-9)


@pytest.mark.parametrize(("lower", "loaded"), [(0.06, True), (0.003, False)])
def test_a_motor_that_bears_next_to_nothing_does_not_give_way(tmp_path, lower, loaded):
    """Below a hundredth of the largest load; of 0.8 kg at 0.1 m, 8 g at 0.05 m is a half."""
    settling = generic_imperfections(two_links(tmp_path, lower=lower)).settling
    assert (settling.compliance[1] > 0.0) is loaded
    if loaded:
        assert settling.compliance[1] == pytest.approx(0.015 / rms_moment(lower=lower)[1], rel=0.05)


def test_an_arm_without_masses_does_not_give_way(tmp_path):
    settling = generic_imperfections(two_links(tmp_path, upper=0.0, lower=0.0)).settling
    assert settling.compliance == (0.0, 0.0)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("armpi_fpv", "hobby servo"),
        ("so101", "hobby servo"),
        ("ur5e", "industrial"),
        ("panda", "industrial"),
    ],
)
def test_bundled_arms_have_the_class_of_their_kind(name, kind):
    robot = load_robot(name)
    assert class_name(robot) == kind
    assert generic_imperfections(robot).settling.scatter[0] == FIGURES[kind][4]


@pytest.mark.parametrize(("tip", "kind"), [(0.39, "hobby servo"), (0.41, "industrial")])
def test_an_arm_of_no_class_has_that_of_its_reach(tmp_path, tip, kind):
    """0.2 m and the rest: arms beyond 0.6 m are taken to be industrial."""
    assert class_name(two_links(tmp_path, tip=tip)) == kind


def test_a_class_that_is_told_counts_more_than_the_reach(tmp_path):
    assert class_name(two_links(tmp_path, "cable-driven", tip=0.9)) == "cable-driven"


def test_an_unknown_class_is_refused(tmp_path):
    robot = two_links(tmp_path, "cable-drven")
    told = (
        r"unknown arm_class 'cable-drven'\. Did you mean 'cable-driven'\? "
        r"Valid: hobby servo, industrial, cable-driven\."
    )
    with pytest.raises(InputError, match=told):
        generic_imperfections(robot)
    with pytest.raises(InputError, match="unknown arm_class 'steam'"):
        class_name(replace(robot, profile=replace(robot.profile, arm_class="steam")))


def test_a_robot_without_a_calibration_is_like_its_kind(tmp_path):
    robot = two_links(tmp_path, "cable-driven")
    expected = generic_imperfections(robot)
    assert load_calibration(None, robot).imperfections == expected
    assert load_calibration("generic", robot).imperfections == expected
    own = load_calibration("generic", load_robot("armpi_fpv")).imperfections
    assert own.name == "generic, not calibrated"
