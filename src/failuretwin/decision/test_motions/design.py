"""Which movements to make: those that are expected to tell most, one after the other.

    next = argmax over safe poses of [I(D + D_pose) - I(D)] / time of the movement

Poses are drawn anywhere within the limits of the joints, off the floor and the arm's own links; the
best are drawn around again. A way must be safe as the arm would follow it healthy, as it settles,
and with any one motor left where it stood at first.

Section: docs/check.md#choice-of-movements
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from failuretwin.connection.links.base import Order
from failuretwin.core.errors import InputError
from failuretwin.core.types import FloatArray
from failuretwin.decision.acting.safety import LEAST_RAMP_S, SafetyGate, Way
from failuretwin.decision.acting.work import QUIET_S
from failuretwin.decision.test_motions.outlook import Outlook, of_posterior
from failuretwin.inference.observation.evidence import SETTLING_S
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.posterior import Posterior

POOL = 1024
"""Poses drawn at first."""
CANDIDATES = (64, 512)
"""Poses weighed for one movement: fewest and most."""
PAIRS = 50_000
"""Pairs of members at poses that are weighed for one movement."""
NEARBY = 16
"""Poses drawn around the best of them."""
NEARBY_SHARE = 0.08
"""How far around, in the range of each motor [-]."""
READINGS = 2.0
"""Readings by which rest is seen late [-]."""
TRIED = 12
"""So many of the best are looked at for a safe way."""


@dataclass(frozen=True)
class Movement:
    """One movement of a design.

    Attributes:
        order: What the motors are told.
        previous: What they were told before, (motor,) [rad].
        seconds: Time until the tool was seen at rest [s].
    """

    order: Order
    previous: FloatArray
    seconds: float


@dataclass
class Designer:
    """Chooses movements for one arm.

    Attributes:
        gate: What is safe.
        outlook: What may be the case, and what it would look like.
        seed: Seed of the poses that are tried.
        usual: Whether poses keep to the ranges of usual movements.
        least_rest_s: Time that is left for coming to rest after each movement at least [s].
    """

    gate: SafetyGate
    outlook: Outlook
    seed: int = 0
    usual: bool = False
    least_rest_s: float = 0.0
    _pool: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)
        self._pool = self._allowed(self._rng.uniform(*self.limits, (POOL, len(self.limits[0]))))
        if len(self._pool) == 0:
            raise InputError(
                f"none of {POOL} poses of {self.gate.robot.name} is off its floor and its own "
                "links. State their heights and radius: --floor, --radius."
            )

    @property
    def model(self) -> HealthyModel:
        """The healthy robot."""
        return self.outlook.model

    @property
    def limits(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest pose of each motor, (motor,) [rad]."""
        return self.gate.pose_limits(self.usual)

    @property
    def rest_s(self) -> float:
        """Time from the end of a ramp until the tool is seen at rest, on average [s]."""
        figures = self.model.imperfections
        late = figures.timing.late_rate * float(np.mean(figures.timing.late_s))
        beat = 0.0 if figures.readings is None else READINGS / figures.readings.rate_hz
        usual = SETTLING_S + self.model.lag_s + QUIET_S + late + beat
        return max(usual, self.least_rest_s)

    def sequence(self, start: FloatArray, seconds: float, most: int = 1000) -> list[Movement]:
        """Return movements that fit into a time.

        The motors were told `start` last, (motor,) [rad].
        """
        made: list[Movement] = []
        while len(made) < most and (found := self.next(start, made, seconds)) is not None:
            made.append(found)
        if not made:
            raise InputError(
                f"no safe movement from {np.rad2deg(start).round(1).tolist()} deg fits into "
                f"{seconds:g} s. Begin elsewhere, or give more time."
            )
        return made

    def next(
        self, start: FloatArray, made: Sequence[Movement] = (), seconds: float = np.inf
    ) -> Movement | None:
        """Return the movement that is expected to tell most for its time; None: none is safe.

        The motors were told `start` before all movements, (motor,) [rad]. The outcome of those that
        are `made` is not known yet; all of them take `seconds` at most [s].
        """
        told = np.array([start, *(movement.order.target for movement in made)])
        since = np.cumsum([0.0, *(movement.seconds for movement in made)])
        outlook = self.outlook.after(told)
        made_so_far = told[1:], told[:-1], since[1:], np.arange(len(made))
        nats = outlook.distances(*made_so_far).sum(axis=0)

        def score_of(poses: FloatArray) -> FloatArray:
            count = len(poses)
            before = np.tile(told[-1], (count, 1)), np.full(count, since[-1])
            next_nats = outlook.distances(poses, *before, np.full(count, len(made)))
            gained = outlook.information(nats + next_nats)
            needed = np.array([self.gate.least_duration(pose - told[-1]) for pose in poses])
            return np.asarray((gained - outlook.information(nats)) / (needed + self.rest_s))

        count = int(np.clip(PAIRS // len(outlook.members) ** 2, *CANDIDATES))
        drawn = self._pool[self._rng.integers(len(self._pool), size=count)]
        score = score_of(drawn)
        width = NEARBY_SHARE * np.ptp(np.array(self.limits), axis=0)
        around = width * self._rng.standard_normal((NEARBY, len(start)))
        near = self._allowed(np.clip(drawn[np.argmax(score)] + around, *self.limits))
        drawn, score = np.concatenate([drawn, near]), np.append(score, score_of(near))
        for pose in drawn[np.argsort(-score)[:TRIED]]:
            found = self.movement(pose, told[-1], start)
            if found is not None and since[-1] + found.seconds <= seconds:
                return found
        return None

    def random(self, start: FloatArray, seconds: float, most: int = 1000) -> list[Movement]:
        """Return movements to poses drawn at random from the same poses; see `sequence`."""
        made: list[Movement] = []
        at, left = start, seconds
        for _ in range(TRIED * most):
            pose = self._pool[self._rng.integers(len(self._pool))]
            found = self.movement(pose, at, start)
            if found is None or found.seconds > left:
                continue
            made.append(found)
            left, at = left - found.seconds, found.order.target
            if len(made) == most or left < self.rest_s + LEAST_RAMP_S:
                break
        return made

    def movement(self, pose: FloatArray, at: FloatArray, start: FloatArray) -> Movement | None:
        """Return the movement to a pose; None if it is not safe.

        It begins `at` what the motors were told last; one that does not follow is left at `start`.
        All are (motor,) [rad].
        """
        ramp = self.gate.least_duration(pose - at)
        order = Order(pose, np.full(len(pose), ramp))
        if self.gate.wrong(order, self._ways(at, pose, start)):
            return None
        return Movement(order, at, ramp + self.rest_s)

    def _allowed(self, poses: FloatArray) -> FloatArray:
        """Return poses as they can be told, without those that are not allowed."""
        if self.gate.robot.profile.servo_units is not None:
            units = self.gate.robot.servo_units
            poses = units.to_rad(np.round(units.to_counts(poses)))
        low, high = self.limits
        poses = poses[np.all((poses >= low) & (poses <= high), axis=1)]
        return np.asarray(poses[self.gate.clearance.margin(poses) > self.gate.margin_m])

    def _ways(self, at: FloatArray, pose: FloatArray, start: FloatArray) -> Sequence[Way]:
        """Return the way as it is told, as it settles, and with each motor left at the start."""
        settle, none = self.model.settle, self.model.none_held
        ways = [(at, pose), (settle(at, 0.0 * at, none), settle(pose, np.sign(pose - at), none))]
        for held in np.eye(len(at), dtype=bool):
            ways.append((np.where(held, start, at), np.where(held, start, pose)))
        return ways


def next_movement(
    model: HealthyModel,
    gate: SafetyGate,
    posterior: Posterior,
    at: FloatArray,
    seed: int = 0,
) -> Order | None:
    """Return the movement that is expected to settle best what a posterior leaves open.

    The motors were told `at` last, (motor,) [rad]. None: no movement is safe, or nothing is left to
    ask.
    """
    members = of_posterior(posterior)
    if len({member.hypothesis for member in members}) < 2:
        return None
    found = Designer(gate, Outlook(model, members), seed).next(at)
    return None if found is None else found.order
