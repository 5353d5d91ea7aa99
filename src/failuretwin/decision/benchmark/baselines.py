"""Entries that come with the package: the Bayesian diagnoser, Kalman filters, and chance."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.special import softmax

from failuretwin.connection.calibration.calibrate import calibrate
from failuretwin.connection.self_calibration import SelfCalibratingDiagnoser
from failuretwin.core.hypothesis import Diagnosis, Fault, Hypothesis
from failuretwin.core.runs import truth_of
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.decision.learned.feature_encoder import Signals, expectation_of, signals_of
from failuretwin.digital_model.arm_classes import class_of, generic_imperfections
from failuretwin.digital_model.nonidealities import Imperfections
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.inference.diagnoser import BayesDiagnoser

if TYPE_CHECKING:
    import xarray as xr


def _hypotheses(runs: xr.Dataset) -> list[Hypothesis]:
    return [Hypothesis.parse(name) for name in runs.attrs["hypotheses"].split(",")]


def _diagnoses(runs: xr.Dataset, names: list[str], chances: FloatArray) -> list[Diagnosis]:
    return [
        Diagnosis(str(run), dict(zip(names, map(float, row), strict=True)))
        for run, row in zip(runs["run"].values, chances, strict=True)
    ]


class Chance:
    """Every hypothesis is equally probable."""

    def __init__(self, twin: DigitalTwin) -> None:
        self.twin = twin

    def fit(self, runs: xr.Dataset) -> None:
        """Learn nothing."""

    def diagnose(self, runs: xr.Dataset) -> list[Diagnosis]:
        """Return equal probabilities."""
        names = runs.attrs["hypotheses"].split(",")
        return _diagnoses(runs, names, np.full((runs.sizes["run"], len(names)), 1.0 / len(names)))


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

    The state is the displacement of each motor from the healthy response [rad]. A motor with a
    steady-state error may jump at the start of each movement. A stuck motor keeps the angle that it
    had `HELD_FROM_S` after the start: its displacement is known up to a constant. The posterior is
    that of the innovations' likelihoods, divided by `CORRELATION`, since errors of the model last
    over readings.
    """

    def diagnose(self, runs: xr.Dataset) -> list[Diagnosis]:
        """Return the posterior of each run by its filters."""
        signals, motors = signals_of(runs), self.twin.robot.motor_names
        hypotheses = [h for h in _hypotheses(runs) if h.known]
        likelihood = np.stack(
            [self._log_likelihood(signals, h.faults, motors, runs) for h in hypotheses], axis=1
        )
        return _diagnoses(runs, [str(h) for h in hypotheses], softmax(likelihood, axis=1))

    def _log_likelihood(
        self,
        signals: Signals,
        faults: tuple[Fault, ...],
        motors: list[str],
        runs: xr.Dataset,
    ) -> FloatArray:
        """Return the log likelihood of one hypothesis for each run, (run,) [nats]."""
        healthy = self.healthy(runs)
        kind, robot = class_of(self.twin.robot), self.twin.robot
        command, time = signals.command, signals.time
        settling = healthy.settling
        lag = np.asarray(expectation_of(robot, healthy).lag_s)
        angle = np.stack(
            [
                np.stack([np.interp(time - lag[m], time, one[:, m]) for one in command])
                for m in range(len(motors))
            ],
            axis=-1,
        )
        if settling is not None:
            angle = angle + settling.offset(robot, angle, np.zeros_like(angle))
        still = np.hypot(kind.scatter_rad, kind.friction_rad)
        doubt = np.hypot(still, 0.0 if runs.attrs["individual"] in self.known else kind.bias_rad)
        first = np.full(len(motors), doubt**2)
        drift = np.full(len(motors), still**2 * WANDER)
        jump = np.zeros(len(motors))
        for fault in faults:
            motor = motors.index(fault.motor)
            if fault.mode == "stuck":
                held = int(np.searchsorted(time, HELD_FROM_S))
                angle[:, held:, motor] = angle[:, held : held + 1, motor]
                first[motor] += HELD_RAD**2
            else:
                jump[motor] = (JUMP * still) ** 2
        speed = np.abs(np.diff(command, axis=1, prepend=command[:, :1])).max(axis=2)
        moving = np.asarray(speed > 1e-5)
        return self._filtered(signals, angle, moving, first, drift, jump)

    def _filtered(
        self,
        signals: Signals,
        angle: FloatArray,
        moving: BoolArray,
        first: FloatArray,
        drift: FloatArray,
        jump: FloatArray,
    ) -> FloatArray:
        steps = np.flatnonzero(signals.seen.any(axis=0))
        path, jacobian = self.twin.path_and_jacobian(angle[:, steps])
        runs, motors = len(angle), angle.shape[2]
        state = np.zeros((runs, motors))
        spread = np.broadcast_to(np.diag(first + jump), (runs, motors, motors)).copy()
        noise = (SENSOR_OF_REACH * self.twin.robot.reach) ** 2 * np.eye(3)
        total, was_moving = np.zeros(runs), np.zeros(runs, dtype=bool)
        for place, step in enumerate(steps):
            seen = signals.seen[:, step] & ~moving[:, step]  # poses at rest alone
            starts = moving[:, step] & ~was_moving
            was_moving = moving[:, step]
            spread += np.diag(drift) + starts[:, None, None] * np.diag(jump)
            rows = jacobian[:, place]
            innovation = signals.measured[:, step] - path[:, place]
            innovation = innovation - np.einsum("ram,rm->ra", rows, state)
            innovation = np.where(seen[:, None], innovation, 0.0)
            cross = np.einsum("rmn,ran->rma", spread, rows)
            known = np.linalg.inv(np.einsum("ram,rmb->rab", rows, cross) + noise)
            squares = np.einsum("ra,rab,rb->r", innovation, known, innovation)
            fit = 0.5 * np.linalg.slogdet(known)[1] - 0.5 * np.minimum(squares, LARGEST_SQUARE)
            total += np.where(seen, fit, 0.0)
            gain = np.einsum("rma,rab->rmb", cross, known) * seen[:, None, None]
            state = state + np.einsum("rma,ra->rm", gain, innovation)
            left = np.eye(motors) - np.einsum("rma,ran->rmn", gain, rows)
            spread = np.einsum("rmn,rnk,rlk->rml", left, spread, left)  # Joseph's form
            spread += np.einsum("rma,ab,rnb->rmn", gain, noise, gain)
        return total / CORRELATION


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
CORRELATION = 5.0
"""Readings that count as one."""
