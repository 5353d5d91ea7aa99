from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from executed import command_line

FILES = (
    "trajectory_monitoring_cmd.csv",
    "trajectory_monitoring_cmd_duration.csv",
    "trajectory_monitoring_position.csv",
)


@pytest.fixture(scope="session")
def failuretwin():
    """Run the command line as a user does, without a terminal."""
    return command_line().run


@pytest.fixture(scope="session")
def begin():
    """Begin a command, and do not wait for it."""
    return command_line().begin


@pytest.fixture(scope="session")
def write_session():
    """Write a session of five movements of a healthy arm; its readings end at `until_s`."""

    def write(folder: Path, until_s=10.0, seed=0):
        folder.mkdir(parents=True)
        targets = np.random.default_rng(seed).integers(300, 700, (5, 6)).astype(float)
        start = 2.0 * np.arange(5)
        knots = np.stack([start, start + 0.8], axis=1).ravel()
        values = np.repeat(np.vstack([[500.0] * 6, targets]), 2, axis=0)[1:-1]
        at = np.arange(-0.55, until_s, 0.1)
        readings = np.stack([np.interp(at, knots, v) for v in values.T], axis=-1).round()
        tables = ((start, targets), (start, np.full((5, 6), 800.0)), (at, readings))
        for name, (time, rows) in zip(FILES, tables, strict=True):
            lines = ["timestamp,motor_1,motor_2,motor_3,motor_4,motor_5,motor_6"]
            for stamp, row in zip(time + 100.0, rows, strict=True):
                lines.append(",".join(map(str, [stamp, *row])))
            (folder / name).write_text("\n".join(lines) + "\n")
        return folder

    return write


@pytest.fixture(scope="session")
def simulated(failuretwin, tmp_path_factory):
    """A run set of nine imperfect runs, one of each class."""
    path = tmp_path_factory.mktemp("simulated") / "runs.nc"
    answer = failuretwin(
        "simulate", "--out", path, "--runs-per-class", 1, "--calibration", "armpi_fpv"
    )
    assert answer.returncode == 0, answer.stderr
    return path


@pytest.fixture
def listing():
    """List everything below a folder."""
    return lambda folder: sorted(str(p.relative_to(folder)) for p in folder.rglob("*"))
