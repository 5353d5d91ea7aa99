"""From a hypothesis to what runs say of it: the one place that knows the law of each mode."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import UNKNOWN, Fault, Hypothesis, single_faults
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.knowledge import prior_odds
from failuretwin.decision.evidence.scene import Scene
from failuretwin.decision.evidence.two_angles import two_angles
from failuretwin.decision.hypotheses.law import Law, weigh
from failuretwin.decision.hypotheses.laws.drift import drift_law
from failuretwin.decision.hypotheses.laws.lasting import AMOUNTS, lasting_law
from failuretwin.decision.hypotheses.laws.nodes import LOCAL_STEPS
from failuretwin.decision.hypotheses.laws.stays import MISSES, weigh_misses
from failuretwin.decision.hypotheses.laws.steady_state_error import error_law
from failuretwin.decision.hypotheses.laws.stuck import stuck_law
from failuretwin.decision.hypotheses.laws.timed import lag_law, slow_law
from failuretwin.decision.hypotheses.laws.unknown import weigh_unknown
from failuretwin.decision.hypotheses.pairs import weigh_pair
from failuretwin.decision.hypotheses.priors import Priors
from failuretwin.decision.hypotheses.weight import Estimate, Weight

UNKNOWN_ODDS = 1.0
"""Odds of `unknown` against healthy where nothing is seen; each explanation of what is seen has
odds of its own in its evidence, none has more."""
MOST_FAULTS = 2
"""Faults that can be weighed at once."""


def _lasting(mode: str) -> Callable[[Scene, int, Priors], Law]:
    return lambda scene, motor, priors: lasting_law(
        scene, motor, mode, priors.onset.before_run(mode)
    )


LAWS: Mapping[str, Callable[[Scene, int, Priors], Law]] = {
    "stuck": lambda scene, motor, priors: stuck_law(scene, motor, priors.onset),
    "steady_state_error": lambda scene, motor, priors: error_law(
        scene, motor, priors.error_ranges, priors.onset.before_run("steady_state_error")
    ),
    "drift": lambda scene, motor, priors: drift_law(scene, motor, priors.onset.before_run("drift")),
    **{mode: _lasting(mode) for mode in AMOUNTS},
}
"""Law of each mode that makes a motor settle beside its target."""
TIMED: Mapping[str, Callable[[Scene, int, float], Law]] = {"lag": lag_law, "slow": slow_law}
"""Law of each mode that shows on the way."""
WEIGHABLE = (*LAWS, *TIMED, *MISSES)
"""Modes that can be weighed."""


def check_weighable(hypothesis: Hypothesis) -> None:
    """Refuse a hypothesis that cannot be weighed.

    Raises:
        InputError: If a mode cannot be weighed, or not together with another.
    """
    if len(hypothesis.faults) > MOST_FAULTS:
        raise InputError(
            f"hypothesis '{hypothesis}' has {len(hypothesis.faults)} faults. Expected "
            f"{MOST_FAULTS} at most."
        )
    known = WEIGHABLE if len(hypothesis.faults) == 1 else tuple(LAWS)
    for fault in hypothesis.faults:
        if fault.mode not in known:
            raise InputError(
                f"fault mode {fault.mode!r} cannot be weighed in '{hypothesis}'. Expected one of "
                f"{', '.join(known)}."
            )


def shows_on_way(hypothesis: Hypothesis) -> bool:
    """Return whether a hypothesis shows in how the motors move more than in where they settle."""
    return not hypothesis.known or any(fault.mode in TIMED for fault in hypothesis.faults)


def log_prior(hypotheses: Sequence[Hypothesis], priors: Priors) -> FloatArray:
    """Return the log prior probability of each hypothesis, (hypothesis,)."""
    odds = np.array([prior_odds(h) if h.known else UNKNOWN_ODDS for h in hypotheses])
    odds[[h.is_healthy for h in hypotheses]] *= priors.healthy_odds
    return np.asarray(np.log(odds / odds.sum()))


def weigh_all(scene: Scene, hypotheses: Sequence[Hypothesis], priors: Priors) -> list[Weight]:
    """Return what runs say of each hypothesis, in their order."""
    known = [h for h in hypotheses if h.known]
    weights = {h: weigh_hypothesis(scene, h, priors) for h in known}
    if len(known) < len(hypotheses):
        others = [
            (prior_odds(h), weigh_hypothesis(scene, h, priors)) for h in left_out(scene, known)
        ]
        weights[UNKNOWN] = weigh_unknown(scene, _weigh_healthy, others, known)
    return [weights[h] for h in hypotheses]


def left_out(scene: Scene, known: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return the single faults that can be weighed but are not among the known hypotheses."""
    names = scene.model.twin.robot.motor_names
    return [h for h in single_faults(names, WEIGHABLE) if h.faults and h not in known]


def weigh_hypothesis(scene: Scene, hypothesis: Hypothesis, priors: Priors) -> Weight:
    """Return what runs say of one known hypothesis."""
    if hypothesis.is_healthy:
        return _weigh_healthy(scene)
    if len(hypothesis.faults) == 2:
        scenes = [scene[run] for run in range(len(scene.log_healthy))]
        one, two = hypothesis.faults
        return weigh_pair(scenes, [_laws_of_two(alone, one, two, priors) for alone in scenes])
    fault = hypothesis.faults[0]
    if fault.mode in MISSES:
        early = priors.onset.before_run(fault.mode)
        return weigh_misses(scene, motor_of(scene, fault), fault.mode, early)
    return weigh(scene, law_of(scene, fault, priors))


def motor_of(scene: Scene, fault: Fault) -> int:
    """Return the index of the motor that has the fault."""
    return scene.model.twin.robot.motor_names.index(fault.motor)


def law_of(scene: Scene, fault: Fault, priors: Priors) -> Law:
    """Return the law of a fault, of any mode but those of `MISSES`."""
    motor = motor_of(scene, fault)
    if fault.mode in TIMED:
        return TIMED[fault.mode](scene, motor, priors.onset.before_run(fault.mode))
    return LAWS[fault.mode](scene, motor, priors)


def _laws_of_two(scene: Scene, one: Fault, two: Fault, priors: Priors) -> tuple[Law, Law]:
    """Return the laws of two faults that are there at once; those held look where both point."""
    first, second = sorted((motor_of(scene, one), motor_of(scene, two)))
    seen = two_angles(scene.evidence, scene.model, scene.alternatives, (first, second))

    def law(fault: Fault) -> Law:
        if fault.mode != "stuck":
            return law_of(scene, fault, priors)
        motor = motor_of(scene, fault)
        at = seen.pair.index(motor)
        width = np.sqrt(seen.covariance[..., at])
        nodes = seen.angle[..., at, None] + width[..., None] * LOCAL_STEPS
        return stuck_law(scene, motor, priors.onset, nodes.reshape(len(nodes), -1))

    return law(one), law(two)


def _weigh_healthy(scene: Scene) -> Weight:
    """Return what runs say of no motor being faulty."""
    by_movement = scene.log_healthy + scene.on_way

    def estimate(run: int) -> Estimate:
        return Estimate(None, None, scene.became[run])

    of_run, settled = by_movement.__getitem__, scene.log_healthy.__getitem__
    return Weight(by_movement.sum(axis=1), of_run, settled, estimate)
