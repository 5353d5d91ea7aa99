"""Which diagnoser the user asks for."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from failuretwin.app.learning import check_learning
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Hypothesis, parse_hypotheses
from failuretwin.decision.bayes import BayesDiagnoser
from failuretwin.decision.learned.hybrid import Diagnoser, HybridDiagnoser
from failuretwin.digital_model.robot import Robot

if TYPE_CHECKING:
    from failuretwin.decision.learned.estimator import LearnedDiagnoser

BAYES = "bayes"
"""Name of the method that needs no file."""
BLEND = f"{BAYES}+"
"""What stands before the file of a network that is blended with it."""


def told_hypotheses(text: str | None, robot: Robot) -> tuple[Hypothesis, ...] | None:
    """Return the hypotheses that the user names; None where none are named.

    Args:
        text: Hypotheses in their text form, separated by commas.
        robot: The robot, for the names of its motors.

    Raises:
        InputError: If one cannot be read, or there is only one, which would always be certain.
    """
    if text is None:
        return None
    hypotheses = parse_hypotheses(text.split(","), robot.motor_names)
    if len(hypotheses) < 2:
        raise InputError(
            f"--hypotheses names only {hypotheses[0]}, so every run would be that for certain. "
            "Expected two at least, such as healthy,motor_1:stuck."
        )
    return hypotheses


def chosen_diagnoser(
    method: str, bayes: BayesDiagnoser, settings: Mapping[str, object]
) -> Diagnoser:
    """Return the diagnoser that the user names.

    Args:
        method: ``bayes``, the file of a network, or ``bayes+`` and that file.
        bayes: The Bayesian diagnoser.
        settings: Options by name that belong to it alone; None where not given.

    Raises:
        InputError: If one of those is given with a network, the file is no network for this robot
            or was never fitted to be blended, or the extra `learn` is missing.
    """
    if method == BAYES:
        return bayes
    network = _network(Path(method.removeprefix(BLEND)), bayes.twin.robot, settings)
    if not method.startswith(BLEND):
        return network
    if network.weights_ is None:
        raise InputError(
            f"{method.removeprefix(BLEND)}: how it weighs beside Bayes was never fitted. Train it "
            "with `failuretwin train`, or use it alone."
        )
    return HybridDiagnoser(bayes, network, network.weights_)


def _network(path: Path, robot: Robot, settings: Mapping[str, object]) -> LearnedDiagnoser:
    if not path.exists():
        raise InputError(
            f"--method {path}: is neither 'bayes' nor a file that exists. Train a network with "
            f"`failuretwin train --out {path.with_suffix('.npz')}`."
        )
    given = [name for name, value in settings.items() if value is not None]
    if given:
        raise InputError(
            f"{', '.join(given)}: a network has learned what it knows, and cannot be told more. "
            "Leave that out, or use --method bayes."
        )
    check_learning()
    from failuretwin.decision.learned.storage import load_network

    return load_network(path, robot)


def expected_name(diagnoser: Diagnoser, bayes: BayesDiagnoser) -> str:
    """Return the name of the healthy behaviour that a diagnoser expects.

    Args:
        diagnoser: As `chosen_diagnoser` gave it.
        bayes: The Bayesian diagnoser, which is it or a part of it unless it is a network.
    """
    encoder = getattr(diagnoser, "encoder", None)
    if encoder is None:
        return bayes.healthy_model.imperfections.name
    return encoder.expected.name if encoder.expected else "none"
