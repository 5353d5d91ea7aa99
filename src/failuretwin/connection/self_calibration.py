"""Diagnosis of a folder that calibrates itself: no healthy logs, no labels.

What a kind of arm is like is the prior; the runs say together how this robot differs from it, each
weighed by how surely it is known what is wrong in it. What is learned is an ordinary calibration.

Section: docs/inference.md#folders
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from failuretwin.connection.calibration.observations import session_names
from failuretwin.connection.calibration.parameters import readings_of, schedule_of, timing_of
from failuretwin.connection.calibration.result import SETTLING_UNITS, Calibration, Parameter
from failuretwin.connection.calibration.timing_fit import gap_starts, lateness
from failuretwin.connection.population import Population, stated_variation
from failuretwin.core.errors import InputError, counted
from failuretwin.core.foreign import check_memory
from failuretwin.core.hypothesis import Diagnosis, Hypothesis
from failuretwin.core.movements import Movements
from failuretwin.core.progress import Progress, unseen
from failuretwin.core.runs import RunSet, check_motors, truths_of
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.readers.read import RunsLike, as_runs
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.digital_model.calibrated_robot import (
    HealthyLike,
    RobotLike,
    calibrated,
)
from failuretwin.digital_model.geometry import SensorFrame, roll_pitch_yaw
from failuretwin.digital_model.nonidealities import (
    Imperfections,
    LostCommand,
    Readings,
    Variation,
)
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import poses_in_range
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.inference.diagnoser import BayesDiagnoser
from failuretwin.inference.engine.theta import has_geometry, offsets_doubted
from failuretwin.inference.faults.prior_odds import log_prior
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.evidence import Evidence
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.on_the_way import likeliest_lag, on_the_way
from failuretwin.inference.observation.registered import (
    ORIGIN,
    REGISTRATION,
    SCALE,
    TURN,
    registered,
)
from failuretwin.inference.set_ups.set_ups import FAR_OFF, FAULT_OF_EVERY_RUN
from failuretwin.inference.together.fault_course import FaultCourse
from failuretwin.inference.together.folder_posterior import (
    FolderPosterior,
    folder_posterior,
)
from failuretwin.inference.together.mixed_runs import of_second_robot, two_robots

RUN_BYTES = 2.2e6
"""Memory that self-calibration takes for each run, by peaks of 32 and 128 runs of the ArmPi FPV and
nine hypotheses [bytes]."""
LATE_LOSSES = 4.0
"""How many times as often a movement that starts late loses its command, where nobody has counted:
a stalled bus does both; assumed."""
FRAME_OFF = 14.1
"""Squared distance of the sensor's frame from that of the profile, in deviations, from which it is
told: 95 % of seven normal numbers are nearer."""
IDENTIFIED = 0.7
"""An offset is learned where the runs narrow it to this share of the prior's deviation, or move it
as far as healthy robots hardly ever do."""
ODD = {
    "bias": f"a zero that is off, or {FAULT_OF_EVERY_RUN}",
    "compliance": "a fault that is there in every run looks like this",
    "friction": "a fault that is there in every run looks like this",
}
"""What it may mean that one is."""


@dataclass(frozen=True)
class SelfCalibration:
    """What some runs say together.

    Attributes:
        diagnoses: Of each run.
        calibration: What they teach of the robot.
        prior: Probability of each hypothesis before any run, (hypothesis,).
        taught: By how much each run has narrowed that, in the runs' order [nats].
    """

    diagnoses: Sequence[Diagnosis]
    calibration: Calibration
    prior: FloatArray
    taught: FloatArray

    @property
    def course(self) -> FaultCourse:
        """What became of the robot over the runs, if they are in their order."""
        return FaultCourse.of(self.diagnoses, self.prior)

    @property
    def remarks(self) -> tuple[str, ...]:
        """What is to be known of what was learned, in sentences."""
        return self.calibration.remarks


@dataclass(frozen=True)
class SelfCalibratingDiagnoser:
    """Diagnoses the runs of one robot together, and learns from them how it differs from its kind.

    ``SelfCalibratingDiagnoser("armpi_fpv").diagnose("logs/")`` is enough. Results are protocol P1:
    runs inform each other, though none its own prior.

    Attributes:
        robot: The robot, its name or its profile.
        population: What such robots are like: a population fitted to others of them; figures, the
            name or path of a calibration whose variation says how far this robot may differ; None:
            what arms of its class are like.
        hypotheses: What may be the case; None: the paper's classes.
        priors: Beliefs about faults and set-ups; None: the usual ones.
    """

    robot: RobotLike
    population: Population | HealthyLike = None
    hypotheses: Sequence[Hypothesis | str] | None = None
    priors: Priors | None = None

    @cached_property
    def twin(self) -> DigitalTwin:
        """Digital twin of the robot."""
        return calibrated(self.robot, self._figures or "none").twin

    @property
    def _figures(self) -> HealthyLike:
        of = self.population
        return of.imperfections if isinstance(of, Population) else of

    def diagnose(self, runs: RunsLike) -> list[Diagnosis]:
        """Return the diagnosis of each run, judged with what all the others teach.

        Raises:
            InputError: If the runs cannot be read or are of another robot.
        """
        return list(self.learn(runs).diagnoses)

    def learn(self, runs: RunsLike, advance: Progress = unseen) -> SelfCalibration:
        """Return the diagnoses, and what the runs teach of the robot.

        Args:
            runs: A run set, or any logs by their path.
            advance: Told of progress.

        Raises:
            InputError: If the runs cannot be read or are of another robot.
        """
        robot = self.twin.robot
        runs = as_runs(runs, robot)
        check_motors(runs, robot.name, robot.motor_names)
        count = runs.sizes["run"]
        check_memory(RUN_BYTES * count, "the runs", f"self-calibration by {count} runs")
        movements = Evidence(runs).settled.movements
        check_moves(movements)
        believed = self._population(runs, movements)
        bayes = BayesDiagnoser(self.twin, believed, self.hypotheses, self.priors)
        model = bayes.healthy_model
        seen = Evidence(runs, model.settings)
        evidence = on_the_way(seen.sound, model, likeliest_lag(seen.sound, model))
        likelihood = RunLikelihood(evidence, model)
        found = folder_posterior(likelihood, bayes.hypothesis_set, bayes.priors, advance)
        names, truth = [str(name) for name in runs["run"].values], truths_of(runs)
        judged = [(one, at) for one in found.posteriors for at in range(len(one.log_posterior))]
        diagnoses = [
            replace(
                posterior.to_diagnosis(at, names[run], seen.quality[run], truth[run]),
                protocol="P1",
                method=_method(robot, bool(evidence.on_the_way[run])),
            )
            for run, (posterior, at) in enumerate(judged)
        ]
        learned = as_calibration(found, believed, robot, runs)
        prior = np.exp(log_prior(bayes.hypothesis_set, bayes.priors))
        return SelfCalibration(diagnoses, learned, prior, found.taught)

    def _population(self, runs: RunSet, movements: Movements) -> Imperfections:
        """Return what such robots are like, with what the commands alone say of their timing."""
        robot = self.twin.robot
        believed = calibrated(self.robot, self._figures or generic_imperfections(robot))
        if self._figures is not None:
            return believed.imperfections
        known = with_timing_of(believed.imperfections, movements, robot, runs)
        if known.timing.late_rate <= 0.0:
            return known
        return replace(known, lost_commands=tuple(map(more_when_late, known.lost_commands)))


def learned_name(robot: Robot) -> str:
    """Return the name of a calibration that a robot's own runs teach."""
    return f"{robot.name}, self-calibrated"


def _method(robot: Robot, on_the_way: bool) -> str:
    used = "readings on the way" if on_the_way else "settled poses"
    return f"bayes, {used}; healthy behaviour: {learned_name(robot)}"


def check_moves(movements: Movements) -> None:
    """Raise InputError if no run holds a movement."""
    if movements.start.shape[1] == 0:
        raise InputError(
            "no run holds a movement: `command` never leaves its first value. Expected runs "
            "of one movement at least."
        )


def with_timing_of(
    known: Imperfections, movements: Movements, robot: Robot, runs: RunSet | None = None
) -> Imperfections:
    """Return imperfections with the late starts and the schedule that commands tell.

    The runs tell when readings stop before a late start.
    """
    late = lateness(movements)
    gaps = np.zeros(0) if runs is None else gap_starts(runs, movements, late)
    schedule = schedule_of(movements, late, robot)
    return replace(known, timing=timing_of(None, late, gaps), schedule=schedule)


def more_when_late(entry: LostCommand) -> LostCommand:
    """Return how often some motors lose a command, late movements more often."""
    return replace(entry, rate_when_late=min(LATE_LOSSES * entry.rate, 0.2))


def as_calibration(
    found: FolderPosterior, believed: Imperfections, robot: Robot, runs: RunSet
) -> Calibration:
    """Return what was learned as a calibration, which anybody may use."""
    learned = found.model.imperfections
    source = f"{counted(runs.sizes['run'], 'run')} without labels; {believed.name}"
    parameters = _parameters(found, believed, robot)
    return Calibration(
        imperfections=replace(
            learned,
            name=learned_name(robot),
            source=source,
            protocol="P1",
            readings=_readings(found.model, runs),
            variation=_variation(found),
            of_class=False,
            frames_in_doubt=has_geometry(found.model),
        ),
        parameters=tuple(parameters),
        sessions=tuple(dict.fromkeys(session_names(runs))),
        runs=runs.sizes["run"],
        movements=int(sum(p.likelihood.evidence.usable.sum() for p in found.posteriors)),
        used_readings=False,
        remarks=tuple(_remarks(parameters, found, runs)),
        frame=_frame(found),
        moments=sum(p.likelihood.evidence.moments_on_the_way for p in found.posteriors),
    )


def _readings(model: HealthyModel, runs: RunSet) -> Readings:
    """Return how the sensor sampled the runs, with its noise where nobody had measured it."""
    found = readings_of(runs, model.twin.robot, None)
    return found if model.knows_noise else replace(found, noise_m=model.path_noise)


def _frame(found: FolderPosterior) -> SensorFrame | None:
    """Return where the sensor was found to stand; None: where the profile says."""
    before = found.model.twin.robot.frame
    if not found.moved:
        return before
    turn = Rotation.from_rotvec(found.place[TURN]).as_matrix()
    x, y, z = found.place[ORIGIN].tolist()
    here = SensorFrame((x, y, z, *roll_pitch_yaw(turn)), 1.0 + float(found.place[SCALE][0]))
    return here.after(before)


def _variation(found: FolderPosterior) -> Variation:
    """Return the deviations of what was learned, as a calibration states them.

    They are those beside the frame that the calibration holds: what the two make up for is no doubt
    of where the tool comes to rest.
    """
    if not offsets_doubted(found.model):
        return found.model.imperfections.variation or Variation()
    own = np.linalg.inv(np.linalg.inv(found.covariance)[REGISTRATION:, REGISTRATION:])
    offsets = np.sqrt(np.diag(own))[: 3 * len(found.model.scatter)]
    return stated_variation(offsets, found.model.settling)


def _parameters(found: FolderPosterior, believed: Imperfections, robot: Robot) -> list[Parameter]:
    """Return every offset with its 95 % interval, and how far it lies from what such robots do."""
    if not offsets_doubted(found.model):
        return []
    motors, told = robot.motor_names, []
    for k, name in enumerate(ODD):
        values = np.asarray(getattr(found.model.settling, name))
        expected = np.asarray(getattr(believed.settling, name))
        for i, motor in enumerate(motors):
            at = REGISTRATION + k * len(motors) + i
            spread, prior = found.deviation[at], found.usual_deviation[at]
            off = float((values[i] - expected[i]) / prior)
            odd = _surprise(off, float(spread / prior)) > FAR_OFF
            note = f"{off:+.1f} deviations off what such robots do" if odd else ""
            known = bool(spread < IDENTIFIED * prior) or odd
            if not known:
                note = "the runs do not tell it from what such robots differ by"
            value, deviation = float(values[i]), float(spread)
            told.append(
                Parameter.normal(
                    name, motor, SETTLING_UNITS[name], value, deviation, known, note, off
                )
            )
    return told


def _surprise(off: float, doubt: float) -> float:
    """Return how far off a posterior mean is, in deviations of such means among healthy robots.

    Runs that narrow a prior N(0, 1) to a deviation s move the mean of a robot of its kind by a
    normal number of variance 1 - s^2. Where they hardly narrow it, s = `IDENTIFIED` counts.

    Args:
        off: The mean, in deviations of the prior.
        doubt: s, in the same.
    """
    return abs(off) / float(np.sqrt(1.0 - min(doubt, IDENTIFIED) ** 2))


def _remarks(parameters: Sequence[Parameter], found: FolderPosterior, runs: RunSet) -> list[str]:
    """Return what else is to be known of what was learned."""
    lines = [
        f"{p.name} of {p.motor}: {p.note}: {ODD[p.name]}"
        for p in parameters
        if p.identified and p.note
    ]
    lines += _set_up(found)
    names = [str(name) for name in runs["run"].values]
    second = of_second_robot(found.sites)
    if second is not None:
        lines.append(two_robots(second, names))
    most = [f"{names[i]} ({found.taught[i]:.1f} nats)" for i in np.argsort(-found.taught)[:3]]
    if most:
        lines.append(f"most was learned from {', '.join(most)}")
    lines.append(
        "a constant error that is there in every run cannot be told from the robot's own, up to "
        "what such robots differ by"
    )
    return lines


def _set_up(found: FolderPosterior) -> list[str]:
    """Return what is to be said of where the sensor stands; nothing where the profile says.

    Offsets count as those of any robot of the kind: what a turn of the frame and a bias of the
    first motor explain alike is told as a turn where such a bias would be odd.
    """
    robot, frame = found.model.twin.robot, slice(0, REGISTRATION)
    odder = found.usual_deviation**-2.0 - found.prior_deviation**-2.0
    odder[frame] = 0.0
    precision = np.linalg.inv(found.covariance)
    covariance = np.linalg.inv(precision + np.diag(odder))
    off = (covariance @ precision @ found.mean)[frame]
    if off @ np.linalg.solve(covariance[frame, frame], off) < FRAME_OFF:
        return []
    point = found.model.twin.path(poses_in_range(robot) * robot.sense)
    away = np.linalg.norm(registered(point[None], found.place[None])[0] - point, axis=1)
    origin, turn = _axes(1e3 * found.place[ORIGIN]), _axes(np.rad2deg(found.place[TURN]))
    return [
        "the sensor does not seem to stand where the profile says: the tool appears about "
        f"{1e3 * away.mean():.2g} mm off, its frame by ({origin}) mm, turned by ({turn}) deg, "
        f"scale {1e2 * found.place[SCALE][0]:+.1f} %. Offsets were learned beside that, and a "
        "calibration that is written holds both. `failuretwin robot fit` on healthy runs finds the "
        "frame more exactly"
    ]


def _axes(values: FloatArray) -> str:
    return ", ".join(f"{value:.1f}" for value in values)
