"""One arm of the physics engine that is moved on stretch by stretch, for as long as one likes."""

from __future__ import annotations

import numpy as np

from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.engine import Drive
from failuretwin.digital_model.physics.batch import SAMPLES_AT_ONCE, chunks, strength_of
from failuretwin.digital_model.physics.engine import PhysicsEngine
from failuretwin.digital_model.physics.extra import load_mujoco


class LiveArm:
    """An arm at rest that then follows whatever it is told next.

    Stretches that follow each other give what one run of the engine would give. Angles are in the
    log's sense.

    Args:
        engine: The engine; its threads are not used.
        reference: Where the arm stands, (motor,) [rad].
        step_s: Step of the references to come [s].
        payload: Mass at the tool point [kg].

    Raises:
        InputError: If mujoco is missing.
    """

    def __init__(
        self, engine: PhysicsEngine, reference: FloatArray, step_s: float, payload: float = 0.0
    ) -> None:
        self._batch = engine.batch(step_s)
        self._sense = engine.robot.sense
        self._last = (reference * self._sense)[None]
        pool = load_mujoco().rollout.Rollout(nthread=0)
        self._arms = self._batch.at_rest(
            self._last, np.ones_like(self._last), np.array([payload]), pool, 1
        )
        self._strength = np.ones_like(self._last)

    @property
    def angle(self) -> FloatArray:
        """Where the arm stands, (motor,) [rad]."""
        return self._batch.angle(self._arms)[0] * self._sense

    def follow(
        self, reference: FloatArray, held: BoolArray | None, weakness: FloatArray | None
    ) -> FloatArray:
        """Move on and return the angles at the same instants, (time, motor) [rad].

        Args:
            reference: What the servos are told, one step after where the arm stands and so on,
                (time, motor) [rad].
            held: Whether the gears are held, (time, motor); None: never.
            weakness: Share of its stiffness that each motor has lost, (time, motor); None: none.

        Raises:
            InputError: If the simulation becomes unstable.
        """
        told = np.concatenate([self._last, reference * self._sense])[None]
        limited = self._batch.limited(told)
        drive = Drive(reference[None], weakness=None if weakness is None else weakness[None])
        strength = np.concatenate([self._strength[None], strength_of(drive)], axis=1)
        self._last, self._strength = limited[:, -1], strength[:, -1]
        angles = np.empty_like(reference)
        for part in chunks(len(reference), SAMPLES_AT_ONCE):
            span = slice(part.start, part.stop + 1)
            brake = None if held is None else held[None, part]
            angles[part] = self._batch.advance(
                self._arms, limited[:, span], strength[:, span], brake
            )[0]
        return angles * self._sense
