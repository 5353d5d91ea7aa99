"""By how many nats what is true beats every other hypothesis, if nothing is left to chance.

    D(h) = max over m0, z of E log p(e | truth, m0, z) - max over m0, z of E log p(e | h, m0, z)

The truth of each run is made again without scatter, losses and glitches, seen where the run was
seen, and laid beside the best member of every hypothesis, in units of the declared scatter.

Runs that hardly rest are judged by moments on the way, as recorded ones are: D is then the
difference of their log evidence, and sums over sizes, onsets and all that is unknown of the robot.

Section: docs/isolability.md#method
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Hypothesis, paper_hypotheses, parse_hypotheses
from failuretwin.core.movements import Movements, find_movements
from failuretwin.core.numerics import log_of
from failuretwin.core.runs import check_motors, check_runs
from failuretwin.core.types import BoolArray, FloatArray, IntArray, as_floats
from failuretwin.data_knowledge.signals import noise_free_path
from failuretwin.digital_model.nonidealities import Imperfections
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.failure_behavior.fault import FaultValue
from failuretwin.failure_behavior.injection import Injection, replayed
from failuretwin.failure_behavior.mode import Signature
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.engine.registration import evidence_at_once
from failuretwin.inference.faults.marginal import change_points, movement_log_likelihoods
from failuretwin.inference.faults.missed_movements import log_densities
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.movements.joint_likelihood import JointLikelihood, movement_likelihoods
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.evidence import Evidence, SettledEvidence, TransientSamples
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.on_the_way import (
    CURVED_RAD,
    hardly_rest,
    likeliest_lag,
    on_the_way,
)
from failuretwin.inference.observation.readings import measured_samples
from failuretwin.inference.posterior import (
    check_diagnosable,
    fault_model_of,
    motor_of,
)

if TYPE_CHECKING:
    import xarray as xr

# How well the best member of a hypothesis fits: the best size, held angle or range of errors.


def first_affected(movements: Movements, onset: FloatArray) -> BoolArray:
    """Return with which movements the effects of a fault may begin, (run, movement).

    The one under way at the onset, or the next: some faults act at once, others on the next
    command.

    Args:
        movements: Movements of the runs.
        onset: Onset of the fault, (run,) [s]; NaN or before the first movement: the first.
    """
    count = np.sum(movements.start <= np.nan_to_num(onset)[:, None], axis=1, keepdims=True)
    under_way = np.maximum(count - 1, 0)
    number = np.arange(movements.start.shape[1])
    next_one = (count > 0) & (number == under_way + 1) & movements.exists
    return np.asarray((number == under_way) | next_one)


def max_likelihood(
    likelihood: RunLikelihood, hypothesis: Hypothesis, priors: Priors, first: BoolArray
) -> FloatArray:
    """Return max over m0, z of log p(e | m0, z), of the best member of a hypothesis, (run,).

    Args:
        likelihood: The runs.
        hypothesis: Healthy or one fault.
        priors: Ranges of sizes that are considered.
        first: Movements with which the effects of the fault may begin, (run, movement).
    """
    if hypothesis.is_healthy:
        return np.asarray((likelihood.log_healthy + likelihood.log_transient).sum(axis=1))
    fault = hypothesis.faults[0]
    log_first = log_of(first)[..., None]
    if MODES[fault.mode].signature is Signature.MISSED:
        chain = log_densities(likelihood, motor_of(likelihood, fault), fault.mode)[:, -1]
        return np.asarray((chain + log_first).max(axis=(1, 2)))
    fault_model = fault_model_of(likelihood, fault, priors)
    says = movement_log_likelihoods(likelihood, fault_model)
    possible = log_first + log_of(np.isfinite(fault_model.log_prior))
    healthy = likelihood.log_healthy + likelihood.log_transient
    return change_points(healthy, says.by_cell + says.way, possible).max(axis=(1, 2))


# Noise-free runs as they are weighed on average: what a distance is expected to cost.

MOST_NATS = 40.0
"""What one movement counts at most [nats]: about what a tool that may be anywhere costs."""


def expected_distance_factor(dof: float) -> float:
    """Return the factor on squared distances that makes noise-free falls expected ones.

    Of a 3-variate Student t the log density falls by (dof + 3)/2 log(1 + d2/dof) from its centre.
    Shifted by d, it loses (dof + 3)/2 log(1 + d2/(dof + 5)) on average over its own scatter:
    exactly so for small d, by Fisher's information, and within half a nat for any.

    Args:
        dof: Degrees of freedom; infinite: normal.
    """
    return 1.0 if np.isinf(dof) else dof / (dof + 5.0)


def expected_run_likelihood(
    evidence: SettledEvidence, model: HealthyModel, moving: TransientSamples | None
) -> RunLikelihood:
    """Return noise-free runs with densities that are expected ones, relative to a perfect fit.

    Every hypothesis has the scatter of the healthy robot, also at a motor that is held, so that
    the tool's place counts alone; a command that arrives counts as certain. The tool of a healthy
    robot strays along the circle of the motor that strays, not along its tangent: so that of the
    motor counts that explains the position best.

    Args:
        evidence: Settled positions of runs without noise.
        model: The healthy robot and its scatter.
        moving: Readings on the way; None: they are left aside.
    """
    found = movement_likelihoods(evidence, model)
    log_weight = found.outcomes.log_weight - found.outcomes.log_weight[..., :1]
    profiles = tuple(_expected(profile, log_weight) for profile in found.profiles)
    says = [p.log_density(p.expected[:, :, None], False)[..., 0] for p in profiles]
    expected = replace(found, profiles=profiles)
    return RunLikelihood(evidence, model, moving, remembered=expected, healthy=np.max(says, axis=0))


def _expected(profile: JointLikelihood, log_weight: FloatArray) -> JointLikelihood:
    """Return what each movement is expected to say of a motor, whether it is held or not."""
    factor = expected_distance_factor(profile.dof)
    own = 1.0 + profile.scatter**2 * profile.precision
    return replace(
        profile,
        precision=profile.precision / own * factor,
        min_distance2=profile.min_distance2 * factor,
        log_weight=log_weight,
        scatter=0.0,
        held_scatter=0.0,
        outlier=-MOST_NATS,
    )


CHUNK_RUNS = 64
"""Runs at a time: keeps the work on nodes in about 100 MB."""


@dataclass(frozen=True)
class LogBayesFactors:
    """How far the truth of some runs is ahead of each hypothesis.

    Attributes:
        hypotheses: The hypotheses.
        truth: What is true of each run, among them or not.
        nats: By how much the truth is expected to beat each, (run, hypothesis) [nats]; 0 for
            itself.
    """

    hypotheses: tuple[Hypothesis, ...]
    truth: tuple[Hypothesis, ...]
    nats: FloatArray

    @property
    def nearest(self) -> FloatArray:
        """By how much the truth beats the nearest other hypothesis, (run,) [nats]."""
        own = np.array([[h == truth for h in self.hypotheses] for truth in self.truth])
        return np.asarray(np.where(own, np.inf, self.nats).min(axis=1))


@dataclass(frozen=True)
class ExpectedLogBayesFactor:
    """Lays noise-free runs beside every hypothesis.

    Attributes:
        model: The healthy robot and its scatter.
        hypotheses: What may be the case: healthy or single faults.
        priors: Ranges of sizes that are considered.
    """

    model: HealthyModel
    hypotheses: tuple[Hypothesis, ...]
    priors: Priors

    def __post_init__(self) -> None:
        for hypothesis in self.hypotheses:
            if not hypothesis.known or len(hypothesis.faults) > 1:
                raise InputError(
                    f"'{hypothesis}' cannot be laid beside others. Expected healthy or one fault."
                )
            check_diagnosable(hypothesis)

    def fits(
        self, runs: xr.Dataset, faults: Sequence[Sequence[FaultValue]], onset: FloatArray
    ) -> FloatArray:
        """Return how well the best member of each hypothesis fits, (run, hypothesis) [nats].

        Args:
            runs: Runs as commanded, with readings where the tool is seen.
            faults: The true faults of each run.
            onset: When faults begin in each run, (run,) [s]; NaN: before it.
        """
        parts = [
            self._fits(
                runs.isel(run=slice(at, at + CHUNK_RUNS)),
                faults[at : at + CHUNK_RUNS],
                onset[at : at + CHUNK_RUNS],
            )
            for at in range(0, len(faults), CHUNK_RUNS)
        ]
        return np.concatenate(parts)

    def _fits(
        self, runs: xr.Dataset, faults: Sequence[Sequence[FaultValue]], onset: FloatArray
    ) -> FloatArray:
        evidence = self._evidence(self.noise_free(runs, faults))
        hardly = hardly_rest(evidence, self.model)
        found = np.empty((len(hardly), len(self.hypotheses)))
        rest, move = np.flatnonzero(~hardly), np.flatnonzero(hardly)
        if len(rest):
            found[rest] = self._fits_at_rest(evidence, onset, rest)
        if len(move):
            found[move] = self._fits_moving(runs.isel(run=move), [faults[i] for i in move.tolist()])
        return found

    def hardly_rest(self, runs: xr.Dataset) -> bool:
        """Return whether the healthy robot hardly rests in any of the runs."""
        healthy = self.noise_free(runs, [[] for _ in range(runs.sizes["run"])])
        return bool(hardly_rest(self._evidence(healthy), self.model).any())

    def _evidence(self, runs: xr.Dataset) -> Evidence:
        return Evidence(runs, self.model.settings, self.model.sensors)

    def _fits_at_rest(self, evidence: Evidence, onset: FloatArray, rows: IntArray) -> FloatArray:
        """Return how well the best member of each hypothesis fits some runs that rest."""
        settled = evidence.settled[rows]
        moving = evidence.transient[rows] if self._needs_way else None
        likelihood = expected_run_likelihood(settled, self.model, moving)
        first = first_affected(settled.movements, onset[rows])
        return np.stack(
            [max_likelihood(likelihood, h, self.priors, first) for h in self.hypotheses], axis=1
        )

    def _fits_moving(self, runs: xr.Dataset, faults: Sequence[Sequence[FaultValue]]) -> FloatArray:
        """Return the log evidence of each hypothesis by moments on the way."""
        evidence = self._evidence(self.noise_free(runs, faults, curves=True))
        seen = on_the_way(evidence, self.model, likeliest_lag(evidence, self.model))
        return evidence_at_once(RunLikelihood(seen, self.model), self.hypotheses, self.priors)

    def noise_free(
        self, runs: xr.Dataset, faults: Sequence[Sequence[FaultValue]], curves: bool = False
    ) -> xr.Dataset:
        """Return the runs as they would be seen if nothing were left to chance.

        With `curves` the motors go along commands that are no ramps, without a rest in between.
        """
        twin, time = self.model.twin, as_floats(runs["time"].values)
        movements = commanded(runs)
        if curves:
            movements, faults = _along_curves(runs, movements, faults)
        path = noise_free_path(
            twin,
            self.model.imperfections,
            movements,
            time,
            Injection(faults, twin.robot.motor_names, MODES),
        )
        seen = measured_samples(runs).seen[..., None]
        return runs.assign(measured=(("run", "time", "axis"), np.where(seen, path, np.nan)))

    @property
    def _needs_way(self) -> bool:
        """Whether the way counts: only of faults that show there, if the timing is known."""
        modes = [MODES[fault.mode] for h in self.hypotheses for fault in h.faults]
        on_way = any(mode.signature is Signature.TRANSIENT for mode in modes)
        return on_way and self.model.knows_timing


KNOT_S = 0.04
"""Time between the corners of lines that stand for a command that is no ramp [s]."""


def _along_curves(
    runs: xr.Dataset, told: Movements, faults: Sequence[Sequence[FaultValue]]
) -> tuple[Movements, Sequence[Sequence[FaultValue]]]:
    """Return movements that go where runs were told to go, and faults with values for each.

    A curve is one movement of the run set. Here it is many short ramps, which share what a fault
    draws for the movement.
    """
    time, command = as_floats(runs["time"].values), as_floats(runs["command"].values)
    if np.abs(told.reference(time) - command).max(initial=0.0) <= CURVED_RAD:
        return told, faults
    step = max(1, round(KNOT_S / (time[1] - time[0])))
    knots = command[:, ::step]
    start = np.broadcast_to(time[::step][:-1], (len(knots), knots.shape[1] - 1))
    lasts = np.full(knots[:, 1:].shape, step * (time[1] - time[0]))
    number = np.stack(
        [
            np.searchsorted(own[np.isfinite(own)], at, side="right") - 1
            for own, at in zip(told.start, start, strict=True)
        ]
    )
    number = np.maximum(number, 0)
    return Movements(knots[:, 0], knots[:, 1:], lasts, np.array(start)), [
        [_of_parts(fault, number[run]) for fault in group] for run, group in enumerate(faults)
    ]


def _of_parts(fault: FaultValue, number: IntArray) -> FaultValue:
    """Return a fault with a value for each part of its movements, of which the number is given."""
    return replace(
        fault, per_movement={name: values[number] for name, values in fault.per_movement.items()}
    )


def commanded(runs: xr.Dataset) -> Movements:
    """Return the movements of a run set: as it tells them, else as `command` shows them."""
    names = ("target", "ramp_duration", "movement_start")
    command = as_floats(runs["command"].values)
    if all(name in runs for name in names):
        return Movements(command[:, 0], *(as_floats(runs[name].values) for name in names))
    return find_movements(command, as_floats(runs["time"].values))


def expected_log_bayes_factors(
    twin: DigitalTwin,
    runs: xr.Dataset,
    imperfections: Imperfections | None = None,
    hypotheses: Sequence[Hypothesis | str] | None = None,
    priors: Priors | None = None,
) -> LogBayesFactors:
    """Return by how much the truth of simulated runs is expected to beat each hypothesis.

    Args:
        twin: Digital twin of the robot.
        runs: A run set with its truth (`fault`, `fault_detail`, `onset`), of the modes as they
            come.
        imperfections: The declared scatter and chance of the robot that the runs are of; without
            lost commands, scatter alone counts. None: as its profile says.
        hypotheses: What the truth is laid beside: healthy and single faults, as `Hypothesis` or
            in the text form; None: the paper's.
        priors: Ranges of sizes that are considered; None: the default.

    Raises:
        InputError: If the truth is not told, or a run has several faults at once.
    """
    check_runs(runs, "the run set")
    check_motors(runs, twin.robot.name, twin.robot.motor_names)
    truth, faults = truth_and_faults(runs)
    motors = twin.robot.motor_names
    asked = paper_hypotheses(motors) if hypotheses is None else parse_hypotheses(hypotheses, motors)
    model = HealthyModel.of(twin, imperfections)
    everything = tuple(dict.fromkeys((*asked, *truth)))
    judge = ExpectedLogBayesFactor(model, everything, priors or Priors())
    fit = judge.fits(runs, faults, as_floats(runs["onset"].values))
    own = fit[np.arange(len(truth)), [everything.index(h) for h in truth]]
    return LogBayesFactors(asked, truth, own[:, None] - fit[:, : len(asked)])


def truth_and_faults(
    runs: xr.Dataset,
) -> tuple[tuple[Hypothesis, ...], list[list[FaultValue]]]:
    """Return what is true of each run, and its faults as they strike it.

    Raises:
        InputError: If the run set does not tell.
    """
    for name in ("fault", "fault_detail", "onset"):
        if name not in runs:
            raise InputError(
                f"the run set does not tell its truth: no variable `{name}`. Expected simulated "
                "runs, such as `failuretwin simulate` writes."
            )
    truth = tuple(Hypothesis.parse(str(name)) for name in runs["fault"].values)
    details = [json.loads(str(text)) for text in runs["fault_detail"].values]
    return truth, [[replayed(fault) for fault in detail["faults"]] for detail in details]
