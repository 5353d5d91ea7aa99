"""What `calibrate` prints: parameters with intervals, held-out sessions, what was left out."""

from __future__ import annotations

from collections import Counter

import numpy as np
from rich.table import Table

from failuretwin.app.console import console
from failuretwin.connection.calibration.calibration import Calibration, HeldOut, Parameter
from failuretwin.digital_model.robot import Robot, shown_unit


def print_calibration(found: Calibration, robot: Robot) -> None:
    """Print everything that was learned and how far it can be trusted."""
    out = console()
    way = "motor readings" if found.used_readings else "the tool path alone"
    out.print(f"{robot.name}: {found.movements} settled movements of {found.runs} runs, {way}\n")
    out.print(_parameter_table(found.parameters, robot))
    for parameter in found.parameters:
        if not parameter.identified:
            out.print(f"  {_title(parameter)}: {parameter.note}", soft_wrap=True)
    for remark in found.remarks:
        out.print(f"  {remark}", soft_wrap=True)
    if found.left_out:
        out.print(f"\nleft out: {left_out_line(found)}", soft_wrap=True)
    if found.held_out:
        out.print("\nsessions predicted by what the others say (settled error)\n")
        out.print(_held_out_table(found, robot))
    out.print(f"\n{verdict_line(found)}", soft_wrap=True)


def _parameter_table(parameters: tuple[Parameter, ...], robot: Robot) -> Table:
    table = Table(box=None, pad_edge=False)
    for column in ("parameter", "value", "95 % interval", "unit", ""):
        table.add_column(column, overflow="fold")
    for p in parameters:
        scale, unit = shown_unit(p.unit, robot)
        value, low, high = (f"{scale * x:.4g}" for x in (p.value, p.low, p.high))
        known = "" if p.identified else "not identified"
        table.add_row(_title(p), value, f"{low} to {high}", unit, known)
    return table


def _title(parameter: Parameter) -> str:
    return f"{parameter.name}, {parameter.motor}" if parameter.motor else parameter.name


def _held_out_table(found: Calibration, robot: Robot) -> Table:
    scale, unit = shown_unit("rad", robot) if found.used_readings else (1e3, "mm")
    names = robot.motor_names if found.used_readings else ["x", "y", "z"]
    table = Table(box=None, pad_edge=False)
    table.add_column("session")
    table.add_column("movements")
    for name in names:
        table.add_column(f"{name} [{unit}]")
    table.add_column("gain [nats a movement]")
    for entry in found.held_out:
        cells = [
            f"{scale * before:.2f} -> {scale * after:.2f}"
            for before, after in zip(entry.before, entry.after, strict=True)
        ]
        gain = f"{entry.gain:+.2f} +- {1.96 * entry.gain_error:.2f}"
        table.add_row(entry.session, str(entry.movements), *cells, gain)
    return table


def left_out_line(found: Calibration) -> str:
    """Return how many runs and movements were left out and why, in one line."""
    kinds = Counter((entry.movement == 0, entry.motor, entry.reason) for entry in found.left_out)
    return "; ".join(_counted(count, *kind) for kind, count in kinds.most_common())


def _counted(count: int, whole_run: bool, motor: str, reason: str) -> str:
    what = ("run" if whole_run else "movement") + ("" if count == 1 else "s")
    return f"{count} {what}: {motor} {reason}" if motor else f"{count} {what}: {reason}"


def beats_uncalibrated(found: Calibration) -> bool:
    """Return False if unseen sessions say that the calibration is no better than none."""
    if not found.held_out:
        return True
    gain, error = mean_gain(found.held_out)
    return gain - error > 0.0


def verdict_line(found: Calibration) -> str:
    """Return whether the fit beats the uncalibrated twin on sessions that it has not seen."""
    if not found.held_out:
        return (
            "not checked on unseen logs: it takes two sessions, each long enough to learn from. "
            "Record another day and calibrate on both."
        )
    gain, error = mean_gain(found.held_out)
    told = f"{gain:+.2f} nats a movement (95 % interval {gain - error:+.2f} to {gain + error:+.2f})"
    if beats_uncalibrated(found):
        return f"on unseen sessions the calibrated twin beats the uncalibrated one: {told}"
    return (
        f"on unseen sessions the calibration does NOT beat the uncalibrated twin: {told}. Do not "
        "use it; record more healthy logs."
    )


def mean_gain(held_out: tuple[HeldOut, ...]) -> tuple[float, float]:
    """Return the mean gain over all movements [nats] and half its 95 % interval."""
    count = np.array([entry.movements for entry in held_out], dtype=float)
    gain = np.array([entry.gain for entry in held_out])
    error = np.array([entry.gain_error for entry in held_out])
    share = count / count.sum()
    return float(share @ gain), 1.96 * float(np.sqrt(np.sum((share * error) ** 2)))
