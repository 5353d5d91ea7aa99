"""The live loop through a real roscore: nine states, delay, latency.

Delays count from the end of the ramp of the first movement that can show the fault (can_show.py),
and from that of the first one after the onset.

Start `roscore` first. Arguments: how fast the emulated robots work (default 1), seconds that each
of them works by its own clock (default 45: errors are told after ten movements), seed (default 0).
"""

from __future__ import annotations

import subprocess
import sys
import time
from dataclasses import dataclass

import numpy as np
from can_show import CanShow
from kept_commands import KeptCommands

from failuretwin import DigitalTwin, load_robot
from failuretwin.app.shadow import Shadow
from failuretwin.connection.emulated_arm import FIRST_COMMAND_S, Emulation
from failuretwin.connection.links.base import CommandSent, Reading
from failuretwin.connection.links.ros_link import RosSink, RosSource, open_transport
from failuretwin.connection.links.ros_messages import RosTopics, RosWriter
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.core.types import FloatArray
from failuretwin.decision.streaming.monitor import monitor
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.robot import Robot
from failuretwin.failure_behavior.injection import ScheduledFault

ONSET_S = 6.0
"""When the faults begin, by the robot's clock [s]."""
SURE = 0.9
LAST_WORDS_S = 1.0
"""Time for the last messages to come once the robot is gone [s]."""


@dataclass(frozen=True)
class Outcome:
    """What was said of one state.

    Attributes:
        last: The last diagnosis.
        sure_s: When the first sure and right answer came that was kept to the end, by the robot's
            clock [s]; NaN where there was none.
        ramp_ends: When the ramps of the movements after the onset end, (movement,) [s].
    """

    last: str | None
    sure_s: float
    ramp_ends: FloatArray

    def delay(self, movement: int) -> float:
        """Return the time from the end of a movement's ramp to the sure answer [s]; from 1."""
        return self.sure_s - float(self.ramp_ends[movement - 1])


def watch_state(robot: Robot, state: str, speed: float, seconds: float, seed: int) -> Outcome:
    """Let a robot of a state work in a process of its own and watch it over ROS."""
    command = [sys.executable, "-m", "failuretwin", "emulate", "--seed", str(seed)]
    command += ["--speed", str(speed), "--seconds", str(seconds)]
    if state != "healthy":
        command += ["--fault", f"{state}@{ONSET_S}"]
    twin, commands, sure_since = DigitalTwin(robot), KeptCommands(), np.nan
    with open_transport("ros1") as transport:
        source = RosSource(robot, RosTopics(), transport)
        child = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        shadow = Shadow(
            source,
            monitor(twin),
            twin,
            [commands],
        )
        deadline = np.inf
        while time.monotonic() < deadline:
            shadow.step(0.1)
            if child.poll() is not None:
                deadline = min(deadline, time.monotonic() + LAST_WORDS_S)
            answer = shadow.snapshot.answer
            if answer.diagnosis is None or answer.diagnosis.undecided:
                continue
            right = answer.diagnosis.posterior[state] >= SURE
            sure_since = (answer.time if np.isnan(sure_since) else sure_since) if right else np.nan
    diagnosis = shadow.snapshot.answer.diagnosis
    last = None if diagnosis is None else diagnosis.diagnosis
    zero = commands.sent[0].time - FIRST_COMMAND_S
    return Outcome(last, sure_since, commands.ramp_ends(zero + ONSET_S))


def first_shown(robot: Robot, state: str, seconds: float, seed: int) -> int:
    """Return the first movement after the onset that can show a fault, from 1."""
    fault = ScheduledFault.parse(f"{state}@{ONSET_S}", robot.motor_names)
    known = load_calibration(robot.name, robot)
    emulation = Emulation(known.robot, known.imperfections, (fault,), seed)
    shown = CanShow(emulation, seconds).movement(fault)
    if shown is None:
        raise RuntimeError(f"{state}, seed {seed}: no movement can show it")
    return shown


def latency(robot: Robot, samples: int = 300) -> list[float]:
    """Return the times from publishing a reading to the answer to it [s], through roscore."""
    twin, topics = DigitalTwin(robot), RosTopics()
    rng = np.random.default_rng(0)
    taken = []
    with open_transport("ros1") as transport:
        source = RosSource(robot, topics, transport)
        sink = RosSink(RosWriter(robot, topics), transport)
        shadow = Shadow(
            source,
            monitor(twin),
            twin,
        )
        time.sleep(2.0)
        pose = np.zeros(len(robot.motors))
        for k in range(samples):
            if k % 20 == 0:
                pose = rng.uniform(-0.8, 0.8, len(pose))
                sink.put(CommandSent(1000.0 + 0.1 * k, pose, np.full(len(pose), 0.8)))
                shadow.step(1.0)
            begin = time.perf_counter()
            sink.put(Reading(1000.05 + 0.1 * k, np.full(3, np.nan), pose))
            shadow.step(1.0)
            taken.append(time.perf_counter() - begin)
            time.sleep(0.02)
    return taken


def main() -> None:
    """Print a line for each state, then the latency."""
    speed, seconds, seed = (
        float(a) for a in [*sys.argv[1:], *("1", "45", "0")[len(sys.argv) - 1 :]]
    )
    robot = load_robot("armpi_fpv")
    taken = 1000.0 * np.array(latency(robot))
    print(
        f"latency of a sample through roscore: median {np.median(taken):.1f} ms, "
        f"99 % {np.percentile(taken, 99):.1f} ms, longest {taken.max():.1f} ms"
    )
    delays, since_first, right = [], [], 0
    for state in map(str, paper_hypotheses(robot.motor_names)):
        outcome = watch_state(robot, state, speed, seconds, int(seed))
        right += outcome.last == state
        print(f"{state:28s} named {outcome.last!s:28s}", end=" ", flush=True)
        if state == "healthy":
            print()
            continue
        shown = first_shown(robot, state, seconds, int(seed))
        delays.append(outcome.delay(shown))
        since_first.append(outcome.delay(1))
        print(f"can be shown by movement {shown}, sure {delays[-1]:5.1f} s after its ramp")
    print(
        f"{right} of 9 right; median delay {np.nanmedian(delays):.1f} s after the movement that "
        f"can show it, {np.nanmedian(since_first):.1f} s after the first"
    )


if __name__ == "__main__":
    main()
