"""What the paper reports, to stand beside our figures (arXiv 2411.01360, tables II and III)."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Spread:
    """Mean and standard deviation over repetitions; NaN where there is none."""

    mean: float
    deviation: float


NONE = Spread(math.nan, math.nan)

TABLE_2 = {
    "training": Spread(0.9812, 0.0171),
    "validation": Spread(0.9244, 0.0041),
    "test": Spread(0.6156, 0.0559),
}
"""Accuracy after 5050 iterations with augmented features."""

RATIOS = ("precision", "recall", "F1")
"""Columns of Table III."""

TABLE_3 = {
    "healthy": (NONE, Spread(0.0, 0.0), NONE),
    "motor_1:steady_state_error": (Spread(1.00, 0.00), Spread(0.52, 0.13), Spread(0.68, 0.11)),
    "motor_1:stuck": (Spread(0.96, 0.06), Spread(0.84, 0.05), Spread(0.89, 0.04)),
    "motor_2:steady_state_error": (Spread(0.49, 0.10), Spread(0.70, 0.10), Spread(0.58, 0.10)),
    "motor_2:stuck": (Spread(0.75, 0.10), Spread(0.92, 0.04), Spread(0.82, 0.06)),
    "motor_3:steady_state_error": (Spread(0.64, 0.08), Spread(0.70, 0.16), Spread(0.66, 0.08)),
    "motor_3:stuck": (Spread(0.64, 0.16), Spread(0.72, 0.11), Spread(0.67, 0.11)),
    "motor_4:steady_state_error": (Spread(0.39, 0.06), Spread(0.68, 0.11), Spread(0.50, 0.07)),
    "motor_4:stuck": (Spread(0.49, 0.11), Spread(0.46, 0.15), Spread(0.47, 0.13)),
}
"""Precision, recall and F1 of each class on 90 real runs, in the order of the paper's rows."""
