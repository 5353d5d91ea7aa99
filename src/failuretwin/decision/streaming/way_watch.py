"""Watching an arm that never rests: its last seconds as a run, judged by those before it.

A window without a rest is a run of a life on the way (`LifeFilter`): theta goes on from window to
window. Given theta, windows are independent, and faults come and go between them:

    p(h)       <- [ (1 - rho) p(h) + p(healthy) lambda_h ] L_h
    p(healthy) <- (1 - sum lambda) p(healthy) + rho sum p(h)

with L_h the likelihood of a window over that of a healthy robot, all divided by their sum.

Section: docs/inference.md#streams
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from failuretwin.connection.tracked_diagnosis import begin, followed_evidence
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.core.numerics import log_of
from failuretwin.core.runs import RunTable
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.inference.diagnoser import BayesDiagnoser
from failuretwin.inference.observation.evidence import Evidence
from failuretwin.inference.observation.on_the_way import hardly_rest
from failuretwin.inference.posterior import StreamPosition
from failuretwin.inference.together.fault_filter import MOST_NATS, S_PER_H, FaultFilter

WINDOW_S = 6.0
"""Length of a window [s]: some moments on the way."""
PAUSE_S = 0.5
"""Time without a new command from which an arm may come to rest [s]: windows in which it has are
left to what sees rests."""
FAILING = 3.0
"""Readings fail where one is missing for a pause and for so many times their usual distance."""
STILL_RAD = 1e-5
"""Change of a command that is none [rad]."""
FITTING = 3
"""Windows that a healthy robot explains best from which the log fits the profile."""
FEWEST = 6
"""Readings of a window that is judged, at least."""
FINEST_S = 0.01
"""Smallest step of the grid of a window [s]."""

Sample = tuple[float, FloatArray, FloatArray | None]
"""Time [s], reference (motor,) [rad], and tool position (axis,) [m] where there is a reading."""


class WayWatch:
    """Judges windows of one robot in which its tool does not rest.

    Attributes:
        posterior: Probability of each hypothesis, (hypothesis,).
        diagnosis: By the last window without a rest; None before it.
        fitting: Windows so far that a healthy robot explains best.
    """

    def __init__(self, diagnoser: BayesDiagnoser, own: FaultFilter) -> None:
        """Begin.

        Args:
            diagnoser: The robot, and what may be the case.
            own: How often its faults come and go.
        """
        self._diagnoser, self._own = diagnoser, own
        self._life = begin(diagnoser, diagnoser.healthy_model.imperfections.of_class)
        self._samples: list[Sample] = []
        self._healthy = [h.is_healthy for h in diagnoser.hypothesis_set].index(True)
        self.posterior = np.eye(len(diagnoser.hypothesis_set))[self._healthy]
        self.diagnosis: Diagnosis | None = None
        self.fitting = 0

    @property
    def fits(self) -> bool:
        """Whether the log has been seen to fit the profile: what comes later is a fault."""
        return self.fitting >= FITTING

    @property
    def taught(self) -> int:
        """Moments so far from which the robot is known."""
        return self._life.movements

    def see(
        self,
        time: float,
        reference: FloatArray | None,
        point: FloatArray | None,
        rested_s: float | None,
    ) -> float:
        """Take a sample; return the length of the window that it ends and that was judged [h].

        Args:
            time: Time of the stream [s].
            reference: Of every motor, (motor,) [rad]; None: not known.
            point: Tool position, (axis,) [m]; None or NaN: no reading.
            rested_s: When the arm was last seen at rest [s]; None: never.
        """
        if reference is None or not np.isfinite(reference).all():
            return 0.0
        if self._samples and time <= self._samples[-1][0]:
            return 0.0
        read = point is not None and bool(np.isfinite(point).all())
        self._samples.append((time, reference, point if read else None))
        lasted = time - self._samples[0][0]
        return self._end_window(rested_s) if lasted >= WINDOW_S else 0.0

    def conclude(self, rested_s: float | None) -> float:
        """Return the length of the last window [h], if it is half as long as others and judged.

        Args:
            rested_s: As in `see`.
        """
        if not self._samples or self._samples[-1][0] - self._samples[0][0] < 0.5 * WINDOW_S:
            return 0.0
        return self._end_window(rested_s)

    def _end_window(self, rested_s: float | None) -> float:
        """Judge the samples since the last window; return their length if they were judged [h]."""
        some, self._samples = self._samples, self._samples[-1:]
        rested = rested_s is not None and (rested_s >= some[0][0] or _readings_fail(some))
        if rested and _longest_pause(some) > PAUSE_S:
            return 0.0
        hours = (some[-1][0] - some[0][0]) / S_PER_H
        return hours if self._judge(some, hours) else 0.0

    def _judge(self, some: Sequence[Sample], hours: float) -> bool:
        """Judge a window; return whether its tool never rests."""
        runs = _as_run(some, self._diagnoser)
        if runs is None:
            return False
        life, seen = self._life, Evidence(runs.to_dataset(), self._life.model.settings)
        if not hardly_rest(seen.sound, life.model).any():
            return False
        found = life.follow(followed_evidence(seen, life))
        says = found.log_posterior[0] - found.log_prior
        self._advance(np.clip(says - says[self._healthy], -MOST_NATS, MOST_NATS), hours)
        self.fitting += int(found.log_posterior[0].argmax() == self._healthy)
        found = replace(found, log_posterior=log_of(self.posterior)[None])
        place = StreamPosition(some[0][0], 0, self.diagnosis)
        self.diagnosis = found.to_diagnosis(0, "stream", seen.quality[0], place=place)
        return True

    def _advance(self, says: FloatArray, hours: float) -> None:
        """Take in what a window says, (hypothesis,) [nats over healthy]."""
        came = 1.0 - np.exp(-hours * self._own.rate_per_h)
        came[self._healthy] = 0.0
        mended = 1.0 - np.exp(-hours * self._own.rates.repairs_per_1000_h / 1000.0)
        healthy = self.posterior[self._healthy]
        after = (1.0 - mended) * self.posterior + healthy * came
        after[self._healthy] = healthy * (1.0 - came.sum()) + mended * (1.0 - healthy)
        after = after * np.exp(says)
        self.posterior = after / after.sum()


def _longest_pause(some: Sequence[Sample]) -> float:
    """Return the longest time within samples in which no motor is told anything new [s]."""
    time, told = np.array([at for at, _, _ in some]), np.stack([one for _, one, _ in some])
    news = np.abs(np.diff(told, axis=0)).max(axis=1) > STILL_RAD
    return float(np.diff(np.r_[time[0], time[1:][news], time[-1]]).max())


def _readings_fail(some: Sequence[Sample]) -> bool:
    """Return whether readings are missing for so long that an arm may have rested unseen."""
    read = [at for at, _, point in some if point is not None]
    if len(read) < 2:
        return True
    missing = float(np.diff([some[0][0], *read, some[-1][0]]).max())
    return missing > max(PAUSE_S, FAILING * float(np.median(np.diff(read))))


def _as_run(some: Sequence[Sample], diagnoser: BayesDiagnoser) -> RunTable | None:
    """Return samples as a run on an even grid; None: there are too few readings."""
    robot = diagnoser.twin.robot
    time = np.array([at for at, _, _ in some]) - some[0][0]
    read = [(at - some[0][0], point) for at, _, point in some if point is not None]
    if len(read) < FEWEST:
        return None
    step = max(float(np.median(np.diff(time))), FINEST_S)
    grid = as_floats(step * np.arange(int(time[-1] / step) + 1))
    told = np.stack([reference for _, reference, _ in some])
    measured = np.full((len(grid), 3), np.nan)
    for at, point in read:
        measured[min(round(at / step), len(grid) - 1)] = point
    apart = float(np.median(np.diff([at for at, _ in read])))
    return RunTable(
        run=["stream"],
        motor=robot.motor_names,
        time=grid,
        command=np.stack([np.interp(grid, time, one) for one in told.T], axis=-1)[None],
        measured=measured[None],
        measured_rate_hz=1.0 / apart,
        attributes={"robot": robot.name},
    )
