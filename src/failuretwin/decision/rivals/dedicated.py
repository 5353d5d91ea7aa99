"""Networks dedicated to single motors, and a hierarchy: first which motor, then which mode.

Classes are the paper's nine: healthy, stuck motors 1 to 4, errors of motors 1 to 4.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.special import log_softmax, logsumexp

from failuretwin.core.types import FloatArray, IntArray
from failuretwin.decision.learned.feature_encoder import Floats
from failuretwin.decision.learned.networks import Batch, scores_of

Train = Callable[[Batch, int], Any]
"""Returns a network trained on runs with so many classes."""
Logits = Callable[[Floats], FloatArray]
MOTORS = 4
MOTOR_OF = np.array([0, *range(1, MOTORS + 1), *range(1, MOTORS + 1)])
"""Motor of each class, from 1; 0: healthy."""
MODE_OF = np.repeat([0, 1, 2], [1, MOTORS, MOTORS])
"""Mode of each class: none, stuck, error."""


def hierarchy(train: Train, learn: Batch) -> Logits:
    """Return log probabilities by one network for the motor, and one for each motor's mode."""
    features, classes = learn
    motors = train((features, MOTOR_OF[classes]), MOTORS + 1)
    modes = []
    for motor in range(1, MOTORS + 1):
        own = MOTOR_OF[classes] == motor
        modes.append(train((features[own], MODE_OF[classes[own]] - 1), 2))

    def logits(seen: Floats) -> FloatArray:
        which = _logs(motors, seen)
        how = np.stack([_logs(one, seen) for one in modes], axis=1)  # run, motor, mode
        both = which[:, 1:, None] + how
        return np.concatenate([which[:, :1], both[:, :, 0], both[:, :, 1]], axis=1)

    return logits


def specialists(train: Train, learn: Batch) -> Logits:
    """Return log probabilities by one network for each motor, as if motors failed by themselves."""
    own = {motor: _specialist(train, learn, motor) for motor in range(1, MOTORS + 1)}

    def logits(seen: Floats) -> FloatArray:
        logs = {motor: _logs(one, seen) for motor, one in own.items()}
        total = sum(log[:, _groups(motor)] for motor, log in logs.items())
        return np.asarray(log_softmax(total, axis=1))

    return logits


def motors_3_and_4(train: Train, learn: Batch, general: Any) -> Logits:
    """Return log probabilities of a network, corrected by specialists of motors 3 and 4.

    What a specialist states of its motor replaces what the network states of it.
    """
    own = {motor: _specialist(train, learn, motor) for motor in (3, 4)}

    def logits(seen: Floats) -> FloatArray:
        total = _logs(general, seen)
        for motor, one in own.items():
            group, stated = _groups(motor), _logs(one, seen)
            parts = [logsumexp(total[:, group == mode], axis=1) for mode in range(3)]
            total = total + (stated - np.stack(parts, axis=1))[:, group]
        return total

    return logits


def _specialist(train: Train, learn: Batch, motor: int) -> Any:
    return train((learn[0], _groups(motor)[learn[1]]), 3)


def _groups(motor: int) -> IntArray:
    """Return what each class says of a motor: 0 nothing, 1 stuck, 2 error."""
    return np.where(motor == MOTOR_OF, MODE_OF, 0)


def _logs(network: Any, seen: Floats) -> FloatArray:
    return np.asarray(log_softmax(scores_of(network, seen), axis=1))
