"""Base classes of fault modes.

A mode is one class: distributions of magnitude and onset, its effect on the motion at each stage,
the settled angle of a faulty motor, its prior, and its words. Simulation and diagnosis use the same
object. Stages work on all runs at once that have the mode at the same motor; by default they change
nothing.
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
    """Observable effect of a fault, which decides how its likelihood is computed."""

    OFFSET = "an offset of each target that one size decides for the whole run"
    GROWING_OFFSET = "the same, growing with the time since the onset"
    REDRAWN_OFFSET = "an offset that is drawn anew for each movement"
    HELD = "an angle that the motor keeps"
    TRANSIENT = "a way that takes longer or begins later"
    MISSED = "single movements that are not made"


class Reaction(Enum):
    """Reaction of an arm that goes on working to a fault of one of its motors."""

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
"""Default reaction to each signature."""


@dataclass(frozen=True, kw_only=True)
class FaultMode(ABC):
    """A fault mode with the distributions of its parameters.

    All ranges are uniform and drawn for each run; equal ends fix the value. A mode without use for
    one of them makes it a field that cannot be set.

    Attributes:
        onset_s: Range of the onset [s]; limited to the end of the run.
        profiles: Time profiles, each with the same probability.
        rise_s: Range of the time from the onset to full severity of a ramp [s].
        episode_s: Range of the lengths of intermittent episodes [s].
        episode_share: Range of the share of the time after the onset that episodes fill.

    Raises:
        InputError: If a range is out of order or out of bounds, or the mode does not allow a
        profile.
    """

    mode: ClassVar[str]
    """Id of the mode."""
    unit: ClassVar[str]
    """Unit of its magnitude, such as ``rad``; ``ratio`` for a share."""
    signature: ClassVar[Signature] = Signature.OFFSET
    """Its observable effect."""
    sizes: ClassVar[Range | None] = None
    """Range of magnitudes in diagnosis, uniform; None: the range drawn in simulation."""
    signed: ClassVar[bool] = False
    """Whether magnitudes can be negative."""
    down_to_visible: ClassVar[bool] = False
    """Whether the smallest magnitude in diagnosis is the smallest visible one on robots whose
    profile states none; `sizes` then apply to a motor with half a turn of travel."""
    misses: ClassVar[tuple[float, float]] = (1.0, 0.0)
    """For `MISSED`, per unit of magnitude: probability that the motor stays at its origin, and that
    it stops on the way."""
    prior_odds: ClassVar[float] = 0.3
    """Prior odds against healthy for each motor."""
    before_run: ClassVar[float] = 0.9
    """Probability that an existing fault was there before the run; wear rarely starts within a
    run."""
    name: ClassVar[str] = ""
    """Name for users with ``{motor}`` for the motor; empty: by its id."""
    size_words: ClassVar[str] = " ({size:.3g} {unit})"
    """Text of a magnitude after the name, in the unit for users."""
    mechanisms: ClassVar[tuple[str, ...]] = ()
    """Possible causes."""
    advice: ClassVar[str] = ""
    """Next steps."""
    allowed_profiles: ClassVar[tuple[str, ...]] = PROFILES
    """Valid time profiles."""
    own_reaction: ClassVar[Reaction | None] = None
    """Reaction to it; None: the default of its signature."""
    needs_compliance: ClassVar[bool] = False
    """Whether it is only visible at a motor that yields under load."""
    hysteresis: ClassVar[bool] = False
    """Whether the way to a target counts, not only the target and the last travel."""

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
        """Return a random fault for one run.

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
        """Draw values for each movement, (movement,), by name."""
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
        """Return the orders that the motor follows; the same object without a change."""
        return orders

    def on_reference(
        self, faults: FaultGroup, reference: FloatArray, time: FloatArray
    ) -> FloatArray:
        """Return the reference (run, time) [rad] of the servo loop.

        Args:
            faults: The faults of these runs.
            reference: Reference of the orders, (run, time) [rad]; returned unchanged without
            effect.
            time: Uniform grid, (time,) [s].
        """
        return reference

    def on_curve(self, faults: FaultGroup, reference: FloatArray, time: FloatArray) -> FloatArray:
        """Return the reference of the servo loop where it is streamed, not a ramp for each order.

        Args:
            faults: The faults of these runs.
            reference: What is streamed, (run, time) [rad].
            time: Uniform grid, (time,) [s].
        """
        return self.on_reference(faults, reference, time)

    def held(self, faults: FaultGroup, time: FloatArray) -> BoolArray | None:
        """Return when the gear holds the motor, (run, time) at `time` (time,) [s]; None: never."""
        return None

    def weakness(self, faults: FaultGroup, time: FloatArray) -> FloatArray | None:
        """Return the share of stiffness lost, (run, time) at `time` (time,) [s]; None: none."""
        return None

    def as_struck(self, faults: FaultGroup, motion: MotorMotion) -> FaultGroup:
        """Return the faults with values that follow from the motion: held angles, movements hit."""
        return faults

    # What diagnosis asks; by default it is found from the stages above.

    @property
    def considered(self) -> Range:
        """Lowest and highest magnitude in diagnosis; NaN without one."""
        drawn: Range = getattr(self, "magnitude", (math.nan, math.nan))
        return self.sizes or drawn

    @property
    def in_episodes(self) -> bool:
        """Whether it is always one that misses movements as the motor sticks in episodes."""
        return self.signature is Signature.MISSED and self.allowed_profiles == (INTERMITTENT,)

    @property
    def reaction(self) -> Reaction:
        """Reaction of an arm that goes on working."""
        return self.own_reaction or USUAL_REACTION[self.signature]

    def plain_name(self, motor: str) -> str:
        """Return the name of the fault of a motor for users."""
        return (self.name or f"{{motor}} {self.mode.replace('_', ' ')}").format(motor=motor)

    def settled_offset(self, size: FloatArray, arrival: Arrival) -> FloatArray:
        """Return the settled angle with the fault minus that without it [rad].

        Default: the stages applied to a motor that stands at the origin, then at the target, at
        full severity since the onset.

        Args:
            size: Magnitudes, broadcast against `arrival`.
            arrival: Ends of movements.
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
        """Return the factor of the settled offset if it is not the size itself."""
        return size

    def size_of(self, amount: FloatArray) -> FloatArray:
        """Return the size with this `amount`."""
        return amount

    def ramp_factor(self, size: FloatArray) -> FloatArray:
        """Return the duration of a movement relative to its command, (size,)."""
        one = np.ones((len(size), 1))
        orders = MotorOrders(0.0 * one, one, 0.0 * one, one < 0.0)
        faults = FaultGroup(size, [Course(STEP, 0.0)])
        return np.asarray(self.on_movements(faults, orders).ramp_duration[:, 0])

    def dead_time(self, size: FloatArray) -> FloatArray:
        """Return the delay of the motor relative to the others, (size,) [s]."""
        return np.zeros_like(size)


# Modes whose magnitude is drawn from a range.


@dataclass(frozen=True, kw_only=True)
class SizedMode(FaultMode):
    """A fault mode with a random magnitude.

    Attributes:
        magnitude: Range of the magnitude, in the mode's unit.
    """

    lowest: ClassVar[float] = 0.0
    """Smallest valid magnitude."""
    highest: ClassVar[float] = math.inf
    """Largest valid magnitude."""

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
        both_signs: Whether magnitudes change their sign with probability 1/2; otherwise the range
            applies as given and may be negative.
    """

    lowest: ClassVar[float] = -math.inf
    signed: ClassVar[bool] = True

    both_signs: bool = True

    @property
    def considered(self) -> Range:
        """Lowest and highest absolute magnitude in diagnosis."""
        low, high = self.magnitude
        return self.sizes or (max(low, -high, 0.0), max(-low, high))

    def _draw_magnitude(self, rng: np.random.Generator) -> float:
        size = super()._draw_magnitude(rng)
        return -size if self.both_signs and rng.random() < 0.5 else size
