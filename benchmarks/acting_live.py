"""Act on emulated arms as they are: late starts, stalls, gaps, rest seen by readings at 10 Hz.

    python benchmarks/acting_live.py [--arms 12] [--robot armpi_fpv]

Each arm has a motor that sticks 5 s after the start. Shares of targets within 5 mm, by where the
tool really is, among those worked on after that; "of": what some safe pose can reach.
"""

from __future__ import annotations

import argparse

import numpy as np
from acting import TOLERANCE_M, Row, possible, tasks_of

from failuretwin.connection.emulated_arm import EmulatedArm, Emulation
from failuretwin.connection.links.base import Event
from failuretwin.core.hypothesis import Fault
from failuretwin.core.types import FloatArray
from failuretwin.decision.acting.actor import Actor
from failuretwin.decision.acting.safety import SafetyGate
from failuretwin.decision.acting.session import Acting
from failuretwin.decision.acting.task import ActingSettings
from failuretwin.decision.acting.work import Work, first_standing
from failuretwin.digital_model.calibrated_robot import CalibratedRobot, load_calibration
from failuretwin.failure_behavior.injection import ScheduledFault

STUCK_AT_S = 5.0


class Watched(EmulatedArm):
    """A commanded arm that notes where it really stands when work on a target is over."""

    actor: Actor | None = None

    def __init__(self, emulation: Emulation) -> None:
        super().__init__(emulation)
        self.now = 0.0
        self.ends: list[tuple[float, FloatArray]] = []

    def poll(self, timeout_s: float) -> Event | None:
        """Return the next event."""
        self.note()
        event = super().poll(timeout_s)
        if event is not None:
            self.now = event.time
        return event

    def note(self) -> None:
        """Note where the arm stands for every target that is over."""
        while self.actor is not None and len(self.ends) < len(self.actor.results):
            self.ends.append((self.now, self.angle))


def rows_of(known: CalibratedRobot, motor: int, seed: int, strategy: str) -> list[Row]:
    """Return what became of the targets of one arm that were worked on after the onset."""
    robot = known.robot
    schedule = (ScheduledFault(Fault(robot.motor_names[motor], "stuck"), STUCK_AT_S),)
    arm = Watched(Emulation(robot, known.imperfections, schedule, seed))
    task = tasks_of(robot, 1, 9, 1000 * motor + seed)[0]
    acting = Acting(known, SafetyGate(robot), strategy, ActingSettings())
    standing = first_standing(arm)
    arm.actor = actor = acting.actor(task, standing, lambda text: None)
    Work(actor, acting.gate, arm, standing).carry_out()
    arm.note()
    held, rows = float(arm.ends[-1][1][motor]), []
    for (at, angle), result in zip(arm.ends, actor.results, strict=True):
        error = float(np.linalg.norm(known.twin.path(angle) - result.target.point))
        if at > STUCK_AT_S + 1.5:
            hit, place = error <= TOLERANCE_M, list(result.target.position)
            moves = result.movements
            row = {
                "hit": hit,
                "held": held,
                "motor": motor + 1,
                "target": place,
                "movements": moves,
            }
            rows.append(row)
    return rows


def main() -> None:
    """Print shares by motor."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--robot", default="armpi_fpv")
    parser.add_argument("--arms", type=int, default=12)
    told = parser.parse_args()
    known = load_calibration(None, told.robot)
    for strategy in ("feedback", "diagnose"):
        for motor in range(len(known.robot.motors)):
            rows = [r for seed in range(told.arms) for r in rows_of(known, motor, seed, strategy)]
            could, hits = possible(known.robot, rows), np.array([row["hit"] for row in rows])
            moves = np.mean([row["movements"] for row in rows])
            print(
                f"{strategy:9s} motor {motor + 1}: {hits.mean():.2f} of {could.mean():.2f} "
                f"[{moves:.1f}] n {len(rows)} ({hits.sum()} of {could.sum()})",
                flush=True,
            )


if __name__ == "__main__":
    main()
