from __future__ import annotations

import re
import shutil
import sys

import numpy as np
import pytest

from failuretwin import load_robot
from failuretwin.app.cli import main
from failuretwin.core.errors import InputError
from failuretwin.digital_model.robot import bundled_folder, bundled_robots
from failuretwin.digital_model.urdf.file import read_root

ARM = """<robot name="arm">
  <link name="base"/>
  <joint name="turn" type="revolute"><parent link="base"/><child link="hand"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" velocity="2" effort="3"/></joint>
  <link name="hand"><inertial><mass value="0.5"/>
    <inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="mount" type="fixed"><parent link="hand"/><child link="tip"/>
    <origin xyz="0.25 0 0"/></joint>
  <link name="tip"/>
</robot>"""


@pytest.fixture
def arm(tmp_path):
    """Write the arm with one piece of its text replaced, and return the path."""

    def write(old="", new=""):
        assert old in ARM
        path = tmp_path / "arm.urdf"
        path.write_text(ARM.replace(old, new, 1) if old else ARM, encoding="utf-8")
        return path

    return write


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
        out, err = capsys.readouterr()
        return code, out, err

    return run


def plain(text):
    return " ".join(text.split())


def test_check_prints_the_chain(arm, run):
    code, out, err = run("robot", "check", arm())

    assert (code, err) == (0, "")
    assert "arm: from base to tip, 1 motor can move the tool point" in out
    assert "the tool gets 0.250 m away from the base's origin; what moves weighs 0.500 kg" in out
    assert re.search(r"turn +revolute +-57.3 to 57.3 deg +114.6 deg/s +3 N m +0.5 kg +motor_1", out)
    assert re.search(r"mount +fixed +- \(fixed\)", out)
    assert "warning" not in out
    assert "note" not in out


@pytest.mark.parametrize(
    ("old", "new", "shown"),
    [
        ('type="revolute"', 'type="prismatic"', "-1000 to 1000 mm 2000 mm/s 3 N 0.5 kg motor_1"),
        ('type="revolute"', 'type="continuous"', "continuous endless 114.6 deg/s 3 N m"),
        (
            '<limit lower="-1" upper="1" velocity="2" effort="3"/>',
            "",
            "revolute ? ? ? 0.5 kg motor_1",
        ),
        ('<mass value="0.5"/>', "", "114.6 deg/s 3 N m ? motor_1"),
    ],
)
def test_check_shows_units_and_what_is_unknown(arm, run, old, new, shown):
    code, out, _ = run("robot", "check", arm(old, new))
    assert code == 0
    assert shown in plain(out)


def test_check_prints_warnings_and_notes_in_full(arm, run):
    mesh = '<link name="tip"><visual><mesh filename="package://a/[b].stl"/></visual></link>'
    code, out, _ = run("robot", "check", arm('<link name="tip"/>', mesh))
    assert code == 0
    assert (
        "note: 1 mesh is named by a package address that only ROS can resolve "
        "('package://a/[b].stl'). Only the picture is missing; kinematics works."
    ) in plain(out)


def test_check_ends_with_2_on_errors(arm, run):
    path = arm('type="revolute"', 'type="revolut"')
    code, out, err = run("robot", "check", path)
    assert (code, out) == (2, "")
    assert err.startswith(f"error: {path}: joint 'turn': unknown joint type 'revolut'. Did you")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--tool", "tipp"], "unknown link 'tipp'. Did you mean 'tip'?"),
        (["--base", "bas"], "unknown link 'bas'. Did you mean 'base'?"),
        (["--tool", "base"], "no joint on the way to the tool moves"),
        (["--tool", "hand"], "no motor can move the tool point, the origin of link 'hand'"),
    ],
)
@pytest.mark.parametrize("verb", ["check", "init"])
def test_links_that_do_not_fit_end_with_2(arm, run, tmp_path, verb, words, message):
    out_option = ["--out", tmp_path / "arm.toml"] if verb == "init" else []
    code, _, err = run("robot", verb, arm(), *words, *out_option)
    assert code == 2
    assert message in err
    assert [path.name for path in tmp_path.iterdir()] == ["arm.urdf"]


def test_a_missing_file_is_named(run, tmp_path):
    code, out, err = run("robot", "check", tmp_path / "lost.urdf")
    assert (code, out) == (2, "")
    assert "lost.urdf: cannot be read (No such file or directory)." in err


def test_a_xacro_file_says_how_to_expand_it(arm, run):
    code, _, err = run("robot", "check", arm("</robot>", "<xacro:wrist/></robot>"))
    assert code == 2
    assert "Expand it with `xacro arm.urdf > arm_expanded.urdf` and give that file." in err


def test_init_writes_a_profile_that_loads(arm, run, tmp_path):
    out = tmp_path / "mine.toml"
    code, said, err = run("robot", "init", arm(), "--out", out)

    assert (code, err) == (0, "")
    assert f"profile with 1 motor written to {out}" in said
    robot = load_robot(out)
    assert (robot.name, robot.motor_names, robot.motors[0].speed_limit) == ("arm", ["motor_1"], 2.0)
    np.testing.assert_allclose(robot.chain.position(np.zeros(1)), [0.25, 0.0, 0.0], atol=1e-15)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["arm.urdf", "mine.toml"]


def test_init_passes_warnings_on(arm, run, tmp_path):
    path = arm('<mass value="0.5"/>', "")
    code, _, err = run("robot", "init", path, "--out", tmp_path / "mine.toml")
    assert code == 0
    assert err.startswith("warning: link 'hand' has no <inertial> mass")


def test_init_never_overwrites(arm, run, tmp_path):
    out = tmp_path / "mine.toml"
    out.write_text("precious")
    code, _, err = run("robot", "init", arm(), "--out", out)
    assert code == 2
    assert f"{out}: exists already. Choose another name, or remove it first." in err
    assert out.read_text() == "precious"


def test_init_wants_a_name_that_can_be_loaded(arm, run, tmp_path):
    code, _, err = run("robot", "init", arm(), "--out", tmp_path / "mine.txt")
    assert code == 2
    assert "mine.txt: a profile ends in .toml." in err


def test_init_into_a_folder_that_does_not_exist_says_so(arm, run, tmp_path):
    code, _, err = run("robot", "init", arm(), "--out", tmp_path / "new" / "mine.toml")
    assert code == 2
    assert "does not exist. Make it first." in err


@pytest.mark.parametrize("name", bundled_robots())
def test_bundled_robots_pass_both_verbs(run, tmp_path, name):
    profile = load_robot(name).profile
    urdf = shutil.copy(bundled_folder() / profile.urdf, tmp_path)
    links = ["--base", profile.base_link, "--tool", profile.tool_link]

    code, out, _ = run("robot", "check", urdf, *links)
    assert code == 0
    assert f"to {profile.tool_link}, {len(profile.motors)} motors can move" in out

    code, _, err = run("robot", "init", urdf, *links, "--out", tmp_path / "mine.toml")
    assert (code, err) == (0, "")
    assert load_robot(tmp_path / "mine.toml").motor_names == [m.name for m in profile.motors]


def test_a_made_profile_can_be_simulated(arm, run, tmp_path):
    run("robot", "init", arm(), "--out", tmp_path / "mine.toml")
    words = ["--runs-per-class", 2, "--out", tmp_path / "runs.nc"]
    code, out, _ = run("simulate", "--robot", tmp_path / "mine.toml", *words)
    assert code == 0
    assert "6 runs written" in out


def test_init_centres_random_movements_on_the_pose_at_rest(arm, run, tmp_path):
    out = tmp_path / "mine.toml"
    wide = arm('lower="-1" upper="1"', 'lower="-6" upper="6"')
    code, _, _ = run("robot", "init", wide, "--home", "-90", "--out", out)

    motor = load_robot(out).motors[0]
    assert code == 0
    assert motor.home == pytest.approx(-np.pi / 2)
    assert np.mean(motor.movement_range) == pytest.approx(-np.pi / 2)


@pytest.mark.parametrize(
    ("home", "message"),
    [("1,2", "2 values, expected 1"), ("a", "expected numbers separated by commas")],
)
def test_init_refuses_a_pose_at_rest_of_another_arm(arm, run, tmp_path, home, message):
    code, _, err = run("robot", "init", arm(), "--home", home, "--out", tmp_path / "mine.toml")
    assert code == 2
    assert message in err


def test_urdf_and_profile_are_not_mixed_up(tmp_path):
    with pytest.raises(InputError, match=r"failuretwin robot init arm\.urdf --out arm\.toml"):
        load_robot("arm.urdf")
    with pytest.raises(InputError, match="is the profile of a robot, expected its URDF"):
        read_root(tmp_path / "arm.toml")
