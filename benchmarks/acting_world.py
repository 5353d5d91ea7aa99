"""Arms in lockstep that are told where to go: the world of `acting.py`.

Movement by movement, on the physics engine or at rest only. All chance of an arm comes from a
generator of its own, drawn alike whatever it is told, so that strategies share their bad luck.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from failuretwin.connection.links.base import Order
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.calibrated_robot import CalibratedRobot
from failuretwin.digital_model.nonidealities import Imperfections, vary
from failuretwin.digital_model.physics.engine import LiveArms, PhysicsEngine
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import Settling, sag
from failuretwin.failure_behavior.fault import EndlessEpisodes

STEP_S = 0.01
SETTLE_S = 0.8
"""Time at rest after the longest ramp [s]."""
ONSET = 4
"""Movements before the fault begins."""
BIAS_RAD = float(np.deg2rad(0.3))
"""Unknown constant errors of arms that nobody has calibrated, their deviation [rad]."""
REPEAT_RAD = float(np.deg2rad(0.011))
"""Their scatter from movement to movement [rad]."""
ERROR_RAD = (float(np.deg2rad(2.4)), float(np.deg2rad(12.0)))
"""Random and constant errors, 10 to 50 counts of 0.24 deg [rad]."""
SCALE = (0.1, 0.6)
MODES = {
    "healthy": "",
    "stuck": "stuck",
    "random": "steady_state_error",
    "bias": "encoder_bias",
    "scale": "encoder_scale",
    "torque": "torque_loss",
    "lost": "lost_commands",
    "drift": "drift",
    "intermittent": "intermittent",
}
STOPS_AFTER = 12
"""Movements that an intermittent motor still makes before it stops for good."""
EPISODE_S = (0.5, 2.0)
"""Lengths of the times in which an intermittent motor is held [s]."""


@dataclass(frozen=True)
class TrueFault:
    """The fault of one arm: a kind of `MODES` at a motor; size in the unit of its mode.

    Random errors without a size are drawn from `World.errors`.
    """

    kind: str
    motor: int = 0
    size: float = np.nan


@dataclass
class World:
    """Arms in lockstep, one movement at a time."""

    known: CalibratedRobot
    faults: Sequence[TrueFault]
    seed: int
    engine: str
    redrawn_at_rest: bool = False
    onset: int = ONSET
    errors: tuple[float, float] = ERROR_RAD
    count: int = 0
    lost: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=bool))

    def __post_init__(self) -> None:
        robot, n = self.known.robot, len(self.faults)
        self.robot, self.m = robot, len(robot.motors)
        self.twin = self.known.twin
        self.rngs = [np.random.default_rng([self.seed, i]) for i in range(n)]
        self.own = [self._own(rng) for rng in self.rngs]
        self.settling = [own.settling or Settling.ideal(self.m) for own in self.own]
        self.bias, self.friction, self.scatter, self.compliance = (
            np.array([getattr(s, name) for s in self.settling])
            for name in ("bias", "friction", "scatter", "compliance")
        )
        self.commanded = self.home = np.tile(home_of(robot), (n, 1))
        self.base = self.home + self.bias
        self.error = np.zeros(n)
        self.held = np.full(n, np.nan)
        self.time_s = self.struck_s = 0.0
        self.episodes: list[EndlessEpisodes | None] = [None] * n
        if any(f.kind == "intermittent" for f in self.faults) and self.engine != "physics":
            raise SystemExit("an intermittent motor is held on its way: use --engine physics")
        if self.engine == "physics":
            self.arms = LiveArms(PhysicsEngine(robot), self.base, STEP_S, np.zeros(n))
            self.angle = self.arms.angle
        else:
            self.angle = self._rest(np.zeros((n, self.m), dtype=bool))

    def _own(self, rng: np.random.Generator) -> Imperfections:
        """Return what this very arm is like."""
        figures = self.known.imperfections
        if self.robot.imperfections_file is not None:
            return vary(figures, rng)
        zero = (0.0,) * self.m
        settling = Settling(
            tuple(BIAS_RAD * rng.standard_normal(self.m)), zero, zero, (REPEAT_RAD,) * self.m, 4.0
        )
        return replace(figures, settling=settling, lost_commands=(), variation=None)

    def move(self, orders: Sequence[Order]) -> FloatArray:
        """Carry out an order of each arm; return where the tools are seen at rest, (arm, 3)."""
        self.count += 1
        target = np.array([order.target for order in orders])
        ramp = np.array([order.duration for order in orders])
        still = np.abs(target - self.commanded) < 1e-9
        aim, scatter, held = target.copy(), np.empty_like(target), np.zeros(target.shape, bool)
        self.lost = np.zeros(target.shape, dtype=bool)
        weak = np.zeros(target.shape)
        noise = np.zeros((len(target), 3))
        for i, rng in enumerate(self.rngs):
            dof = self.settling[i].tail_dof
            scatter[i] = (
                rng.standard_normal(self.m) if np.isinf(dof) else rng.standard_t(dof, self.m)
            )
            self._lose(i, rng.random())
            noise[i] = rng.standard_normal(3)
            luck = rng.random(3)
            if self.count > self.onset:
                self._strike(i, luck, aim, held, weak, still)
        if self.count <= self.onset:
            self.struck_s = self.time_s
        scatter *= self.scatter
        # The engine knows the play of gears only of robots whose figures it was fitted to.
        fitted = bool(self.robot.profile.physics)
        friction = 0.0 if self.engine == "physics" and fitted else self.friction
        new = aim + self.bias - friction * np.sign(target - self.commanded) + scatter
        keeps = still if not self.redrawn_at_rest else np.zeros_like(still)
        new = np.where(keeps | self.lost, self.base, new)
        self.commanded = np.where(self.lost, self.commanded, target)
        before, self.base = self.base, new
        period = float(ramp.max()) + SETTLE_S
        self.time_s += period
        if self.engine == "physics":
            self._drive(before, ramp, period, held, weak)
        else:
            self.angle = self._rest(held, weak)
        return self._seen(noise)

    def _lose(self, i: int, chance: float) -> None:
        below, names = 0.0, self.robot.motor_names
        for entry in self.own[i].lost_commands:
            if below <= chance < below + entry.rate:
                self.lost[i, [names.index(motor) for motor in entry.motors]] = True
            below += entry.rate

    def _strike(
        self,
        i: int,
        luck: FloatArray,
        aim: FloatArray,
        held: BoolArray,
        weak: FloatArray,
        still: BoolArray,
    ) -> None:
        """Let the fault of an arm act on what it is told."""
        fault = self.faults[i]
        k = fault.motor
        if fault.kind == "stuck" or self._stops(i):
            self.held[i] = self.angle[i, k] if np.isnan(self.held[i]) else self.held[i]
            held[i, k] = True
        elif fault.kind == "random":
            if self.redrawn_at_rest or not still[i, k] or self.error[i] == 0.0:
                sign = 1.0 if luck[0] < 0.5 else -1.0
                drawn = self.errors[0] + luck[1] * (self.errors[1] - self.errors[0])
                self.error[i] = sign * (drawn if np.isnan(fault.size) else fault.size)
            aim[i, k] += self.error[i]
        elif fault.kind == "torque":
            weak[i, k] = fault.size
        elif fault.kind == "lost":
            self.lost[i, k] |= luck[2] < fault.size
        else:
            aim[i, k] += self._constant(fault, float(aim[i, k]))

    def _constant(self, fault: TrueFault, aim: float) -> float:
        """Return the offset of a fault that chance has no part in [rad]."""
        by_kind = {"bias": 1.0, "scale": aim, "drift": self.time_s - self.struck_s}
        return fault.size * by_kind[fault.kind] if fault.kind in by_kind else 0.0

    def _stops(self, i: int) -> bool:
        """Return whether a motor that stuck now and then has stopped for good; begin its times."""
        fault = self.faults[i]
        if fault.kind != "intermittent":
            return False
        if self.episodes[i] is None:
            chance = np.random.default_rng([self.seed, i, 7])
            self.episodes[i] = EndlessEpisodes(self.time_s, fault.size, EPISODE_S, chance)
        return self.count > self.onset + STOPS_AFTER

    def _rest(self, held: BoolArray, weak: FloatArray | None = None) -> FloatArray:
        give = self.compliance / (1.0 - (0.0 if weak is None else weak))
        stand = np.where(held, self.held[:, None], self.base)
        near = stand
        for _ in range(3):
            near = np.where(held, stand, self.base + sag(self.robot, near, give, 0.0))
        return near

    def _drive(
        self,
        before: FloatArray,
        ramp: FloatArray,
        period: float,
        held: BoolArray,
        weak: FloatArray,
    ) -> None:
        """Let the physics engine carry the movement out."""
        t = np.arange(1, round(period / STEP_S) + 1)[None, :, None] * STEP_S
        share = np.clip(t / ramp[:, None], 0.0, 1.0)
        reference = before[:, None] + share * (self.base - before)[:, None]
        steps = reference.shape[1]
        sticks = self._sticks(np.asarray(t[0, :, 0] + self.time_s - period))
        stops = np.repeat(held[:, None], steps, axis=1) | sticks
        brake = stops if stops.any() else None
        weakness = np.repeat(weak[:, None], steps, axis=1) if weak.any() else None
        self.angle = self.arms.follow(reference, brake, weakness)[:, -1]

    def _sticks(self, time: FloatArray) -> BoolArray:
        """Return when which intermittent motor is held, (arm, time, motor)."""
        found = np.zeros((len(self.faults), len(time), self.m), dtype=bool)
        for i, endless in enumerate(self.episodes):
            if endless is not None:
                for start, end in endless.within(float(time[0]), float(time[-1])):
                    found[i, :, self.faults[i].motor] |= (start <= time) & (time < end)
        return found

    def _seen(self, noise: FloatArray) -> FloatArray:
        readings, angle = self.known.imperfections.readings, self.angle
        if readings is not None and readings.whole_counts:
            units = self.robot.servo_units
            angle = units.to_rad(np.round(units.to_counts(angle)))
        noise_m = 0.0005 if readings is None else readings.noise_m
        return self.twin.path(angle) + noise_m * noise

    @property
    def tool(self) -> FloatArray:
        """Where the tools really are, (arm, 3) [m]."""
        return self.twin.path(self.angle)


def home_of(robot: Robot) -> FloatArray:
    """Return where arms start: at zero, or as near to it as their usual movements come."""
    return np.array([float(np.clip(0.0, *motor.movement_range)) for motor in robot.motors])
