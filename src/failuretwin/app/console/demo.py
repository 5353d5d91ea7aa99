"""The console without a robot: emulated arms at work, and a fleet with a year of history."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from threading import Thread

import numpy as np

from failuretwin.app.console.live import LiveRobot, LiveSettings
from failuretwin.app.keepers import begin_watch
from failuretwin.app.remembering import RobotRecord
from failuretwin.app.simulated_years import last_midnight
from failuretwin.connection.links.base import Source
from failuretwin.connection.links.replay import Pace
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.data_knowledge.records.log_files import log_file
from failuretwin.data_knowledge.records.store import Store, open_store
from failuretwin.decision.streaming.monitor import monitor
from failuretwin.digital_model.calibrated_robot import CalibratedRobot
from failuretwin.inference.diagnoser import BayesDiagnoser

DAY_S = 86_400
LOW_PRIORITY = 5
CHILD = """import os, shlex, sys, threading
def end_with_parent():
    os.read(0, 1)
    os._exit(1)
threading.Thread(target=end_with_parent, daemon=True).start()
from failuretwin.app.cli import main
for command in sys.argv[1:]:
    sys.argv[1:] = shlex.split(command)
    main()"""
"""Runs commands, one after the other: libraries are imported and compiled code is loaded once.

Its input ends when its parent does, however that ends; then it ends too.
"""
YEAR_SEED = 5
ARMS = {
    "hall_1-arm_1": ((), 0.0),
    "hall_1-arm_2": (("motor_3:stuck@24",), 0.0),
    "hall_1-arm_3": ((), 30.0),
}
"""Emulated arms: their faults, and when each falls silent [s]; 0: never."""
LOGS = {
    "hall_2-arm_7": (("monday", 0), ("tuesday", 2), ("wednesday", 3)),
    "hall_2-arm_8": (("thursday", 1),),
}
"""Logs of robots: name and number of the simulated run. The last two are of a stuck motor."""
TRACKED, TRACKED_RUNS, TRACKED_SEED = "hall_2-arm_9", 20, 3
"""Robot whose offsets are followed over two logs; as many runs as its remaining life needs."""
REVERSED = {"hall_2-arm_8": 1}
"""Robots whose set-up is wrong: the number of the motor whose commands have the other sign."""


def demo_store(folder: Path, known: CalibratedRobot, stack: ExitStack) -> Store:
    """Return a store that a thread fills with robots whose logs are in the folder.

    The stack waits for the thread: cut while it writes, it would keep the lock of HDF5, for which
    the end of the interpreter waits.
    """
    store = open_store(folder / "robots.db", create=True)
    thread = Thread(target=_write_logs, args=(store, folder, known), name="logs", daemon=True)
    thread.start()
    stack.callback(thread.join)
    return store


def _write_logs(store: Store, folder: Path, known: CalibratedRobot) -> None:
    plan = Plan(
        known.robot, ["healthy", "motor_3:stuck"], 2, seed=7, imperfections=known.imperfections
    )
    runs, midnight = simulate(plan), last_midnight().timestamp()
    diagnoser = BayesDiagnoser(known.twin, known.imperfections)
    for robot, logs in LOGS.items():
        record = RobotRecord(store, robot, known.robot)
        motors = np.arange(len(known.robot.motors))
        signs = np.where(motors == REVERSED.get(robot, -1), -1.0, 1.0)
        for day, (name, number) in enumerate(logs):
            path, at = folder / f"{name}.nc", midnight - (len(logs) - day) * DAY_S
            one = runs.isel(run=[number]).assign_coords(run=[name])
            one = one.drop_vars(_TRUTH, errors="ignore")
            one = one.assign({part: signs * one[part] for part in _COMMANDED if part in one})
            one.to_netcdf(path)
            os.utime(path, (at, at))
            record.remember(diagnoser.diagnose(one), log_file(path))


_TRUTH = ["fault", "fault_detail", "onset", "magnitude"]
_COMMANDED = ("command", "target")


@dataclass
class HistoryWriter:
    """Writes the past of the demo into its store, in a process that gives way to the pages.

    Attributes:
        store: The store.
        folder: Folder for logs.
        known: The robot, calibrated.
        robots: Robots whose year is simulated.
    """

    store: Store
    folder: Path
    known: CalibratedRobot
    robots: int
    _process: subprocess.Popen[bytes] | None = None
    _stopped: bool = False

    def __post_init__(self) -> None:
        self._thread = Thread(target=self._write, name="history", daemon=True)

    def start(self) -> None:
        """Begin to write."""
        self._thread.start()

    def stop(self) -> None:
        """End the process that writes, and wait for the thread, as for that of the logs."""
        self._stopped = True
        if self._process is not None:
            self._process.terminate()
        self._thread.join()

    def _write(self) -> None:
        stored = ["--store", self.store.name]
        followed = ["--track", "--robot-name", TRACKED, *stored]
        fleet = ["--fleet", str(self.robots), "--years", "1", "--seed", str(YEAR_SEED)]
        commands = [["diagnose", str(log), *followed] for log in self._tracked_logs()]
        self._run(*commands, ["simulate", *fleet, *stored])

    def _tracked_logs(self) -> list[Path]:
        """Write the logs of the robot that is followed, and return them."""
        healthy = self.known.imperfections
        plan = Plan(self.known.robot, ["healthy"], TRACKED_RUNS, TRACKED_SEED, healthy)
        runs, halves, paths = simulate(plan), np.split(np.arange(TRACKED_RUNS), 2), []
        for name, half, days in zip(("may", "november"), halves, (200, 1), strict=True):
            path, at = self.folder / f"{name}.nc", last_midnight().timestamp() - days * DAY_S
            runs.isel(run=half).drop_vars(_TRUTH, errors="ignore").to_netcdf(path)
            os.utime(path, (at, at))
            paths.append(path)
        return paths

    def _run(self, *commands: list[str]) -> None:
        """Run commands to their end, unless all is stopped."""
        if self._stopped:
            return
        words, quiet = map(shlex.join, commands), subprocess.DEVNULL
        command = [sys.executable, "-c", CHILD, *words]
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(command, stdin=pipe, stdout=quiet, stderr=quiet)
        os.setpriority(os.PRIO_PROCESS, self._process.pid, LOW_PRIORITY)
        if self._stopped:  # meanwhile
            self._process.terminate()
        self._process.wait()


def demo_arms(store: Store, known: CalibratedRobot, speed: float) -> dict[str, LiveRobot]:
    """Return the emulated arms, not yet watched; the store keeps their alarms."""
    found = {}
    for k, (name, (faults, silent_s)) in enumerate(ARMS.items()):
        opened = partial(_emulated, known, faults, silent_s, k, speed)
        watch = monitor(known.twin, known.imperfections)
        still = tuple(fault.partition("@")[0] for fault in faults)
        record = RobotRecord(store, name, known.robot)
        basis = record.basis("watch", "console", known)
        keep = partial(begin_watch, record, "emulated", basis, None)
        found[name] = LiveRobot(LiveSettings(name, known, watch, opened, faults=still), keep)
    return found


def _emulated(
    known: CalibratedRobot,
    faults: tuple[str, ...],
    silent_s: float,
    seed: int,
    speed: float,
    stack: ExitStack,
) -> Source:
    from failuretwin.app.arms import emulation_with
    from failuretwin.connection.emulated_arm import EmulatedArm, Shifts

    shifts = Shifts(break_s=0.0, duration_s=silent_s or np.inf)
    return stack.enter_context(
        EmulatedArm(emulation_with(faults, known, seed), Pace(speed), shifts)
    )
