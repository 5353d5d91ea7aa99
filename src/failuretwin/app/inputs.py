"""From options of the command line to runs, hypotheses and diagnosers."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from failuretwin.app.terminal import progress_bar, tell
from failuretwin.core.config import from_table, read_toml
from failuretwin.core.errors import InputError, needs_extra
from failuretwin.core.hypothesis import Diagnosis, Hypothesis, parse_hypotheses
from failuretwin.data_knowledge.readers.bag_messages import BagTopics
from failuretwin.data_knowledge.readers.column_guess import column_map_text
from failuretwin.data_knowledge.readers.column_map import CORRECTION, read_column_map
from failuretwin.data_knowledge.readers.lerobot import CLIPPED, is_lerobot, lerobot_map_text
from failuretwin.data_knowledge.readers.lerobot_units import GUESSED, LeRobotAngles
from failuretwin.data_knowledge.readers.read import ReadOptions, find_logs, read_logs
from failuretwin.data_knowledge.run_pieces import RunPieces
from failuretwin.data_knowledge.store import write_text
from failuretwin.data_knowledge.workers import ONE_PROCESS, Workforce
from failuretwin.decision.learned.log_pool import HybridDiagnoser
from failuretwin.digital_model.arm_classes import GENERIC_NAME, class_name
from failuretwin.digital_model.calibrated_robot import CalibratedRobot, calibrated
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.diagnoser import BayesDiagnoser, Diagnoser, diagnoser_from_text
from failuretwin.inference.explanation import with_learned_method, with_reading_doubt
from failuretwin.inference.observation.computed_tool import is_computed
from failuretwin.inference.posterior import check_diagnosable
from failuretwin.inference.set_ups.log_correction import CorrectionTable, LogCorrection

if TYPE_CHECKING:
    import xarray as xr

    from failuretwin.decision.learned.diagnoser import MotorwiseDiagnoser


def read_inputs(
    logs: Sequence[Path],
    robot: Robot,
    options: ReadOptions,
    columns: Path | None,
    workforce: Workforce | None = None,
) -> xr.Dataset:
    """Return the runs of all logs as one run set, read with the map of `columns`, if any."""
    options, correction = with_map(options, columns, logs, robot)
    found = find_logs(logs, options)
    with progress_bar("reading logs", len(found)) as advance:
        runs = read_logs(found, robot, options, workforce or ONE_PROCESS, advance)
    if correction is not None:
        runs = correction.runs(runs)
    source = str(runs.attrs.get("source", ""))
    if source.startswith("LeRobot") and (GUESSED in source or CLIPPED in source):
        told = ". State it with --columns MAP.toml" if GUESSED in source else ""
        tell(f"note: {source.rpartition('; ')[0]}{told}", err=True)
    return runs


def read_some(
    logs: Sequence[Path], robot: Robot, options: ReadOptions, columns: Path | None, most: int
) -> xr.Dataset:
    """Return the runs of all logs; of more than `most`, so many evenly spread ones, and say so.

    Raises:
        InputError: If they cannot be read.
    """
    mapped, correction = with_map(options, columns, logs, robot)
    every = RunPieces(logs, robot, mapped)
    if every.size <= most:
        return read_inputs(logs, robot, options, columns)
    runs = every.sample(most)
    tell(f"note: {runs.sizes['run']} of {every.size} runs are used, evenly spread", err=True)
    return runs if correction is None else correction.runs(runs)


def with_doubts(
    diagnoses: Sequence[Diagnosis], runs: xr.Dataset, twin: DigitalTwin, learned: bool = False
) -> list[Diagnosis]:
    """Return diagnoses with what else is to be said of their runs.

    Args:
        diagnoses: The diagnoses.
        runs: Their runs; a tool path that was computed from motor readings needs a caveat.
        twin: The robot.
        learned: Whether their priors were learned.
    """
    said = list(diagnoses)
    if is_computed(runs, twin):
        said = [with_reading_doubt(one, one.diagnosis or "") for one in said]
    return [with_learned_method(one) for one in said] if learned else said


def warn_mismatch(runs: xr.Dataset, expected: str) -> None:
    """Warn if simulated runs have other imperfections than the expected ones (by name)."""
    try:
        made_with = json.loads(runs.attrs["configuration"])["imperfections"]
    except (KeyError, TypeError, ValueError):  # a run set of other people may say anything there
        return
    if isinstance(made_with, str) and expected not in (made_with, GENERIC_NAME):
        tell(
            f"note: the runs were simulated with imperfections '{made_with}', the diagnosis "
            f"expects '{expected}'; there will be false alarms",
            err=True,
        )


def with_map(
    options: ReadOptions, path: Path | None, logs: Sequence[Path], robot: Robot
) -> tuple[ReadOptions, LogCorrection | None]:
    """Return the options with a map of columns, topics or angles, and the correction in it."""
    if path is None:
        return options, None
    if not path.exists():
        raise _guessed(path, logs, robot)
    if path.suffix == ".json":
        return replace(options, lerobot=stated_angles(path)), None
    table, correction = read_toml(path), None
    if CORRECTION in table:
        where = f"{path}: {CORRECTION}"
        stated = from_table(CorrectionTable, table[CORRECTION], where)
        correction = LogCorrection.from_file(stated, len(robot.motors), where)
    if "topics" in table:
        topics = from_table(BagTopics, table["topics"], f"{path}: topics")
        options = replace(options, topics=topics)
    elif "lerobot" in table:
        options = replace(options, lerobot=stated_angles(path))
    elif set(table) != {CORRECTION}:
        options = replace(options, columns=read_column_map(path, robot))
    return options, correction


def stated_angles(path: Path | None) -> LeRobotAngles | None:
    """Return the angles that a map or a calibration file of LeRobot (.json) states, if any."""
    if path is not None and path.suffix == ".json":
        return LeRobotAngles(calibration=str(path))
    table = {} if path is None else read_toml(path)
    if path is None or "lerobot" not in table:
        return None
    angles = from_table(LeRobotAngles, table["lerobot"], f"{path}: lerobot")
    beside = path.parent / angles.calibration
    return replace(angles, calibration=str(beside)) if angles.calibration else angles


def _guessed(path: Path, logs: Sequence[Path], robot: Robot) -> InputError:
    """Write and show a guessed map; return the request to check it."""
    log = next((s for s in logs if is_lerobot(s) or (s.suffix == ".csv" and s.is_file())), None)
    if log is None:
        return InputError(
            f"{path}: does not exist, and no CSV file or LeRobot data set is given to guess it "
            "from."
        )
    text = (lerobot_map_text if is_lerobot(log) else column_map_text)(log, robot)
    write_text(text, path)
    tell(text)
    return InputError(
        f"{path} did not exist. The guess above has been written there and nothing was read: check "
        "every line, correct it, and run the same command again."
    )


# The extra `learn`.


def check_learning() -> None:
    """Raise InputError, saying how to install them, if the learning libraries are missing."""
    with needs_extra("networks need PyTorch and scikit-learn", "learn"):
        import sklearn
        import torch
    del sklearn, torch


# Diagnoser of `--method`.

BAYES = "bayes"
"""Name of the method that needs no file."""
BLEND = f"{BAYES}+"
"""Prefix of the file of a network that is blended with it."""


def parse_cli_hypotheses(text: str | None, robot: Robot) -> tuple[Hypothesis, ...] | None:
    """Return the hypotheses of a text separated by commas; None: the default ones."""
    if text is None:
        return None
    try:
        hypotheses = parse_hypotheses(text.split(","), robot.motor_names)
    except InputError as error:
        raise InputError(f"{error} Modes: {', '.join(MODES)}.") from error
    for hypothesis in hypotheses:
        check_diagnosable(hypothesis)
    if len(hypotheses) < 2:
        raise InputError(
            f"--hypotheses names only {hypotheses[0]}, so every run would be that for certain. "
            "Expected two at least, such as healthy,motor_1:stuck."
        )
    return hypotheses


def chosen_diagnoser(method: str, bayes: BayesDiagnoser) -> Diagnoser:
    """Return the diagnoser of `--method`.

    It is ``bayes``, the file of a network, ``bayes+`` and that file, or ``module:Class`` of the
    user's own.
    """
    if method == BAYES:
        return bayes
    path = Path(method.removeprefix(BLEND))
    own = ":" in method and path.suffix != ".npz" and not path.exists()
    if not own and not path.exists():
        raise InputError(
            f"--method {path}: is neither 'bayes', nor a file that exists, nor module:Class. Train "
            f"a network with `failuretwin train --out {path.with_suffix('.npz')}`."
        )
    if own:
        return diagnoser_from_text(method, bayes.twin)
    check_learning()
    from failuretwin.decision.learned.storage import load_network

    network = load_network(path, _told_robot(bayes))
    return _pooled(network, bayes, path) if method.startswith(BLEND) else network


def _told_robot(bayes: BayesDiagnoser) -> Robot | CalibratedRobot:
    """Return the robot, with its healthy behaviour where that is not what its profile says."""
    robot, told = bayes.twin.robot, bayes.imperfections
    if told is None or told == calibrated(robot).imperfections:
        return robot
    return CalibratedRobot(robot, told)


def _pooled(network: MotorwiseDiagnoser, bayes: BayesDiagnoser, path: Path) -> HybridDiagnoser:
    if network.weights_ is None:
        raise InputError(
            f"{path}: how it weighs beside Bayes was never fitted. Train it "
            "with `failuretwin train`, or use it alone."
        )
    return HybridDiagnoser(bayes, network, network.weights_, class_name(bayes.twin.robot))


def expected_name(diagnoser: Diagnoser) -> str:
    """Return the name of the healthy behaviour that a diagnoser expects.

    The expectation of a user's class is unknown.
    """
    encoder = getattr(diagnoser, "encoder", None)
    if encoder is None:
        return GENERIC_NAME
    return str(encoder.imperfections.name)
