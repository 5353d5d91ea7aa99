"""Streaming diagnosis of one robot: an answer at every sample."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from failuretwin.connection.links.base import OK, STALE, Answer
from failuretwin.core.config import fingerprint, from_table
from failuretwin.core.errors import InputError, unknown_name
from failuretwin.core.foreign import reading
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.data_knowledge.readers.file_claims import check_npz
from failuretwin.data_knowledge.store import replacing
from failuretwin.decision.streaming.fleet import MOVEMENTS, StreamingFleet
from failuretwin.digital_model.calibrated_robot import RobotLike
from failuretwin.inference.diagnoser import BayesDiagnoser

FORMAT = 6
SUFFIX = ".npz"
HEADER = "header"


class RobotStream:
    """A stream of one robot: an answer at every sample.

    Its movements are followed by a fleet of one.
    """

    def __init__(self, fleet: StreamingFleet) -> None:
        self._fleet = fleet
        self._diagnosis: Diagnosis | None = None

    def update(
        self,
        time: float,
        command: Mapping[str, float] | ArrayLike | None,
        measured: ArrayLike | None,
        position: ArrayLike | None = None,
        goal: ArrayLike | None = None,
    ) -> Answer:
        """Take what is known at a time and return what is believed then.

        Args:
            time: Time of the stream [s]; a sample may come late, as long as its movement lasts.
            command: Reference of every motor, by name or (motor,) [rad]; None: not known.
            measured: Tool position, (axis,) [m]; None or NaN: no reading.
            position: What the motors report of themselves, (motor,) [rad], where that is believed.
            goal: Goals that they report to have received, (motor,) [rad], where these are believed.

        Raises:
            InputError: If a motor is missing, shapes do not fit or the time is not finite.
        """
        reference = reference_of(self._fleet.diagnoser.twin.robot.motor_names, command)
        point = None if measured is None else as_floats(measured)
        if len(self._fleet.update(time, *map(row_of, (reference, point, position, goal)))):
            self._judge()
        self._watch(time, reference, point)
        return self._answer()

    def conclude(self) -> Answer:
        """Count all that has come, as if the stream were over: the answer of the batch method."""
        self._fleet.conclude()
        self._judge()
        self._conclude_watch()
        return self._answer()

    def _judge(self) -> None:
        """Renew the diagnosis by what the last movements say."""
        found = self._fleet.diagnosis(0, self._diagnosis)
        self._diagnosis = None if found is None else replace(found, run="stream")

    def _watch(self, time: float, reference: FloatArray | None, point: FloatArray | None) -> None:
        """Take a sample for what is watched in addition to the motors: nothing."""

    def _conclude_watch(self) -> None:
        """Count what is watched in addition to the motors, as if the stream were over: nothing."""

    def _answer(self) -> Answer:
        """Return what is believed."""
        state = STALE if self._fleet.stale[0] else OK
        return Answer(self._fleet.time, state, self._diagnosis)


class StreamingDiagnoser(RobotStream):
    """Streaming diagnosis of one robot; see `StreamingFleet` for what counts when.

    Args:
        diagnoser: The method, with its hypotheses and healthy behaviour.
        rate_hz: True rate of the tool sensor [Hz]; readings that come closer together than it
            says are taken for drawn out; None: all readings are real.
        movements: Movements that are remembered, the present one included.
    """

    def __init__(
        self,
        diagnoser: BayesDiagnoser | RobotLike,
        rate_hz: float | None = None,
        movements: int = MOVEMENTS,
    ) -> None:
        super().__init__(StreamingFleet(diagnoser, 1, rate_hz, movements))

    def save(self, path: str | Path) -> None:
        """Write the state, all at once; a stream that goes on from it gives the same answers.

        Raises:
            InputError: If the name does not end in .npz.
            OutputError: If it cannot be written.
        """
        path = Path(path)
        if path.suffix != SUFFIX:
            raise InputError(f"{path}: the file of a stream ends in {SUFFIX}.")
        said = [] if self._diagnosis is None else [dataclasses.asdict(self._diagnosis)]
        header = {
            "format": FORMAT,
            "method": _method(self._fleet.diagnoser),
            "robots": self._fleet.robots,
            "movements": self._fleet.movements,
            "rate_hz": self._fleet.rate_hz,
            "said": said,
        }
        arrays: dict[str, Any] = {
            HEADER: np.frombuffer(json.dumps(header).encode(), dtype=np.uint8),
            **self._fleet.state(),
        }
        with replacing(path) as partial, partial.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)

    @classmethod
    def load(cls, path: str | Path, diagnoser: BayesDiagnoser) -> StreamingDiagnoser:
        """Return a stream as it was saved.

        Args:
            path: The file.
            diagnoser: The method with which it was saved.

        Raises:
            InputError: If it is no such file or of another robot or method.
        """
        path = Path(path)
        with reading(path, "a stream", "Expected a file that `save` of a stream wrote."):
            check_npz(path)
            with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
                arrays = {name: stored[name] for name in stored.files}
            header = json.loads(arrays.pop(HEADER).tobytes())
            wrong = _mismatch(header, diagnoser)
            if wrong:
                raise InputError(f"{path}: {wrong}")
            stream = cls(diagnoser, header["rate_hz"], header["movements"])
            stream._fleet.restore(arrays)
            for fields in header["said"]:
                stream._diagnosis = from_table(Diagnosis, fields, "diagnosis")
        return stream


def _method(diagnoser: BayesDiagnoser) -> str:
    """Return a hash of all that answers depend on."""
    known = dataclasses.replace(diagnoser, imperfections=diagnoser.healthy_model.imperfections)
    return fingerprint(known)


def _mismatch(header: dict[str, Any], diagnoser: BayesDiagnoser) -> str:
    """Return why a stream does not go on from a file, empty if it does."""
    if header["format"] != FORMAT:
        return f"is of format {header['format']}, this version reads {FORMAT}. Begin anew."
    if header["method"] != _method(diagnoser):
        return (
            "was saved with another robot, calibration, hypotheses or priors. Name the same, or "
            "begin anew."
        )
    return ""


def row_of(values: ArrayLike | None) -> FloatArray | None:
    """Return the values of one robot as those of a fleet of one, (1, ...); None stays None."""
    return None if values is None else as_floats(values)[None]


def reference_of(
    motors: Sequence[str], command: Mapping[str, float] | ArrayLike | None
) -> FloatArray | None:
    """Return a reference as an array, (motor,) [rad]; None stays None."""
    if not isinstance(command, Mapping):
        return None if command is None else as_floats(command)
    for name in motors:
        if name not in command:
            raise unknown_name("motor", name, command)
    return as_floats([command[name] for name in motors])
