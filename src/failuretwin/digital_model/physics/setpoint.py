"""The servos' set-points: references within the speed limit, filtered, at the fine step."""

from __future__ import annotations

import numpy as np

from failuretwin.core.types import FloatArray


def limit_speed(reference: FloatArray, step: float, speed: FloatArray) -> FloatArray:
    """Return references that chase the given ones no faster than each motor can.

    Args:
        reference: (run, time, motor) [rad].
        step: Time between samples [s].
        speed: Largest speed of each motor, (motor,) [rad/s].
    """
    largest = speed * step * (1.0 + 1e-9)  # a ramp at exactly this speed is left as it is
    limited = reference.copy()
    # Only runs that ask for more are touched, so that none depends on the others by rounding.
    fast = (np.abs(np.diff(reference, axis=1)) > largest).any(axis=(1, 2))
    for i in range(1, reference.shape[1]):
        change = np.clip(reference[fast, i] - limited[fast, i - 1], -largest, largest)
        limited[fast, i] = limited[fast, i - 1] + change
    return limited


def refine(samples: FloatArray, substeps: int) -> FloatArray:
    """Return `samples` (run, time, motor) with straight lines between, `substeps` times finer.

    The result has (time - 1) * substeps + 1 instants.
    """
    share = (np.arange(substeps) / substeps)[:, None]
    low, high = samples[:, :-1, None], samples[:, 1:, None]
    fine = low + share * (high - low)
    fine = fine.reshape(len(samples), -1, samples.shape[-1])
    return np.concatenate([fine, samples[:, -1:]], axis=1)


def filtered(
    reference: FloatArray, before: FloatArray, step: float, filter_s: FloatArray
) -> FloatArray:
    """Return references after each motor's first-order filter; exact for straight lines.

    Args:
        reference: (run, time, motor) [rad].
        before: What the filter has put out at the first instant, (run, motor) [rad].
        step: Time between instants [s].
        filter_s: Time constants, (motor,) [s].

    Returns:
        (run, time, motor) [rad], beginning with `before`.
    """
    from scipy.signal import lfilter

    out = np.empty_like(reference)
    out[:, 0] = before
    for k, tau in enumerate(filter_s):
        kept = np.exp(-step / tau)
        new = 1.0 - (1.0 - kept) * tau / step
        old = (1.0 - kept) * tau / step - kept
        memory = old * reference[:, :1, k] + kept * before[:, k, None]
        out[:, 1:, k], _ = lfilter([new, old], [1.0, -kept], reference[:, 1:, k], axis=1, zi=memory)
    return out
