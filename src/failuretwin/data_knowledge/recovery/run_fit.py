"""All movements of a run fitted to its path at once, by least squares.

The solver is our own: that of scipy takes singular values of the whole Jacobian, for which BLAS
starts threads that take many times as long where cores are shared.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from failuretwin.core.movements import Movements
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.data_knowledge.recovery.ramp_fit import PathPart, Ramps
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin

STEPS = 100
"""Most steps of the fit."""
DAMPING, DAMPING_RANGE = 1e-4, (1e-13, 1e2)
"""First damping and its limits, as shares of the largest diagonal entry of the equations."""
LEAST_GAIN = 1e-5
"""The fit ends with a step that lessens the squared error by a smaller share."""
LEAST_COST = 1e-24
"""A squared error as small as rounding [m2]."""
START_SHIFT_S = 0.15
"""A start may move this far from its first guess [s]."""
LEAST_DURATION_S = 0.02
"""Shortest ramp that is fitted [s]."""
STAYS_RAD = 1e-6
"""A motor with less travel [rad] does not move."""


@dataclass(frozen=True)
class RunFit:
    """The fit of all movements of a run at once, from first guesses of each.

    The parameters are the initial pose, all targets, all durations and all starts, in this order.

    Attributes:
        path: The desired path.
        twin: Its kinematics make a path of a reference.
        ramps: One guess of each movement.
    """

    path: PathPart
    twin: DigitalTwin
    ramps: Sequence[Ramps]

    def movements(self) -> Movements:
        """Return the best movements, with a leading run axis of 1."""
        pose, duration, start = self._unpack(self._fitted())
        stays = np.abs(np.diff(pose, axis=0)) <= STAYS_RAD
        return Movements(
            initial=pose[:1],
            target=pose[None, 1:],
            ramp_duration=np.where(stays, 0.0, duration)[None],
            start=start[None],
        )

    def _fitted(self) -> FloatArray:
        """Return the best parameters, by damped Gauss-Newton steps within bounds."""
        low, high = self._bounds()
        guess = np.clip(self._pack(), low, high)
        x, error, J = guess, self._error(guess), self._jacobian(guess)
        damping = DAMPING
        for _ in range(STEPS):
            trial = np.clip(x + _step(error, J, damping), low, high)
            trial_error = self._error(trial)
            gain = 1.0 - np.sum(trial_error**2) / max(np.sum(error**2), LEAST_COST)
            if gain > 0.0:
                x, error, J = trial, trial_error, self._jacobian(trial)
            damping = np.clip(damping * (0.1 if gain > 0.0 else 10.0), *DAMPING_RANGE)
            if 0.0 <= gain < LEAST_GAIN or damping == DAMPING_RANGE[1]:
                break
        return x

    def _pack(self) -> FloatArray:
        pose = [self.ramps[0].origin, *(ramp.target for ramp in self.ramps)]
        duration = [ramp.duration for ramp in self.ramps]
        start = [ramp.start for ramp in self.ramps]
        return np.concatenate([np.ravel(pose), np.ravel(duration), np.ravel(start)])

    def _unpack(self, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return poses (1 + movement, motor), durations (movement, motor), starts (movement,)."""
        count, motors = len(self.ramps), len(self.twin.robot.motors)
        ends = [(count + 1) * motors, (2 * count + 1) * motors]
        pose, duration, start = np.split(x, ends)
        return pose.reshape(-1, motors), duration.reshape(-1, motors), start

    def _bounds(self) -> tuple[FloatArray, FloatArray]:
        count, motors = len(self.ramps), len(self.twin.robot.motors)
        low, high = _limits(self.twin.robot)
        begun = np.array([ramp.start[0] for ramp in self.ramps])
        begun = np.maximum.accumulate(begun)
        longest = np.diff(begun, append=np.inf).clip(2.0 * LEAST_DURATION_S)
        early, late = begun - START_SHIFT_S, begun + START_SHIFT_S
        shortest = np.full(count * motors, LEAST_DURATION_S)
        return (
            np.concatenate([np.tile(low, count + 1), shortest, early]),
            np.concatenate([np.tile(high, count + 1), np.repeat(longest, motors), late]),
        )

    def _shares(self, x: FloatArray) -> FloatArray:
        """Return how much of each ramp is done, (movement, time, motor)."""
        _, duration, start = self._unpack(x)
        passed = self.path.time[None, :, None] - start[:, None, None]
        return np.clip(passed / duration[:, None], 0.0, 1.0)

    def _reference(self, x: FloatArray) -> FloatArray:
        pose, _, _ = self._unpack(x)
        return pose[0] + np.einsum("mtk,mk->tk", self._shares(x), np.diff(pose, axis=0))

    def _error(self, x: FloatArray) -> FloatArray:
        return (self.twin.path(self._reference(x)) - self.path.point).ravel()

    def _jacobian(self, x: FloatArray) -> FloatArray:
        """Return derivatives of `_error`, (time * axis, parameter)."""
        pose, duration, _ = self._unpack(x)
        share, travel = self._shares(x), np.diff(pose, axis=0)
        _, by_motor = self.twin.path_and_jacobian(self._reference(x))
        under_way = (share > 0.0) & (share < 1.0)
        speed = np.where(under_way, (travel / duration)[:, None], 0.0)
        of_pose = np.concatenate([1.0 - share[:1], share[:-1] - share[1:], share[-1:]])
        by_pose = np.einsum("tak,mtk->tamk", by_motor, of_pose)
        by_duration = np.einsum("tak,mtk->tamk", by_motor, -speed * share)
        by_start = np.einsum("tak,mtk->tam", by_motor, -speed)
        rows = 3 * len(self.path.time)
        parts = (by_pose, by_duration, by_start)
        return np.concatenate([part.reshape(rows, -1) for part in parts], axis=1)


def _limits(robot: Robot) -> tuple[FloatArray, FloatArray]:
    """Return lowest and highest angles in the log's sense, (motor,) [rad]."""
    joints = np.array([(joint.low, joint.high) for joint in robot.chain.joints])
    ends = np.sort(joints * robot.sense[:, None], axis=1)
    return ends[:, 0], ends[:, 1]


def _step(error: FloatArray, J: FloatArray, damping: float) -> FloatArray:
    # Without BLAS, see above.
    normal = np.einsum("rp,rq->pq", J, J)
    normal += damping * normal.diagonal().max() * np.eye(len(normal))
    return as_floats(-np.linalg.solve(normal, np.einsum("rp,r->p", J, error)))
