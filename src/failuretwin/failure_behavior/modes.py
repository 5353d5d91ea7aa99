"""The built-in fault modes.

Causes and effects: stuck and steady-state error from arXiv 2411.01360, section III-B, the others by
engineering judgement; odds without a source are assumed.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.failure_behavior.fault import (
    INTERMITTENT,
    RAMP,
    STEP,
    Arrival,
    Course,
    FaultGroup,
    MotorMotion,
    MotorOrders,
    PerMovement,
    draw_episodes,
)
from failuretwin.failure_behavior.mode import (
    FaultMode,
    Range,
    Reaction,
    Signature,
    SignedMode,
    SizedMode,
)

# Modes in which the gear holds the motor: stuck, intermittent.

PUBLISHED_ONSET_S = 0.49
"""Onset of stuck faults in the published data: frozen from 0-based sample 49 of 100 Hz on [s]."""


@dataclass(frozen=True, kw_only=True)
class Stuck(FaultMode):
    """The motor keeps its angle at the onset; its magnitude is that angle [rad].

    With the intermittent profile it is held in episodes, and the magnitude is the angle of the
    first.
    """

    mode: ClassVar[str] = "stuck"
    unit = "rad"
    signature = Signature.HELD
    prior_odds, before_run = 1.0, 0.5  # the paper's nine classes are equally many
    name = "{motor} stuck"
    size_words = " at {size:z.0f} {unit}"
    mechanisms = ("broken brushes", "damaged power supply",
                  "seized gear or bearing", "servo in overload shutdown")  # fmt: skip
    advice = (
        "Cut the power and turn the joint by hand. If it turns freely, check supply and cable of "
        "the servo; if not, look for a seized gear. Replace the servo."
    )
    allowed_profiles: ClassVar[tuple[str, ...]] = (STEP, INTERMITTENT)

    onset_s: Range = (PUBLISHED_ONSET_S, PUBLISHED_ONSET_S)
    rise_s: Range = field(init=False, default=(0.0, 0.0))

    def _draw_magnitude(self, rng: np.random.Generator) -> float:
        return np.nan

    def held(self, faults: FaultGroup, time: FloatArray) -> BoolArray:
        """Return when the motor is held: while the fault is present."""
        return faults.severity(time) > 0.0

    def as_struck(self, faults: FaultGroup, motion: MotorMotion) -> FaultGroup:
        """Return the faults with the angle at the first held instant."""
        held = self.held(faults, motion.time)
        first = np.argmax(held, axis=1)
        angle = motion.position[np.arange(len(first)), first]
        return replace(faults, magnitude=np.where(held.any(axis=1), angle, np.nan))


@dataclass(frozen=True, kw_only=True)
class Intermittent(SizedMode):
    """The motor is held in episodes; its magnitude is their share of the time after the onset."""

    mode: ClassVar[str] = "intermittent"
    unit = "ratio"
    prior_odds = 0.2
    signature = Signature.MISSED
    # Held for 0.5 to 2 s at a time, uniformly: at the end of a movement of 2 s with a ramp of 0.6
    # to 1.0 s, a held motor was on the plateau when the episode began in 6 of 10 cases, on the
    # ramp in 3, not yet on its way in 1.
    misses = (0.1, 0.3)
    own_reaction = Reaction.PARK  # while it still moves, before it stops where that helps least
    sizes = (0.1, 0.9)
    name = "{motor} sticks now and then"
    size_words = " ({size:.0f} {unit} of the time)"
    mechanisms = ("loose connector", "dirty commutator",
                  "broken cable that makes contact in some poses")  # fmt: skip
    advice = "Move the cable of the servo while it holds a pose; renew connector or cable."
    allowed_profiles: ClassVar[tuple[str, ...]] = (INTERMITTENT,)
    highest: ClassVar[float] = 1.0

    magnitude: Range = (0.2, 0.6)
    profiles: tuple[str, ...] = (INTERMITTENT,)
    rise_s: Range = field(init=False, default=(0.0, 0.0))
    episode_share: Range = field(init=False, default=(0.0, 0.0))

    def _draw_course(
        self, magnitude: float, onset_s: float, end_s: float, rng: np.random.Generator
    ) -> Course:
        """Draw episodes that fill the share given by the magnitude."""
        episodes = draw_episodes(onset_s, end_s, magnitude, self.episode_s, rng)
        return Course(INTERMITTENT, onset_s, episodes=episodes)

    def held(self, faults: FaultGroup, time: FloatArray) -> BoolArray:
        """Return when the motor is held: in every episode."""
        return faults.severity(time) > 0.0


# Modes that disturb the motion to the target: slow, lag, backlash, lost commands.

CHANCE, LOST = "chance", "lost"


@dataclass(frozen=True, kw_only=True)
class Slow(SizedMode):
    """The motor loses a share of its speed; late movements are interrupted by the next.

    Along a streamed curve it keeps below what is left of the largest speed that it is told.
    """

    mode: ClassVar[str] = "slow"
    unit = "ratio"
    signature = Signature.TRANSIENT
    sizes = (0.15, 0.85)
    name = "{motor} slow"
    size_words = " by {size:.0f} {unit}"
    mechanisms = ("worn brushes", "dry or dirty gear", "low supply voltage")
    advice = "Measure the supply voltage under load; clean and grease the gear."
    highest: ClassVar[float] = 0.99

    magnitude: Range = (0.3, 0.8)
    profiles: tuple[str, ...] = (STEP, RAMP)

    def on_movements(self, faults: FaultGroup, orders: MotorOrders) -> MotorOrders:
        """Lengthen the ramps of movements that start after the onset."""
        speed = 1.0 - faults.effect(orders.start)
        return replace(orders, ramp_duration=orders.ramp_duration / speed)

    def on_curve(self, faults: FaultGroup, reference: FloatArray, time: FloatArray) -> FloatArray:
        """Limit the speed."""
        told = np.abs(np.diff(reference, axis=1))
        most = (told.max(axis=1, initial=0.0)[:, None] * (1.0 - faults.effect(time))).T
        wanted = reference.T
        output = wanted.copy()
        for k in range(1, len(time)):
            here = output[k - 1]
            output[k] = np.clip(wanted[k], here - most[k], here + most[k])
        return output.T


@dataclass(frozen=True, kw_only=True)
class Lag(SizedMode):
    """The motor follows its reference with a dead time [s].

    The default range lies above the lag of 0.04 to 0.06 s of healthy motors of the ArmPi FPV.
    """

    mode: ClassVar[str] = "lag"
    unit = "s"
    signature = Signature.TRANSIENT
    sizes = (0.06, 0.4)
    name = "{motor} late"
    size_words = " by {size:.2f} {unit}"
    mechanisms = ("overloaded bus or controller", "loose coupling", "filter set too strong")
    advice = "Check the load of the bus and of the controller, then the coupling of the joint."

    magnitude: Range = (0.1, 0.3)

    def on_reference(
        self, faults: FaultGroup, reference: FloatArray, time: FloatArray
    ) -> FloatArray:
        """Delay the reference; where the dead time grows, it waits and never runs backwards."""
        step = (time[-1] - time[0]) / (len(time) - 1)
        place = np.arange(len(time)) - faults.effect(time) / step
        place = np.maximum.accumulate(np.maximum(place, 0.0), axis=1)
        low = place.astype(np.int64)
        before = np.take_along_axis(reference, low, axis=1)
        after = np.take_along_axis(reference, np.minimum(low + 1, len(time) - 1), axis=1)
        return before + (place - low) * (after - before)

    def dead_time(self, size: FloatArray) -> FloatArray:
        """Return the magnitude."""
        return size


@dataclass(frozen=True, kw_only=True)
class Backlash(SizedMode):
    """The joint has play [rad]: it stays until the motor has turned through the play.

    At the onset the motor is in the middle of the play, so that the joint settles half of it short
    of each target in the direction of travel.
    """

    mode: ClassVar[str] = "backlash"
    unit = "rad"
    sizes = (0.02, 0.15)
    down_to_visible = True
    name = "{motor} has play"
    size_words = " of {size:.1f} {unit}"
    mechanisms = ("worn gear teeth", "loose horn screw")
    advice = "Tighten the horn screw; replace the gear set if the play stays."
    allowed_profiles: ClassVar[tuple[str, ...]] = (STEP, RAMP)
    hysteresis: ClassVar[bool] = True

    magnitude: Range = (0.03, 0.12)
    profiles: tuple[str, ...] = (STEP, RAMP)
    episode_s: Range = field(init=False, default=(0.0, 0.0))
    episode_share: Range = field(init=False, default=(0.0, 0.0))

    def on_reference(
        self, faults: FaultGroup, reference: FloatArray, time: FloatArray
    ) -> FloatArray:
        """Apply the play to the reference."""
        half = 0.5 * faults.effect(time).T
        low, high = reference.T - half, reference.T + half
        output = np.empty_like(low)
        here = reference[:, 0]
        for k in range(len(time)):
            here = np.minimum(np.maximum(here, low[k]), high[k])
            output[k] = here
        return output.T

    def settled_offset(self, size: FloatArray, arrival: Arrival) -> FloatArray:
        """Return half of the play, against the last travel."""
        return -0.5 * size * arrival.direction


@dataclass(frozen=True, kw_only=True)
class LostCommands(SizedMode):
    """A share of the commands is lost: the motor stays at its angle for that movement."""

    mode: ClassVar[str] = "lost_commands"
    unit = "ratio"
    prior_odds = 0.2
    signature = Signature.MISSED
    sizes = (0.2, 1.0)
    name = "{motor} loses commands"
    size_words = " ({size:.0f} {unit} of them)"
    mechanisms = ("noise on the bus", "loose connector", "overloaded controller")
    advice = (
        "Check connectors, cable lengths and supply of the bus; count the errors of its protocol."
    )
    highest: ClassVar[float] = 1.0

    magnitude: Range = (0.3, 0.8)

    def _draw_per_movement(
        self, movements: int, rng: np.random.Generator
    ) -> dict[str, PerMovement]:
        return {CHANCE: rng.random(movements)}

    def _lost(self, faults: FaultGroup, start: FloatArray) -> BoolArray:
        """Return which movements are lost, (run, movement)."""
        return np.asarray(faults.per_movement[CHANCE] < faults.effect(start))

    def on_movements(self, faults: FaultGroup, orders: MotorOrders) -> MotorOrders:
        """Add lost commands to those lost in any case."""
        return replace(orders, lost=orders.lost | self._lost(faults, orders.start))

    def settled_offset(self, size: FloatArray, arrival: Arrival) -> FloatArray:
        """Return the offset of a lost movement."""
        return arrival.origin - arrival.target

    def as_struck(self, faults: FaultGroup, motion: MotorMotion) -> FaultGroup:
        """Return the faults with the movements that they lost."""
        return replace(faults, per_movement={LOST: self._lost(faults, motion.start)})


# Modes with an offset from the target: steady-state error, encoder faults, drift.

PUBLISHED_ERROR_RAD = (float(np.deg2rad(10 * 0.24)), float(np.deg2rad(50 * 0.24)))
"""Bounds of the paper's steady-state errors: 10 and 50 counts of 0.24 deg [rad]."""

OFFSET = "offset_rad"


@dataclass(frozen=True, kw_only=True)
class SteadyStateError(SizedMode):
    """Every target is missed by an error of random size and sign, drawn for each movement.

    The magnitude of a run is the rms of its errors over the movements that start after the onset.

    Attributes:
        magnitude: Range of the size of one error [rad]; the default is the paper's.
    """

    mode: ClassVar[str] = "steady_state_error"
    unit = "rad"
    signature = Signature.REDRAWN_OFFSET
    prior_odds = 1.0  # the paper's nine classes are equally many
    down_to_visible = True
    name = "{motor} misses its targets"
    size_words = " by about {size:.1f} {unit}"
    mechanisms = ("worn position sensor", "slipping horn or gear",
                  "wrong calibration of the servo")  # fmt: skip
    advice = (
        "Check that the servo horn is tight and the zero position is right; repeat a few movements "
        "of this motor alone. Replace the servo if its position sensor is worn."
    )

    magnitude: Range = PUBLISHED_ERROR_RAD
    onset_s: Range = (0.0, 0.0)

    def _draw_magnitude(self, rng: np.random.Generator) -> float:
        return np.nan

    def _draw_per_movement(
        self, movements: int, rng: np.random.Generator
    ) -> dict[str, PerMovement]:
        sign = np.where(rng.random(movements) < 0.5, -1.0, 1.0)
        return {OFFSET: sign * rng.uniform(*self.magnitude, movements)}

    def on_movements(self, faults: FaultGroup, orders: MotorOrders) -> MotorOrders:
        """Add the errors to the targets."""
        offset = faults.per_movement[OFFSET] * faults.severity(orders.start)
        return replace(orders, target=orders.target + offset)

    def settled_offset(self, size: FloatArray, arrival: Arrival) -> FloatArray:
        """Return the size: that of one error."""
        return size

    def as_struck(self, faults: FaultGroup, motion: MotorMotion) -> FaultGroup:
        """Return the faults with the actual errors and their rms."""
        severity = faults.severity(motion.start)
        offset = faults.per_movement[OFFSET] * severity
        hit = np.maximum(np.count_nonzero(severity, axis=1), 1)
        rms = np.sqrt(np.sum(offset**2, axis=1) / hit)
        return replace(faults, magnitude=rms, per_movement={OFFSET: offset})


@dataclass(frozen=True, kw_only=True)
class EncoderBias(SignedMode):
    """The position sensor has a constant error [rad], and so has the motor at every angle."""

    mode: ClassVar[str] = "encoder_bias"
    unit = "rad"
    sizes = (0.02, 0.85)
    down_to_visible = True
    name = "{motor} has a shifted zero"
    size_words = " by {size:+.1f} {unit}"
    mechanisms = ("slipped horn", "moved sensor", "lost calibration")
    advice = "Re-zero the joint and check that the horn is tight."

    magnitude: Range = PUBLISHED_ERROR_RAD

    def on_reference(
        self, faults: FaultGroup, reference: FloatArray, time: FloatArray
    ) -> FloatArray:
        """Shift the reference."""
        return reference + faults.effect(time)


@dataclass(frozen=True, kw_only=True)
class EncoderScale(SignedMode):
    """The position sensor has a scale error: the motor goes (1 + magnitude) as far from zero.

    The default range is nearly that of runs recorded in 2024 with a proportional error, with shares
    from -0.63 to 0.73.
    """

    mode: ClassVar[str] = "encoder_scale"
    unit = "ratio"
    prior_odds = 0.2
    sizes = (0.03, 0.75)  # well below 1: a motor that goes nowhere is stuck
    name = "{motor} has a wrong scale"
    size_words = " by {size:+.0f} {unit}"
    mechanisms = ("worn potentiometer track", "wrong gear ratio after a repair")
    advice = (
        "Command both ends of the range and measure the angle; replace the sensor or correct the "
        "scale."
    )
    lowest: ClassVar[float] = -1.0
    highest: ClassVar[float] = 1.0

    magnitude: Range = (0.05, 0.7)

    def on_reference(
        self, faults: FaultGroup, reference: FloatArray, time: FloatArray
    ) -> FloatArray:
        """Scale the reference about zero."""
        return reference * (1.0 + faults.effect(time))


@dataclass(frozen=True, kw_only=True)
class Drift(SignedMode):
    """The motor drifts from its target at a rate [rad/s]; the displacement remains."""

    mode: ClassVar[str] = "drift"
    unit = "rad/s"
    prior_odds = 0.2
    signature = Signature.GROWING_OFFSET
    sizes = (0.005, 0.06)
    down_to_visible = True
    name = "{motor} drifts"
    size_words = " by {size:+.2f} {unit}"
    mechanisms = ("warming position sensor", "slipping coupling", "failing holding current")
    advice = "Let the motor cool down and repeat; check the coupling for slip."

    magnitude: Range = (0.01, 0.05)

    def on_reference(
        self, faults: FaultGroup, reference: FloatArray, time: FloatArray
    ) -> FloatArray:
        """Shift the reference by the accumulated drift."""
        return reference + faults.accumulated(time)

    def settled_offset(self, size: FloatArray, arrival: Arrival) -> FloatArray:
        """Return the accumulated drift."""
        return size * arrival.since_onset


# The mode with too little stiffness: torque loss.


@dataclass(frozen=True, kw_only=True)
class TorqueLoss(SizedMode):
    """The motor loses a share of its stiffness: it sags 1 / (1 - magnitude) times as far."""

    mode: ClassVar[str] = "torque_loss"
    unit = "ratio"
    prior_odds = 0.2
    sizes = (0.25, 0.8)
    name = "{motor} weak"
    size_words = " by {size:.0f} {unit}"
    mechanisms = ("demagnetised or shorted motor", "low supply voltage", "hot motor")
    advice = "Take off the payload and repeat; measure voltage and temperature of the servo."
    highest: ClassVar[float] = 0.99
    needs_compliance: ClassVar[bool] = True
    own_reaction = Reaction.SPARE

    magnitude: Range = (0.3, 0.7)
    profiles: tuple[str, ...] = (STEP, RAMP)

    def weakness(self, faults: FaultGroup, time: FloatArray) -> FloatArray:
        """Return the share of stiffness lost."""
        return faults.effect(time)

    def amount(self, size: FloatArray) -> FloatArray:
        """Return the additional sag relative to that of a healthy motor."""
        return size / (1.0 - size)

    def size_of(self, amount: FloatArray) -> FloatArray:
        """Return the lost share of stiffness for an additional sag."""
        return amount / (1.0 + amount)


BUILT_IN: tuple[FaultMode, ...] = (
    Stuck(),
    SteadyStateError(),
    Slow(),
    Lag(),
    Backlash(),
    Drift(),
    Intermittent(),
    TorqueLoss(),
    EncoderBias(),
    EncoderScale(),
    LostCommands(),
)
"""The modes with their default distributions."""
