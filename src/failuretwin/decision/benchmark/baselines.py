"""Entries that come with the package: the Bayesian diagnoser, Kalman filters, and chance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import softmax

from failuretwin.connection.calibration.calibrate import calibrate
from failuretwin.connection.self_calibration import SelfCalibratingDiagnoser
from failuretwin.core.hypothesis import Diagnosis, Fault, Hypothesis
from failuretwin.core.runs import truth_of
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.decision.benchmark.tasks import diagnoses_of
from failuretwin.decision.learned.feature_encoder import Signals, mean_lag_s, signals_of
from failuretwin.digital_model.arm_classes import class_of, generic_imperfections
from failuretwin.digital_model.nonidealities import Imperfections
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.inference.diagnoser import BayesDiagnoser

if TYPE_CHECKING:
    import xarray as xr


def _hypotheses(runs: xr.Dataset) -> list[Hypothesis]:
    return [Hypothesis.parse(name) for name in runs.attrs["hypotheses"].split(",")]


class Chance:
    """Every hypothesis is equally probable."""

    def __init__(self, twin: DigitalTwin) -> None:
        self.twin = twin

    def fit(self, runs: xr.Dataset) -> None:
        """Learn nothing."""

    def diagnose(self, runs: xr.Dataset) -> list[Diagnosis]:
        """Return equal probabilities."""
        names = runs.attrs["hypotheses"].split(",")
        return diagnoses_of(runs, names, [[1.0 / len(names)] * len(names)] * runs.sizes["run"])


class Calibrated:
    """Healthy behaviour learned from healthy runs of the robot that is tested.

    Runs of another robot are ignored: they say nothing of this one.
    """

    def __init__(self, twin: DigitalTwin) -> None:
        self.twin = twin
        self.known: dict[str, Imperfections] = {}
        self.together = False

    def fit(self, runs: xr.Dataset) -> None:
        """Calibrate on the healthy runs; runs of unknown state are judged together."""
        truth = truth_of(runs)
        if truth is None:
            self.together = True
            return
        healthy = runs.isel(run=[place for place, fault in enumerate(truth) if fault == "healthy"])
        found = calibrate(healthy, self.twin.robot, "benchmark", "healthy runs of the track")
        self.known[runs.attrs["individual"]] = found.imperfections

    def healthy(self, runs: xr.Dataset) -> Imperfections:
        """Return the healthy behaviour for test runs; that of the class where none was learned."""
        generic = generic_imperfections(self.twin.robot)
        return self.known.get(runs.attrs["individual"], generic)


class Bayes(Calibrated):
    """The Bayesian diagnoser; self-calibrating where test runs may inform each other."""

    def diagnose(self, runs: xr.Dataset) -> list[Diagnosis]:
        """Return its diagnoses."""
        robot, hypotheses = self.twin.robot, _hypotheses(runs)
        if self.together:
            return SelfCalibratingDiagnoser(robot, hypotheses=hypotheses).diagnose(runs)
        return BayesDiagnoser(self.twin, self.healthy(runs), hypotheses).diagnose(runs)


class KalmanBank(Calibrated):
    """Bank of extended Kalman filters, one for each hypothesis (Magill, IEEE TAC 1965).

    The state is the displacement of each motor from the healthy response [rad]. It jumps at the
    start of each movement by scatter and friction, by the sag of the class where the robot is not
    calibrated, and further where the motor has a steady-state error. A stuck motor keeps the angle
    that it had `HELD_FROM_S` after the start, up to a constant. All readings within `LASTING_S`
    count as one, since errors of the model last as long.
    """

    def diagnose(self, runs: xr.Dataset) -> list[Diagnosis]:
        """Return the posterior of each run by its filters."""
        whole = signals_of(runs)
        speed = np.abs(np.diff(whole.command, axis=1, prepend=whole.command[:, :1])).max(axis=2)
        steps = np.flatnonzero(whole.seen.any(axis=0))
        expected = self._expected(whole, runs)[:, steps]
        signals = Signals(
            whole.time[steps], whole.command[:, steps], whole.measured[:, steps], whole.duration
        )
        readings = Readings(signals.measured, signals.seen & (speed[:, steps] <= STILL_RAD))
        hypotheses = [h for h in _hypotheses(runs) if h.known]
        likelihood = []
        for hypothesis in hypotheses:
            angle, displacement = self._model(hypothesis.faults, expected, signals.time, runs)
            likelihood.append(self.log_likelihood(readings, angle, displacement))
        alike = np.array([_alike(signals.time[seen]) for seen in signals.seen])
        chances = softmax(np.stack(likelihood, axis=1) / alike[:, None], axis=1)
        return diagnoses_of(runs, [str(h) for h in hypotheses], chances.tolist())

    def _expected(self, signals: Signals, runs: xr.Dataset) -> FloatArray:
        """Return the angles of a healthy arm, (run, time, motor) [rad]."""
        robot, healthy, time = self.twin.robot, self.healthy(runs), signals.time
        angle = signals.command.copy()
        for motor, lag in enumerate(mean_lag_s(robot, healthy)):
            for run, command in enumerate(signals.command[..., motor]):
                angle[run, :, motor] = np.interp(time - lag, time, command)
        if healthy.settling is None:
            return angle
        return angle + healthy.settling.offset(robot, angle, np.zeros_like(angle))

    def _model(
        self, faults: tuple[Fault, ...], expected: FloatArray, time: FloatArray, runs: xr.Dataset
    ) -> tuple[FloatArray, Displacement]:
        """Return the expected angles of a hypothesis, and what is known of the displacements."""
        kind, angle, motors = class_of(self.twin.robot), expected.copy(), expected.shape[2]
        still = np.hypot(kind.scatter_rad, kind.friction_rad)
        new = runs.attrs["individual"] not in self.known
        first = np.full(motors, new * kind.bias_rad**2)
        jump = np.full(motors, still**2 + new * kind.sag_rad**2)
        for fault in faults:
            motor = self.twin.robot.motor_names.index(fault.motor)
            if fault.mode == "stuck":
                held = int(np.searchsorted(time, HELD_FROM_S))
                angle[:, held:, motor] = angle[:, held : held + 1, motor]
                first[motor] += HELD_RAD**2
                jump[motor] = 0.0
            else:
                jump[motor] += (JUMP * still) ** 2
        return angle, Displacement(first, np.full(motors, WANDER * still**2), jump)

    def log_likelihood(
        self, readings: Readings, angle: FloatArray, displacement: Displacement
    ) -> FloatArray:
        """Return the log density of the readings at rest, (run,) [nats], without its constant."""
        path, jacobian = self.twin.path_and_jacobian(angle)
        runs, motors = len(angle), angle.shape[2]
        state, drift = np.zeros((runs, motors)), np.diag(displacement.drift)
        jump = np.diag(displacement.jump)
        spread = np.tile(np.diag(displacement.first) + jump, (runs, 1, 1))
        noise = (SENSOR_OF_REACH * self.twin.robot.reach) ** 2 * np.eye(3)
        total, rested = np.zeros(runs), np.ones(runs, dtype=bool)
        for step in range(angle.shape[1]):
            rests, rows = readings.rests[:, step], jacobian[:, step]
            spread = spread + drift + (rested & ~rests)[:, None, None] * jump
            rested = rests
            innovation = readings.measured[:, step] - path[:, step]
            innovation = innovation - np.einsum("ram,rm->ra", rows, state)
            innovation = np.where(rests[:, None], innovation, 0.0)
            cross = np.einsum("rmn,ran->rma", spread, rows)
            known = np.linalg.inv(np.einsum("ram,rmb->rab", rows, cross) + noise)
            squares = np.einsum("ra,rab,rb->r", innovation, known, innovation)
            fit = 0.5 * np.linalg.slogdet(known)[1] - 0.5 * np.minimum(squares, LARGEST_SQUARE)
            total += np.where(rests, fit, 0.0)
            gain = np.einsum("rma,rab->rmb", cross, known) * rests[:, None, None]
            state = state + np.einsum("rma,ra->rm", gain, innovation)
            left = np.eye(motors) - np.einsum("rma,ran->rmn", gain, rows)
            spread = np.einsum("rmn,rnk,rlk->rml", left, spread, left)  # Joseph's form
            spread += np.einsum("rma,ab,rnb->rmn", gain, noise, gain)
        return total


def _alike(time: FloatArray) -> float:
    """Return the number of readings of a run that count as one."""
    return max(1.0, LASTING_S / float(np.median(np.diff(time)))) if len(time) > 1 else 1.0


@dataclass(frozen=True)
class Readings:
    """Tool positions, (run, step, axis) [m], and whether the arm rests then, (run, step)."""

    measured: FloatArray
    rests: BoolArray


@dataclass(frozen=True)
class Displacement:
    """Variances of the motors' displacements, (motor,) each [rad^2].

    Attributes:
        first: At the start of a run.
        drift: Gained from one reading to the next.
        jump: Gained when a movement starts.
    """

    first: FloatArray
    drift: FloatArray
    jump: FloatArray


STILL_RAD = 1e-5
"""Largest change of a command from one sample to the next at rest [rad]."""
HELD_FROM_S = 0.5
"""When a stuck motor is taken to stop [s]: the onset of the published data."""
HELD_RAD = 0.05
"""Deviation of the held angle from the angle then [rad]."""
JUMP = 6.0
"""Deviation of a steady-state error, in the usual scatter of the class [-]."""
WANDER = 0.05
"""Variance that a displacement gains from one reading to the next, in that of the scatter [-]."""
SENSOR_OF_REACH = 1e-3
"""Deviation of a reading on each axis, in the reach [-]."""
LARGEST_SQUARE = 30.0
"""Largest squared normalised innovation: outliers count no more [-]."""
LASTING_S = 2.0
"""Time that errors of the model last: one movement [s]."""
