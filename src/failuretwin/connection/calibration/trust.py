"""Which runs had better not teach the twin, and why."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from failuretwin.connection.calibration.calibration import LeftOut
from failuretwin.core.types import FloatArray

SUSPECT = 0.9
"""A run that is faulty with at least this probability is left out."""
MOST_SUSPECT = 0.25
"""Share of runs that may look faulty. Beyond it, and from two runs on, a session is left out as a
whole, and logs are refused. Of ten healthy runs three look faulty in one session of a thousand."""


def untrusted(
    names: Sequence[str], sessions: Sequence[str], suspicion: FloatArray
) -> list[LeftOut]:
    """Return the runs that look faulty, and those of sessions that do.

    Args:
        names: Names of the runs.
        sessions: The session of each run.
        suspicion: Probability that each run is faulty, (run,).
    """
    suspect, of = suspicion >= SUSPECT, np.asarray(sessions)
    found = []
    for i, name in enumerate(names):
        inside = of == of[i]
        hits = int(suspect[inside].sum())
        if hits >= 2 and hits > MOST_SUSPECT * inside.sum():
            reason = f"its session looks faulty, in {hits} of {int(inside.sum())} runs"
            found.append(LeftOut(name, 0, "", reason))
        elif suspect[i]:
            found.append(LeftOut(name, 0, "", "looks faulty"))
    return found
