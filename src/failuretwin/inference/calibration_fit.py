"""Whether a calibration is of this robot: another of the same make does almost the same.

    p(own | runs) / p(other | runs) = (1 - f) p(runs | calibration) / [ f p(runs | kind) ]

with the faults of each run summed over inside, and f the probability that a calibration is of
another robot or of other weeks. Of one that it is not of, the kind of arm says more.

Section: docs/inference.md#set-ups
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.inference.explanation import percent
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.seen_runs import SeenRuns
from failuretwin.inference.set_up_weighing import SetUpWeighing
from failuretwin.inference.together.healthy_mixture import FOREIGN

MISFIT = 0.05
"""Probability below which a calibration is said to be of another robot."""


def fits_this_robot(seen: SeenRuns) -> float | None:
    """Return how probable it is that the calibration is of the robot that made some runs.

    Args:
        seen: The runs, with whatever was wrong of their set-up undone.

    Returns:
        None where none was given, or nothing can be said.
    """
    known = seen.model.imperfections
    if known.of_class or known.settling is None or not seen.sample.usable.any():
        return None
    kind = HealthyModel.of(seen.model.twin, generic_imperfections(seen.model.twin.robot))
    says = []
    for model in (seen.model, kind):
        weighing = SetUpWeighing(replace(seen, model=model).sample, seen.hypotheses, seen.priors)
        says.append(float(weighing.weigh([weighing.as_told])[0].log_evidence.sum()))
    log_odds = np.log(1.0 - FOREIGN) - np.log(FOREIGN) + says[0] - says[1]
    return float(np.exp(-np.logaddexp(0.0, -log_odds)))


def calibration_told(name: str, fits: float) -> str:
    """Return in words whose calibration it is.

    Args:
        name: Name of the calibration.
        fits: Probability that it is this robot's.
    """
    if fits >= MISFIT:
        return f"calibration {name!r} is this robot's: {percent(fits)} sure"
    return (
        f"the log does not fit calibration {name!r} ({percent(fits)} sure that it is this "
        "robot's): another robot of the same make, or one that has changed. Calibrate this one"
    )
