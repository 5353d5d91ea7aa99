"""Healthy hours of emulated robots, each drawn anew: what the watch says in error.

    python benchmarks/live_healthy.py [--robots 20] [--hours 1] [--seed 0] [--sensing tool]

Physics engine with gears that stick and joints that flex; offsets, scatter, lost commands and late
starts as the calibration of the ArmPi says of such robots; readings at the rate of its sensor. The
watch is that of `failuretwin watch emulated`, as fast as it can go.
"""

from __future__ import annotations

import argparse

from telling import per_100_hours

from failuretwin import DigitalTwin
from failuretwin.app.shadow import Shadow
from failuretwin.connection.emulated_arm import EmulatedArm, Emulation, Shifts
from failuretwin.core.hypothesis import CLEAR, RAISED, SUSPECTED, Alarm
from failuretwin.decision.streaming.monitor import monitor
from failuretwin.digital_model.calibrated_robot import load_calibration


def said_in_error(robot: str, hours: float, seed: int, sensing: str) -> list[Alarm]:
    """Return the suspicions and alarms in the life of one healthy robot, in order.

    Args:
        robot: Its name.
        hours: How long it works.
        seed: Seed of all chance; the robot is drawn by it too.
        sensing: What the watch believes.
    """
    known = load_calibration(None, robot)
    twin, said, before = DigitalTwin(known.robot), list[Alarm](), CLEAR
    emulation = Emulation(known.robot, known.imperfections, seed=seed)
    work = Shifts(break_s=0.0, duration_s=3600.0 * hours)
    with EmulatedArm(emulation, shifts=work) as source:
        shadow = Shadow(source, monitor(twin, sensing=sensing), twin, [])
        while shadow.step(0.1):
            alarm = shadow.snapshot.answer.alarm
            if alarm.state not in (before, CLEAR) and (alarm.state, before) != (SUSPECTED, RAISED):
                said.append(alarm)
            before = alarm.state
    return said


def main() -> None:
    """Print what was said in error of each robot, then the rates."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--robot", default="armpi_fpv")
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--hours", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--sensing", default="tool")
    options = parser.parse_args()
    raised = suspected = 0
    for number in range(options.robots):
        said = said_in_error(options.robot, options.hours, options.seed + number, options.sensing)
        causes = [a.cause for a in said if a.state == RAISED]
        raised += len(causes)
        suspected += sum(a.state == SUSPECTED for a in said)
        hours = options.hours * (number + 1)
        print(
            f"{number + 1} robots, {hours:g} h: alarms {per_100_hours(raised, hours)}, suspicions "
            f"{per_100_hours(suspected, hours)}; this one: {', '.join(causes) or 'no alarm'}",
            flush=True,
        )


if __name__ == "__main__":
    main()
