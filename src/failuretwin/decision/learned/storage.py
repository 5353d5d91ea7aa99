"""A trained network in a file: our own, an ONNX graph, or Python that needs numpy alone.

Our own is an npz archive of plain arrays, read without pickle, so that loading a file of a stranger
runs nothing; the configuration is JSON in an array of bytes. Both exports are made of one recording
of what the network does, operator by operator, in the terms of ONNX: nothing but `onnx` is needed
to write the graph, and the Python file has the same operators in numpy.
"""

from __future__ import annotations

import base64
import json
import platform
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.resources import files
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import fx, nn
from torch.fx.passes.shape_prop import ShapeProp

from failuretwin import __version__
from failuretwin.core.config import fingerprint, from_table
from failuretwin.core.errors import InputError, needs_extra
from failuretwin.core.foreign import reading
from failuretwin.data_knowledge.file_claims import check_npz
from failuretwin.data_knowledge.store import replacing
from failuretwin.decision.learned.diagnoser import LearnedDiagnoser, network_shape
from failuretwin.decision.learned.feature_encoder import (
    DAMPING_M,
    DISTANCE_M,
    POINTS,
    TURN_RAD,
    Expectation,
    FeatureEncoder,
    expectation_of,
)
from failuretwin.decision.learned.log_pool import PoolWeights
from failuretwin.decision.learned.networks import Standard, build_network
from failuretwin.digital_model.kinematics import GRAVITY
from failuretwin.digital_model.nonidealities import NO_IMPERFECTIONS
from failuretwin.digital_model.robot import Robot, load_robot

FORMAT = 1
SUFFIX = ".npz"
_WEIGHT = "weight/"
_NOT_STORED = ("encoder", "network")
"""Arguments of the estimator that have a place of their own in the file."""
Arrays = dict[str, NDArray[Any]]


def check_network_file(path: Path) -> None:
    """Raise InputError unless a network can be written under this name."""
    if path.suffix != SUFFIX:
        raise InputError(f"{path}: a network file ends in {SUFFIX}.")


def save_network(diagnoser: LearnedDiagnoser, path: str | Path) -> None:
    """Write a trained network; a file of that name is replaced at the end, all at once.

    Raises:
        InputError: If the suffix is not .npz.
        OutputError: If it cannot be written.
    """
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
        "arguments": {key: v for key, v in arguments.items() if key not in _NOT_STORED},
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
    """Return a hash of all of a robot that features depend on."""
    return fingerprint([robot.chain, robot.loads, robot.sense, robot.sensor_sense])


def load_network(path: str | Path, robot: Robot | None = None) -> LearnedDiagnoser:
    """Read a trained network for its robot; None: the bundled one of the name in the file.

    Raises:
        InputError: If the file cannot be read, is no network, or is one for another robot.
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
    known = set(LearnedDiagnoser().get_params(deep=False)) - set(_NOT_STORED)
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
    """Raise ValueError unless the numbers of a network can be reckoned with."""
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


# What a network does, recorded operator by operator.

OPSET = 18
"""Operator set of the graph; any runtime since 2023 knows it."""
IR_VERSION = 9
INPUT, OUTPUT = "features", "probabilities"
Attributes = Mapping[str, Any]
_RESHAPES = ("unflatten", "flatten", "unsqueeze")
_REDUCTIONS = {"mean": "ReduceMean", "amax": "ReduceMax"}
_PLAIN = {"relu": "Relu", "add": "Add", "cat": "Concat"}


_Operator = tuple[str, Sequence[str], Sequence[str], Attributes]
"""An operator of ONNX: its kind, names of what it takes and makes, and attributes."""


@dataclass
class _Recording:
    """Operators in their order, and the constants that they take."""

    weights: Arrays
    operators: list[_Operator] = field(default_factory=list)
    constants: Arrays = field(default_factory=dict)

    def add(
        self, kind: str, *inputs: str, how: Attributes | None = None, outputs: int = 1
    ) -> list[str]:
        """Add an operator; return the names of its outputs."""
        names = [f"{kind}_{len(self.operators)}_{i}" for i in range(outputs)]
        self.operators.append((kind, inputs, names, how or {}))
        return names

    def constant(self, values: Any) -> str:
        """Add a constant; return its name."""
        name = f"constant_{len(self.constants)}"
        self.constants[name] = np.asarray(values)
        return name

    def layer(self, module: nn.Module, name: str, x: str) -> list[str]:
        """Add a layer."""
        if isinstance(module, nn.Dropout):
            return [x]
        if isinstance(module, nn.LSTM):
            return self._lstm(name, x)
        own = [f"{name}.{kind}" for kind, _ in module.named_parameters()]
        self.constants |= {weight: self.weights[weight] for weight in own}
        if isinstance(module, nn.Linear):
            return self.add("Gemm", x, *own, how={"transB": 1})
        assert isinstance(module, nn.Conv1d)
        side = int(module.padding[0])
        return self.add("Conv", x, *own, how={"pads": [side] * 2, "strides": list(module.stride)})

    def _lstm(self, name: str, x: str) -> list[str]:
        """Add an LSTM layer; in ONNX its steps come first, (point, run, channel)."""
        kinds = ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
        into, back, *biases = (_gates(self.weights[f"{name}.{kind}_l0"]) for kind in kinds)
        weights = [self.constant(a[None]) for a in (into, back, np.concatenate(biases))]
        (x,) = self.add("Transpose", x, how={"perm": [1, 0, 2]})
        (x,) = self.add("LSTM", x, *weights, how={"hidden_size": back.shape[1]})
        (x,) = self.add("Squeeze", x, self.constant([1]))
        return self.add("Transpose", x, how={"perm": [1, 0, 2]})

    def function(self, node: fx.Node, *inputs: str) -> list[str]:
        """Add what torch does beside layers."""
        name = node.target if isinstance(node.target, str) else node.target.__name__
        dim: Any = node.kwargs.get("dim")
        rest: Any = node.args[1:]
        axis = {} if dim is None else {"axis": dim}
        if name in _RESHAPES:
            shape = node.meta["tensor_meta"].shape
            return self.add("Reshape", *inputs, self.constant([-1, *shape[1:]]))
        if name == "split":
            return self.add("Split", *inputs, self.constant(*rest), how=axis, outputs=len(*rest))
        if name == "select":
            return self.add("Gather", *inputs, self.constant(node.kwargs["index"]), how=axis)
        if name == "repeat":
            return self.add("Tile", *inputs, self.constant(rest))
        if name == "permute":
            return self.add("Transpose", *inputs, how={"perm": list(rest)})
        if name in _REDUCTIONS:
            return self.add(_REDUCTIONS[name], *inputs, self.constant([dim]), how={"keepdims": 0})
        return self.add(_PLAIN[name], *inputs, how=axis)


def _gates(weight: NDArray[Any]) -> NDArray[Any]:
    """Return gates in the order of ONNX (input, output, forget, cell) from PyTorch's."""
    i, f, g, o = np.split(weight, 4)
    return np.concatenate([i, o, f, g])


def _record(diagnoser: LearnedDiagnoser) -> _Recording:
    """Return what a diagnoser does from features to probabilities."""
    standard, network = diagnoser.standard_, diagnoser.network_.eval()
    traced = fx.symbolic_trace(network)
    ShapeProp(traced).propagate(torch.zeros(1, POINTS, len(standard.mean)))
    made = _Recording(_weights(diagnoser))
    (x,) = made.add("Sub", INPUT, made.constant(standard.mean))
    x, *_ = made.add("Div", x, made.constant(standard.spread))
    names: dict[fx.Node, list[str]] = {}
    for node in traced.graph.nodes:
        inputs = [names[before][0] for before in node.all_input_nodes]
        if node.op == "placeholder":
            names[node] = [x]
        elif node.op == "call_module":
            names[node] = made.layer(traced.get_submodule(node.target), node.target, *inputs)
        elif node.name.startswith("getitem"):
            names[node] = [names[node.args[0]][node.args[1]]]
        elif node.op != "output":
            names[node] = made.function(node, *inputs)
        else:
            (x,) = inputs
    (x,) = made.add("Div", x, made.constant(np.float32(diagnoser.temperature_)))
    made.operators.append(("Softmax", [x], [OUTPUT], {"axis": 1}))
    return made


def export_onnx(diagnoser: LearnedDiagnoser, path: Path) -> None:
    """Write a trained network as an ONNX file.

    Its input `features` is (run, 100, channel) as the encoder makes them, its output
    `probabilities` (run, class); the metadata hold the names of the classes.

    Raises:
        InputError: If onnx is missing.
        OutputError: If it cannot be written.
    """
    with needs_extra("ONNX files need onnx", "learn"):
        import onnx
        from onnx import TensorProto, helper, numpy_helper
    made = _record(diagnoser)
    channels, classes = len(diagnoser.standard_.mean), len(diagnoser.classes_)
    model = helper.make_model(
        helper.make_graph(
            [helper.make_node(kind, x, y, **how) for kind, x, y, how in made.operators],
            "diagnosis",
            [helper.make_tensor_value_info(INPUT, TensorProto.FLOAT, ["run", POINTS, channels])],
            [helper.make_tensor_value_info(OUTPUT, TensorProto.FLOAT, ["run", classes])],
            [numpy_helper.from_array(array, name) for name, array in made.constants.items()],
        ),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="failuretwin",
    )
    helper.set_model_props(model, {"classes": ",".join(map(str, diagnoser.classes_))})
    onnx.checker.check_model(model, full_check=True)
    with replacing(path) as partial:
        partial.write_bytes(model.SerializeToString())


def export_numpy(diagnoser: LearnedDiagnoser, path: Path) -> None:
    """Write a trained network as one Python file that needs numpy alone, for the robot's computer.

    Raises:
        InputError: If the name is not that of a Python module, or the network has no encoder.
        OutputError: If it cannot be written.
    """
    if path.suffix != ".py" or not path.stem.isidentifier():
        raise InputError(f"{path}: cannot be imported. Expected a name such as diagnoser.py.")
    if diagnoser.encoder is None:
        raise InputError("this network has no encoder, so it could not read runs by itself.")
    made = _record(diagnoser)
    settings = {
        "classes": [str(name) for name in diagnoser.classes_],
        "features": diagnoser.encoder.features,
        "points": POINTS,
        "operators": made.operators,
    }
    buffer = BytesIO()
    arrays = {**_feature_constants(diagnoser.encoder), **made.constants}
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    packed = textwrap.fill(base64.b64encode(buffer.getvalue()).decode("ascii"), 96)
    template = (files("failuretwin.decision.learned") / "standalone.py.txt").read_text("utf-8")
    text = (
        template.replace("@MODULE@", path.stem)
        .replace("@VERSION@", __version__)
        .replace("@SETTINGS@", json.dumps(settings))
        .replace("@WEIGHTS@", packed)
    )
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")


def _feature_constants(encoder: FeatureEncoder) -> Arrays:
    """Return all that the features of a run depend on beside the run."""
    robot = encoder.robot
    expected = encoder.expected or expectation_of(robot, NO_IMPERFECTIONS)
    settling = expected.settling
    numbers: dict[str, Any] = {
        "joints": [joint.T_pj for joint in robot.chain.joints],
        "tool": robot.chain.T_jt[:3, 3],
        "mass": robot.loads.mass,
        "centre": robot.loads.centre,
        "sense": robot.sense,
        "sensor_sense": robot.sensor_sense,
        "gravity": GRAVITY,
        "payload": settling.payload,
        "bias": settling.bias,
        "compliance": settling.compliance,
        "friction": settling.friction,
        "lag": expected.lag_s,
        "turn": TURN_RAD,
        "distance": DISTANCE_M,
        "damping": DAMPING_M,
    }
    return {name: np.asarray(values, dtype=np.float64) for name, values in numbers.items()}
