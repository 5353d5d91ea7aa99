"""What is done to a log so that it fits the profile of its robot: a wrong set-up undone.

    q = C u + z,    x = M s + t,    the tool at time a is read at time a + late

with commands u and tool positions s as the log has them. Corrections form a group, so that
two mistakes at once are one correction. Nothing of the robot changes.

Section: docs/inference.md#set-ups
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.movements import Stretches
from failuretwin.core.runs import time_step
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.inference.observation.evidence import SettledEvidence

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True)
class CorrectionTable:
    """A correction as a file states it, see `LogCorrection`.

    Attributes:
        commands: C, a row a motor [-].
        zero: z [rad, m of a slide].
        tool: M, a row an axis [-].
        origin: t [m].
        late_s: How much later than the commands' the clock of the tool is [s].
    """

    commands: tuple[tuple[float, ...], ...]
    zero: tuple[float, ...]
    tool: tuple[tuple[float, ...], ...]
    origin: tuple[float, float, float]
    late_s: float = 0.0


@dataclass(frozen=True)
class LogCorrection:
    """How commands and tool positions of a log become those of the profile.

    Attributes:
        C: Of commands, (motor, motor): senses, order and unit.
        z: What is added to them, (motor,) [rad, m of a slide].
        M: Of tool positions, (3, 3): axes, unit and turn.
        t: What is added to them, (3,) [m].
        late_s: How much later than the commands' the clock of the tool is [s].
    """

    C: FloatArray
    z: FloatArray
    M: FloatArray
    t: FloatArray
    late_s: float = 0.0

    @classmethod
    def none(cls, motors: int) -> LogCorrection:
        """Return that of a log that fits a robot of so many motors."""
        return cls(np.eye(motors), np.zeros(motors), np.eye(3), np.zeros(3))

    @classmethod
    def from_file(cls, table: CorrectionTable, motors: int, where: str) -> LogCorrection:
        """Return that which a file states.

        Raises:
            InputError: If it is of a robot with another number of motors, or cannot be undone.
        """
        rows = [len(row) for row in (*table.commands, table.zero)]
        if rows != [motors] * (motors + 1) or [len(row) for row in table.tool] != [3, 3, 3]:
            raise InputError(
                f"{where}: expected {motors} rows of {motors} numbers in commands, {motors} in "
                "zero, and 3 rows of 3 in tool. Let `failuretwin doctor LOG --out FILE` write it."
            )
        C, z = np.array(table.commands), np.array(table.zero)
        M, t = np.array(table.tool), np.array(table.origin)
        found = cls(C, z, M, t, table.late_s)
        if not min(abs(np.linalg.det(found.C)), abs(np.linalg.det(found.M))) > 0.0:
            raise InputError(f"{where}: commands or tool cannot be undone: a row says nothing.")
        return found

    def text(self, says: str) -> str:
        """Return the table of a file that states it.

        Args:
            says: What it undoes, for the comment.
        """
        rows = {"commands": self.C.tolist(), "zero": self.z.tolist()}
        rows |= {"tool": self.M.tolist(), "origin": self.t.tolist(), "late_s": self.late_s}
        lines = [f"{name} = {value}" for name, value in rows.items()]
        return "\n".join([f"# {says}", "[correction]", *lines]) + "\n"

    def after(self, first: LogCorrection) -> LogCorrection:
        """Return what doing `first` and then this comes to."""
        return LogCorrection(
            self.C @ first.C,
            self.C @ first.z + self.z,
            self.M @ first.M,
            self.M @ first.t + self.t,
            self.late_s + first.late_s,
        )

    @property
    def inverse(self) -> LogCorrection:
        """What makes a log of the profile one of this set-up."""
        C, M = as_floats(np.linalg.inv(self.C)), as_floats(np.linalg.inv(self.M))
        return LogCorrection(C, -C @ self.z, M, -M @ self.t, -self.late_s)

    @property
    def is_none(self) -> bool:
        """Whether it changes nothing."""
        none = LogCorrection.none(len(self.z))
        parts = ((self.C, none.C), (self.z, none.z), (self.M, none.M), (self.t, none.t))
        return self.late_s == 0.0 and all(np.array_equal(a, b) for a, b in parts)

    def command(self, command: FloatArray) -> FloatArray:
        """Return commands (..., motor) [rad] as the profile has them."""
        return np.asarray(command @ self.C.T + self.z)

    def point(self, point: FloatArray) -> FloatArray:
        """Return tool positions (..., 3) [m] as the profile has them."""
        return np.asarray(point @ self.M.T + self.t)

    def evidence(self, evidence: SettledEvidence) -> SettledEvidence:
        """Return settled positions as the profile has them; the clock stays as it is."""
        known = evidence.movements
        order = (self.C != 0.0).astype(np.float64)
        duration = np.where(np.isfinite(known.ramp_duration), known.ramp_duration, 0.0) @ order.T
        movements = replace(
            known,
            initial=self.command(known.initial),
            target=self.command(known.target),
            ramp_duration=np.where(np.isfinite(known.ramp_duration), duration, np.nan),
        )
        if isinstance(movements, Stretches):
            movements = replace(
                movements,
                beginning=self.command(movements.beginning),
                speed=movements.speed @ self.C.T,
                bend=movements.bend @ self.C.T,
                direction=movements.direction @ np.sign(self.C).T,
                done=movements.done @ order.T,
            )
        return replace(evidence, movements=movements, point=self.point(evidence.point))

    def runs(self, runs: xr.Dataset) -> xr.Dataset:
        """Return a run set as the profile has it; what stands in it beside is left as it is."""
        if self.is_none:
            return runs
        command, measured = runs["command"], runs["measured"]
        seen = self.point(as_floats(measured.values))
        steps = round(self.late_s / time_step(runs)) if self.late_s else 0
        if steps:
            seen = np.roll(seen, -steps, axis=1)
            seen[:, slice(-steps, None) if steps > 0 else slice(None, -steps)] = np.nan
        told = self.command(as_floats(command.values))
        return runs.assign(command=(command.dims, told), measured=(measured.dims, seen))
