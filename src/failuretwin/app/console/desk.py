"""What the console reads from and writes to: the store, the fleet and live robots."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from threading import Event, Thread

import numpy as np

from failuretwin.app.console import state as shown
from failuretwin.app.console import texts
from failuretwin.app.console.checking import CheckRun
from failuretwin.app.console.draw import spoken
from failuretwin.app.console.live import LiveRobot
from failuretwin.app.console.state import Tile, Trace
from failuretwin.app.remembering import RobotRecord
from failuretwin.connection.fleet.broker import Access, open_broker
from failuretwin.core.errors import FailureTwinError, InputError
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.core.movements import find_movements
from failuretwin.core.runs import RunSet
from failuretwin.core.types import as_floats
from failuretwin.data_knowledge.readers.read import ReadOptions, read_runs
from failuretwin.data_knowledge.records.history import FaultEpisode
from failuretwin.data_knowledge.records.log_files import log_file
from failuretwin.data_knowledge.records.queries import RobotGlance, StoredRun
from failuretwin.data_knowledge.records.store import Store
from failuretwin.digital_model.calibrated_robot import CalibratedRobot, load_calibration
from failuretwin.digital_model.robot import Robot, bundled_robots, load_robot
from failuretwin.inference.diagnoser import BayesDiagnoser

LOOK_S = 2.0
"""Time between two looks into the store [s]."""
END_S = 1.0
"""Time that each watch may take to store its last words at the end [s]."""
STATUS_S = 1.0
"""Time between two looks at the fleet [s]."""


@dataclass(frozen=True)
class Imported:
    """A log that was diagnosed: its runs, their diagnoses, and what was stored, a line each."""

    runs: RunSet
    diagnoses: Sequence[Diagnosis]
    stored: Sequence[str]


@dataclass
class Desk:
    """The sources of the console.

    Attributes:
        known: The robot of the command line, calibrated.
        store: The store; None: none is open.
        access: The fleet; None: none is named.
        live: Live robots by name.
        move: Whether a real arm may be moved.
        speed: How fast time of emulated arms passes.
        folder: Folder for logs that are imported, and for pages.
        trouble: Why store or fleet cannot be read at present; empty: they can.
        check: The last check; None: none so far.
        reports: Pages for technicians by number.
        expected: Robots that the store will have once the history of the demo is simulated.
        beat_s: When the server worked last, by the monotonic clock [s].
    """

    known: CalibratedRobot
    store: Store | None
    access: Access | None
    live: dict[str, LiveRobot]
    move: bool
    speed: float
    folder: Path
    trouble: str = ""
    check: CheckRun | None = None
    reports: dict[int, str] = field(default_factory=dict)
    expected: int = 0
    beat_s: float = field(default_factory=time.monotonic)
    _glances: tuple[RobotGlance, ...] = ()
    _fleet: tuple[Tile, ...] = ()
    _stopped: Event = field(default_factory=Event)

    def start(self) -> None:
        """Begin to look at all sources."""
        for robot in self.live.values():
            robot.start()
        if self.store is not None:
            self.look()
            Thread(target=self._look_into_store, name="store", daemon=True).start()
        if self.access is not None:
            fleet = Thread(target=lambda: asyncio.run(self._look_at_fleet()), daemon=True)
            fleet.start()

    def stop(self) -> None:
        """End all threads, and the check."""
        self._stopped.set()
        for robot in self.live.values():
            robot.stop()
        if self.check is not None:
            self.check.stop("the console ends")
        for robot in self.live.values():
            robot.wait(END_S)

    # The wall.

    def tiles(self) -> list[Tile]:
        """Return all robots, the worst first: live ones, else by the fleet, else by the store."""
        now = datetime.now(UTC)
        found = {one.robot: shown.stored_tile(one, now) for one in self._glances}
        kinds = {name: tile.kind for name, tile in found.items()}
        for tile in self._fleet:
            found[tile.name] = replace(tile, kind=kinds.get(tile.name, tile.kind))
        faults = {one.robot: one.faults for one in self._glances}
        found |= {
            name: robot.tile.alarmed(faults.get(name, {})) for name, robot in self.live.items()
        }
        return shown.worst_first(list(found.values()))

    @property
    def note(self) -> str:
        """How far the history of the demo is; empty: it is complete."""
        done = len(self._glances)
        return texts.SIMULATING.format(done=done, all=self.expected) if done < self.expected else ""

    def tile(self, name: str) -> Tile | None:
        """Return a robot; None: it is not known."""
        return next((tile for tile in self.tiles() if tile.name == name), None)

    def look(self) -> None:
        """Read the store now."""
        if self.store is not None:
            self._glances = self.store.overview()

    def _look_into_store(self) -> None:
        while not self._stopped.wait(LOOK_S):
            try:
                self.look()
                self.trouble = ""
            except FailureTwinError as error:
                self.trouble = str(error)

    async def _look_at_fleet(self) -> None:
        from failuretwin.app.fleet import read_status

        assert self.access is not None
        broker, status = None, None
        while not self._stopped.is_set():
            try:
                broker = broker or await open_broker(self.access, "console")
                status = await asyncio.wait_for(read_status(broker), 5.0)
                self.trouble = ""
            except (FailureTwinError, OSError, TimeoutError) as error:
                self.trouble = f"fleet: {error or 'no answer'}"
            if status is not None:
                kinds = {one.robot: one.kind for one in self._glances}
                self._fleet = tuple(shown.fleet_tiles(status, kinds, time.time()))
            await asyncio.sleep(STATUS_S)

    # Robots.

    def robot(self, name: str) -> CalibratedRobot | None:
        """Return a robot, calibrated as the store says; None: its profile is not known here."""
        live = self.live.get(name)
        if live is not None:
            return live.settings.known
        tile = self.tile(name)
        return None if tile is None else self.of_kind(tile.kind, name)

    def profile(self, kind: str) -> Robot | None:
        """Return the robot of a profile; None: it is not known here."""
        if kind in ("", self.known.robot.name):
            return self.known.robot
        return _bundled(kind)

    def of_kind(self, kind: str, name: str = "") -> CalibratedRobot | None:
        """Return a robot of a profile, with the calibration of the store if it has one."""
        profile = self.profile(kind)
        if profile is None:
            return None
        own = profile is self.known.robot
        known = self.known if own else load_calibration(None, profile)
        record = self.record(name, known)
        return record.calibrated or known if record is not None else known

    def record(self, name: str, known: CalibratedRobot) -> RobotRecord | None:
        """Return a robot in the store, with its calibration; None: no store, or no name."""
        if self.store is None or not name:
            return None
        record = RobotRecord(self.store, name, known.robot)
        return replace(record, calibration=self.store.calibration(name))

    def diagnose(self, path: Path, kind: str, name: str, columns: str = "") -> Imported:
        """Diagnose a log, and store the diagnoses as those of a robot.

        Args:
            path: The log, in a folder of its own.
            kind: Name of its profile.
            name: Name of the robot; empty: nothing is stored.
            columns: Map of its columns or topics (TOML); empty: their names tell.

        Raises:
            InputError: If it cannot be read.
            OutputError: If it cannot be stored.
        """
        from failuretwin.app.inputs import with_map

        known = self.of_kind(kind, name)
        if known is None:
            raise InputError(
                f"unknown profile {kind!r}. Expected a bundled robot or that of --robot."
            )
        written = path.with_name("columns.toml") if columns else None
        if written is not None:
            written.write_text(columns, "utf-8")
        options, correction = with_map(ReadOptions(), written, [path], known.robot)
        runs = read_runs(path, known.robot, options)
        runs = runs if correction is None else correction.runs(runs)
        diagnoses = BayesDiagnoser(known.twin, known.imperfections).diagnose(runs)
        record = self.record(name, known)
        lines: list[str] = []
        if record is not None:
            done = record.remember(diagnoses, log_file(path), runs)
            from failuretwin.app.records import episode_line

            lines = [f"{done.added} added, {done.known} known before"]
            lines += map(episode_line, done.episodes)
            self.look()
        return Imported(runs, diagnoses, lines)

    def stored_runs(self, name: str) -> tuple[StoredRun, ...]:
        """Return the runs of a robot in the store, the newest first; empty: there are none."""
        if self.store is None or name not in {one.robot for one in self._glances}:
            return ()
        return self.store.runs(name)

    def last_diagnosis(self, name: str) -> Diagnosis | None:
        """Return the last diagnosis of a robot in the store, without its evidence; None: none."""
        glance, runs = self.glance(name), self.stored_runs(name)
        if glance is None or not runs:
            return None
        undecided, *quality = glance.remarks or ("",)
        return Diagnosis("", runs[0].posterior, quality=tuple(quality), undecided=undecided)

    def open_faults(self, name: str) -> list[str]:
        """Return the faults of the open episodes of a robot in the store, ``MOTOR:MODE``."""
        glance = self.glance(name)
        return [] if glance is None else list(glance.faults)

    def open_episodes(self, name: str) -> list[FaultEpisode]:
        """Return the open episodes of a robot in the store."""
        store = self.store if self.glance(name) is not None else None
        return [] if store is None else store.history(name).open_episodes

    def glance(self, name: str) -> RobotGlance | None:
        """Return what the store last said of a robot; None: it does not know it."""
        return next((one for one in self._glances if one.robot == name), None)

    def stored_log(self, name: str, row: int) -> tuple[RunSet, CalibratedRobot]:
        """Return a run of a robot in the store as its log has it, and the robot.

        Raises:
            InputError: If there is no such run, or its log is not here.
        """
        run = next((one for one in self.stored_runs(name) if one.row == row), None)
        known = self.robot(name)
        if run is None or known is None or not has_log(run):
            raise InputError(f"run {row} of {name!r}: its log is not on this computer.")
        return read_runs(run.log, known.robot).isel(run=[run.position]), known

    # What is worked out when it is asked for.

    def blind_spots(self, trace: Trace, known: CalibratedRobot) -> list[str]:
        """Return what a motion could not show, in sentences."""
        from failuretwin.app.reports.isolability_report import group_lines, size_lines
        from failuretwin.inference.isolability import isolability

        grid = np.arange(0.0, float(np.ptp(trace.time)), 0.05)
        command = np.stack(
            [np.interp(grid, trace.time - trace.time[0], one) for one in trace.command.T], axis=-1
        )
        found = isolability(known.twin, command, grid, known.imperfections)
        return [*group_lines(found, known.robot), *size_lines(found, known.robot)]

    def remaining_life(self, name: str) -> list[str]:
        """Return the remaining life of each motor, in sentences.

        Raises:
            InputError: If the store does not know the robot.
        """
        from failuretwin.decision.remaining_life import LEAST_RUNS, motor_lives
        from failuretwin.inference.observation.healthy_model import HealthyModel

        known = self.robot(name)
        record = None if known is None else self.record(name, known)
        if known is None or record is None:
            raise InputError("no store is open, or the robot is not known there.")
        rows = record.store.tracked_rows(name)
        if not rows:
            return [texts.NOT_TRACKED]
        model = HealthyModel(known.twin, known.imperfections)
        lives = motor_lives(rows, model, np.random.default_rng(0))
        few = texts.TOO_FEW.format(least=LEAST_RUNS)
        return [
            f"{spoken(motor)}: {life.verdict if life else few}" for motor, life in lives.items()
        ]


def has_log(run: StoredRun) -> bool:
    """Return whether the log of a run is on this computer; a check has none."""
    return bool(run.log) and Path(run.log).exists()


@cache
def _bundled(kind: str) -> Robot | None:
    return load_robot(kind) if kind in bundled_robots() else None


def trace_of(runs: RunSet, known: CalibratedRobot) -> Trace:
    """Return the motion of a single run, and its diagnosis."""
    diagnosis = BayesDiagnoser(known.twin, known.imperfections).diagnose(runs)[0]
    length = float(runs["duration"].values[0])
    time_s = as_floats(runs["time"].values)
    inside = time_s <= length
    command = as_floats(runs["command"].values)
    movements = find_movements(command, time_s)
    starts = movements.start[0][movements.exists[0]]
    measured = as_floats(runs["measured"].values)[0]
    return Trace(
        str(runs["run"].values[0]),
        time_s[inside],
        command[0][inside],
        measured[inside],
        starts,
        diagnosis,
    )
