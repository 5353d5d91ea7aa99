"""A trained network as one Python file that needs numpy alone, for the computer of the robot.

The file runs on any Python from 2.7 on, such as that of ROS Melodic, and holds features, network
and weights. Its code is `standalone.py.txt`, the same for all networks.
"""

from __future__ import annotations

import base64
import json
import textwrap
from importlib.resources import files
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from failuretwin import __version__
from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.store import replacing
from failuretwin.decision.learned.encoder import Encoder
from failuretwin.decision.learned.estimator import LearnedDiagnoser
from failuretwin.decision.learned.networks import STRIDES
from failuretwin.decision.learned.paper_features import POINTS
from failuretwin.decision.learned.robust_features import (
    DAMPING_M,
    DISTANCE_M,
    SHARED,
    TURN_RAD,
    expectation_of,
)
from failuretwin.digital_model.imperfections import NO_IMPERFECTIONS
from failuretwin.digital_model.loads import GRAVITY


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
