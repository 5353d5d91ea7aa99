"""Fits told as parameters: value, interval, and whether the logs say it at all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from failuretwin.connection.calibration.calibration import Parameter
from failuretwin.connection.calibration.rates import LossRates, Rate
from failuretwin.connection.calibration.settled_fit import SettledFit, largest_load
from failuretwin.connection.calibration.timing_fit import BOUNDS, TimingFit
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.robot import Robot

Z_95 = 1.959963984540054
LEARNED = 0.3
"""A parameter is identified if the logs bring its deviation below this share of the prior's."""
LOAD_FLOOR_NM = 1e-6
DRAWS = 400
DELAY_BOUNDS = BOUNDS[0]
"""Where a delay that the logs do not tell may lie [s]."""
FEW_TOGETHER = 3
"""A set of motors seen to lose commands together fewer times than this says little of how often."""

ADVICE = {
    "bias": "more movements that come to rest, to targets all over the range",
    "compliance": "movements of this motor with the arm stretched out to either side",
    "friction": "movements to the same pose from both sides",
    "scatter": "more movements that come to rest",
    "tail_dof": "a hundred movements or more",
}


def settling_parameters(fit: SettledFit, robot: Robot, payload: float) -> list[Parameter]:
    """Return bias, compliance, friction and scatter of each motor, and the tails."""
    load = largest_load(robot, payload)
    found = []
    units = {"bias": "rad", "compliance": "rad/(N m)", "friction": "rad", "scatter": "rad"}
    for group, (name, unit) in enumerate(units.items()):
        for k, motor in enumerate(robot.motor_names):
            at = group * fit.motors + k
            value, half = float(fit.mode[at]), Z_95 * float(fit.deviation[at])
            learned = bool(fit.deviation[at] < LEARNED * fit.prior_deviation[at])
            note = "" if learned else f"the logs do not say; it takes {ADVICE[name]}"
            if name == "compliance" and load[k] < LOAD_FLOOR_NM:
                learned, note = False, "gravity does not load this motor"
            low, high = value - half, value + half
            if name == "scatter":
                value, low, high = (float(np.exp(x)) for x in (value, low, high))
            found.append(Parameter(name, motor, unit, value, low, high, learned, note))
    tail, half = float(fit.mode[-1]), Z_95 * float(fit.deviation[-1])
    learned = bool(fit.deviation[-1] < LEARNED * fit.prior_deviation[-1])
    note = "" if learned else f"the logs hardly say; it takes {ADVICE['tail_dof']}"
    value, low, high = (float(np.exp(x)) for x in (tail, tail - half, tail + half))
    return [*found, Parameter("tail_dof", "", "-", value, low, high, learned, note)]


def timing_parameters(fit: TimingFit | None, rng: np.random.Generator) -> list[Parameter]:
    """Return mean and spread of delay and shortening over runs, and the lag."""
    if fit is None:
        note = "fewer than three runs show ramps that begin on time at a known place"
        return [Parameter("delay", "", "s", 0.0, *DELAY_BOUNDS, False, note)]
    low, high = fit.lag_interval
    return [
        _mean("delay, mean over runs", "s", fit.delay, rng),
        _mean("ramp shortening, mean over runs", "share", fit.shortening, rng),
        Parameter("lag", "", "s", fit.lag, low, high),
    ]


def _mean(name: str, unit: str, values: FloatArray, rng: np.random.Generator) -> Parameter:
    draws = rng.choice(values, (DRAWS, len(values))).mean(axis=1)
    low, high = (float(q) for q in np.quantile(draws, [0.025, 0.975]))
    return Parameter(name, "", unit, float(values.mean()), low, high)


def rate_parameter(name: str, motor: str, rate: Rate) -> Parameter:
    """Return a share estimated from a count."""
    return Parameter(name, motor, "share", rate.mean, *rate.interval)


def loss_parameters(losses: Sequence[LossRates]) -> list[Parameter]:
    """Return the share of lost commands of each set of motors, punctual and late apart."""
    found = []
    for loss in losses:
        motors = "+".join(loss.motors)
        rates = [rate_parameter("lost commands", motors, loss.punctual)]
        if loss.late.trials:
            rates.append(rate_parameter("lost commands when late", motors, loss.late))
        hits = loss.punctual.hits + loss.late.hits
        if len(loss.motors) > 1 and hits < FEW_TOGETHER:
            note = f"seen {hits} times, and listed only because it was; it takes longer logs"
            rates = [replace(rate, identified=False, note=note) for rate in rates]
        found += rates
    return found
