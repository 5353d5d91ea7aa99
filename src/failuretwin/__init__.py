"""failuretwin: a digital failure twin for robot arms.

Says from commands and the path of the tool alone which motor failed, how, since when and how
surely. Names are loaded when first used, so that importing the package costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from failuretwin.core.errors import InputError
    from failuretwin.data_knowledge.generate import Plan, iterate, simulate
    from failuretwin.data_knowledge.read import ReadOptions, read_runs
    from failuretwin.decision.streaming.diagnoser import StreamingDiagnoser
    from failuretwin.digital_model.robot import load_robot
    from failuretwin.digital_model.twin import DigitalTwin
    from failuretwin.failure_behavior.mode import FaultMode, SizedMode
    from failuretwin.failure_behavior.registry import register_mode
    from failuretwin.inference.diagnoser import BayesDiagnoser
    from failuretwin.inference.isolability import isolability
    from failuretwin.inference.priors import Priors

__version__ = "0.1.0"

_HOME = {
    "BayesDiagnoser": "inference.diagnoser",
    "DigitalTwin": "digital_model.twin",
    "FaultMode": "failure_behavior.mode",
    "InputError": "core.errors",
    "Plan": "data_knowledge.generate",
    "Priors": "inference.priors",
    "ReadOptions": "data_knowledge.read",
    "SizedMode": "failure_behavior.mode",
    "StreamingDiagnoser": "decision.streaming.diagnoser",
    "isolability": "inference.isolability",
    "iterate": "data_knowledge.generate",
    "load_robot": "digital_model.robot",
    "read_runs": "data_knowledge.read",
    "register_mode": "failure_behavior.registry",
    "simulate": "data_knowledge.generate",
}

__all__ = [
    "BayesDiagnoser",
    "DigitalTwin",
    "FaultMode",
    "InputError",
    "Plan",
    "Priors",
    "ReadOptions",
    "SizedMode",
    "StreamingDiagnoser",
    "__version__",
    "isolability",
    "iterate",
    "load_robot",
    "read_runs",
    "register_mode",
    "simulate",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'failuretwin' has no attribute {name!r}")
    return getattr(import_module(f"failuretwin.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return __all__
