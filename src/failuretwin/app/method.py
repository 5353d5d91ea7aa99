"""Which diagnoser the user asks for."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from failuretwin.app.learning import check_learning
from failuretwin.core.errors import InputError
from failuretwin.decision.bayes import BayesDiagnoser
from failuretwin.digital_model.robot import Robot

if TYPE_CHECKING:
    from failuretwin.decision.learned.estimator import LearnedDiagnoser

BAYES = "bayes"
"""Name of the method that needs no file."""


def learned_diagnoser(
    method: str, robot: Robot, settings: Mapping[str, object]
) -> LearnedDiagnoser:
    """Load the network that the user names.

    Args:
        method: Its file.
        robot: The robot that is diagnosed.
        settings: Options by name that belong to the Bayesian method; None where not given.

    Raises:
        InputError: If one of those is given, the file is no network for this robot, or the extra
            `learn` is missing.
    """
    path = Path(method)
    if not path.exists():
        raise InputError(
            f"--method {method}: is neither 'bayes' nor a file that exists. Train a network with "
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


def expected_name(diagnoser: BayesDiagnoser | LearnedDiagnoser) -> str:
    """Return the name of the healthy behaviour that a diagnoser expects."""
    if isinstance(diagnoser, BayesDiagnoser):
        return diagnoser.healthy_model.imperfections.name
    expected = diagnoser.encoder and diagnoser.encoder.expected
    return expected.name if expected else "none"
