"""Measured poses of two real arms, which do not come with the package."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from dh_arms import UR5, UR10, robot_in, urdf

from failuretwin.connection.registration.arm import Poses
from failuretwin.connection.registration.fit import register
from failuretwin.digital_model.robot import _assembled

ARMS = {"ur10_series_c": UR10, "ur5": UR5}
FOLDER = Path(os.environ.get("FAILURETWIN_DATA", "../shared/data")) / "real_arms"


@pytest.fixture(params=ARMS)
def arm(request):
    path = FOLDER / f"{request.param}.csv"
    if not path.exists():
        pytest.skip(f"no measured poses {path}")
    table = np.genfromtxt(path, delimiter=",", names=True)
    motors = [name for name in table.dtype.names if name.startswith("q")][:5]
    q = np.stack([table[name] for name in motors], axis=1)
    point = np.stack([table[axis] for axis in "xyz"], axis=1)
    order = np.random.default_rng(0).permutation(len(q))
    return request.param, Poses(q[order], point[order])


def rms_mm(made, poses):
    error = made.chain.position(poses.target) - poses.point
    return 1e3 * np.sqrt(np.mean(np.sum(error**2, axis=1)))


@pytest.mark.parametrize(
    ("count", "most"),
    [(400, {"ur10_series_c": 0.51, "ur5": 0.14}), (40, {"ur10_series_c": 0.75, "ur5": 0.2})],
)
def test_unseen_poses_in_the_frame_of_the_tracker(tmp_path, arm, count, most):
    name, poses = arm
    tool = np.array([0.0, 0.0, {"ur10_series_c": 0.0929, "ur5": 0.0338}[name]])
    robot = robot_in(tmp_path, urdf(ARMS[name], tool))
    found = register(poses[slice(0, count)], robot)

    made = _assembled(found.profile, robot.source)
    assert rms_mm(made, poses[slice(count, None)]) < most[name]
    assert found.frames_mm > found.after_mm or count == 40
