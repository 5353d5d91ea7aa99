"""Steps of the tracker as lines of JSON. Floats keep all their digits, so nothing is lost."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from failuretwin.connection.run_evidence import RunEvidence
from failuretwin.connection.tracker_step import Step
from failuretwin.connection.wear import WearState
from failuretwin.core.errors import InputError
from failuretwin.core.types import FloatArray, as_floats


def row_of(step: Step) -> dict[str, Any]:
    """Return a step as a JSON object."""
    bias, compliance = np.split(step.state.mean, 2)
    bias_deviation, compliance_deviation = np.split(step.state.deviation, 2)
    below = np.tril_indices(len(step.state.mean))
    return {
        "number": step.number,
        "run": step.evidence.run,
        "key": step.evidence.key,
        "probability_faulty": None if np.isnan(step.suspicion) else step.suspicion,
        "level": step.level,
        "alarm": step.alarm,
        "fates": [list(fate) for fate in step.fates],
        "learned_at": step.learned_at,
        "bias": bias.tolist(),
        "bias_deviation": bias_deviation.tolist(),
        "compliance": compliance.tolist(),
        "compliance_deviation": compliance_deviation.tolist(),
        "covariance": step.state.covariance[below].tolist(),
        "error": step.evidence.error.tolist(),
        "design": step.evidence.design.tolist(),
    }


def step_of(line: str, where: str) -> Step:
    """Return the step that a line holds.

    Args:
        line: JSON as `row_of` gives it.
        where: What to call it in an error.

    Raises:
        InputError: If it is no such line.
    """
    row = parse_line(line, where)
    try:
        mean = as_floats([*row["bias"], *row["compliance"]])
        error, design = _evidence(row, len(mean))
        chance = row["probability_faulty"]
        return Step(
            number=int(row["number"]),
            evidence=RunEvidence(str(row["run"]), str(row["key"]), error, design),
            suspicion=float("nan") if chance is None else float(chance),
            level=float(row["level"]),
            alarm=str(row["alarm"]),
            fates=tuple((int(number), fate) for number, fate in row["fates"]),
            learned_at=int(row["learned_at"]),
            state=WearState(mean, _symmetric(as_floats(row["covariance"]), len(mean))),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{where}: is damaged ({error}). Move the file away.") from error


def _evidence(row: dict[str, Any], size: int) -> tuple[FloatArray, FloatArray]:
    """Return error and design of a row, with their axes also where a run says nothing."""
    error = as_floats(row["error"])
    if error.size == 0:
        error = np.zeros((0, 1))
    return error, as_floats(row["design"]).reshape(*error.shape, size)


def _symmetric(below: FloatArray, size: int) -> FloatArray:
    """Return the symmetric matrix of a lower triangle."""
    matrix, (row, column) = np.empty((size, size)), np.tril_indices(size)
    matrix[row, column] = matrix[column, row] = below
    return matrix


def parse_line(line: str, where: str) -> dict[str, Any]:
    """Return the JSON object of a line.

    Raises:
        InputError: If it is none.
    """
    try:
        value = json.loads(line)
    except json.JSONDecodeError as error:
        raise InputError(f"{where}: is damaged ({error}). Move the file away.") from error
    if not isinstance(value, dict):
        raise InputError(f"{where}: is damaged (no object). Move the file away.")
    return value
