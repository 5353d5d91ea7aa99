"""What every fault mode is.

A mode is one class: how large it is and when it begins, what it does to the motion at each stage,
where a motor settles with it, what is believed of it beforehand, and its words. Simulation and
diagnosis ask the same object. It never touches the twin; each stage does nothing unless a mode says
otherwise, and works on all runs at once that have the mode at the same motor.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import Enum
from typing import ClassVar

import numpy as np

from failuretwin.core.errors import InputError, unknown_name
from failuretwin.core.hypothesis import Fault
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.failure_behavior.fault import (
    INTERMITTENT,
    PROFILES,
    RAMP,
    STEP,
    Arrival,
    Course,
    FaultGroup,
    FaultValue,
    MotorMotion,
    MotorOrders,
    PerMovement,
    draw_episodes,
)

Range = tuple[float, float]


class Signature(Enum):
    """How a fault shows, which decides how its likelihood is summed."""

    OFFSET = "an offset of each target that one size decides for the whole run"
    GROWING_OFFSET = "the same, growing with the time since the onset"
    REDRAWN_OFFSET = "an offset that is drawn anew for each movement"
    HELD = "an angle that the motor keeps"
    TRANSIENT = "a way that takes longer or begins later"
    MISSED = "single movements that are not made"


class Reaction(Enum):
    """What an arm that goes on working does about a fault of one of its motors."""

    LOCK = "plan with the motor held where it is believed to stand"
    INVERT = "command what the fault turns into what is wanted"
    PARK = "let the motor rest in a known place, and work with the others"
    REPEAT = "look whether each command came, and send it again"
    WAIT = "give it the time that it takes"
    SPARE = "choose poses in which it carries little, and command against its sag"


USUAL_REACTION = {
    Signature.OFFSET: Reaction.INVERT,
    Signature.GROWING_OFFSET: Reaction.INVERT,
    Signature.REDRAWN_OFFSET: Reaction.PARK,
    Signature.HELD: Reaction.LOCK,
    Signature.TRANSIENT: Reaction.WAIT,
    Signature.MISSED: Reaction.REPEAT,
}
"""What is done about a fault that shows in such a way."""


@dataclass(frozen=True, kw_only=True)
class FaultMode(ABC):
    """A fault mode with the distributions of its parameters.

    All ranges are drawn from uniformly, anew for each run; equal ends fix the value. A mode that
    has no use for one of them makes it a field that cannot be set, so that nobody sets it in vain.

    Attributes:
        onset_s: Range of the onset [s]; no later than the end of the run.
        profiles: Time profiles that occur, each equally often.
        rise_s: Range of the time that a ramp takes from the onset to full severity [s].
        episode_s: Range of the lengths of intermittent episodes [s].
        episode_share: Range of the share of the time after the onset that episodes fill.

    Raises:
        InputError: If a range is out of order or out of bounds, or the mode does not know a
            profile.
    """

    mode: ClassVar[str]
    """Id of the mode."""
    unit: ClassVar[str]
    """Unit of its magnitude, such as ``rad``; ``ratio`` for a share."""
    signature: ClassVar[Signature] = Signature.OFFSET
    """How it shows."""
    sizes: ClassVar[Range | None] = None
    """Magnitudes that diagnosis considers, all as likely; None: those that are drawn."""
    signed: ClassVar[bool] = False
    """Whether magnitudes also come with a minus."""
    down_to_visible: ClassVar[bool] = False
    """Whether the least magnitude considered is what can be seen of the motor, on robots whose
    profile states none; `sizes` are then those of a motor that turns through half a turn."""
    misses: ClassVar[tuple[float, float]] = (1.0, 0.0)
    """Of `MISSED` movements, for each unit of magnitude: the probability that the motor stays where
    it stood, and that it stands somewhere on the way."""
    prior_odds: ClassVar[float] = 0.3
    """Odds against healthy for each motor before a run is seen; 1: as likely."""
    before_run: ClassVar[float] = 0.9
    """Probability that the fault was there before the run, if it is there; what wears out rarely
    does so within the ten seconds of one run."""
    name: ClassVar[str] = ""
    """What a person calls it, ``{motor}`` standing for the motor; empty: by its id."""
    size_words: ClassVar[str] = " ({size:.3g} {unit})"
    """How a magnitude is told behind the name, in the unit that people read."""
    mechanisms: ClassVar[tuple[str, ...]] = ()
    """What breaks."""
    advice: ClassVar[str] = ""
    """What to do now."""
    allowed_profiles: ClassVar[tuple[str, ...]] = PROFILES
    """Time profiles that make sense for it."""
    own_reaction: ClassVar[Reaction | None] = None
    """What to do about it; None: what is usual for how it shows."""
    needs_compliance: ClassVar[bool] = False
    """Whether it shows only at a motor that gives way under load."""

    onset_s: Range = (0.0, 5.0)
    profiles: tuple[str, ...] = (STEP,)
    rise_s: Range = (2.0, 8.0)
    episode_s: Range = (0.5, 2.0)
    episode_share: Range = (0.3, 0.7)

    def __post_init__(self) -> None:
        self._check_range("onset_s", 0.0, math.inf)
        if not self.profiles:
            raise InputError(f"{self.mode}: profiles is empty. Give at least one.")
        for profile in self.profiles:
            if profile not in self.allowed_profiles:
                raise InputError(
                    f"{self.mode}: {unknown_name('profile', profile, self.allowed_profiles)}"
                )
        if RAMP in self.profiles:
            self._check_range("rise_s", 1e-3, math.inf)
        if INTERMITTENT in self.profiles:
            self._check_range("episode_s", 1e-3, math.inf)
            self._check_range("episode_share", 0.0, 1.0)

    def _check_range(self, name: str, lowest: float, highest: float) -> None:
        """Refuse a range that is out of order, not finite or not within its bounds."""
        low, high = getattr(self, name)
        if not (lowest <= low <= high <= highest and math.isfinite(high)):
            raise InputError(
                f"{self.mode}: {name} is [{low:g}, {high:g}], expected two numbers in order, "
                f"between {lowest:g} and {highest:g}."
            )

    def draw(
        self, motor: str, movements: int, duration: float, rng: np.random.Generator
    ) -> FaultValue:
        """Return the fault as it strikes one run.

        Args:
            motor: Name of the motor.
            movements: Number of movements in the run.
            duration: Length of the run [s].
            rng: The run's own generator.
        """
        magnitude = self._draw_magnitude(rng)
        per_movement = self._draw_per_movement(movements, rng)
        onset = min(float(rng.uniform(*self.onset_s)), duration)
        course = self._draw_course(magnitude, onset, duration, rng)
        return FaultValue(Fault(motor, self.mode), magnitude, course, per_movement)

    @abstractmethod
    def _draw_magnitude(self, rng: np.random.Generator) -> float:
        """Draw the size in the mode's unit; NaN where it follows from the motion."""

    def _draw_per_movement(
        self, movements: int, rng: np.random.Generator
    ) -> dict[str, PerMovement]:
        """Draw what differs from movement to movement, (movement,), by name."""
        return {}

    def _draw_course(
        self, magnitude: float, onset_s: float, end_s: float, rng: np.random.Generator
    ) -> Course:
        """Draw a time profile and its parameters."""
        profile = self.profiles[0]
        if len(self.profiles) > 1:
            profile = self.profiles[int(rng.integers(len(self.profiles)))]
        if profile == RAMP:
            return Course(profile, onset_s, rise_s=float(rng.uniform(*self.rise_s)))
        if profile == INTERMITTENT:
            share = float(rng.uniform(*self.episode_share))
            episodes = draw_episodes(onset_s, end_s, share, self.episode_s, rng)
            return Course(profile, onset_s, episodes=episodes)
        return Course(profile, onset_s)

    def on_movements(self, faults: FaultGroup, orders: MotorOrders) -> MotorOrders:
        """Return the orders that the motor follows; the same object where none changes."""
        return orders

    def on_reference(
        self, faults: FaultGroup, reference: FloatArray, time: FloatArray
    ) -> FloatArray:
        """Return the reference (run, time) [rad] that the servo loop follows.

        Args:
            faults: The faults of these runs.
            reference: As the orders have it, (run, time) [rad]; the same object is returned
                where nothing changes.
            time: Uniform grid, (time,) [s].
        """
        return reference

    def held(self, faults: FaultGroup, time: FloatArray) -> BoolArray | None:
        """Return when the gear holds the motor, (run, time) at `time` (time,) [s]; None: never."""
        return None

    def weakness(self, faults: FaultGroup, time: FloatArray) -> FloatArray | None:
        """Return the share of stiffness lost, (run, time) at `time` (time,) [s]; None: none."""
        return None

    def as_struck(self, faults: FaultGroup, motion: MotorMotion) -> FaultGroup:
        """Return the faults with what only the motion tells: held angles, movements hit."""
        return faults

    # What diagnosis asks; by default it is found from the stages above.

    @property
    def considered(self) -> Range:
        """Lowest and highest magnitude that diagnosis considers; NaN where it has none."""
        drawn: Range = getattr(self, "magnitude", (math.nan, math.nan))
        return self.sizes or drawn

    @property
    def reaction(self) -> Reaction:
        """What an arm does about it that has to go on working."""
        return self.own_reaction or USUAL_REACTION[self.signature]

    def plain_name(self, motor: str) -> str:
        """Return what a person calls the fault of a motor."""
        return (self.name or f"{{motor}} {self.mode.replace('_', ' ')}").format(motor=motor)

    def settled_offset(self, size: FloatArray, arrival: Arrival) -> FloatArray:
        """Return by how much a motor settles beside where it would without the fault [rad].

        Here: what becomes of a motor that stands at the origin, then at the target, once its
        orders, reference, gear and stiffness have had the fault, at full severity since the onset.

        Args:
            size: Magnitudes, broadcast against `arrival`.
            arrival: Where the motor comes to rest.

        Returns:
            Of the shape of both.
        """
        since = np.asarray(arrival.since_onset)
        size, origin, target, sag, each = np.broadcast_arrays(
            size, arrival.origin, arrival.target, arrival.sag, since
        )
        shape, end = size.shape, max(float(since.max()), 1.0)
        onset = end - (since if since.size == 1 else each)
        size, origin, target, sag = (x.reshape(-1, 1) for x in (size, origin, target, sag))
        faults = FaultGroup(size[:, 0], [Course(STEP, s) for s in np.ravel(onset).tolist()])
        time, nothing = np.array([0.0, 0.5 * end, end]), np.zeros_like(target)
        orders = MotorOrders(target, nothing, nothing, np.zeros(target.shape, dtype=bool))
        followed = self.on_movements(faults, orders)
        goal = np.where(followed.lost, origin, followed.target)
        settled = self.on_reference(faults, np.hstack([origin, goal, goal]), time)[:, -1]
        held, weakness = self.held(faults, time), self.weakness(faults, time)
        if held is not None:
            settled = np.where(held[:, -1], origin[:, 0], settled)
        if weakness is not None:
            settled = settled + sag[:, 0] * weakness[:, -1] / (1.0 - weakness[:, -1])
        return np.asarray(settled - target[:, 0]).reshape(shape)

    def amount(self, size: FloatArray) -> FloatArray:
        """Return what the settled offset is proportional to, if not to the size itself."""
        return size

    def size_of(self, amount: FloatArray) -> FloatArray:
        """Return the size that has this `amount`."""
        return amount

    def ramp_factor(self, size: FloatArray) -> FloatArray:
        """Return how many times as long as commanded a movement takes, (size,)."""
        one = np.ones((len(size), 1))
        orders = MotorOrders(0.0 * one, one, 0.0 * one, one < 0.0)
        faults = FaultGroup(size, [Course(STEP, 0.0)])
        return np.asarray(self.on_movements(faults, orders).ramp_duration[:, 0])

    def dead_time(self, size: FloatArray) -> FloatArray:
        """Return how much later than the others the motor starts, (size,) [s]."""
        return np.zeros_like(size)


# Modes whose magnitude is drawn from a range.


@dataclass(frozen=True, kw_only=True)
class SizedMode(FaultMode):
    """A fault mode whose magnitude is drawn.

    Attributes:
        magnitude: Range of the magnitude, in the mode's unit.
    """

    lowest: ClassVar[float] = 0.0
    """Smallest magnitude that makes sense."""
    highest: ClassVar[float] = math.inf
    """Largest magnitude that makes sense."""

    magnitude: Range

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_range("magnitude", self.lowest, self.highest)

    def _draw_magnitude(self, rng: np.random.Generator) -> float:
        return float(rng.uniform(*self.magnitude))


@dataclass(frozen=True, kw_only=True)
class SignedMode(SizedMode):
    """A fault mode whose magnitude has a sign.

    Attributes:
        both_signs: Whether half of the magnitudes change their sign; otherwise they are drawn
            from the range as it stands, which may be negative.
    """

    lowest: ClassVar[float] = -math.inf
    signed: ClassVar[bool] = True

    both_signs: bool = True

    @property
    def considered(self) -> Range:
        """Lowest and highest magnitude that diagnosis considers, whatever their sign."""
        low, high = self.magnitude
        return self.sizes or (max(low, -high, 0.0), max(-low, high))

    def _draw_magnitude(self, rng: np.random.Generator) -> float:
        size = super()._draw_magnitude(rng)
        return -size if self.both_signs and rng.random() < 0.5 else size
