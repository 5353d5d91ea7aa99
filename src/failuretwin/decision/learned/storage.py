"""Trained networks in files: our own format, and ONNX.

Our own format is an npz archive of plain arrays and a JSON configuration, read without pickle.
"""

from __future__ import annotations

import json
import logging
import platform
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
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
from failuretwin.decision.learned.diagnoser import MotorwiseDiagnoser, Widths
from failuretwin.decision.learned.log_pool import PoolWeights
from failuretwin.decision.learned.moment_encoder import MomentEncoder
from failuretwin.decision.learned.moment_features import FEATURES
from failuretwin.decision.learned.motorwise import MotorwiseNetwork, class_logits
from failuretwin.digital_model.calibrated_robot import CalibratedRobot, RobotLike, calibrated
from failuretwin.digital_model.nonidealities import Imperfections
from failuretwin.digital_model.robot import Robot, load_robot
from failuretwin.digital_model.twin import DigitalTwin

FORMAT = 2
SUFFIX = ".npz"
_WEIGHT = "weight/"
_ENCODER = "encoder"
"""Argument of the estimator with its own place in the file."""
Arrays = dict[str, NDArray[Any]]


def check_network_file(path: Path) -> None:
    """Raise InputError unless the name ends in .npz."""
    if path.suffix != SUFFIX:
        raise InputError(f"{path}: a network file ends in {SUFFIX}.")


def save_network(diagnoser: MotorwiseDiagnoser, path: str | Path) -> None:
    """Write a trained network; an existing file is replaced atomically."""
    path = Path(path)
    check_network_file(path)
    configuration = json.dumps(_configuration(diagnoser)).encode()
    weights = diagnoser.network_.state_dict()
    arrays: Arrays = {
        "configuration": np.frombuffer(configuration, dtype=np.uint8),
        **{_WEIGHT + name: tensor.cpu().numpy() for name, tensor in weights.items()},
    }
    with replacing(path) as partial, partial.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def _configuration(diagnoser: MotorwiseDiagnoser) -> dict[str, Any]:
    """Return what a file holds beside the weights."""
    arguments, encoder = diagnoser.get_params(deep=False), diagnoser.coder
    return {
        "format": FORMAT,
        "arguments": {key: v for key, v in arguments.items() if key != _ENCODER},
        "movements": diagnoser.movements_,
        "arms": diagnoser.arms_,
        "widths": diagnoser.widths_,
        "weights": diagnoser.weights_ and asdict(diagnoser.weights_),
        "temperature": float(diagnoser.temperature_),
        "robot": encoder.robot.name,
        "arm_sha256": arm_fingerprint(encoder.robot),
        "imperfections": asdict(encoder.imperfections),
        "versions": {
            "failuretwin": __version__,
            "numpy": np.__version__,
            "torch": torch.__version__,
            "python": platform.python_version(),
        },
    }


def arm_fingerprint(robot: Robot) -> str:
    """Return a hash of the parts of a robot that the input of a network depends on."""
    return fingerprint([robot.chain, robot.loads, robot.sense, robot.sensor_sense])


def load_network(path: str | Path, robot: RobotLike | None = None) -> MotorwiseDiagnoser:
    """Read a trained network.

    It diagnoses any robot. It knows the one it was trained for by the calibration in the file,
    unless another is given with the robot.

    Args:
        path: The file.
        robot: The robot, calibrated or not; None: the bundled one named in the file.

    Raises:
        InputError: If the robot is unknown, or the file no network or one of another version.
    """
    path = Path(path)
    if isinstance(robot, str | Path):
        robot = load_robot(robot)
    with reading(path, "a network", "Expected a file that `failuretwin train` wrote."):
        check_npz(path)
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        return _restored(json.loads(arrays["configuration"].tobytes()), arrays, robot, path)


def _restored(
    configuration: dict[str, Any],
    arrays: Arrays,
    robot: RobotLike | None,
    path: Path,
) -> MotorwiseDiagnoser:
    if configuration["format"] != FORMAT:
        raise InputError(
            f"{path}: is of format {configuration['format']}, this version reads {FORMAT}. "
            "Train it again, or use the version that wrote it: "
            f"{configuration['versions'].get('failuretwin')}."
        )
    temperature, widths = float(configuration["temperature"]), _widths(configuration["widths"])
    _check_numbers(arrays, temperature)
    arguments: dict[str, Any] = configuration["arguments"]
    known = set(MotorwiseDiagnoser().get_params(deep=False)) - {_ENCODER}
    if set(arguments) != known:
        raise KeyError(f"arguments {sorted(set(arguments) ^ known)}")
    modes = tuple(str(mode) for mode in arguments["modes"])
    owner = _known_robot(configuration, robot, path)
    encoder = MomentEncoder(owner.robot, owner.imperfections)
    found = MotorwiseDiagnoser(encoder, **{**arguments, "modes": modes})
    network = MotorwiseNetwork(len(modes))
    weights = {n.removeprefix(_WEIGHT): a for n, a in arrays.items() if n.startswith(_WEIGHT)}
    network.load_state_dict({name: torch.from_numpy(array) for name, array in weights.items()})
    found.network_, found.temperature_, found.widths_ = network, temperature, widths
    low, high = configuration["movements"]
    found.movements_ = int(low), int(high)
    found.arms_ = tuple(str(name) for name in configuration["arms"])
    pool = configuration["weights"]
    found.weights_ = pool and from_table(PoolWeights, pool, f"{path}: weights")
    return found.for_robot(encoder)


def _widths(table: dict[str, Any]) -> dict[str, Widths]:
    """Return the widths of intervals by arm, as a file holds them."""
    return {
        str(arm): tuple((float(power), float(factor)) for power, factor in pairs)
        for arm, pairs in table.items()
    }


def _known_robot(
    configuration: dict[str, Any], robot: RobotLike | None, path: Path
) -> CalibratedRobot:
    """Return the robot that a network is to diagnose."""
    if isinstance(robot, CalibratedRobot):
        return robot
    given = robot.robot if isinstance(robot, DigitalTwin) else robot
    model = load_robot(configuration["robot"] if given is None else given)
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
    if not 0.0 < temperature < np.inf:
        raise ValueError(f"temperature {temperature:g}")


# Exports.

OPSET = 18
"""ONNX operator set; known to every runtime since 2023."""


class _Motorwise(nn.Module):
    """A network from tokens to probabilities (run, class) and what else it says."""

    def __init__(self, diagnoser: MotorwiseDiagnoser) -> None:
        super().__init__()
        self.network, self.temperature = diagnoser.network_, diagnoser.temperature_

    def forward(self, features: Tensor, exists: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return probabilities (run, class), and rows, bins and sizes."""
        healthy, rows, bins, sizes = self.network(features, exists.to(features.dtype))
        scores = class_logits(healthy, rows)
        return torch.softmax(scores / self.temperature, dim=1), rows, bins, sizes


RUN, MOMENT, MOTOR = (torch.export.Dim(name, max=4096) for name in ("run", "moment", "motor"))


def check_onnx() -> None:
    """Raise InputError if the library that writes ONNX files is missing."""
    with needs_extra("ONNX files need onnxscript", "learn"):
        import onnxscript  # noqa: F401


EXPORTER_LOG = "torch.onnx._internal.exporter._registration"
"""Logger of the exporter that warns of each operator of torchvision, which no network uses."""


@contextmanager
def _quiet(name: str) -> Iterator[None]:
    """Keep the warnings of a logger from the terminal."""
    logger = logging.getLogger(name)
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


def export_onnx(diagnoser: MotorwiseDiagnoser, path: Path) -> None:
    """Write a trained network as an ONNX file.

    Inputs are the `features` and `exists` of tokens, for any robot. Outputs are `probabilities`
    (run, class), and `rows`, `bins` and `sizes` for onset and size. The metadata entries `classes`
    and `modes` list the classes of the robot and the modes.
    """
    check_onnx()
    with warnings.catch_warnings(), _quiet(EXPORTER_LOG):
        warnings.simplefilter("ignore")  # from inside the exporter
        program = torch.onnx.export(
            _Motorwise(diagnoser).eval(),
            (torch.zeros(2, 3, 4, FEATURES), torch.ones(2, 3, dtype=torch.bool)),
            input_names=["features", "exists"],
            output_names=["probabilities", "rows", "bins", "sizes"],
            opset_version=OPSET,
            dynamo=True,
            dynamic_shapes=({0: RUN, 1: MOMENT, 2: MOTOR}, {0: RUN, 1: MOMENT}),
            verbose=False,
        )
    assert program is not None
    program.model.metadata_props["modes"] = ",".join(diagnoser.modes)
    program.model.metadata_props["classes"] = ",".join(map(str, diagnoser.classes_))
    with replacing(path) as partial:
        partial.write_bytes(program.model_proto.SerializeToString())
