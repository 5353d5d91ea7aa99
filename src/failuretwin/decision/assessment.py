"""What keeps a run from being judged, and what happened in it besides any fault."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.data_knowledge.log_quality import LogQuality
from failuretwin.data_knowledge.settled_evidence import SettledEvidence

UNEXPLAINED_NATS = 1.0
"""A movement whose density is within this of "anywhere within reach" is not explained [nats]."""
FEW_MOVEMENTS = 2
"""So few usable movements carry a verdict only if one hypothesis holds half of the probability."""
LIKELY = 0.5
"""Probability from which a lost command is told [-]."""


def unused_movements(evidence: SettledEvidence, run: int) -> list[str]:
    """Return why movements of a run are not used, a line each."""
    lines = []
    for movement in np.flatnonzero(evidence.movements.exists[run] & ~evidence.usable[run]):
        if evidence.moving[run, movement]:
            reason = "the tool does not come to rest"
        else:
            reason = "no reading while the tool is at rest"
        lines.append(f"movement {movement + 1} not used: {reason}")
    return lines


def why_undecided(
    quality: LogQuality,
    evidence: SettledEvidence,
    run: int,
    probability: float,
    by_movement: FloatArray,
    outlier_log_density: float,
) -> str:
    """Return why a run allows no verdict, empty if it does.

    Args:
        quality: Defects of the log.
        evidence: Settled positions.
        run: Index of the run.
        probability: Posterior of the best hypothesis.
        by_movement: Log density of each movement under the best hypothesis, (movement,).
        outlier_log_density: That of a tool anywhere within reach.
    """
    if quality.fatal:
        return quality.fatal
    usable = evidence.usable[run]
    if not evidence.movements.exists[run].any():
        return "no motor is told to move"
    if not usable.any():
        return "the tool is not seen at rest after any movement"
    if usable.sum() <= FEW_MOVEMENTS and probability < 0.5:
        count = int(usable.sum())
        return f"only {count} movement{'s' * (count != 1)} can be used and no hypothesis stands out"
    unexplained = usable & (by_movement < outlier_log_density + UNEXPLAINED_NATS)
    if 2 * unexplained.sum() <= usable.sum():
        return ""
    which = ", ".join(str(m + 1) for m in np.flatnonzero(unexplained))
    return (
        f"after movement {which} the tool is nowhere near where any of the hypotheses puts it: "
        "wrong units or robot, a spoilt sensor, or a fault of another kind"
    )


def lost_commands(
    became: FloatArray, lost: BoolArray, motors: Sequence[str], faulty: Sequence[str]
) -> list[str]:
    """Return the commands of a run that seem not to have arrived, a line each.

    Args:
        became: Probability of each alternative, (movement, alternative).
        lost: Motors that lose their command in it, (alternative, motor).
        motors: Names of the motors.
        faulty: Motors whose fault is told anyway.
    """
    lines = []
    for movement, share in enumerate(became):
        missing = share @ lost > LIKELY
        told = [m for m, gone in zip(motors, missing, strict=True) if gone and m not in faulty]
        if told:
            names = " and ".join(motor.replace("_", " ") for motor in told)
            lines.append(f"movement {movement + 1}: {names} did not get the command")
    return lines
