"""What is the case now, by all movements so far: an exact filter without a window.

A robot is healthy, or one motor has a fault that began with some movement and lasts until it is
repaired. After its onset a stuck motor depends on its held angle alone, an error on its range
alone, so the onsets need not be remembered:

    W_k(a)  <- [ (1 - rho) W_k(a)  + h lambda p_km(a) ] L_km(a)      motor k held at a
    V_kr    <- [ (1 - rho) V_kr    + h lambda p_kr    ] L_krm        motor k off, sizes of range r
    h       <- (1 - sum lambda) h  + rho (sum W + sum V)             healthy

with L the likelihood of movement m over that of a healthy robot, lambda and rho the probability of
a fault and of a repair since the movement before, all divided by their sum. A movement that was not
seen has L = 1.

Section: docs/inference.md#streams
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Fault, Hypothesis
from failuretwin.core.numerics import Weighted, log_of
from failuretwin.core.types import ArrayStruct, Axes, FloatArray, IntArray
from failuretwin.failure_behavior.mode import Signature
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.faults.fault_models import redrawn_offset_model
from failuretwin.inference.faults.fault_sizes import DENSE, SizePrior
from failuretwin.inference.faults.marginal import movement_log_likelihoods
from failuretwin.inference.faults.prior_odds import shares_of_motors
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.faults.stuck import held_prior, stuck_intervals
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.posterior import motor_of

S_PER_H = 3600.0
STEP = 0.5
"""Step between held angles, in the angle that one settled position shows of the motor."""
MOST_NODES = 1500
"""Held angles of a motor at most: of exact arms with a wide travel they lie further apart."""
LEAST = 1e-300
"""Probability below which none is kept."""
MOST_NATS = 300.0
"""Most that one movement can say for a fault or against."""
PLACES = np.array([0.1, 0.3, 0.5, 0.7, 0.9])
"""Where sizes are told of a range in which all are as likely, in its width."""


@dataclass(frozen=True)
class FaultRates:
    """How often faults come and go.

    Attributes:
        faults_per_1000_h: Faults of each motor in 1000 hours of work; assumed.
        repairs_per_1000_h: Repairs in 1000 hours with a fault; assumed: it is noticed within a few
            movements whatever stands here.
    """

    faults_per_1000_h: float = 10.0
    repairs_per_1000_h: float = 100.0

    def __post_init__(self) -> None:
        for name in ("faults_per_1000_h", "repairs_per_1000_h"):
            if not 0.0 < getattr(self, name) <= 1e5:
                raise InputError(f"{name} is {getattr(self, name):g}, expected above 0, up to 1e5.")


RATES = FaultRates()
"""What is assumed where nothing is said."""


@dataclass(frozen=True)
class FaultBelief(ArrayStruct):
    """Probabilities of what is the case, by all that was seen; they sum to 1.

    Attributes:
        healthy: h, (robot,).
        held: W of all motors one after the other, (robot, node).
        off: V of all motors one after the other, (robot, cell).
        log_predictive: Log density of the last movement given those before it, over that of a
            healthy robot, (robot,).
    """

    healthy: Annotated[FloatArray, Axes("run", empty=1.0)]
    held: Annotated[FloatArray, Axes("run", "node")]
    off: Annotated[FloatArray, Axes("run", "cell")]
    log_predictive: Annotated[FloatArray, Axes("run")]

    @property
    def log_odds(self) -> FloatArray:
        """Log odds of any fault against none, (robot,)."""
        return np.asarray(log_of(self.held.sum(axis=1) + self.off.sum(axis=1) + LEAST)) - log_of(
            self.healthy
        )


@dataclass(frozen=True)
class FaultEvidence(ArrayStruct):
    """What movements say of each fault, over what they say of a healthy robot.

    Attributes:
        held: log L of each held angle, (robot, movement, node).
        off: log L of each range of errors, (robot, movement, cell).
        begun: p(held angle | stuck since the movement before), (robot, movement, node); sums to 1
            for each motor.
        hours: Time since the movement before, (robot, movement) [h].
        healthy: Log density of each settled position if no motor is faulty, (robot, movement); 0
            where it was not seen.
    """

    held: Annotated[FloatArray, Axes("run", "movement", "node")]
    off: Annotated[FloatArray, Axes("run", "movement", "cell")]
    begun: Annotated[FloatArray, Axes("run", "movement", "node")]
    hours: Annotated[FloatArray, Axes("run", "movement")]
    healthy: Annotated[FloatArray, Axes("run", "movement")]


@dataclass(frozen=True)
class FaultFilter:
    """The filter for one kind of robot; see the module.

    Attributes:
        model: The healthy robot; its grid of held angles is that of the first.
        hypotheses: What may be the case: healthy, stuck motors and redrawn errors.
        priors: Beliefs about held angles and sizes.
        rates: How often faults come and go.

    Raises:
        InputError: If a hypothesis is none of these, or healthy is missing.
    """

    model: HealthyModel
    hypotheses: Sequence[Hypothesis]
    priors: Priors
    rates: FaultRates = RATES

    def __post_init__(self) -> None:
        known = (Signature.HELD, Signature.REDRAWN_OFFSET)
        modes = [MODES[fault.mode] for h in self.hypotheses for fault in h.faults]
        single = all(h.known and len(h.faults) < 2 for h in self.hypotheses)
        followed = single and all(mode.signature in known for mode in modes)
        if not followed or sum(h.is_healthy for h in self.hypotheses) != 1:
            raise InputError(
                f"hypotheses {', '.join(map(str, self.hypotheses))} cannot be followed from "
                "movement to movement. Expected healthy, stuck motors and steady-state errors."
            )

    def begin(self, robots: int) -> FaultBelief:
        """Return the belief that all is well."""
        return FaultBelief.empty(run=robots, node=len(self.held_of), cell=len(self._cell_of))

    def evidence(self, likelihood: RunLikelihood, since: int = 0) -> FaultEvidence:
        """Return what movements say of each fault.

        Args:
            likelihood: The movements of each robot. Of the first, what came before is the begin of
                the run.
            since: Number of the first movement that is asked for.
        """
        asked = likelihood.since(since) if since else likelihood
        healthy = asked.log_healthy[..., None]
        held, begun, off = [], [], []
        for fault, grid in zip(self._of(Signature.HELD), self._grids, strict=True):
            motor = motor_of(likelihood, fault)
            profile, step = asked.profile(motor), grid[1] - grid[0]
            blurred = float(np.hypot(profile.held_scatter, DENSE * step))
            profile = replace(profile, held_scatter=blurred)
            held.append(profile.log_density(grid[:, None], True) - healthy)
            length = stuck_intervals(likelihood, motor).length[:, since:]
            total = length.sum(axis=-1, keepdims=True)
            share = np.where(total > 0.0, length / np.where(total > 0.0, total, 1.0), 0.5)
            angle = np.broadcast_to(grid, (len(healthy), len(grid)))
            mass = held_prior(likelihood, motor, angle, self.priors.onset)[:, since:]
            begun.append((share[..., None, :] @ mass)[..., 0, :])
        for fault in self._of(Signature.REDRAWN_OFFSET):
            motor, mode = motor_of(likelihood, fault), MODES[fault.mode]
            sizes, early = self._sizes(fault), mode.before_run
            model = redrawn_offset_model(asked, motor, mode, sizes, early)
            off.append(movement_log_likelihoods(asked, model).by_cell - healthy)
        none = np.zeros((*healthy.shape[:2], 0))
        return FaultEvidence(
            np.concatenate([*held, none], axis=-1),
            np.concatenate([*off, none], axis=-1),
            np.concatenate([*begun, none], axis=-1),
            self._hours(likelihood)[:, since:],
            asked.log_healthy,
        )

    def advance(
        self,
        belief: FaultBelief,
        seen: FaultEvidence,
        movement: int,
        renewed: FloatArray | None = None,
    ) -> FaultBelief:
        """Return what is believed after one movement more.

        Args:
            belief: What was believed before it.
            seen: What movements say.
            movement: Which of them.
            renewed: Probability that the robot has been another, healthy one since the movement
                before, (robot,); None: 0.
        """
        same = np.ones(len(belief.healthy)) if renewed is None else 1.0 - renewed
        hours = seen.hours[:, movement, None]
        came = 1.0 - np.exp(-hours * self.rate_per_h)  # (robot, hypothesis)
        mended = 1.0 - np.exp(-hours[:, 0] * self.rates.repairs_per_1000_h / 1000.0)
        broken = same * (belief.held.sum(axis=1) + belief.off.sum(axis=1))
        well = same * belief.healthy + (1.0 - same)
        healthy = well * (1.0 - came.sum(axis=1)) + mended * broken
        begun = well[:, None] * came
        kept = (same * (1.0 - mended))[:, None]
        held = kept * belief.held + begun[:, self.held_of] * seen.begun[:, movement]
        off = kept * belief.off + begun[:, self._cell_of] * self._cell_share
        held = held * np.exp(np.clip(seen.held[:, movement], -MOST_NATS, MOST_NATS))
        off = off * np.exp(np.clip(seen.off[:, movement], -MOST_NATS, MOST_NATS))
        total = healthy + held.sum(axis=1) + off.sum(axis=1)
        return FaultBelief(
            np.maximum(healthy / total, LEAST),
            held / total[:, None],
            off / total[:, None],
            np.log(total),
        )

    def posterior(self, belief: FaultBelief) -> FloatArray:
        """Return the probability of each hypothesis, (robot, hypothesis)."""
        found = np.zeros((len(belief.healthy), len(self.hypotheses)))
        found[:, [h.is_healthy for h in self.hypotheses]] = belief.healthy[:, None]
        for of, values in ((self.held_of, belief.held), (self._cell_of, belief.off)):
            for k in np.unique(of):
                found[:, k] = values[:, of == k].sum(axis=1)
        return found

    def size(self, belief: FaultBelief, at: int, robot: int = 0) -> Weighted | None:
        """Return what is believed of the size of a fault; None of a healthy robot.

        Args:
            belief: What is believed.
            at: Index of its hypothesis.
            robot: Which robot.

        Returns:
            Held angles of a stuck motor [rad]; sizes of an error [rad], each range at `PLACES`.
        """
        nodes, cells = self.held_of == at, self._cell_of == at
        if nodes.any():
            return Weighted(self.held_angles[nodes], belief.held[robot, nodes])
        if not cells.any():
            return None
        ranges = np.array(self._sizes(self.hypotheses[at].faults[0]).ranges)
        inside = ranges[:, :1] + np.ptp(ranges, axis=1)[:, None] * PLACES
        share = np.repeat(belief.off[robot, cells] / len(PLACES), len(PLACES))
        return Weighted(inside.ravel(), share)

    @property
    def faults_per_h(self) -> float:
        """Faults of the whole robot in an hour."""
        return float(self.rate_per_h.sum())

    def _of(self, signature: Signature) -> list[Fault]:
        """Return the faults of one signature."""
        faults = [fault for h in self.hypotheses for fault in h.faults]
        return [fault for fault in faults if MODES[fault.mode].signature is signature]

    @cached_property
    def rate_per_h(self) -> FloatArray:
        """Rate of each fault, (hypothesis,) [1/h]: a motor's, shared by the odds of modes."""
        learned = [self.priors.factor_of(h) for h in self.hypotheses]
        return self.rates.faults_per_1000_h / 1000.0 * shares_of_motors(self.hypotheses) * learned

    @cached_property
    def _grids(self) -> list[FloatArray]:
        """Held angles of each motor that may be stuck, (node,) [rad]."""
        found = []
        robot = self.model.twin.robot
        for fault in self._of(Signature.HELD):
            motor = robot.motor_names.index(fault.motor)
            (low, high), margin = robot.travel[motor], robot.held_beyond(motor)
            width = high - low + 2.0 * margin
            count = min(MOST_NODES, int(np.ceil(width / (STEP * self.model.least_visible[motor]))))
            found.append(np.linspace(low - margin, high + margin, count + 1))
        return found

    @property
    def held_angles(self) -> FloatArray:
        """Held angle of each node, (node,) [rad]."""
        return np.concatenate([*self._grids, np.zeros(0)])

    @cached_property
    def held_of(self) -> IntArray:
        """Hypothesis of each node, (node,)."""
        own = [self._index(fault) for fault in self._of(Signature.HELD)]
        return np.repeat(np.array(own, dtype=np.int64), [len(grid) for grid in self._grids])

    @cached_property
    def _cell_of(self) -> IntArray:
        """Hypothesis of each cell, (cell,)."""
        faults = self._of(Signature.REDRAWN_OFFSET)
        own = np.array([self._index(fault) for fault in faults], dtype=np.int64)
        return np.repeat(own, [len(share) for share in self._shares])

    @cached_property
    def _cell_share(self) -> FloatArray:
        """Probability of each cell's range, (cell,)."""
        return np.concatenate([*self._shares, np.zeros(0)])

    @cached_property
    def _shares(self) -> list[FloatArray]:
        return [np.array(self._sizes(f).shares) for f in self._of(Signature.REDRAWN_OFFSET)]

    def _sizes(self, fault: Fault) -> SizePrior:
        """Return what is believed of an error's size, of the robot as it was at first."""
        motor = self.model.motor_names.index(fault.motor)
        return self.priors.sizes_of(MODES[fault.mode], self.model, motor)

    def _index(self, fault: Fault) -> int:
        return list(self.hypotheses).index(Hypothesis((fault,)))

    @staticmethod
    def _hours(likelihood: RunLikelihood) -> FloatArray:
        """Return the time from each movement's command to that of the one before, (..., m) [h]."""
        start = likelihood.evidence.movements.start
        return np.nan_to_num(np.diff(start, axis=1, prepend=0.0)) / S_PER_H
