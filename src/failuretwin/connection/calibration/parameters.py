"""Fits told as parameters: value, interval, and whether the logs say it at all."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from failuretwin.connection.calibration.calibration import Parameter
from failuretwin.connection.calibration.rates import LossRates, Rate
from failuretwin.connection.calibration.settled_errors import LEAST_DOF
from failuretwin.connection.calibration.settled_fit import SettledFit
from failuretwin.connection.calibration.settled_prior import DOF_PRIOR, DOF_PRIOR_SPREAD
from failuretwin.connection.calibration.timing_fit import BOUNDS, TimingFit
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import largest_load

Z_95 = 1.959963984540054
LEARNED = 0.3
"""A parameter is identified if the logs bring its deviation below this share of the prior's."""
LOAD_FLOOR_NM = 1e-6
DELAY_BOUNDS = BOUNDS[0]
"""Where a delay that the logs do not tell may lie [s]."""
INVERSE_DOF_SPREAD = float(
    np.sqrt(np.expm1(DOF_PRIOR_SPREAD**2)) * np.exp(DOF_PRIOR_SPREAD**2 / 2.0) / DOF_PRIOR
)
"""Standard deviation of the inverse degrees of freedom in the log-normal prior."""
UNLOADED = "gravity does not load this motor"

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
                learned, note = False, UNLOADED
            low, high = value - half, value + half
            if name == "scatter":
                value, low, high = (float(np.exp(x)) for x in (value, low, high))
            found.append(Parameter(name, motor, unit, value, low, high, learned, note))
    return [*found, _tails(fit)]


def spring_remarks(settling: Sequence[Parameter]) -> list[str]:
    """Return a sentence for each motor that seems to rise against gravity."""
    return [
        f"compliance of {p.motor}: {p.value:.2g} {p.unit} ({p.low:.2g} to {p.high:.2g}) is "
        "negative, as if the motor rose against gravity; check its sense, the masses of the URDF "
        "and the payload. The figure is used as it is"
        for p in settling
        if p.name == "compliance" and p.note != UNLOADED and p.value < 0.1 * (p.value - p.high)
    ]


def _tails(fit: SettledFit) -> Parameter:
    """Return the degrees of freedom, with an interval that is even about their inverse.

    How well logs tell the inverse hardly depends on what it is. They tell the figure itself the
    better the lower it seems: to judge by that would pick those who are sure by chance.
    """
    dof = float(np.exp(fit.mode[-1]))
    inverse, deviation = 1.0 / dof, float(fit.deviation[-1]) / dof
    low, least = 1.0 / (inverse + Z_95 * deviation), inverse - Z_95 * deviation
    learned = deviation < LEARNED * INVERSE_DOF_SPREAD and dof > 1.05 * LEAST_DOF
    note = "" if learned else f"the logs hardly say; it takes {ADVICE['tail_dof']}"
    high = 1.0 / least if least > 0.0 else float("inf")
    return Parameter("tail_dof", "", "-", dof, low, high, learned, note)


def timing_parameters(fit: TimingFit | None) -> list[Parameter]:
    """Return mean delay and shortening over runs, and the lag."""
    if fit is None:
        note = "fewer than three runs show ramps that begin on time at a known place"
        return [Parameter("delay", "", "s", 0.0, *DELAY_BOUNDS, False, note)]
    kinds = (
        ("delay, mean over runs", "s", float(fit.delay.mean()), -np.inf),
        ("ramp shortening, mean over runs", "share", float(fit.shortening.mean()), -np.inf),
        ("lag", "s", fit.lag, 0.0),
    )
    return [
        Parameter(name, "", unit, value, max(value - half, least), value + half)
        for (name, unit, value, least), half in zip(kinds, fit.doubt, strict=True)
    ]


def rate_parameter(name: str, motor: str, rate: Rate) -> Parameter:
    """Return a share estimated from a count; one that was never seen has but an upper bound."""
    low, high = rate.interval
    note = ""
    if not rate.identified:
        note = f"never seen in {rate.trials} cases, so {100.0 * high:.2g} % at most"
        note += "; it takes longer logs"
    return Parameter(name, motor, "share", rate.mean, low, high, rate.identified, note)


def loss_parameters(losses: Sequence[LossRates]) -> list[Parameter]:
    """Return the share of lost commands of each set of motors, punctual and late apart."""
    found = []
    for loss in losses:
        motors = "+".join(loss.motors)
        found.append(rate_parameter("lost commands", motors, loss.punctual))
        if loss.late.trials:
            found.append(rate_parameter("lost commands when late", motors, loss.late))
    return found
