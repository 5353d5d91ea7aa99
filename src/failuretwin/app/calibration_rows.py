"""The rows of a calibration page: figures rounded as far as they are known, and interval bars."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from failuretwin.connection.calibration.calibration import Calibration, Parameter
from failuretwin.digital_model.robot import Robot, shown_unit

MEANING = {
    "bias": "error of the resting motor that is there in every pose",
    "compliance": "how far a motor gives way under the load torque of the arm",
    "friction": "how far it stops short, seen in the direction of travel",
    "scatter": "what is left, from movement to movement (scale of its Student t distribution)",
    "tail_dof": "degrees of freedom of the scatter: 30 is nearly normal, 3 has heavy tails",
    "delay, mean over runs": "dead time on top of the servo loop",
    "ramp shortening, mean over runs": "share of its time by which a ramp ends early",
    "lag": "time constant of a first-order lag on top of the servo loop",
    "late starts": "movements that start late, all motors together",
    "late start, least": "the shortest delay of a late start",
    "late start, most": "the longest delay of a late start",
    "readings stop before a late start": "time after the movement before; interval of single gaps",
    "lost commands": "movements on time for which a motor does not get its command",
    "lost commands when late": "the same for movements that start late",
    "spoilt readings": "readings that are missing or out of range",
    "loop gain P": "proportional gain of the servo loop, from step tests",
    "loop gain I": "integral gain of the servo loop, from step tests",
    "filter time": "time constant of the loop's input filter, from step tests",
    "speed limit": "largest speed of the motor, from step tests",
    "dead time": "time from a command to the first motion, from step tests",
    "overshoot": "how far a step goes beyond where it settles",
    "settling time after the ramp": "until a step stays where it settles",
}
TITLES = {"tail_dof": "tails"}
SHORT_S = 0.2
"""Times below this are shown in milliseconds [s]."""


@dataclass(frozen=True)
class Row:
    """One parameter of one motor as text, and its interval as shares of the bar's width [%].

    Attributes:
        who: The motors; empty for the whole robot.
        value: Best value.
        interval: 95 % interval.
        left: Where the interval begins on the bar.
        width: How wide it is.
        tick: Where the value stands.
        identified: Whether the logs say it.
        note: What is missing where they do not.
    """

    who: str
    value: str
    interval: str
    left: float
    width: float
    tick: float
    identified: bool
    note: str


@dataclass(frozen=True)
class Group:
    """The same parameter of all motors.

    Attributes:
        title: Its name.
        meaning: What it is, in plain words.
        unit: Its unit.
        zero: Where zero lies on the bars [%]; None: not on them.
        rows: A row a motor.
    """

    title: str
    meaning: str
    unit: str
    zero: float | None
    rows: tuple[Row, ...]


def parameter_groups(found: Calibration, robot: Robot) -> list[Group]:
    """Return the parameters as text, those of the same name together."""
    by_name: dict[str, list[Parameter]] = {}
    for parameter in found.parameters:
        by_name.setdefault(parameter.name, []).append(parameter)
    return [_group(name, members, robot) for name, members in by_name.items()]


def _group(name: str, members: Sequence[Parameter], robot: Robot) -> Group:
    scale, unit = _unit(members, robot)
    ends = scale * np.array([(p.low, p.value, p.high) for p in members])
    known = ends[[p.identified for p in members]]
    low, high = _span(known if len(known) else ends)
    at = np.clip(100.0 * (ends - low) / (high - low), 0.0, 100.0)
    rows = [_row(p, e, a) for p, e, a in zip(members, ends, at, strict=True)]
    zero = -100.0 * low / (high - low)
    return Group(
        title=TITLES.get(name, name),
        meaning=MEANING.get(name, ""),
        unit=unit,
        zero=zero if 0.0 <= zero <= 100.0 else None,
        rows=tuple(rows),
    )


def _unit(members: Sequence[Parameter], robot: Robot) -> tuple[float, str]:
    unit = members[0].unit
    if unit == "share":
        return 100.0, "%"
    if unit == "s" and max(abs(p.high) for p in members) < SHORT_S:
        return 1e3, "ms"
    return (1.0, "") if unit == "-" else shown_unit(unit, robot)


def _span(ends: np.ndarray) -> tuple[float, float]:
    """Return the ends of the bars' common scale; it begins at zero unless that is far away."""
    low, high = float(ends.min()), float(ends.max())
    if low > 0.0 and low < 0.6 * high:
        low = 0.0
    margin = 0.04 * (high - low) or 1.0
    return (low if low == 0.0 else low - margin), high + margin


def _row(parameter: Parameter, ends: np.ndarray, at: np.ndarray) -> Row:
    low, value, high = (float(x) for x in ends)
    told = parameter.identified
    return Row(
        who=parameter.motor.replace("_", " ").replace("+", ", "),
        value=figure(value, high - low) if told else "",
        interval=f"{figure(low, high - low)} to {figure(high, high - low)}" if told else "",
        left=float(at[0]),
        width=float(at[2] - at[0]),
        tick=float(at[1]),
        identified=told,
        note=parameter.note,
    )


def figure(value: float, width: float) -> str:
    """Return a value with as many digits as an interval of this width leaves meaning."""
    if width <= 0.0 or not np.isfinite(width):
        return f"{value:.3g}"
    decimals = int(np.clip(1 - np.floor(np.log10(width / 2.0)), 0, 6))
    return f"{value + 0.0:.{decimals}f}"
