"""Logs of single servos with a pendulum (kscalelabs/sysid): healthy, some with a low P gain."""

import csv
import json

import numpy as np
import pytest
from click.testing import CliRunner

import failuretwin as ft
from failuretwin.app.cli import cli

PENDULUM = """<robot name="pendulum">
  <link name="base"/>
  <joint name="servo" type="revolute">
    <parent link="base"/><child link="arm"/>
    <origin xyz="0 0 0.1"/><axis xyz="0 1 0"/>
    <limit lower="-3" upper="3" effort="3" velocity="6"/>
  </joint>
  <link name="arm">
    <inertial>
      <origin xyz="0 0 -0.1"/><mass value="1.17"/>
      <inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0" ixz="0" iyz="0"/>
    </inertial>
  </link>
  <joint name="flange" type="fixed">
    <parent link="arm"/><child link="tool"/><origin xyz="0 0 -0.1"/>
  </joint>
  <link name="tool"/>
</robot>
"""


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rig")
    (folder / "pendulum.urdf").write_text(PENDULUM)
    asked = ["robot", "init", str(folder / "pendulum.urdf"), "--out", str(folder / "rig.toml")]
    assert CliRunner().invoke(cli, asked).exit_code == 0
    return ft.load_robot(folder / "rig.toml")


@pytest.fixture(scope="module")
def logs(data):
    """Time [s], goal and position [rad] of each log."""
    found = {}
    for path in sorted((data / "sts3215").glob("*.json")):
        entries = json.loads(path.read_text())["entries"]
        names = ("timestamp", "goal_position", "position")
        found[path.stem] = np.array([[entry[name] for name in names] for entry in entries])
    if not found:
        pytest.skip(f"no logs in {data / 'sts3215'}")
    return found


def diagnosed(rig, log, folder):
    """Return the diagnosis of one log, read from a table as a user has it."""
    path = folder / "log.csv"
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["time_s", "target_servo_rad", "actual_servo_rad"])
        writer.writerows(log.tolist())
    return ft.diagnose(ft.read_runs(path, rig), rig)[0]


def test_healthy_servos_are_not_blamed(rig, logs, tmp_path):
    """They follow by up to 20 degrees late and sag by as much: an eighth of the usual P gain."""
    found = [diagnosed(rig, log, tmp_path) for log in logs.values()]

    assert len(found) == 19
    assert all(d.state != "faulty" for d in found), [d.verdict for d in found]
    assert sum("by encoders" in d.method for d in found) == 13


def test_frozen_servos_are_found(rig, logs, tmp_path):
    """From half time on their readings stay as they are."""
    found = {}
    for name, log in logs.items():
        frozen = log.copy()
        frozen[len(log) // 2 :, 2] = frozen[len(log) // 2, 2]
        found[name] = diagnosed(rig, frozen, tmp_path)

    sure = [name for name, d in found.items() if d.posterior["motor_1:stuck"] > 0.99]
    angles = {name: logs[name][len(logs[name]) // 2, 2] for name in sure}
    off = [abs(found[name].magnitude - angle) for name, angle in angles.items()]
    assert len(sure) >= 13
    assert np.median(off) < np.radians(0.5)
