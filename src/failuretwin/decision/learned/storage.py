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
from failuretwin.decision.learned.diagnoser import (
    LearnedDiagnoser,
    NetworkDiagnoser,
    network_shape,
)
from failuretwin.decision.learned.feature_encoder import POINTS, Expectation, FeatureEncoder
from failuretwin.decision.learned.log_pool import PoolWeights
from failuretwin.decision.learned.moment_encoder import MomentEncoder
from failuretwin.decision.learned.moment_features import FEATURES
from failuretwin.decision.learned.motorwise import MotorwiseNetwork, class_logits
from failuretwin.decision.learned.motorwise_diagnoser import NETWORK, MotorwiseDiagnoser
from failuretwin.decision.learned.networks import Standard, build_network
from failuretwin.digital_model.calibrated_robot import CalibratedRobot, calibrated
from failuretwin.digital_model.nonidealities import Imperfections
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


def save_network(diagnoser: NetworkDiagnoser, path: str | Path) -> None:
    """Write a trained network; an existing file is replaced atomically."""
    path = Path(path)
    check_network_file(path)
    own = _motorwise(diagnoser) if isinstance(diagnoser, MotorwiseDiagnoser) else {}
    if isinstance(diagnoser, LearnedDiagnoser):
        own = _on_features(diagnoser)
    configuration = json.dumps({**_configuration(diagnoser), **own}).encode()
    arrays: Arrays = {
        "configuration": np.frombuffer(configuration, dtype=np.uint8),
        **(vars(diagnoser.standard_) if isinstance(diagnoser, LearnedDiagnoser) else {}),
        **{_WEIGHT + name: array for name, array in _weights(diagnoser).items()},
    }
    with replacing(path) as partial, partial.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def _weights(diagnoser: NetworkDiagnoser) -> Arrays:
    return {name: tensor.cpu().numpy() for name, tensor in diagnoser.network_.state_dict().items()}


def _configuration(diagnoser: NetworkDiagnoser) -> dict[str, Any]:
    """Return what files of all networks hold."""
    arguments = diagnoser.get_params(deep=False)
    return {
        "format": FORMAT,
        "arguments": {key: v for key, v in arguments.items() if key not in _NOT_ARGUMENTS},
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


def _motorwise(diagnoser: MotorwiseDiagnoser) -> dict[str, Any]:
    """Return what the file of a motor-wise network holds beside that."""
    encoder = diagnoser.coder
    return {
        "network": NETWORK,
        "arms": diagnoser.arms_,
        "spread": diagnoser.spread_,
        "robot": encoder.robot.name,
        "arm_sha256": arm_fingerprint(encoder.robot),
        "imperfections": asdict(encoder.imperfections),
    }


def _on_features(diagnoser: LearnedDiagnoser) -> dict[str, Any]:
    """Return what the file of a network on features holds beside that."""
    encoder = diagnoser.encoder
    return {
        "network": diagnoser.network,
        "features_in": int(diagnoser.n_features_in_),
        "encoder": encoder
        and {
            "features": encoder.features,
            "robot": encoder.robot.name,
            "arm_sha256": arm_fingerprint(encoder.robot),
            "expected": encoder.expected and asdict(encoder.expected),
        },
    }


def arm_fingerprint(robot: Robot) -> str:
    """Return a hash of the parts of a robot that features depend on."""
    return fingerprint([robot.chain, robot.loads, robot.sense, robot.sensor_sense])


def load_network(
    path: str | Path, robot: Robot | CalibratedRobot | None = None
) -> NetworkDiagnoser:
    """Read a trained network.

    A motor-wise network diagnoses any robot. It knows the one it was trained for by the calibration
    in the file, unless another is given with the robot.

    Args:
        path: The file.
        robot: The robot, calibrated or not; None: the bundled one named in the file.

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
    configuration: dict[str, Any],
    arrays: Arrays,
    robot: Robot | CalibratedRobot | None,
    path: Path,
) -> NetworkDiagnoser:
    if configuration["format"] != FORMAT:
        raise InputError(
            f"{path}: is of format {configuration['format']}, this version reads {FORMAT}. "
            "Train it again, or use the version that wrote it: "
            f"{configuration['versions'].get('failuretwin')}."
        )
    _check_numbers(arrays, float(configuration["temperature"]))
    weights = {n.removeprefix(_WEIGHT): a for n, a in arrays.items() if n.startswith(_WEIGHT)}
    tensors = {name: torch.from_numpy(array) for name, array in weights.items()}
    if configuration["network"] == NETWORK:
        found: NetworkDiagnoser = _restored_motorwise(configuration, tensors, robot, path)
    else:
        model = robot.robot if isinstance(robot, CalibratedRobot) else robot
        found = _restored_on_features(configuration, arrays, tensors, model, path)
    found.temperature_ = float(configuration["temperature"])
    movements, pool = configuration["movements"], configuration["weights"]
    found.movements_ = movements and (int(movements[0]), int(movements[1]))
    found.weights_ = pool and from_table(PoolWeights, pool, f"{path}: weights")
    return found


def _checked_arguments(configuration: dict[str, Any], fresh: NetworkDiagnoser) -> dict[str, Any]:
    """Return the arguments of the estimator in a file."""
    arguments: dict[str, Any] = configuration["arguments"]
    known = set(fresh.get_params(deep=False)) - set(_NOT_ARGUMENTS)
    if set(arguments) != known:
        raise KeyError(f"arguments {sorted(set(arguments) ^ known)}")
    return arguments


def _restored_on_features(
    configuration: dict[str, Any],
    arrays: Arrays,
    tensors: dict[str, Tensor],
    robot: Robot | None,
    path: Path,
) -> LearnedDiagnoser:
    encoder = _restored_encoder(configuration["encoder"], robot, path)
    arguments = _checked_arguments(configuration, LearnedDiagnoser())
    diagnoser = LearnedDiagnoser(configuration["network"], encoder, **arguments)
    diagnoser.standard_ = Standard(arrays["mean"], arrays["spread"])
    diagnoser.classes_ = np.array(configuration["classes"])
    shape = network_shape(encoder, len(diagnoser.standard_.mean), len(diagnoser.classes_))
    network = build_network(configuration["network"], shape)
    network.load_state_dict(tensors)
    diagnoser.network_ = network
    diagnoser.n_features_in_ = configuration["features_in"]
    return diagnoser


def _restored_motorwise(
    configuration: dict[str, Any],
    tensors: dict[str, Tensor],
    robot: Robot | CalibratedRobot | None,
    path: Path,
) -> MotorwiseDiagnoser:
    arguments = _checked_arguments(configuration, MotorwiseDiagnoser())
    modes = tuple(str(mode) for mode in arguments["modes"])
    known = _known_robot(configuration, robot, path)
    encoder = MomentEncoder(known.robot, known.imperfections)
    diagnoser = MotorwiseDiagnoser(encoder, **{**arguments, "modes": modes})
    network = MotorwiseNetwork(len(modes))
    network.load_state_dict(tensors)
    diagnoser.network_ = network
    diagnoser.spread_ = tuple(float(factor) for factor in configuration["spread"])
    diagnoser.arms_ = tuple(str(name) for name in configuration["arms"])
    return diagnoser.for_robot(encoder)


def _known_robot(
    configuration: dict[str, Any], robot: Robot | CalibratedRobot | None, path: Path
) -> CalibratedRobot:
    """Return the robot that a motor-wise network is to diagnose."""
    if isinstance(robot, CalibratedRobot):
        return robot
    model = load_robot(configuration["robot"]) if robot is None else robot
    same = configuration["robot"] == model.name
    if not same or configuration["arm_sha256"] != arm_fingerprint(model):
        return calibrated(model)
    table = json.loads(json.dumps(configuration["imperfections"]))
    return CalibratedRobot(model, from_table(Imperfections, table, f"{path}: imperfections"))


def _check_numbers(arrays: Arrays, temperature: float) -> None:
    """Raise ValueError unless all numbers of a network are valid."""
    numbers = [value for value in arrays.values() if np.issubdtype(value.dtype, np.floating)]
    if not all(np.isfinite(value).all() for value in numbers):
        raise ValueError("a weight is not finite")
    if "mean" in arrays and arrays["mean"].shape != arrays["spread"].shape:
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


class _Motorwise(nn.Module):
    """A motor-wise network from tokens to probabilities (run, class) and what else it says."""

    def __init__(self, diagnoser: MotorwiseDiagnoser) -> None:
        super().__init__()
        self.network, self.temperature = diagnoser.network_, diagnoser.temperature_

    def forward(self, features: Tensor, exists: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return probabilities (run, class), and rows, bins and sizes."""
        healthy, rows, bins, sizes = self.network(features, exists)
        scores = class_logits(healthy, rows)
        return torch.softmax(scores / self.temperature, dim=1), rows, bins, sizes


RUN, MOMENT, MOTOR = (torch.export.Dim(name, max=4096) for name in ("run", "moment", "motor"))


def export_onnx(diagnoser: NetworkDiagnoser, path: Path) -> None:
    """Write a trained network as an ONNX file.

    Of a network on features, the input is `features` (run, 100, channel) and the output
    `probabilities` (run, class); the metadata entry `classes` lists the classes. Of a motor-wise
    network the inputs are the `features` and `exists` of its tokens, for any robot. Its outputs are
    `probabilities`, and `rows`, `bins` and `sizes` for onset and size; `modes` lists the modes.
    """
    if isinstance(diagnoser, MotorwiseDiagnoser):
        tokens = torch.zeros(2, 3, 4, FEATURES), torch.ones(2, 3)
        shapes = ({0: RUN, 1: MOMENT, 2: MOTOR}, {0: RUN, 1: MOMENT})
        names = ["probabilities", "rows", "bins", "sizes"]
        program = _exported(_Motorwise(diagnoser), tokens, ["features", "exists"], names, shapes)
        program.model.metadata_props["modes"] = ",".join(diagnoser.modes)
    else:
        assert isinstance(diagnoser, LearnedDiagnoser)
        features = torch.zeros(2, POINTS, len(diagnoser.standard_.mean))
        outputs = ["probabilities"]
        program = _exported(_Classifier(diagnoser), (features,), ["features"], outputs, ({0: RUN},))
    program.model.metadata_props["classes"] = ",".join(map(str, diagnoser.classes_))
    with replacing(path) as partial:
        partial.write_bytes(program.model_proto.SerializeToString())


def _exported(
    module: nn.Module,
    arguments: tuple[Tensor, ...],
    inputs: list[str],
    outputs: list[str],
    shapes: tuple[dict[int, Any], ...],
) -> Any:
    """Return a module as an ONNX program whose axes in `shapes` may have any length."""
    with needs_extra("ONNX files need onnxscript", "learn"):
        import onnxscript  # noqa: F401
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # from inside the exporter
        program = torch.onnx.export(
            module.eval(),
            arguments,
            input_names=inputs,
            output_names=outputs,
            opset_version=OPSET,
            dynamo=True,
            dynamic_shapes=shapes,
            verbose=False,
        )
    assert program is not None
    return program
