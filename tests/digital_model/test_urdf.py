from __future__ import annotations

import numpy as np
import pytest

from failuretwin.core.errors import InputError
from failuretwin.digital_model.urdf.file import read_urdf, transform

ARM = """<robot name="arm">
  <link name="base"/><link name="upper"/><link name="hand"/><link name="sensor"/>
  <joint name="shoulder" type="revolute">
    <parent link="base"/><child link="upper"/>
    <origin xyz="0 0 1" rpy="0 0 0"/><axis xyz="0 2 0"/><limit lower="-1" upper="2"/>
  </joint>
  <joint name="slide" type="prismatic"><parent link="upper"/><child link="hand"/></joint>
  <joint name="mount" type="fixed"><parent link="base"/><child link="sensor"/></joint>
</robot>"""


@pytest.fixture
def arm(tmp_path):
    """Write the arm with one piece of its text replaced, and return the path."""

    def write(old="", new=""):
        assert old in ARM
        path = tmp_path / "arm.urdf"
        path.write_text(ARM.replace(old, new, 1) if old else ARM)
        return path

    return write


def test_joints_are_read_as_the_file_states_them(arm):
    shoulder, slide, mount = read_urdf(arm()).joints

    assert (shoulder.parent, shoulder.child, shoulder.type) == ("base", "upper", "revolute")
    assert shoulder.axis == (0.0, 1.0, 0.0)
    assert (shoulder.low, shoulder.high) == (-1.0, 2.0)
    assert slide.axis == (1.0, 0.0, 0.0)
    assert (slide.low, slide.high) == (-np.inf, np.inf)
    np.testing.assert_array_equal(mount.T_pc, np.eye(4))


def test_continuous_joints_have_no_limits(arm):
    joint = read_urdf(arm("revolute", "continuous")).joints[0]
    assert (joint.low, joint.high) == (-np.inf, np.inf)


def test_roll_pitch_yaw_turn_about_the_fixed_axes_in_this_order():
    quarter = np.pi / 2
    T = transform((1.0, 2.0, 3.0), (quarter, 0.0, quarter))

    np.testing.assert_allclose(T[:3, :3] @ [0, 1, 0], [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(T[:3, :3] @ [1, 0, 0], [0, 1, 0], atol=1e-15)
    np.testing.assert_array_equal(T[:3, 3], [1.0, 2.0, 3.0])


def test_chain_may_begin_above_the_root(arm):
    chain = read_urdf(arm()).chain("upper", "hand", ["slide"])
    np.testing.assert_allclose(chain.position(np.array([0.3])), [0.3, 0.0, 0.0], atol=1e-15)


def test_chain_keeps_the_limits(arm):
    chain = read_urdf(arm()).chain("base", "hand", ["shoulder", "slide"])
    assert [(joint.low, joint.high) for joint in chain.joints] == [(-1.0, 2.0), (-np.inf, np.inf)]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('<robot name="arm">', "<robot", "not an XML file"),
        ('type="revolute"', 'type="revolut"', "unknown joint type 'revolut'. Did you mean"),
        ('<parent link="base"/>', "", "joint 'shoulder' has no <parent> or no <child>"),
        ("0 2 0", "0 0 0", "joint 'shoulder' has a zero axis"),
        ("0 2 0", "0 2", "joint 'shoulder': xyz='0 2', expected three finite numbers"),
        (
            'rpy="0 0 0"',
            'rpy="a b c"',
            "joint 'shoulder': rpy='a b c', expected three finite numbers",
        ),
        ('lower="-1"', 'lower="low"', "joint 'shoulder': lower='low', expected a number"),
    ],
)
def test_malformed_files_say_where(arm, old, new, message):
    path = arm(old, new)
    with pytest.raises(InputError) as error:
        read_urdf(path)
    assert str(error.value).startswith(f"{path}: ")
    assert message in str(error.value)


def test_other_xml_is_not_a_urdf(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text("<mujoco/>")
    with pytest.raises(InputError, match="the top element is <mujoco>, a URDF has <robot>"):
        read_urdf(path)


@pytest.mark.parametrize(
    ("base", "tool", "moving", "message"),
    [
        ("base", "hnd", [], "unknown link 'hnd'. Did you mean 'hand'?"),
        ("root", "hand", [], "unknown link 'root'."),
        ("upper", "sensor", [], "no chain of joints leads from 'upper' to 'sensor'"),
        ("base", "hand", ["shoulders"], "'shoulders'. Did you mean 'shoulder'?"),
        ("base", "hand", ["mount"], "unknown joint on the way to the tool 'mount'."),
        ("base", "sensor", ["mount"], "joint 'mount' is fixed, so no motor can move it."),
    ],
)
def test_chains_that_do_not_exist_are_refused(arm, base, tool, moving, message):
    with pytest.raises(InputError) as error:
        read_urdf(arm()).chain(base, tool, moving)
    assert message in str(error.value)


def test_links_in_a_circle_are_refused(arm):
    path = arm(
        '<parent link="base"/><child link="upper"/>', '<parent link="hand"/><child link="upper"/>'
    )
    with pytest.raises(InputError, match="no chain of joints leads from 'base' to 'hand'"):
        read_urdf(path).path("base", "hand")
