"""A trained network as an ONNX graph: features in, probabilities out.

Written operator by operator: the networks are few and small, and nothing but `onnx` is needed.
The graph standardises the features, divides scores by the temperature and takes the softmax.
"""

from __future__ import annotations

import base64
import json
import textwrap
from dataclasses import dataclass, field
from importlib.resources import files
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from failuretwin import __version__
from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.store import replacing
from failuretwin.decision.learned.diagnoser import LearnedDiagnoser
from failuretwin.decision.learned.features import (
    DAMPING_M,
    DISTANCE_M,
    POINTS,
    SHARED,
    TURN_RAD,
    Encoder,
    expectation_of,
)
from failuretwin.decision.learned.networks import (
    KERNEL,
    MOTORWISE_WIDTH,
    STRIDES,
    Cnn,
    MotorWise,
    PaperLstm,
)
from failuretwin.digital_model.gravity import GRAVITY
from failuretwin.digital_model.nonidealities import NO_IMPERFECTIONS

OPSET = 18
"""Operator set of the graph; any runtime since 2023 knows it."""
IR_VERSION = 9
INPUT, OUTPUT = "features", "probabilities"


@dataclass
class _Graph:
    """A graph that grows, operator by operator."""

    weights: dict[str, NDArray[Any]]
    nodes: list[Any] = field(default_factory=list)
    constants: dict[str, NDArray[Any]] = field(default_factory=dict)

    def add(self, operator: str, *inputs: str, outputs: int = 1, **attributes: Any) -> str:
        """Add an operator; return the name of its first output."""
        from onnx import helper

        names = [f"{operator}_{len(self.nodes)}_{i}" for i in range(outputs)]
        self.nodes.append(helper.make_node(operator, list(inputs), names, **attributes))
        return names[0]

    def constant(self, values: Any) -> str:
        """Add a constant; return its name."""
        name = f"constant_{len(self.constants)}"
        self.constants[name] = np.asarray(values)
        return name

    def reduce(self, operator: str, x: str, axis: int) -> str:
        """Add a reduction over one axis, which vanishes."""
        return self.add(operator, x, self.constant(np.array([axis])), keepdims=0)

    def reshape(self, x: str, *shape: int) -> str:
        """Add a change of shape."""
        return self.add("Reshape", x, self.constant(np.array(shape)))

    def dense(self, x: str, layer: str) -> str:
        """Add a dense layer."""
        weight = self.constant(self.weights[f"{layer}.weight"])
        return self.add("Gemm", x, weight, self.constant(self.weights[f"{layer}.bias"]), transB=1)

    def convolution(self, x: str, layer: str, stride: int) -> str:
        """Add a convolution over the last axis."""
        inputs = [self.constant(self.weights[f"{layer}.weight"])]
        if f"{layer}.bias" in self.weights:
            inputs.append(self.constant(self.weights[f"{layer}.bias"]))
        side = KERNEL // 2
        return self.add("Conv", x, *inputs, pads=[side, side], strides=[stride])

    def lstm(self, x: str, layer: str) -> str:
        """Add an LSTM layer to (point, run, channel); the steps are (point, run, unit)."""
        names = [f"{layer}.{kind}_l0" for kind in ("weight_ih", "weight_hh", "bias_ih", "bias_hh")]
        into, back, *biases = (_gates(self.weights[name]) for name in names)
        inputs = [self.constant(a[None]) for a in (into, back, np.concatenate(biases))]
        steps = self.add("LSTM", x, *inputs, hidden_size=back.shape[1])
        return self.add("Squeeze", steps, self.constant(np.array([1])))


def _gates(weight: NDArray[Any]) -> NDArray[Any]:
    """Return gates in the order of ONNX (input, output, forget, cell) from PyTorch's."""
    i, f, g, o = np.split(weight, 4)
    return np.concatenate([i, o, f, g])


def _lstm(graph: _Graph, x: str) -> str:
    x = graph.add("Transpose", x, perm=[1, 0, 2])
    steps = graph.lstm(graph.lstm(x, "first"), "second")
    last = graph.add("Gather", steps, graph.constant(np.array(-1)), axis=0)
    return graph.dense(last, "dense")


def _cnn(graph: _Graph, x: str) -> str:
    x = graph.add("Transpose", x, perm=[0, 2, 1])
    for i, stride in enumerate(STRIDES):
        x = graph.add("Relu", graph.convolution(x, f"convolutions.{i}", stride))
    seen = [graph.reduce(operator, x, 2) for operator in ("ReduceMean", "ReduceMax")]
    return _head(graph, graph.add("Concat", *seen, axis=1))


def _motor_wise(graph: _Graph, x: str, network: MotorWise) -> str:
    motors, shared, own, points = network.motors, network.shared, network.each, POINTS
    split = graph.constant(np.array([motors * own, shared]))
    each = graph.add("Split", x, split, outputs=2, axis=2)
    common = each.removesuffix("0") + "1"
    each = graph.reshape(each, -1, points, motors, own)
    common = graph.reshape(common, -1, points, 1, shared)
    common = graph.add("Tile", common, graph.constant(np.array([1, 1, motors, 1])))
    x = graph.add("Transpose", graph.add("Concat", each, common, axis=3), perm=[0, 2, 3, 1])
    wide = own + shared
    for i, stride in enumerate(STRIDES):
        flat = graph.reshape(x, -1, wide, points)
        mean = graph.convolution(graph.reduce("ReduceMean", x, 1), f"all.{i}", stride)
        wide, points = MOTORWISE_WIDTH, (points - 1) // stride + 1
        parts = graph.reshape(graph.convolution(flat, f"own.{i}", stride), -1, motors, wide, points)
        mean = graph.reshape(mean, -1, 1, wide, points)
        x = graph.add("Relu", graph.add("Add", parts, mean))
    seen = [graph.reduce(operator, x, 3) for operator in ("ReduceMean", "ReduceMax")]
    flat = graph.reshape(graph.add("Concat", *seen, axis=2), -1, motors * 2 * wide)
    return _head(graph, flat)


def _head(graph: _Graph, x: str) -> str:
    return graph.dense(graph.add("Relu", graph.dense(x, "hidden")), "dense")


def export_onnx(diagnoser: LearnedDiagnoser, path: Path) -> None:
    """Write a trained network as an ONNX file.

    Its input `features` is (run, 100, channel) as the encoder makes them, its output
    `probabilities` (run, class); the metadata hold the names of the classes.

    Raises:
        InputError: If onnx is missing.
        OutputError: If it cannot be written.
    """
    try:
        import onnx
    except ImportError as error:
        raise InputError(
            f"ONNX files need onnx ({error}). Install it: pip install 'failuretwin[learn]'."
        ) from error
    model = _model(diagnoser)
    onnx.checker.check_model(model, full_check=True)
    with replacing(path) as partial:
        partial.write_bytes(model.SerializeToString())


def _model(diagnoser: LearnedDiagnoser) -> Any:
    from onnx import TensorProto, helper, numpy_helper

    network, standard = diagnoser.network_, diagnoser.standard_
    weights = {name: tensor.cpu().numpy() for name, tensor in network.state_dict().items()}
    graph = _Graph(weights)
    x = graph.add("Sub", INPUT, graph.constant(standard.mean))
    x = graph.add("Div", x, graph.constant(standard.spread))
    if isinstance(network, PaperLstm):
        scores = _lstm(graph, x)
    elif isinstance(network, Cnn):
        scores = _cnn(graph, x)
    else:
        assert isinstance(network, MotorWise)
        scores = _motor_wise(graph, x, network)
    scores = graph.add("Div", scores, graph.constant(np.float32(diagnoser.temperature_)))
    chances = graph.add("Softmax", scores, axis=1)
    graph.nodes.append(helper.make_node("Identity", [chances], [OUTPUT]))
    channels, classes = len(standard.mean), len(diagnoser.classes_)
    model = helper.make_model(
        helper.make_graph(
            graph.nodes,
            "diagnosis",
            [helper.make_tensor_value_info(INPUT, TensorProto.FLOAT, ["run", POINTS, channels])],
            [helper.make_tensor_value_info(OUTPUT, TensorProto.FLOAT, ["run", classes])],
            [numpy_helper.from_array(array, name) for name, array in graph.constants.items()],
        ),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="failuretwin",
    )
    helper.set_model_props(model, {"classes": ",".join(map(str, diagnoser.classes_))})
    return model


# A trained network as one Python file that needs numpy alone, for the computer of the robot.


def export_numpy(diagnoser: LearnedDiagnoser, path: Path) -> None:
    """Write a trained network as a Python file.

    Raises:
        InputError: If the name is not that of a Python module, or the network has no encoder.
        OutputError: If it cannot be written.
    """
    if path.suffix != ".py" or not path.stem.isidentifier():
        raise InputError(f"{path}: cannot be imported. Expected a name such as diagnoser.py.")
    if diagnoser.encoder is None:
        raise InputError("this network has no encoder, so it could not read runs by itself.")
    template = (files("failuretwin.decision.learned") / "standalone.py.txt").read_text("utf-8")
    text = (
        template.replace("@MODULE@", path.stem)
        .replace("@VERSION@", __version__)
        .replace("@SETTINGS@", json.dumps(_settings(diagnoser, diagnoser.encoder)))
        .replace("@WEIGHTS@", _packed(_arrays(diagnoser, diagnoser.encoder)))
    )
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")


def _settings(diagnoser: LearnedDiagnoser, encoder: Encoder) -> dict[str, Any]:
    return {
        "classes": [str(name) for name in diagnoser.classes_],
        "features": encoder.features,
        "network": diagnoser.network,
        "temperature": float(diagnoser.temperature_),
        "points": POINTS,
        "motors": len(encoder.robot.motors),
        "shared": len(SHARED),
        "strides": STRIDES,
    }


def _arrays(diagnoser: LearnedDiagnoser, encoder: Encoder) -> dict[str, NDArray[Any]]:
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
    arrays = {name: np.asarray(values, dtype=np.float64) for name, values in numbers.items()}
    weights = {name: t.cpu().numpy() for name, t in diagnoser.network_.state_dict().items()}
    standard = diagnoser.standard_
    return {**arrays, **weights, "mean": standard.mean, "spread": standard.spread}


def _packed(arrays: dict[str, NDArray[Any]]) -> str:
    buffer = BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    return textwrap.fill(base64.b64encode(buffer.getvalue()).decode("ascii"), 96)
