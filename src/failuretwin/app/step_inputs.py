"""Step tests among the logs of a calibration: sorted out, fitted, and joined to the result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from failuretwin.connection.calibration.calibration import Calibration, LeftOut
from failuretwin.connection.calibration.loops import with_loops
from failuretwin.connection.calibration.step_parameters import StepFit, fit_steps
from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.matlab_files import find_matlab_files
from failuretwin.data_knowledge.raw_session import SESSION_FILES
from failuretwin.data_knowledge.step_tests import find_step_tests, read_step_test
from failuretwin.digital_model.robot import Robot


@dataclass(frozen=True)
class LearnedLoops:
    """What step tests say of a robot.

    Attributes:
        robot: The robot with the loops found; as it was unless every motor was tested.
        fits: What was learned of each motor.
        left_out: Steps that did not count.
    """

    robot: Robot
    fits: tuple[StepFit, ...] = ()
    left_out: tuple[LeftOut, ...] = ()


def split_step_tests(logs: Sequence[Path], columns: Path | None) -> tuple[list[Path], list[Path]]:
    """Return step tests, as files, and all other logs.

    A folder that holds both kinds counts as both.

    Args:
        logs: Files and folders.
        columns: Column map, by which other CSV files in a folder are logs; None: they are not.

    Raises:
        InputError: If there are step tests only.
    """
    tests, others = list[Path](), list[Path]()
    for log in logs:
        found = find_step_tests(log)
        tests += found
        if not found or (log.is_dir() and _holds_more(log, found, columns)):
            others.append(log)
    if not others:
        raise InputError(
            f"{len(tests)} step tests and no other log. Step tests say how fast a motor follows, "
            "but each rests at two or three places only; where motors settle takes logs of the arm "
            "moving about. Give a session of the healthy robot beside them."
        )
    return list(dict.fromkeys(tests)), others


def _holds_more(folder: Path, tests: list[Path], columns: Path | None) -> bool:
    if any(True for name in SESSION_FILES for _ in folder.rglob(name)):
        return True
    if columns is not None and len(list(folder.rglob("*.csv"))) > len(tests):
        return True
    return bool(find_matlab_files(folder))


def learn_loops(tests: Sequence[Path], robot: Robot) -> LearnedLoops:
    """Fit servo loops to step tests.

    Raises:
        InputError: If a file cannot be read, or there are step tests but none can be used.
    """
    if not tests:
        return LearnedLoops(robot)
    steps = [step for test in tests for step in read_step_test(test, robot)]
    fits, left_out = fit_steps(steps, robot)
    if not fits:
        told = "; ".join(f"{out.run}: step {out.movement} {out.reason}" for out in left_out[:3])
        raise InputError(
            f"none of {len(steps)} steps can be used ({told}). Give step tests of a healthy motor "
            "in files named after its servo, such as test_motor_6.csv, or leave them out."
        )
    loops = [fit.loop for fit in fits] if len(fits) == len(robot.motors) else []
    return LearnedLoops(with_loops(robot, loops), fits, left_out)


def with_step_tests(found: Calibration, steps: LearnedLoops) -> Calibration:
    """Return a calibration with what step tests say.

    Loops join it only if every motor has one: delay and lag, which are those of the whole robot,
    are on top of the loops and cannot be on top of two kinds.
    """
    if not steps.fits:
        return found
    counts = ", ".join(f"{fit.steps} of {fit.motor}" for fit in steps.fits)
    tested = [fit.motor for fit in steps.fits]
    missing = [name for name in steps.robot.motor_names if name not in tested]
    use = "delay, lag and ramp shortening are what is left on top of them"
    if missing:
        use = f"not used by the twin, since {', '.join(missing)} had no step test"
    return replace(
        found,
        parameters=(*found.parameters, *(p for fit in steps.fits for p in fit.parameters)),
        loops=() if missing else tuple(fit.loop for fit in steps.fits),
        left_out=(*found.left_out, *steps.left_out),
        remarks=(*found.remarks, f"servo loops from step tests ({counts}): {use}"),
    )
