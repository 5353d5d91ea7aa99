"""Trained networks in files: our own format and ONNX.

Our own format is an npz archive of plain arrays and a JSON configuration, read without pickle.
"""

from __future__ import annotations

import json
import platform
import warnings
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from failuretwin import __version__
from failuretwin.core.config import fingerprint, from_table
from failuretwin.core.errors import InputError, needs_extra
from failuretwin.core.foreign import reading
from failuretwin.data_knowledge.readers.file_claims import check_npz
from failuretwin.data_knowledge.store import replacing
from failuretwin.decision.learned.diagnoser import LearnedDiagnoser, network_shape
from failuretwin.decision.learned.feature_encoder import POINTS, Expectation, FeatureEncoder
from failuretwin.decision.learned.log_pool import PoolWeights
from failuretwin.decision.learned.networks import Standard, build_network
from failuretwin.digital_model.robot import Robot, load_robot

FORMAT = 1
SUFFIX = ".npz"
_WEIGHT = "weight/"
_NOT_ARGUMENTS = ("encoder", "network")
"""Arguments of the estimator with their own place in the file."""
Arrays = dict[str, NDArray[Any]]


def check_network_file(path: Path) -> None:
    """Raise InputError unless the name ends in .npz."""
    if path.suffix != SUFFIX:
        raise InputError(f"{path}: a network file ends in {SUFFIX}.")


def save_network(diagnoser: LearnedDiagnoser, path: str | Path) -> None:
    """Write a trained network; an existing file is replaced atomically."""
    path = Path(path)
    check_network_file(path)
    configuration = json.dumps(_configuration(diagnoser)).encode()
    arrays: Arrays = {
        "configuration": np.frombuffer(configuration, dtype=np.uint8),
        **vars(diagnoser.standard_),
        **{_WEIGHT + name: array for name, array in _weights(diagnoser).items()},
    }
    with replacing(path) as partial, partial.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def _weights(diagnoser: LearnedDiagnoser) -> Arrays:
    return {name: tensor.cpu().numpy() for name, tensor in diagnoser.network_.state_dict().items()}


def _configuration(diagnoser: LearnedDiagnoser) -> dict[str, Any]:
    arguments = diagnoser.get_params(deep=False)
    encoder = diagnoser.encoder
    return {
        "format": FORMAT,
        "network": diagnoser.network,
        "encoder": encoder
        and {
            "features": encoder.features,
            "robot": encoder.robot.name,
            "arm_sha256": arm_fingerprint(encoder.robot),
            "expected": encoder.expected and asdict(encoder.expected),
        },
        "arguments": {key: v for key, v in arguments.items() if key not in _NOT_ARGUMENTS},
        "features_in": int(diagnoser.n_features_in_),
        "movements": diagnoser.movements_,
        "weights": diagnoser.weights_ and asdict(diagnoser.weights_),
        "classes": diagnoser.classes_.tolist(),
        "temperature": float(diagnoser.temperature_),
        "versions": {
            "failuretwin": __version__,
            "numpy": np.__version__,
            "torch": torch.__version__,
            "python": platform.python_version(),
        },
    }


def arm_fingerprint(robot: Robot) -> str:
    """Return a hash of the parts of a robot that features depend on."""
    return fingerprint([robot.chain, robot.loads, robot.sense, robot.sensor_sense])


def load_network(path: str | Path, robot: Robot | None = None) -> LearnedDiagnoser:
    """Read a trained network; a robot of None is the bundled one named in the file.

    Raises:
        InputError: If the file is not a network, or a network for another robot.
    """
    path = Path(path)
    with reading(path, "a network", "Expected a file that `failuretwin train` wrote."):
        check_npz(path)
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        return _restored(json.loads(arrays["configuration"].tobytes()), arrays, robot, path)


def _restored(
    configuration: dict[str, Any], arrays: Arrays, robot: Robot | None, path: Path
) -> LearnedDiagnoser:
    if configuration["format"] != FORMAT:
        raise InputError(
            f"{path}: is of format {configuration['format']}, this version reads {FORMAT}. "
            "Train it again, or use the version that wrote it: "
            f"{configuration['versions'].get('failuretwin')}."
        )
    encoder = _restored_encoder(configuration["encoder"], robot, path)
    _check_numbers(arrays, float(configuration["temperature"]))
    arguments = configuration["arguments"]
    known = set(LearnedDiagnoser().get_params(deep=False)) - set(_NOT_ARGUMENTS)
    if set(arguments) != known:
        raise KeyError(f"arguments {sorted(set(arguments) ^ known)}")
    diagnoser = LearnedDiagnoser(configuration["network"], encoder, **arguments)
    diagnoser.standard_ = Standard(arrays["mean"], arrays["spread"])
    diagnoser.classes_ = np.array(configuration["classes"])
    diagnoser.temperature_ = float(configuration["temperature"])
    movements, pool = configuration["movements"], configuration["weights"]
    diagnoser.movements_ = movements and (int(movements[0]), int(movements[1]))
    diagnoser.weights_ = pool and from_table(PoolWeights, pool, f"{path}: weights")
    shape = network_shape(encoder, len(diagnoser.standard_.mean), len(diagnoser.classes_))
    network = build_network(configuration["network"], shape)
    weights = {n.removeprefix(_WEIGHT): a for n, a in arrays.items() if n.startswith(_WEIGHT)}
    network.load_state_dict({name: torch.from_numpy(array) for name, array in weights.items()})
    diagnoser.network_ = network
    diagnoser.n_features_in_ = configuration["features_in"]
    return diagnoser


def _check_numbers(arrays: Arrays, temperature: float) -> None:
    """Raise ValueError unless all numbers of a network are valid."""
    numbers = [value for value in arrays.values() if np.issubdtype(value.dtype, np.floating)]
    if not all(np.isfinite(value).all() for value in numbers):
        raise ValueError("a weight is not finite")
    if arrays["mean"].shape != arrays["spread"].shape:
        raise ValueError("mean and spread differ in length")
    if not 0.0 < temperature < np.inf:
        raise ValueError(f"temperature {temperature:g}")


def _restored_encoder(
    table: dict[str, Any] | None, robot: Robot | None, path: Path
) -> FeatureEncoder | None:
    if table is None:
        return None
    robot = load_robot(table["robot"]) if robot is None else robot
    if table["robot"] != robot.name or table["arm_sha256"] != arm_fingerprint(robot):
        raise InputError(
            f"{path}: was trained for robot {table['robot']!r} as it was then, not for "
            f"{robot.name!r}. Name the right robot (--robot), or train a network for this one."
        )
    expected = table["expected"]
    expected = expected and from_table(Expectation, expected, f"{path}: expected")
    return FeatureEncoder(table["features"], robot, expected)


# Exports.

OPSET = 18
"""ONNX operator set; known to every runtime since 2023."""


class _Classifier(nn.Module):
    """A trained network from features (run, point, channel) to probabilities (run, class)."""

    def __init__(self, diagnoser: LearnedDiagnoser) -> None:
        super().__init__()
        self.network, self.temperature = diagnoser.network_, diagnoser.temperature_
        self.mean, self.spread = (torch.from_numpy(a) for a in vars(diagnoser.standard_).values())

    def forward(self, features: Tensor) -> Tensor:
        """Return probabilities (run, class)."""
        scores = self.network((features - self.mean) / self.spread)
        return torch.softmax(scores / self.temperature, dim=1)


def export_onnx(diagnoser: LearnedDiagnoser, path: Path) -> None:
    """Write a trained network as an ONNX file.

    Its input is `features` (run, 100, channel), its output `probabilities` (run, class); the
    metadata entry `classes` lists the classes.
    """
    with needs_extra("ONNX files need onnxscript", "learn"):
        import onnxscript  # noqa: F401
    features = torch.zeros(2, POINTS, len(diagnoser.standard_.mean))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # from inside the exporter
        program = torch.onnx.export(
            _Classifier(diagnoser).eval(),
            (features,),
            input_names=["features"],
            output_names=["probabilities"],
            opset_version=OPSET,
            dynamo=True,
            dynamic_shapes=({0: torch.export.Dim("run")},),
            verbose=False,
        )
    assert program is not None
    program.model.metadata_props["classes"] = ",".join(map(str, diagnoser.classes_))
    with replacing(path) as partial:
        partial.write_bytes(program.model_proto.SerializeToString())
