"""Streaming diagnosis of one robot: an answer at every sample."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from numpy.typing import ArrayLike

from failuretwin.connection.links.values import OK, STALE, Answer
from failuretwin.core.diagnosis import Diagnosis
from failuretwin.core.errors import unknown_name
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.decision.bayes import BayesDiagnoser
from failuretwin.decision.hypotheses.priors import MONITORING
from failuretwin.decision.streaming.fleet import MOVEMENTS, StreamingFleet
from failuretwin.decision.streaming.saved import load_fleet, save_fleet
from failuretwin.digital_model.imperfections import Imperfections
from failuretwin.digital_model.twin import DigitalTwin


class StreamingDiagnoser:
    """Streaming diagnosis of one robot; see `StreamingFleet` for what counts when.

    Args:
        diagnoser: The method, with its hypotheses and healthy behaviour.
        rate_hz: True rate of the tool sensor [Hz]; readings that come closer together than it
            says are taken for drawn out; None: all readings are real.
        movements: Movements that are remembered, the present one included.
    """

    def __init__(
        self,
        diagnoser: BayesDiagnoser,
        rate_hz: float | None = None,
        movements: int = MOVEMENTS,
    ) -> None:
        self._fleet = StreamingFleet(diagnoser, 1, rate_hz, movements)
        self._motors = diagnoser.twin.robot.motor_names
        self._diagnosis: Diagnosis | None = None

    def update(
        self,
        time: float,
        command: Mapping[str, float] | ArrayLike | None,
        measured: ArrayLike | None,
    ) -> Answer:
        """Take what is known at a time and return what is believed then.

        Args:
            time: Time of the stream [s]; a sample may come late, as long as its movement lasts.
            command: Reference of every motor, by name or (motor,) [rad]; None: not known.
            measured: Tool position, (axis,) [m]; None or NaN: no reading.

        Raises:
            InputError: If a motor is missing, shapes do not fit or the time is not finite.
        """
        reference = None if command is None else self._reference(command)[None]
        point = None if measured is None else as_floats(measured)[None]
        if len(self._fleet.update(time, reference, point)):
            self._diagnosis = self._told()
        return self._answer()

    def conclude(self) -> Answer:
        """Count all that has come and return the answer of the batch method."""
        self._fleet.conclude()
        self._diagnosis = self._told()
        return self._answer()

    def save(self, path: str | Path) -> None:
        """Write the state, all at once; a stream that goes on from it gives the same answers.

        Raises:
            InputError: If the name does not end in .npz.
            OutputError: If it cannot be written.
        """
        save_fleet(self._fleet, path, [] if self._diagnosis is None else [self._diagnosis])

    @classmethod
    def load(cls, path: str | Path, diagnoser: BayesDiagnoser) -> StreamingDiagnoser:
        """Return a stream as it was saved.

        Args:
            path: The file.
            diagnoser: The method with which it was saved.

        Raises:
            InputError: If it is no such file or of another robot, method or number of robots.
        """
        stream = cls(diagnoser)
        stream._fleet, said = load_fleet(path, diagnoser, robots=1)
        stream._diagnosis = said[0] if said else None
        return stream

    def _reference(self, command: Mapping[str, float] | ArrayLike) -> FloatArray:
        if not isinstance(command, Mapping):
            return as_floats(command)
        for name in self._motors:
            if name not in command:
                raise unknown_name("motor", name, command)
        return as_floats([command[name] for name in self._motors])

    def _answer(self) -> Answer:
        state = STALE if self._fleet.stale[0] else OK
        return Answer(self._fleet.time, state, self._diagnosis)

    def _told(self) -> Diagnosis | None:
        found = self._fleet.diagnosis(0, self._diagnosis)
        return None if found is None else replace(found, run="stream")


def monitor(twin: DigitalTwin, imperfections: Imperfections | None = None) -> StreamingDiagnoser:
    """Return what watches a robot at work: settled poses, and faults are rare.

    Args:
        twin: Digital twin of the robot.
        imperfections: How the healthy robot differs from it; None: as its profile says.
    """
    method = BayesDiagnoser(twin, imperfections, priors=MONITORING, whole_run=False)
    return StreamingDiagnoser(method)
