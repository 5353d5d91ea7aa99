"""A trained network in one file: weights, configuration and versions, and no code.

An npz archive of plain arrays, read without pickle, so that loading a file of a stranger runs
nothing. The configuration is JSON in an array of bytes.
"""

from __future__ import annotations

import json
import platform
import zipfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch

from failuretwin import __version__
from failuretwin.core.config import fingerprint, from_table
from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.store import reason, replacing
from failuretwin.decision.learned.diagnoser import LearnedDiagnoser, network_shape
from failuretwin.decision.learned.features import Encoder, Expectation
from failuretwin.decision.learned.networks import Standard, build_network
from failuretwin.decision.learned.posteriors import Weights
from failuretwin.digital_model.robot import Robot

FORMAT = 1
SUFFIX = ".npz"
_WEIGHT = "weight/"
_NOT_STORED = ("encoder", "network")
"""Arguments of the estimator that have a place of their own in the file."""


def check_network_file(path: Path) -> None:
    """Raise InputError unless a network can be written under this name."""
    if path.suffix != SUFFIX:
        raise InputError(f"{path}: a network file ends in {SUFFIX}.")


def save_network(diagnoser: LearnedDiagnoser, path: Path) -> None:
    """Write a trained network; a file of that name is replaced at the end, all at once.

    Raises:
        InputError: If the suffix is not .npz.
        OutputError: If it cannot be written.
    """
    check_network_file(path)
    configuration = json.dumps(_configuration(diagnoser)).encode()
    arrays: dict[str, Any] = {
        "configuration": np.frombuffer(configuration, dtype=np.uint8),
        "mean": diagnoser.standard_.mean,
        "spread": diagnoser.standard_.spread,
    }
    for name, tensor in diagnoser.network_.state_dict().items():
        arrays[_WEIGHT + name] = tensor.cpu().numpy()
    with replacing(path) as partial, partial.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def _configuration(diagnoser: LearnedDiagnoser) -> dict[str, Any]:
    arguments = diagnoser.get_params(deep=False)
    return {
        "format": FORMAT,
        "network": diagnoser.network,
        "encoder": None if diagnoser.encoder is None else _encoder_table(diagnoser.encoder),
        "arguments": {key: v for key, v in arguments.items() if key not in _NOT_STORED},
        "features_in": int(diagnoser.n_features_in_),
        "movements": diagnoser.movements_,
        "weights": None if diagnoser.weights_ is None else asdict(diagnoser.weights_),
        "classes": diagnoser.classes_.tolist(),
        "temperature": float(diagnoser.temperature_),
        "versions": {
            "failuretwin": __version__,
            "numpy": np.__version__,
            "torch": torch.__version__,
            "python": platform.python_version(),
        },
    }


def _encoder_table(encoder: Encoder) -> dict[str, Any]:
    expected = None if encoder.expected is None else asdict(encoder.expected)
    return {
        "features": encoder.features,
        "robot": encoder.robot.name,
        "arm_sha256": arm_fingerprint(encoder.robot),
        "expected": expected,
    }


def arm_fingerprint(robot: Robot) -> str:
    """Return a hash of all of a robot that features depend on."""
    return fingerprint([robot.chain, robot.loads, robot.sense, robot.sensor_sense])


def load_network(path: str | Path, robot: Robot) -> LearnedDiagnoser:
    """Read a trained network.

    Args:
        path: The file.
        robot: The robot that it was trained for.

    Raises:
        InputError: If the file cannot be read, is no network, or is one for another robot.
    """
    path = Path(path)
    arrays = _read(path)
    try:
        configuration = json.loads(arrays["configuration"].tobytes())
        if configuration["format"] != FORMAT:
            raise InputError(
                f"{path}: is of format {configuration['format']}, this version reads {FORMAT}. "
                "Train it again, or use the version that wrote it: "
                f"{configuration['versions'].get('failuretwin')}."
            )
        return _restored(configuration, arrays, robot, path)
    except InputError:
        raise
    except (KeyError, TypeError, AttributeError, ValueError, RuntimeError) as error:
        raise _no_network(path, error) from error


def _read(path: Path) -> dict[str, np.ndarray]:
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files}
    except (OSError, ValueError, TypeError, AttributeError, EOFError, zipfile.BadZipFile) as error:
        raise _no_network(path, error) from error


def _no_network(path: Path, error: BaseException) -> InputError:
    return InputError(
        f"{path}: cannot be read as a network ({reason(error)}). Expected a file that "
        "`failuretwin train` wrote."
    )


def _restored(
    configuration: dict[str, Any], arrays: dict[str, np.ndarray], robot: Robot, path: Path
) -> LearnedDiagnoser:
    encoder = _restored_encoder(configuration["encoder"], robot, path)
    _check_numbers(arrays, float(configuration["temperature"]))
    arguments = configuration["arguments"]
    known = set(LearnedDiagnoser().get_params(deep=False)) - set(_NOT_STORED)
    if set(arguments) != known:
        raise KeyError(f"arguments {sorted(set(arguments) ^ known)}")
    diagnoser = LearnedDiagnoser(configuration["network"], encoder, **arguments)
    diagnoser.standard_ = Standard(arrays["mean"], arrays["spread"])
    diagnoser.classes_ = np.array(configuration["classes"])
    diagnoser.temperature_ = float(configuration["temperature"])
    movements = configuration["movements"]
    diagnoser.movements_ = None if movements is None else (int(movements[0]), int(movements[1]))
    weights = configuration["weights"]
    diagnoser.weights_ = (
        None if weights is None else from_table(Weights, weights, f"{path}: weights")
    )
    channels = len(diagnoser.standard_.mean)
    shape = network_shape(encoder, channels, len(diagnoser.classes_))
    network = build_network(configuration["network"], shape)
    network.load_state_dict(
        {
            name.removeprefix(_WEIGHT): torch.from_numpy(array)
            for name, array in arrays.items()
            if name.startswith(_WEIGHT)
        }
    )
    diagnoser.network_ = network
    diagnoser.n_features_in_ = configuration["features_in"]
    return diagnoser


def _check_numbers(arrays: dict[str, np.ndarray], temperature: float) -> None:
    """Raise ValueError unless the numbers of a network can be reckoned with."""
    numbers = [value for value in arrays.values() if np.issubdtype(value.dtype, np.floating)]
    if not all(np.isfinite(value).all() for value in numbers):
        raise ValueError("a weight is not finite")
    if arrays["mean"].shape != arrays["spread"].shape:
        raise ValueError("mean and spread differ in length")
    if not 0.0 < temperature < np.inf:
        raise ValueError(f"temperature {temperature:g}")


def _restored_encoder(table: dict[str, Any] | None, robot: Robot, path: Path) -> Encoder | None:
    if table is None:
        return None
    if table["robot"] != robot.name or table["arm_sha256"] != arm_fingerprint(robot):
        raise InputError(
            f"{path}: was trained for robot {table['robot']!r} as it was then, not for "
            f"{robot.name!r}. Name the right robot (--robot), or train a network for this one."
        )
    expected = table["expected"]
    return Encoder(
        table["features"],
        robot,
        None if expected is None else from_table(Expectation, expected, f"{path}: expected"),
    )
