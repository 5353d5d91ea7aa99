"""Where the motors of a healthy robot settle, also if it were another kind of robot.

The inference of a folder of runs, `RunsTogether`, with every run known to be healthy: what is
asked is theta, the scatter, its tails and what became of each command. The prior is what arms of
the class are like.

Section: docs/inference.md#calibration-and-geometry
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from failuretwin.connection.calibration.observations import Observations, uncalibrated
from failuretwin.connection.calibration.result import LeftOut
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import HEALTHY
from failuretwin.core.progress import Progress, unseen
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import Settling, largest_load
from failuretwin.inference.engine.theta import AS_TOLD, Layout, robot_components
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.set_ups.setup_prior import SetupPrior
from failuretwin.inference.together.belief import Belief
from failuretwin.inference.together.habits import Habits
from failuretwin.inference.together.runs_together import RunsTogether

FEWEST_MOVEMENTS = 6
"""Settled movements below which nothing can be fitted."""
SCATTER_PRIOR_SPREAD, DOF_PRIOR_SPREAD = 1.0, 0.7
"""Prior deviations of the logarithms of each scatter and of the degrees of freedom; assumed, wider
than within a class: healthy logs tell them."""
LEAST_TRAVEL_RAD = 0.03
"""Travel below which a motor stays and arrives alike, by its scatter and friction [rad]."""
WARMING = 2
"""Passes in which scatter and rates stay as believed: until the offsets are nearly found, what is
left of a movement is no scatter."""
DAMPING = 0.5
"""Share of new sites and habits that is taken: what the tool tells apart badly would be handed to
and fro between motors."""
MOST_PASSES, CONVERGED = 30, 0.02
"""Passes over the runs at most; they end when nothing moves by this share of its deviation, or a
logarithm by this much."""


@dataclass(frozen=True)
class SettlingPosterior:
    """Posterior of all settling parameters of a robot.

    Attributes:
        mode: Bias, compliance, friction and log scatter, then the log degrees of freedom; with n
            motors (4 n + 1,), group by group.
        covariance: Of the same, (4 n + 1, 4 n + 1).
        prior_deviation: Standard deviation before the logs were seen, (4 n + 1,).
    """

    mode: FloatArray
    covariance: FloatArray
    prior_deviation: FloatArray

    @property
    def deviation(self) -> FloatArray:
        """Standard deviation of each parameter, (4 n + 1,)."""
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True)
class SortedMovements:
    """What probably became of healthy movements.

    Attributes:
        lost: Motors that had to move and did not get their command, (movement, motor).
        odd: Movements that look like no healthy ones, (movement,).
        log_likelihood: Of all movements together.
    """

    lost: BoolArray
    odd: BoolArray
    log_likelihood: float

    @classmethod
    def of(cls, observations: Observations, model: HealthyModel) -> SortedMovements:
        """Return what became of movements, as the sensors of a robot beyond doubt saw them."""
        likelihood = RunLikelihood(observations.evidence, model.without_doubt)
        share = likelihood.outcome_probability[observations.at]
        sound = share.sum(axis=-1)
        missed = (share @ likelihood.outcomes.lost) / np.maximum(sound, 1e-12)[:, None]
        travel = np.abs(observations.target - observations.origin)
        lost, odd = (missed > 0.5) & (travel > LEAST_TRAVEL_RAD), np.asarray(sound < 0.5)
        return cls(lost & ~odd[:, None], odd, float(likelihood.log_healthy.sum()))


@dataclass(frozen=True)
class SettlingFit:
    """Settled movements of healthy logs and what was learned from them.

    Attributes:
        observations: All settled movements.
        together: The runs, learned from.
    """

    observations: Observations
    together: RunsTogether

    @property
    def settling(self) -> Settling:
        """Where motors settle, payload included."""
        return replace(self.together.learned.settling, source="fit")

    @cached_property
    def fit(self) -> SettlingPosterior:
        """Where motors settle, with covariance."""
        habits = _believed(self.together).plus(self.together.told)
        settling, motors = self.settling, len(self.together.learned.scatter)
        (_,), (covariance,) = self.together.belief.moments
        unit, own = self.together.unit, self.together.layout.offsets
        offsets = (covariance * np.outer(unit, unit))[own, own]
        scatter = np.linalg.inv(habits.precision)[:-1, :-1]  # without the noise
        whole = np.zeros((len(offsets) + len(scatter),) * 2)
        whole[: len(offsets), : len(offsets)] = offsets
        whole[len(offsets) :, len(offsets) :] = scatter
        told = (settling.bias, settling.compliance, settling.friction, np.log(settling.scatter))
        return SettlingPosterior(
            np.concatenate([*told, [np.log(settling.tail_dof)]]),
            whole,
            np.array([*unit[own], *[SCATTER_PRIOR_SPREAD] * motors, DOF_PRIOR_SPREAD]),
        )

    @cached_property
    def sorted(self) -> SortedMovements:
        """What became of the movements, of the robot that was found."""
        return SortedMovements.of(self.observations, self.together.learned)

    @property
    def fitted(self) -> BoolArray:
        """Movements that the fit is to, (movement,)."""
        return np.asarray(self._counted & ~self.sorted.odd)

    @property
    def _counted(self) -> BoolArray:
        """Movements that motors have set out for from a known place, (movement,)."""
        return np.asarray(self.together.given.usable[self.observations.at])

    def remarks(self) -> list[str]:
        """Return what else did not count, a sentence each."""
        unseen = int(np.sum(~self._counted))
        if unseen == 0:
            return []
        return [
            f"{unseen} movements follow one that was not seen at rest, so where their motors came "
            "from is not known: they count for losses alone"
        ]

    @property
    def log_posterior(self) -> float:
        """Log likelihood and log prior of the offsets found, for comparing robots."""
        offsets = self.together.base.log_density(self.together.belief.moments[0][0])
        return self.sorted.log_likelihood + offsets

    def without(self, runs: BoolArray) -> SettlingFit:
        """Return the fit to all runs but some, a mask (run,), found from here.

        Raises:
            InputError: If too few movements are left.
        """
        kept = np.flatnonzero(~runs)
        return fitted_to(self.observations[kept], self.together.of_runs(kept))

    def left_out(self, robot: Robot) -> tuple[LeftOut, ...]:
        """Return the movements that did not count, each with its reason."""
        found, seen = [], self.observations
        lost, odd = self.sorted.lost, self.sorted.odd
        run, number = seen.at
        for i in np.flatnonzero(odd | lost.any(axis=1)):
            motors = [robot.motor_names[k] for k in np.flatnonzero(lost[i])]
            reason = "is far off its target"
            if motors:
                reason = f"did not get {'its command' if len(motors) == 1 else 'their commands'}"
            name = " and ".join(motors)
            found.append(LeftOut(seen.runs[run[i]], int(number[i]) + 1, name, reason))
        return tuple(found)


def fit_settling(observations: Observations) -> SettlingFit:
    """Fit where the motors of a healthy robot settle, by what is believed of it.

    Raises:
        InputError: If too few movements are left.
    """
    model, evidence, known = observations.model, observations.evidence, observations.follows_seen
    if known.sum() >= FEWEST_MOVEMENTS:
        evidence = replace(evidence, usable=known)
    likelihood = RunLikelihood(evidence, model)
    layout = Layout(len(model.scatter), geometry=False)
    priors = Priors(setup=SetupPrior.known(), load_changes=0.0)
    believed = robot_components(model, layout, AS_TOLD)
    unit = believed.usual_deviation
    base = Belief.of(believed, unit)
    together = RunsTogether.of(likelihood, [HEALTHY], priors, layout, base, unit)
    return fitted_to(observations, together)


def fitted_to(observations: Observations, together: RunsTogether) -> SettlingFit:
    """Return what is learned from runs, one pass after the other until nothing moves.

    Raises:
        InputError: If too few movements are left.
    """
    _refuse_few(len(observations), len(observations))
    rows, habits = np.arange(together.runs), _believed(together)
    for count in range(MOST_PASSES):
        before = together.here / together.unit, together.model.settling
        together.habits = habits if count >= WARMING else None
        sites, told = (1.0 if count <= first else DAMPING for first in (0, WARMING))
        together.learn(together.judge(rows), sites, told)
        if count > WARMING and _moved(together, *before) < CONVERGED:
            break
    found = SettlingFit(observations, together)
    _refuse_few(int(found.fitted.sum()), len(observations))
    return found


def _believed(together: RunsTogether) -> Habits:
    given = together.given.model
    return Habits.believed(given, SCATTER_PRIOR_SPREAD, DOF_PRIOR_SPREAD)


def _moved(together: RunsTogether, place: FloatArray, settling: Settling) -> float:
    """Return by how much a pass has moved the fit, in deviations or logarithms."""
    (_,), (covariance,) = together.belief.moments
    moved = (together.here / together.unit - place) / np.sqrt(np.diag(covariance))
    now = together.model.settling
    scatter = np.log(np.divide(now.scatter, settling.scatter))
    tails = np.log(now.tail_dof / settling.tail_dof)
    return float(max(np.abs(moved).max(), np.abs(scatter).max(), abs(tails)))


def _refuse_few(kept: int, movements: int) -> None:
    if kept < FEWEST_MOVEMENTS:
        raise InputError(
            f"only {kept} of {movements} movements come to rest near their targets, expected "
            f"{FEWEST_MOVEMENTS} at least. Give longer logs of a healthy robot."
        )


# A payload.

SURE_NATS = 5.0
"""Log odds from which a payload is told to be better than none."""
LEAST_SAG_RAD = 1e-3
"""Sag below which nothing is said of a payload [rad]: a quarter of a servo count."""
PAYLOADS_KG = (0.02, 0.1, 0.5, 2.0)
"""Masses at the tool point that are tried [kg]."""


def best_payload(
    part: SettlingFit, robot: Robot, on_progress: Progress = unseen
) -> tuple[float, str]:
    """Return the payload that the logs speak for [kg] and a sentence about it.

    Compliance can take up most of what a payload does, so it is 0 unless the logs are sure.

    Args:
        part: The fit without a payload.
        robot: The robot.
        on_progress: Called with the number of further payloads that were tried.
    """
    sag = np.abs(np.asarray(part.settling.compliance) * largest_load(robot, 0.0))
    if sag.max() < LEAST_SAG_RAD:
        return 0.0, "payload: the motors do not give way, so none can be told"
    seen = part.observations
    gain = np.full(len(PAYLOADS_KG), -part.log_posterior)
    for i, kg in enumerate(PAYLOADS_KG):
        loaded = uncalibrated(robot, seen.of_motors, payload=kg)
        gain[i] += fit_settling(seen.of(loaded)).log_posterior
        on_progress(1)
    best = int(np.argmax(gain))
    if gain[best] > SURE_NATS:
        kg = PAYLOADS_KG[best]
        return kg, f"payload: about {kg:g} kg at the tool point, {gain[best]:.0f} nats over none"
    return 0.0, (
        "payload: the logs do not tell one from a softer motor "
        f"(best {PAYLOADS_KG[best]:g} kg, {gain[best]:+.1f} nats against none); weigh it, or run "
        "the same movements with and without it"
    )
