"""Runs as a Bayesian diagnoser sees them, under one set-up or several.

    p(h | run) = sum over w of p(w | runs) p(h | run, w)

Section: docs/inference.md#set-ups
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.numerics import log_sum
from failuretwin.core.types import IntArray, as_floats
from failuretwin.inference.engine.registration import robot_parts, run_posterior, sensor_in_doubt
from failuretwin.inference.engine.runs import has_rows
from failuretwin.inference.engine.weighing import ALLOWED_FOR, Weighing
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.misfit import FITS, run_misfit
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.evidence import Evidence, SettledEvidence, TransientSamples
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.on_the_way import (
    likeliest_lag,
    on_the_way,
    told_too_seldom,
)
from failuretwin.inference.observation.rounding import (
    Rounding,
    command_rounding,
    rounded,
    told_of,
    tool_rounding,
)
from failuretwin.inference.posterior import Posterior
from failuretwin.inference.robot_mixture import RobotComponent, RobotMixture, robot_components
from failuretwin.inference.set_up_posterior import SetUpPosterior
from failuretwin.inference.set_up_weighing import SetUpWeighing
from failuretwin.inference.set_ups.clock import clock_posterior
from failuretwin.inference.set_ups.log_correction import LogCorrection
from failuretwin.inference.set_ups.set_ups import (
    FEWEST_TO_TURN,
    SetUp,
    clocks_apart,
    gross_unit,
    shifted,
    turned,
)
from failuretwin.inference.set_ups.wrong_setup import ANOTHER, MAY_MISFIT, MISFITS, UNDONE

if TYPE_CHECKING:
    import xarray as xr

JUDGED_RUNS = 32
"""So many runs of a set, evenly spread, tell whether its set-up may be off."""
LOOKS = 20
"""Runs by which the unit of a log is told, and readings of each."""
TOLD = 0.1
"""Probability of a wrong set-up from which it is told."""
SURE = 0.9
"""Probability from which it is told as a finding."""


@dataclass(frozen=True)
class SeenRuns:
    """Runs under one set-up.

    Attributes:
        runs: The run set, as it fits the profile.
        model: The healthy robot.
        hypotheses: What may be the case.
        priors: Beliefs about faults and set-ups.
        whole_run: Whether readings on the way count.
        judges: Runs of the same set, under the same set-up, by which rounding and the place of the
            sensor are judged; None: these runs.
    """

    runs: xr.Dataset
    model: HealthyModel
    hypotheses: Sequence[Hypothesis]
    priors: Priors
    whole_run: bool = True
    judges: SeenRuns | None = None

    @cached_property
    def evidence(self) -> Evidence:
        """What the runs say at system level."""
        return Evidence(self.runs, self.model.settings, self.model.sensors)

    @cached_property
    def settled(self) -> SettledEvidence:
        """Where the tool settled after each movement, or was on its way; one movement at least."""
        sound = self.evidence.sound
        if not sound.settled.usable.shape[1]:
            return sound.settled.padded(1)
        told = sound, self.model, self._judges.lag_s
        if self.whole_run:
            return on_the_way(*told)
        return replace(sound.settled, too_seldom=told_too_seldom(*told))

    @cached_property
    def lag_s(self) -> float:
        """How far the tool trails its commands in runs that hardly rest [s]."""
        return likeliest_lag(self.evidence.sound, self.model)

    @cached_property
    def healthy(self) -> HealthyModel:
        """The healthy robot as these runs show it, with what was rounded off as noise."""
        return rounded(self.model, self._judges.tool_rounding, None)

    @cached_property
    def tool_rounding(self) -> Rounding | None:
        """How coarsely tool positions were rounded; None: it does not matter."""
        if not self.model.sensors.tool_alone:
            return None
        readings = self.evidence.readings
        return tool_rounding(readings.point[readings.seen], self.model)

    @cached_property
    def command_rounding(self) -> tuple[Rounding | None, float]:
        """How coarsely the log alone rounded commands, and how surely; None: it did not."""
        evidence = self.sample.evidence
        command = command_rounding(evidence.movements.target[evidence.usable], self.model)
        if command is None or not self.model.sensors.tool_alone:
            return None, 0.0
        few = SetUpWeighing(self.sample, self.hypotheses, self.priors).few
        coarse = replace(few.likelihood, model=rounded(self.healthy, None, command))
        says = [
            float(one.weigh([one.as_told])[0].log_evidence.sum())
            for one in (few, SetUpWeighing(coarse, self.hypotheses, self.priors))
        ]
        share = float(np.exp(-np.logaddexp(0.0, says[0] - says[1])))
        return (command if share > SURE else None), share

    def rounding(self) -> list[str]:
        """Return what is to be said of how coarsely the runs were written down, a line each."""
        judges = self._judges
        return told_of(judges.tool_rounding, *judges.command_rounding)

    @cached_property
    def sample(self) -> RunLikelihood:
        """Some of the runs by their settled positions; on the way where none rests."""
        return RunLikelihood(self.settled.alike(self.sampled), self.healthy)

    @cached_property
    def sampled(self) -> IntArray:
        """Indices of these runs."""
        moving = self.settled.on_the_way
        rows = np.flatnonzero(~moving) if not moving.all() else np.arange(len(moving))
        some = np.unique(np.linspace(0, len(rows) - 1, JUDGED_RUNS).astype(np.int64))
        return np.asarray(rows[some])

    @cached_property
    def weighed_sample(self) -> list[Weighing]:
        """These runs weighed, by a sensor that stands where the profile says."""
        if not any(has_rows(h) for h in self.hypotheses):
            return []
        return robot_parts(self.sample, self.hypotheses, self.priors)

    @cached_property
    def in_doubt(self) -> bool:
        """Whether the sensor may stand a little elsewhere than the profile says, by any robot."""
        others = self.components[1:2]
        asked = self.hypotheses, self.priors
        return sensor_in_doubt(self.sample, *asked, self.weighed_sample) and all(
            sensor_in_doubt(replace(self.sample, model=one.model), *asked) for one in others
        )

    @cached_property
    def components(self) -> list[RobotComponent]:
        """What is believed of the healthy robot; the first is the model."""
        return robot_components(self.healthy, self.priors)

    def set_ups(self, thorough: bool = False) -> SetUpPosterior:
        """Return what is believed of the set-up: unit and clock first, then all else.

        Args:
            thorough: Whether all set-ups are weighed, also where the one as told fits.
        """
        told = SetUpWeighing(self.sample, self.hypotheses, self.priors)
        if told.rate == 0.0 or not self.model.sensors.tool_alone or self.settled.too_seldom.all():
            return told.taken_as_told()  # what happens to be seen of such ways is no set-up
        first, seen = told.as_told, self
        for look in (SeenRuns.unit, SeenRuns.clock):
            found = look(seen)
            if found is not None:
                first = found.beside(first)
                seen = self.under(first.correction)
        known = seen.weighed_sample if seen.sample.evidence.on_the_way.all() else ()
        weighing = SetUpWeighing(seen.sample, self.hypotheses, self.priors, known)
        posterior = weighing.posterior(thorough)
        return posterior.beside(first) if first.what else posterior

    def unit(self) -> SetUp | None:
        """Return the unit that the log is in; None: that of the profile."""
        command, point = (as_floats(self.runs[n].values) for n in ("command", "measured"))
        runs = np.unique(np.linspace(0, len(point) - 1, LOOKS).astype(np.int64))
        run, time = np.nonzero(np.isfinite(point[runs]).all(axis=-1))
        some = np.linspace(0, len(run) - 1, LOOKS**2).astype(np.int64)
        if len(run) < LOOKS:
            return None
        at = runs[run[some]], time[some]
        return gross_unit(self.model.twin, command[at], point[at])

    def clock(self) -> SetUp | None:
        """Return by how much the clocks are apart; None where that is not sure."""
        found = clock_posterior(self.evidence.sound, self.model)
        if found.apart < SURE:
            return None
        return clocks_apart(self.model.twin.robot, found.late_s)

    def under(self, correction: LogCorrection) -> SeenRuns:
        """Return the same runs with a wrong set-up undone."""
        return self if correction.is_none else replace(self, runs=correction.runs(self.runs))

    def part(self, runs: xr.Dataset) -> SeenRuns:
        """Return other runs of the same set, under the same set-up, judged by these."""
        return replace(self, runs=runs, judges=self)

    @property
    def _judges(self) -> SeenRuns:
        return self.judges or self

    def posterior(self, rows: slice, moving: TransientSamples | None) -> Posterior:
        """Return what some of the runs say.

        Args:
            rows: Which.
            moving: Readings on the way of all runs; None: they are left aside.
        """
        way = None if moving is None else moving[rows]
        some = np.arange(len(self.settled.usable))[rows]
        likelihood = RunLikelihood(self.settled.alike(some), self.healthy, way)
        judged = self.judges is None and np.array_equal(some, self.sampled)
        known = self.weighed_sample if judged else ()
        in_doubt = self._judges.in_doubt
        return run_posterior(likelihood, self.hypotheses, self.priors, in_doubt, known)

    def robots(self, named: Posterior, common: Sequence[str], others: bool) -> RobotMixture:
        """Return what runs say of the robot: that of the model, or another of its kind.

        Args:
            named: Posterior of some of the runs by the model.
            common: What is said of the log of all runs.
            others: Whether other robots are weighed.
        """
        judges = self._judges
        components = judges.components if others else judges.components[:1]
        return RobotMixture.of(named, components, self.priors, judges.in_doubt, common)

    def elsewhere(self) -> str:
        """Return that the sensor stands elsewhere, or is noisier, if most runs say so."""
        if not self.in_doubt:
            return ""
        said = [one for one in self.posterior(slice(None), None).set_up if one]
        if 2 * len(said) <= self.runs.sizes["run"]:
            return ""
        return said[-1].replace(ALLOWED_FOR, "")

    def frame(self) -> SetUp | None:
        """Return the shift of the sensor, or else its turn, that leaves no doubt where it stands.

        None where none does.
        """
        sample, robot = self.sample, self.model.twin.robot
        usable, healthy = sample.usable, sample.healthy_pose
        if not usable.any():
            return None
        poses = self.model.twin.path(healthy[usable]), sample.evidence.point[usable][:, :3]
        ways = [shifted, turned] if usable.sum() >= FEWEST_TO_TURN else [shifted]
        for found in (way(robot, *poses) for way in ways):
            if not self.under(found.correction).elsewhere():
                return found
        return None


def mixed(
    posteriors: Sequence[Posterior], set_ups: SetUpPosterior, rounding: Sequence[str] = ()
) -> Posterior:
    """Return the posterior of runs whose set-up is believed to be one of several.

    Sizes and onsets are those behind the most probable set-up.

    Args:
        posteriors: Of the same runs behind each.
        set_ups: What is believed of the set-up.
        rounding: What is to be said of how coarsely the runs were written down.
    """
    likeliest, weight = posteriors[0], np.log(set_ups.probability)
    if len(posteriors) > 1:
        stacked = np.stack([one.log_posterior for one in posteriors]) + weight[:, None, None]
        likeliest = replace(likeliest, log_posterior=log_sum(stacked, axis=0))
    count, common = len(likeliest.log_posterior), common_remarks(set_ups, rounding)
    known = likeliest.set_up or [""] * count
    if common:
        said = ["; ".join(filter(None, (*common, one))) for one in known]
        likeliest = replace(likeliest, set_up=said)
    if set_ups.fits:
        return likeliest
    everywhere = bool(set_ups.best.set_up.what)
    lost = [_unexplained(likeliest, run, known[run], everywhere) for run in range(count)]
    return replace(likeliest, no_verdict=[ANOTHER if one else "" for one in lost])


def common_remarks(set_ups: SetUpPosterior, rounding: Sequence[str]) -> list[str]:
    """Return what is to be said of the log of all runs, of its set-up first."""
    remark = set_up_remark(set_ups)
    if set_ups.fits and set_ups.wrong >= SURE:
        remark += UNDONE
    return [line for line in (remark, *rounding) if line]


def _unexplained(posterior: Posterior, run: int, set_up: str, wrong: bool) -> bool:
    """Return whether neither a hypothesis nor a sensor that stands a little elsewhere explains it.

    The hypothesis that the fault is unknown says so itself, also where the set-up is `wrong`.
    """
    best = posterior.hypotheses[int(np.argmax(posterior.log_posterior[run]))]
    return best.known and (wrong or (not set_up and run_misfit(posterior, run) > FITS))


def set_up_remark(set_ups: SetUpPosterior) -> str:
    """Return what is to be said of a set-up; empty if nothing is."""
    if set_ups.wrong < TOLD:
        return ""
    pairs = zip(set_ups.found, set_ups.probability, strict=True)
    named = [(one.set_up, float(share)) for one, share in pairs if one.set_up.what]
    if not set_ups.fits:
        return f"{MISFITS}: {ANOTHER}"
    kept, total = [], 0.0
    for set_up, share in named:
        kept.append(set_up.told)
        total += share
        if total > SURE * set_ups.wrong:
            break
    ways = "; or ".join(kept)
    if set_ups.wrong < SURE:
        return f"{MAY_MISFIT} ({set_ups.wrong:.0%}): {ways}"
    sure = "over 99.9 %" if set_ups.wrong > 0.999 else f"{100.0 * set_ups.wrong:.1f} %"
    return f"{MISFITS} ({sure} sure): {ways}"


def set_up_finding(set_ups: SetUpPosterior) -> str:
    """Return the same, also where neither a fault nor a mistake explains the runs."""
    unexplained = "" if set_ups.fits else f"{MISFITS}: {ANOTHER}"
    return set_up_remark(set_ups) or unexplained
