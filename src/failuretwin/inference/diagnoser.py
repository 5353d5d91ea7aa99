"""Bayesian diagnosis: which hypothesis explains where the tool went, and how surely.

    runs -> Evidence -> RunLikelihood -> run_posterior -> Diagnosis of each run

Section: docs/inference.md#posterior
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeGuard

import numpy as np

from failuretwin.core.errors import InputError, unknown_name
from failuretwin.core.hypothesis import Diagnosis, Hypothesis, paper_hypotheses, parse_hypotheses
from failuretwin.core.runs import check_motors, check_runs, truths_of
from failuretwin.core.types import BoolArray
from failuretwin.data_knowledge.readers.read import RunsLike, as_runs
from failuretwin.digital_model.arm_classes import class_name as arm_class_of
from failuretwin.digital_model.calibrated_robot import HealthyLike, RobotLike, calibrated
from failuretwin.digital_model.nonidealities import Imperfections
from failuretwin.digital_model.sensors import Encoders
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.inference.explanation import worded
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.observation.computed_tool import is_computed
from failuretwin.inference.observation.evidence import TransientSamples
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.on_the_way import beside
from failuretwin.inference.observation.sensors import SensorStack, parse_sensing, sensing_of
from failuretwin.inference.posterior import (
    check_diagnosable,
    shows_in_transients,
)
from failuretwin.inference.prepared import PART_RUNS, PreparedDiagnoser, parts_of, spread
from failuretwin.inference.seen_runs import SeenRuns

if TYPE_CHECKING:
    import xarray as xr

OF_ENCODERS = ("encoder_bias", "encoder_scale")
"""Faults that make the reading of a motor wrong."""


@dataclass(frozen=True, init=False)
class BayesDiagnoser:
    """Posterior over hypotheses from where the tool settled in a run, and how it got there.

    ``BayesDiagnoser("armpi_fpv").diagnose("runs.nc")`` is enough.

    Attributes:
        twin: Digital twin of the robot.
        imperfections: How the healthy robot differs from it; None: as its profile says.
        hypotheses: What may be the case, as `Hypothesis` or in its text form, such as
            ``["healthy", "motor_1:stuck", "unknown"]``, with the prior odds of their fault modes;
            None: the paper's classes. A single one is always certain.
        priors: Beliefs about onset and size.
        whole_run: Whether readings on the way count beside settled poses, where it is known how
            late this robot starts to move.
        sensing: Sensors that are believed, such as ``accelerometer`` or ``tool+encoders``; None:
            the tool's position where runs have it, else what they have. Runs of one or two motors
            that hardly rest are judged by the motors' readings if the path is computed from these.

    Raises:
        InputError: If a hypothesis cannot be read or weighed, names a motor that the robot does
            not have, or is given twice, or none is given; or if there is no such sensor.
    """

    twin: DigitalTwin
    imperfections: Imperfections | None
    hypotheses: Sequence[Hypothesis | str] | None
    priors: Priors
    whole_run: bool
    sensing: str | None

    def __init__(
        self,
        twin: RobotLike,
        imperfections: HealthyLike = None,
        hypotheses: Sequence[Hypothesis | str] | None = None,
        priors: Priors | None = None,
        whole_run: bool = True,
        sensing: str | None = None,
    ) -> None:
        """Take values or their text form.

        Args:
            twin: The robot: a twin, a calibrated robot, a robot, its name or its profile.
            imperfections: Figures, or the name or path of a calibration, whose servo loops count
                too; None: as the profile says.
            hypotheses: None: the paper's classes.
            priors: None: the usual ones.
            whole_run: Whether readings on the way count.
            sensing: Sensors that are believed.
        """
        if not (isinstance(twin, DigitalTwin) and _are_figures(imperfections)):
            known = calibrated(twin, imperfections)
            twin, imperfections = known.twin, known.imperfections
        values = (twin, imperfections, hypotheses, priors or Priors(), whole_run, sensing)
        for entry, value in zip(fields(self), values, strict=True):
            object.__setattr__(self, entry.name, value)
        for hypothesis in self.hypothesis_set:
            check_diagnosable(hypothesis)
        if sensing is not None:
            parse_sensing(sensing)

    @cached_property
    def hypothesis_set(self) -> Sequence[Hypothesis]:
        """What may be the case."""
        motors = self.twin.robot.motor_names
        if self.hypotheses is None:
            return paper_hypotheses(motors)
        return parse_hypotheses(self.hypotheses, motors)

    @cached_property
    def healthy_model(self) -> HealthyModel:
        """What a healthy run looks like, by the position of the tool if nothing else is said."""
        model = HealthyModel.of(self.twin, self.imperfections)
        return model if self.sensing is None else model.seen_by(parse_sensing(self.sensing))

    @cached_property
    def uses_transients(self) -> bool:
        """Whether readings on the way count."""
        return self.whole_run and self.healthy_model.knows_timing

    def transient_mask(self, usable: BoolArray, sensors: SensorStack | None = None) -> BoolArray:
        """Return the movements whose readings on the way count, (run, movement).

        Where a motor settled says all about most faults, and more reliably, so readings on the
        way count beside it only where some hypothesis or some motor shows nowhere else, or where
        that was not seen.

        Args:
            usable: Movements with a settled point, (run, movement).
            sensors: What is believed; None: the tool's position alone.
        """
        if sensors and not sensors.tells_all_at_rest:
            return np.ones_like(usable)
        if any(shows_in_transients(hypothesis) for hypothesis in self.hypothesis_set):
            return np.ones_like(usable)
        unseen = ~usable
        unseen[:, 1:] |= unseen[:, :-1]  # what follows tells where it ended
        return unseen

    def diagnose(self, runs: RunsLike) -> list[Diagnosis]:
        """Return the diagnosis of each run of a run set, or of any logs by their path.

        Reads `command` and the sensors that are believed alone; the truth, where there is any, is
        only passed on.

        Raises:
            InputError: If the run set is of another robot, holds no readings of a sensor that is
                to be believed, or no run holds a movement.
        """
        runs = as_runs(runs, self.twin.robot)
        self.check(runs)
        count = runs.sizes["run"]
        if count <= PART_RUNS:
            return self.prepare(runs).diagnose(runs)
        prepared = self.prepare(runs.isel(run=spread(count)))
        parts = (runs.isel(run=slice(part.start, part.stop)) for part in parts_of(count))
        return [diagnosis for part in parts for diagnosis in prepared.diagnose(part)]

    def prepare(self, sample: xr.Dataset) -> PreparedDiagnoser:
        """Return a diagnoser of a run set whose set-up is judged by some of its runs.

        Args:
            sample: These runs: those of `spread`, of a set of any size.

        Raises:
            InputError: As `diagnose` does.
        """
        seen = self.seen(sample)
        if self._motors_tell_more(seen):
            seen = self._seen_by(sample, (Encoders.kind,))
        return PreparedDiagnoser(seen, self._moving)

    def seen(self, runs: xr.Dataset) -> SeenRuns:
        """Return runs as this diagnoser sees them, set up as told; raises as `diagnose` does."""
        self.check(runs)
        return self._seen_by(runs, sensing_of(runs, self.sensing))

    def _seen_by(self, runs: xr.Dataset, sensing: tuple[str, ...]) -> SeenRuns:
        model = self.healthy_model.seen_by(sensing)
        self._check_shown(model)
        found = SeenRuns(runs, model, self.hypothesis_set, self.priors, self.whole_run)
        if found.evidence.sound.settled.movements.start.shape[1] == 0:
            raise InputError(
                "no run holds a movement: `command` never leaves its first value. Expected runs "
                "of one movement at least."
            )
        return found

    def _motors_tell_more(self, seen: SeenRuns) -> bool:
        """Return whether runs that hardly rest are judged by the readings of the motors.

        They are where fewer motors than it has axes move a tool path that is computed from them: it
        lies on a curve without noise, and the engine, which is linear, would take what the curve
        bends away for the sensor's. Not where the readings themselves may be wrong.
        """
        if self.sensing is not None or len(self.twin.robot.motors) >= seen.model.sensors.dims:
            return False
        if any(fault.mode in OF_ENCODERS for h in self.hypothesis_set for fault in h.faults):
            return False
        moving = seen.settled.on_the_way
        return bool(2 * moving.sum() > len(moving)) and is_computed(seen.runs, self.twin)

    def _moving(self, seen: SeenRuns) -> TransientSamples | None:
        """Return the readings on the way that count; None: none do."""
        sound = seen.evidence.sound
        if not (self.uses_transients and sound.settled.usable.shape[1]):
            return None
        moving = beside(sound.transient, seen.settled)
        return moving.where(self.transient_mask(seen.settled.usable, seen.model.sensors))

    def _check_shown(self, model: HealthyModel) -> None:
        """Refuse faults that say that a sensor which is believed is wrong."""
        for fault in {fault for h in self.hypothesis_set for fault in h.faults}:
            if fault.mode in OF_ENCODERS and Encoders.kind in model.sensing:
                raise InputError(
                    f"'{fault}' is a fault of the motor's own reading, which is believed (sensing "
                    f"{'+'.join(model.sensing)}). Leave out encoders, or that fault."
                )

    def check(self, runs: xr.Dataset) -> None:
        """Raise InputError unless a run set is one of this robot, and holds the known onset."""
        check_runs(runs, "the run set")
        check_motors(runs, self.twin.robot.name, self.twin.robot.motor_names)
        known, end = self.priors.onset.known_s, float(runs["time"].values[-1])
        if known is not None and known > end:
            raise InputError(f"the onset is given as {known:g} s, but the runs end at {end:g} s.")


def _are_figures(healthy: HealthyLike) -> TypeGuard[Imperfections | None]:
    """Return whether nothing has to be loaded: with a twin, None leaves its robot as it is."""
    return healthy is None or isinstance(healthy, Imperfections)


def diagnose(
    runs: RunsLike,
    robot: RobotLike = "armpi_fpv",
    calibration: HealthyLike = None,
    hypotheses: Sequence[Hypothesis | str] | None = None,
    priors: Priors | None = None,
    sensing: str | None = None,
) -> list[Diagnosis]:
    """Diagnose runs in one call; see `BayesDiagnoser` for more.

    Args:
        runs: A run set, or the path of anything that `read_runs` reads.
        robot: The robot, its name or its profile.
        calibration: What `calibrate` learned of it, by name or path; None: what its profile names.
        hypotheses: What may be the case; None: the paper's nine classes.
        priors: Beliefs about onset and size; None: the usual ones.
        sensing: Sensors to believe, such as ``accelerometer`` or ``tool+encoders``; None: the
            tool's position where runs have it, else what they have; ``encoders`` only as
            `BayesDiagnoser` says.

    Raises:
        InputError: If something cannot be read, or does not fit together.
    """
    diagnoser = BayesDiagnoser(robot, calibration, hypotheses, priors, sensing=sensing)
    return diagnoser.diagnose(runs)


# What every diagnoser offers, and how one of the user's own is found by its name.


class Diagnoser(Protocol):
    """Whatever diagnoses runs: the Bayesian diagnoser, a network, both, or a class of the user.

    One method is all there is to write. A `Diagnosis` needs a run and a posterior; what else it
    holds, such as onset and size, is shown where it is there.
    """

    def diagnose(self, runs: xr.Dataset) -> list[Diagnosis]:
        """Return the diagnosis of each run.

        Args:
            runs: A run set; `command` (run, time, motor) [rad] and `measured` (run, time, axis)
                [m] alone may be looked at, never the truth.
        """
        ...


def class_from_text(text: str) -> Any:
    """Return a class by ``module:Class``.

    Raises:
        InputError: If there is no such module or class.
    """
    module_name, _, class_name = text.partition(":")
    module = _imported(module_name, text)
    if not hasattr(module, class_name):
        classes = [name for name, value in vars(module).items() if isinstance(value, type)]
        raise InputError(f"{text}: {unknown_name(f'class of {module_name}', class_name, classes)}")
    return getattr(module, class_name)


def diagnoser_from_text(text: str, twin: DigitalTwin) -> CheckedDiagnoser:
    """Return a diagnoser of the user's own, such as ``my_methods:Guess`` in ``my_methods.py``.

    Modules are looked for in the current folder and where Python finds its packages. Verdicts in
    words and the truth of the runs, for scores, are filled in where the class leaves them empty.

    Args:
        text: ``module:Class``; the class is called with the twin.
        twin: Digital twin of the robot whose runs are to be diagnosed.

    Raises:
        InputError: If there is no such module or class, or it has no method `diagnose`.
    """
    kind = class_from_text(text)
    try:
        diagnoser = kind(twin)
    except TypeError as error:
        raise InputError(
            f"{text}: cannot be made ({error}). Expected a class whose __init__ takes the twin."
        ) from error
    if not callable(getattr(diagnoser, "diagnose", None)):
        raise InputError(
            f"{text}: has no method `diagnose`. Expected a class with diagnose(runs) that returns "
            "a Diagnosis for each run."
        )
    return CheckedDiagnoser(diagnoser, text, arm_class_of(twin.robot))


@dataclass(frozen=True)
class CheckedDiagnoser:
    """A diagnoser of the user's own, checked and with words and truth filled in."""

    diagnoser: Diagnoser
    name: str
    arm_class: str

    def diagnose(self, runs: xr.Dataset) -> list[Diagnosis]:
        """Return the diagnosis of each run.

        Raises:
            InputError: If that is not what the class returns.
        """
        told, truth = self.diagnoser.diagnose(runs), truths_of(runs)
        found = list(told) if isinstance(told, Iterable) else []
        count = runs.sizes["run"]
        if len(found) != count or not all(isinstance(d, Diagnosis) for d in found):
            raise InputError(f"{self.name}: diagnose(runs) gave no Diagnosis for each of {count}.")
        if [d.run for d in found] != [str(name) for name in runs["run"].values]:
            raise InputError(f"{self.name}: its diagnoses do not name the runs, in their order.")
        made = [
            replace(d, truth=true, posterior=checked_posterior(d, self.name))
            for d, true in zip(found, truth, strict=True)
        ]
        return [d if d.verdict else self._worded(d) for d in made]

    def _worded(self, diagnosis: Diagnosis) -> Diagnosis:
        ranked = [Hypothesis.parse(name) for name in diagnosis.ranked]
        return worded(diagnosis, ranked, arm_class=self.arm_class)


def checked_posterior(diagnosis: Diagnosis, name: str) -> dict[str, float]:
    """Return the posterior of a diagnosis by the user's class `name`, as plain numbers.

    Raises:
        InputError: If it is not one: other names, or numbers that are no probabilities.
    """
    told = {str(name): float(share) for name, share in diagnosis.posterior.items()}
    for hypothesis in told:
        Hypothesis.parse(hypothesis)
    shares = np.array(list(told.values()))
    if not (len(shares) and (shares >= 0.0).all() and abs(shares.sum() - 1.0) < 1e-6):
        raise InputError(
            f"{name}: the posterior of run {diagnosis.run} is {told}. Expected "
            "probabilities from 0 to 1 that sum to 1."
        )
    return told


def _imported(name: str, text: str) -> Any:
    here = str(Path.cwd())
    sys.path.insert(0, here)
    try:
        return import_module(name)
    except (ImportError, ValueError) as error:
        raise InputError(
            f"{text}: module {name!r} cannot be imported ({error}). Expected module:Class, with "
            "the module in the current folder or installed."
        ) from error
    finally:
        sys.path.remove(here)
