"""Health checks and designed motions as lines, tables and JSON; changes since earlier checks."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from failuretwin.app.reports.isolability_report import sizes_of_motor
from failuretwin.app.reports.technician_page import Section, write_page
from failuretwin.app.terminal import SHOWN, Part, Table, figures_table
from failuretwin.core.errors import counted
from failuretwin.core.foreign import reading
from failuretwin.data_knowledge.store import filling, write_records
from failuretwin.decision.robot_state import robot_state
from failuretwin.decision.test_motions.health_check import OPEN, CheckResult
from failuretwin.decision.test_motions.motions import Motions, write_motions
from failuretwin.digital_model.robot import Robot

ERROR = "steady_state_error"
CHANGED = 3.0
"""Difference to the check before from which a zero or play has changed [standard deviations]."""
LIMIT = "green rules out what the last column says; smaller errors may be there"
"""Remark on a green light."""
LIKELY = 0.05
"""Probability from which motors are named if the result is open."""


def check_lines(result: CheckResult, robot: Robot, seconds: float) -> list[Part]:
    """Return the result of a check: the light, and the figures of every motor."""
    diagnosis = result.diagnosis
    head = f"{result.light.upper()}: {diagnosis.verdict}"
    if result.light == OPEN and not diagnosis.undecided:
        names = [name for name, p in result.by_motor.items() if p >= LIKELY]
        head += f". Ask {' and '.join(names)} further: --further 6" if names else ""
    seen = ("moment", "on the way") if result.on_the_way else ("movement", "seen at rest")
    made = f"{counted(result.movements, seen[0])} {seen[1]}"
    made += f", {seconds:.0f} s planned" if seconds else ""
    if result.further:
        made += f", {counted(result.further, 'further movement')}"
    low = ["" if not diagnosis.quality else "the log: " + "; ".join(diagnosis.quality)]
    said = [] if result.shown is None else [LIMIT]
    return [head, made, *filter(None, low), motor_table(result, robot), *said]


def closing_lines(result: CheckResult, robot: Robot) -> list[str]:
    """Return the last lines of a check: state, certainty and next step, as on its page."""
    state = robot_state([result.diagnosis], robot)
    return [state.line, f"what to do: {state.step}"]


def write_check_page(results: Sequence[CheckResult], robot: Robot, folder: Path) -> None:
    """Write the technician's page of one check, or of the logs of several, into a folder."""
    diagnoses = [result.diagnosis for result in results]
    measured = [
        Section("What the check measured", tables=[motor_table(result, robot)])
        for result in results
        if len(results) == 1
    ]
    with filling(folder) as partial:
        state = robot_state(diagnoses, robot)
        write_page(diagnoses, state, robot, partial / "index.html", sections=measured)


def _unit(robot: Robot, k: int) -> str:
    return "m" if robot.slides[k] else "rad"


def motor_table(result: CheckResult, robot: Robot) -> Table:
    """Return zero and play of each motor, in degrees, of slides in millimetres."""
    found, shown, rows = result.offsets, result.shown, []
    for k, name in enumerate(robot.motor_names):
        factor, unit = SHOWN[_unit(robot, k)]
        rows.append([
            name,
            f"{result.by_motor.get(name, 0.0):.1%}",
            *(f"{factor * value[k]:+.2f} +- {factor * deviation[k]:.2f} {unit}"
              for value, deviation in ((found.zero, found.zero_sd), (found.play, found.play_sd))),
            *([] if shown is None else [sizes_of_motor(shown, name, robot)]),
        ])  # fmt: skip
    heads = ["motor", "faulty", "zero off by", "play"]
    return figures_table([*heads, *([] if shown is None else ["shows errors from"])], rows)


def check_record(result: CheckResult, robot: Robot, seconds: float) -> dict[str, Any]:
    """Return a check as a JSON object: its diagnosis, as of `diagnose --json`, and more."""
    found, shown = result.offsets, result.shown
    return {
        **result.diagnosis.to_record(),
        "robot": robot.name,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "light": result.light,
        "motor": result.motor or None,
        "movements": result.movements,
        "further": result.further,
        "seconds": seconds,
        "motors": [
            {
                "motor": name,
                "probability": result.by_motor.get(name, 0.0),
                "zero": float(found.zero[k]),
                "zero_deviation": float(found.zero_sd[k]),
                "play": float(found.play[k]),
                "play_deviation": float(found.play_sd[k]),
                "unit": _unit(robot, k),
                "shown_from": None if shown is None else shown.isolated.get(f"{name}:{ERROR}"),
            }
            for k, name in enumerate(robot.motor_names)
        ],
    }


# Kept checks: the same motions again, and the changes since.


def kept_checks(path: Path) -> list[dict[str, Any]]:
    """Return the checks of a kept file, the oldest first."""
    with reading(path, "kept checks", "Expected what `check --keep` wrote."):
        checks = json.loads(path.read_text(encoding="utf-8"))["checks"]
        _ = checks[-1]["date"], checks[-1]["motors"][0]["zero"]
        return list(checks)


def keep_check(path: Path, motions: Motions, checks: Sequence[dict[str, Any]]) -> None:
    """Keep motions, and the checks that were made by them, the oldest first."""
    write_records([{"motions": motions.record(), "checks": checks}], path)


def changes(before: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """Return the changes since a check of the same motions, a line each."""
    lines = []
    for old, new in zip(before["motors"], now["motors"], strict=True):
        for what in ("zero", "play"):
            moved = new[what] - old[what]
            spread = float(np.hypot(new[f"{what}_deviation"], old[f"{what}_deviation"]))
            if abs(moved) > CHANGED * spread:
                factor, unit = SHOWN[new["unit"]]
                lines.append(
                    f"since {before['date'][:10]}: {what} of {new['motor']} changed by "
                    f"{factor * moved:+.2f} {unit} ({abs(moved) / spread:.1f} deviations)"
                )
    return lines or [
        f"since {before['date'][:10]}: no zero and no play changed by more than {CHANGED:.0f} "
        "deviations"
    ]


# Designs.


def motion_lines(motions: Motions, robot: Robot, written: Path | None = None) -> list[Part]:
    """Return the movements of the motors, a row each; they go to a file if one is named."""
    saved = []
    if written is not None:
        write_motions(motions, robot, written)
        saved = [f"written to {written}; nothing was moved"]
    scales = [SHOWN[_unit(robot, k)] for k in range(len(robot.motors))]
    factor = np.array([scale for scale, _ in scales])
    rows = [
        [f"{k + 1}", f"{begin:.1f}", f"{ramp:.2f}", *(f"{x:.1f}" for x in factor * target)]
        for k, (begin, ramp, target) in enumerate(
            zip(motions.start_s, motions.ramp_s, motions.target, strict=True)
        )
    ]
    heads = [f"{name} [{unit}]" for name, (_, unit) in zip(robot.motor_names, scales, strict=True)]
    return [
        f"{counted(len(rows), 'movement')} in {motions.duration_s:.1f} s",
        figures_table(["", "at [s]", "ramp [s]", *heads], rows),
        *saved,
    ]
