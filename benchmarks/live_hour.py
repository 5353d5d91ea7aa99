"""An hour of a robot's life: a fault and a repair every two minutes.

Arguments: how fast the robot works (default 10; 0: as fast as possible), seed (default 0), hours
of its own time (default 1). Prints what was found, what was noticed, what was said in error, and
how much memory it took.
"""

from __future__ import annotations

import resource
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from can_show import CanShow
from kept_commands import KeptCommands

from failuretwin import DigitalTwin, load_robot
from failuretwin.app.shadow import Shadow
from failuretwin.connection.emulated_arm import EmulatedArm, Emulation, Shifts
from failuretwin.connection.links.replay import Pace
from failuretwin.core.hypothesis import RAISED, SUSPECTED, paper_hypotheses
from failuretwin.decision.streaming.monitor import monitor
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.failure_behavior.injection import ScheduledFault, state_at

PERIOD_S, BEGIN_S, END_S = 120.0, 40.0, 100.0
"""A fault begins 40 s into every two minutes and is repaired at 100 s."""
WINDOW_S = 15.0
"""After a repair the movements before it still count for so long [s]; what is said then is neither
right nor a false alarm."""


@dataclass(frozen=True)
class Said:
    """What was said at some time.

    Attributes:
        time: When [s].
        name: What the alarm names; healthy without one.
        sure: Whether there is an alarm, or nothing is suspected.
    """

    time: float
    name: str
    sure: bool


def schedule_of(motors: Sequence[str], seconds: float, seed: int) -> list[ScheduledFault]:
    """Return a fault in every period, all kinds in turn, in random order."""
    faults = [h.faults[0] for h in paper_hypotheses(motors) if h.faults]
    rng = np.random.default_rng(seed)
    found: list[ScheduledFault] = []
    while len(found) * PERIOD_S < seconds:
        for k in rng.permutation(len(faults)):
            zero = len(found) * PERIOD_S
            found.append(ScheduledFault(faults[k], zero + BEGIN_S, zero + END_S))
    return [fault for fault in found if fault.end_s <= seconds]


def live(
    schedule: Sequence[ScheduledFault], speed: float, seconds: float, seed: int
) -> tuple[list[Said], KeptCommands, list[float]]:
    """Return what was said, all commands, and the memory taken in between [MB]."""
    robot = load_robot("armpi_fpv")
    twin = DigitalTwin(robot)
    emulation = Emulation(
        robot, load_calibration(robot.name, robot).imperfections, tuple(schedule), seed
    )
    commands = KeptCommands()
    said: list[Said] = []
    memory: list[float] = []
    work = Shifts(break_s=0.0, duration_s=seconds)
    with EmulatedArm(emulation, Pace(speed), work) as source:
        shadow = Shadow(source, monitor(twin), twin, [commands])
        while shadow.step(0.1):
            answer = shadow.snapshot.answer
            if answer.time > 600.0 * (len(memory) + 1):
                memory.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0)
            if answer.diagnosis is None or answer.diagnosis.undecided:
                continue
            alarm = answer.alarm
            name = alarm.cause if alarm.state == RAISED else "healthy"
            said.append(Said(answer.time, name, alarm.state != SUSPECTED))
    return said, commands, memory


def main() -> None:
    """Print one line for each fault, then the sums."""
    speed, seed, hours = (float(a) for a in [*sys.argv[1:], *["10", "0", "1"][len(sys.argv) - 1 :]])
    motors = load_robot("armpi_fpv").motor_names
    schedule = schedule_of(motors, 3600.0 * hours, int(seed))
    said, commands, memory = live(schedule, speed, 3600.0 * hours, int(seed))
    robot = load_robot("armpi_fpv")
    known = load_calibration(robot.name, robot)
    emulation = Emulation(known.robot, known.imperfections, tuple(schedule), int(seed))
    can_show = CanShow(emulation, 3600.0 * hours)
    sure = [s for s in said if s.sure]
    delays, first_named, repairs = [], [], []
    number, after_shown = [], []
    for one in schedule:
        name = str(one.fault)
        there = [s for s in said if s.name == name and one.start_s <= s.time < one.end_s]
        found = [s.time for s in there if s.sure]
        healthy = [
            s.time
            for s in sure
            if s.name == "healthy" and one.end_s <= s.time < one.end_s + PERIOD_S - END_S + BEGIN_S
        ]
        reached = commands.ramp_ends(one.start_s)
        first_named.append(there[0].time - reached[0] if there else np.nan)
        delays.append(found[0] - reached[0] if found else np.nan)
        shown = can_show.movement(one)
        if shown is not None:
            number.append(shown)
            after_shown.append(found[0] - reached[shown - 1] if found else np.nan)
        repairs.append(healthy[0] - one.end_s if healthy else np.nan)
        print(
            f"{name:28s} found after {delays[-1]:5.1f} s, repair noticed after {repairs[-1]:5.1f} s"
        )
    ends = np.array([one.end_s for one in schedule])
    changes = [s for before, s in pairwise(sure) if s.name != before.name]
    wrong = [s for s in changes if s.name != state_at(schedule, s.time, motors)]
    wrong = [s for s in wrong if not any(0.0 <= s.time - end < WINDOW_S for end in ends)]
    alarms = [s for s in wrong if state_at(schedule, s.time, motors) == "healthy"]
    for s in wrong:
        print(f"at {s.time:.1f} s: {s.name}, truth {state_at(schedule, s.time, motors)}")
    print(
        f"{np.isfinite(delays).sum()} of {len(delays)} faults found, most probable after "
        f"{np.nanmedian(first_named):.1f} s, sure after {np.nanmedian(delays):.1f} s (from the "
        f"end of the first ramp), {np.nanmedian(after_shown):.1f} s after the ramp of the movement "
        f"that can show it, which is number {np.median(number):.0f} after the onset (medians; "
        f"{len(schedule) - len(number)} cannot be shown); "
        f"{np.isfinite(repairs).sum()} repairs noticed, median {np.nanmedian(repairs):.1f} s; "
        f"{len(alarms)} false alarms, {len(wrong) - len(alarms)} faults misnamed; "
        f"memory {memory[0]:.0f} to {memory[-1]:.0f} MB"
    )


if __name__ == "__main__":
    main()
