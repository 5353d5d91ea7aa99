from __future__ import annotations

import tomllib
from dataclasses import replace

import pytest

from failuretwin.core.errors import InputError
from failuretwin.digital_model.geometry import Geometry, JointCorrection
from failuretwin.digital_model.profile_text import fitted_text
from failuretwin.digital_model.robot import bundled_folder, load_robot

FITTED = Geometry(
    (JointCorrection("joint2", 0.01, (0.001, 0.0, 0.0)),), 1.002, 0.0004, 'a "fit" of today'
)


def fitted(robot):
    motors = tuple(replace(m, sense=1.0) for m in robot.profile.motors)
    return replace(
        robot.profile,
        motors=motors,
        sensor_pose="physical",
        tool_xyz=(0.0, 0.0, 0.05),
        base_xyz_rpy=(1.0, 2.0, 3.0, 0.0, 0.0, 0.5),
        geometry=FITTED,
        imperfections=None,
    )


def test_remarks_stay_and_the_profile_says_what_it_should(tmp_path):
    robot = load_robot("armpi_fpv")
    text = robot.source.read_text(encoding="utf-8")
    out = tmp_path / "mine.toml"
    result = fitted_text(text, robot.source, out, fitted(robot))
    out.write_text(result, encoding="utf-8")

    made = load_robot(out)
    assert made.profile.geometry == FITTED
    assert made.profile.base_xyz_rpy == (1.0, 2.0, 3.0, 0.0, 0.0, 0.5)
    assert made.profile.imperfections is None
    assert [motor.sense for motor in made.motors] == [1.0] * 4
    assert made.urdf_file.resolve() == (bundled_folder() / "armpi_fpv.urdf").resolve()
    remarks = [line for line in text.splitlines() if line.startswith("#")]
    assert all(line in result for line in remarks)
    assert "# the tool point is the origin of joint 5's frame" in result
    assert "# one count moves the tool by 1 mm" in result


def test_a_second_fit_takes_the_place_of_the_first(tmp_path):
    robot = load_robot("ur5e")
    out = tmp_path / "mine.toml"
    profile = replace(robot.profile, geometry=Geometry(source="first"))
    out.write_text(
        fitted_text(robot.source.read_text(encoding="utf-8"), robot.source, out, profile),
        encoding="utf-8",
    )
    again = load_robot(out)
    second = replace(again.profile, geometry=Geometry(source="second"))
    result = fitted_text(out.read_text(encoding="utf-8"), out, out, second)

    assert tomllib.loads(result)["geometry"]["source"] == "second"
    assert result.count("# Written by `failuretwin robot fit`") == 1
    assert "first" not in result


def test_a_text_that_cannot_be_changed_line_by_line_is_refused(tmp_path):
    robot = load_robot("ur5e")
    text = robot.source.read_text(encoding="utf-8").replace("sense = 1.0\n", "")
    text = text.replace("tool_link =", '"tool_xyz" = [0.0, 0.0, 0.0]\ntool_link =')
    with pytest.raises(InputError, match="cannot be changed line by line"):
        fitted_text(text, robot.source, tmp_path / "mine.toml", fitted(robot))
