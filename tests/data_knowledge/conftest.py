from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from failuretwin import ReadOptions, read_runs

FILES = {
    "command": "trajectory_monitoring_cmd.csv",
    "duration": "trajectory_monitoring_cmd_duration.csv",
    "position": "trajectory_monitoring_position.csv",
}
COLUMNS = ("motor_6", "motor_5", "motor_4", "motor_3")
"""Log columns of motors 1 to 4."""


@dataclass(frozen=True)
class Log:
    """A session as it stands in its files: stamps and counts of motors 1 to 4."""

    command_time: np.ndarray
    target: np.ndarray
    reading_time: np.ndarray
    counts: np.ndarray


@pytest.fixture(scope="session")
def read_log():
    """Read a session folder without failuretwin."""

    def read(folder):
        tables = {n: np.genfromtxt(folder / f, delimiter=",", names=True) for n, f in FILES.items()}
        command, position = tables["command"], tables["position"]
        return Log(
            command["timestamp"],
            np.stack([command[c] for c in COLUMNS], axis=-1),
            position["timestamp"],
            np.stack([position[c] for c in COLUMNS], axis=-1),
        )

    return read


@pytest.fixture(scope="session")
def tool_at():
    """Work out tool positions [m] from counts of motors 1 to 4, by plane trigonometry."""

    def position(counts):
        q = np.deg2rad(120.0 - 0.24 * np.asarray(counts, dtype=float))
        a = q[..., 1]
        b, c = a + q[..., 2], a + q[..., 2] + q[..., 3]
        reach = 0.10048 * np.sin(a) + 0.094714 * np.sin(b) + 0.05071 * np.sin(c)
        height = 0.10048 * np.cos(a) + 0.094714 * np.cos(b) + 0.05071 * np.cos(c)
        turn = q[..., 0]
        return np.stack([reach * np.sin(turn), -reach * np.cos(turn), height + 0.064605], axis=-1)

    return position


@pytest.fixture(scope="session")
def published(data, armpi):
    return read_runs(data / "real_robot_b_20241003", armpi, ReadOptions("published", True))


@pytest.fixture(scope="session")
def measured(data, armpi):
    return read_runs(data / "real_robot_b_20241003", armpi, ReadOptions("measured", True))


@dataclass
class SessionWriter:
    """Writes session folders of an arm whose motors do exactly as told.

    Attributes:
        folder: Where sessions go.
        targets: Counts of motors 1 to 4, (row, motor).
        ramp_s: Length of every ramp [s].
        until_s: End of the readings; the first command is at 0 s, readings start at -0.55 s.
    """

    folder: Path
    targets: np.ndarray
    ramp_s: float = 0.8
    until_s: float = 10.0
    epoch: float = 1.7e9

    @property
    def command_time(self):
        return 2.0 * np.arange(len(self.targets))

    @property
    def reading_time(self):
        return np.arange(-0.55, self.until_s, 0.1)

    def counts(self, time):
        """Return what the motors read at `time` [s], (time, motor); they start at the middle."""
        begin = self.command_time
        knots = np.stack([begin, begin + self.ramp_s], axis=1).ravel()
        values = np.repeat(np.concatenate([[[500.0] * 4], self.targets]), 2, axis=0)[1:-1]
        return np.stack([np.interp(time, knots, v) for v in values.T], axis=-1).round()

    def write(self, name="session", counts: Mapping[int, list[float]] | None = None, gap=(0, 0)):
        """Write a session; readings with a number in `counts` are replaced, `gap` is left out."""
        readings = self.counts(self.reading_time)
        for row, values in (counts or {}).items():
            readings[row] = values
        kept = np.r_[0 : gap[0], gap[1] : len(readings)]
        folder = self.folder / name
        folder.mkdir(parents=True)
        ramp = np.full_like(self.targets, 1000 * self.ramp_s)
        self._table(folder / FILES["command"], self.command_time, self.targets)
        self._table(folder / FILES["duration"], self.command_time, ramp)
        self._table(folder / FILES["position"], self.reading_time[kept], readings[kept])
        return folder

    def _table(self, path, time, motors):
        lines = ["timestamp,motor_1,motor_2,motor_3,motor_4,motor_5,motor_6"]
        for stamp, row in zip(time + self.epoch, motors, strict=True):
            lines.append(",".join(str(float(v)) for v in (stamp, 321, 500, *row[::-1])))
        path.write_text("\n".join(lines) + "\n")


@pytest.fixture
def session(tmp_path):
    targets = np.random.default_rng(0).integers(300, 700, (5, 4)).astype(float)
    return SessionWriter(tmp_path / "logs", targets)
