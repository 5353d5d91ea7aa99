"""What `calibrate` says: parameters with intervals, held-out sessions, what was left out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from failuretwin.app.tables import Table, show
from failuretwin.connection.calibration.result import Calibration, HeldOut, Parameter
from failuretwin.core.runs import AXES
from failuretwin.digital_model.robot import Robot, shown_unit


def print_calibration(found: Calibration, robot: Robot) -> None:
    """Print everything that was learned and how far it can be trusted."""
    way = "motor readings" if found.used_readings else "the tool path alone"
    show(f"{robot.name}: {found.movements} settled movements of {found.runs} runs, {way}\n")
    show(_parameter_table(found.parameters, robot))
    show(*(f"  {_title(p)}: {p.note}" for p in found.parameters if not p.identified))
    show(*(f"  {remark}" for remark in found.remarks))
    if found.left_out:
        show(f"\nleft out: {left_out_line(found)}")
    if found.held_out:
        show("\nsessions predicted by what the others say (settled error)\n")
        show(held_out_table(found, robot))
    show(f"\n{verdict_line(found)}")


def _parameter_table(parameters: tuple[Parameter, ...], robot: Robot) -> Table:
    rows = []
    for p in parameters:
        scale, unit = shown_unit(p.unit, robot)
        value, low, high = (f"{scale * x:.4g}" for x in (p.value, p.low, p.high))
        known = "" if p.identified else "not identified"
        rows.append((_title(p), value, f"{low} to {high}", unit, known))
    return Table(("parameter", "value", "95 % interval", "unit", ""), rows)


def _title(parameter: Parameter) -> str:
    return f"{parameter.name}, {parameter.motor}" if parameter.motor else parameter.name


def channels(robot: Robot, of_motors: bool) -> tuple[list[str], float, str]:
    """Return the name of each motor or tool axis, factor and name of the unit that people read."""
    if not of_motors:
        return [f"tool {axis}" for axis in AXES], 1e3, "mm"
    scale, unit = shown_unit("rad", robot)
    return [name.replace("_", " ") for name in robot.motor_names], scale, unit


def held_out_table(found: Calibration, robot: Robot) -> Table:
    """Return the settled error of each unseen session, uncalibrated and predicted, and the gain."""
    names, scale, unit = channels(robot, found.used_readings)
    rows = []
    for entry in found.held_out:
        pairs = scale * np.array([entry.before, entry.after]).T
        cells = (f"{before:.2f} -> {after:.2f}" for before, after in pairs)
        gain = f"{entry.gain:+.2f} +- {1.96 * entry.gain_error:.2f}"
        rows.append((entry.session, str(entry.movements), *cells, gain))
    settled = (f"{name} [{unit}]" for name in names)
    return Table(("session", "movements", *settled, "gain [nats a movement]"), rows)


def left_out_line(found: Calibration) -> str:
    """Return how many runs and movements were left out and why, in one line."""
    kinds = Counter((entry.movement == 0, entry.motor, entry.reason) for entry in found.left_out)
    return "; ".join(_counted(count, *kind) for kind, count in kinds.most_common())


def _counted(count: int, whole_run: bool, motor: str, reason: str) -> str:
    what = ("run" if whole_run else "movement") + ("" if count == 1 else "s")
    return f"{count} {what}: {motor} {reason}" if motor else f"{count} {what}: {reason}"


def beats_uncalibrated(found: Calibration) -> bool | None:
    """Return whether unseen sessions say that the calibration is better than none; None: no say."""
    if not found.held_out:
        return None
    gain, error = mean_gain(found.held_out)
    return gain - error > 0.0


def verdict_line(found: Calibration) -> str:
    """Return whether the fit beats the uncalibrated twin on sessions that it has not seen."""
    better = beats_uncalibrated(found)
    if better is None:
        return (
            "not checked on unseen logs: it takes two sessions, each long enough to learn from. "
            "Record another day and calibrate on both."
        )
    gain, error = mean_gain(found.held_out)
    nats = f"{gain:+.2f} nats a movement (95 % interval {gain - error:+.2f} to {gain + error:+.2f})"
    if better:
        return f"on unseen sessions the calibrated twin beats the uncalibrated one: {nats}"
    return (
        f"on unseen sessions the calibration does NOT beat the uncalibrated twin: {nats}. Do not "
        "use it; record more healthy logs."
    )


def mean_gain(held_out: tuple[HeldOut, ...]) -> tuple[float, float]:
    """Return the mean gain over all movements [nats] and half its 95 % interval."""
    count = np.array([entry.movements for entry in held_out], dtype=float)
    gain = np.array([entry.gain for entry in held_out])
    error = np.array([entry.gain_error for entry in held_out])
    share = count / count.sum()
    return float(share @ gain), 1.96 * float(np.sqrt(np.sum((share * error) ** 2)))


# The rows of a calibration page: figures rounded as far as they are known, and interval bars.

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
    "late start, median": "the median delay of a late start",
    "readings stop, median": "time from a movement to the last reading before a late one",
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
