"""failuretwin: a digital failure twin for robot arms.

Says from commands and the path of the tool alone which motor failed, how, since when and how
surely. Names are loaded when first used, so that importing the package costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from failuretwin.app.arms import emulated_arm
    from failuretwin.app.reports.plots import run_figure
    from failuretwin.connection.calibration.calibrate import calibrate
    from failuretwin.connection.calibration.result import Calibration, save_calibration
    from failuretwin.connection.links.base import (
        Answer,
        Commander,
        CommandSent,
        LinkCounts,
        Order,
        Reading,
        Sink,
        Source,
    )
    from failuretwin.connection.population import Population
    from failuretwin.connection.self_calibration import SelfCalibratingDiagnoser
    from failuretwin.core.errors import InputError
    from failuretwin.core.hypothesis import Diagnosis, Fault, Hypothesis
    from failuretwin.core.runs import run_set
    from failuretwin.data_knowledge.generate import Plan, iterate, simulate
    from failuretwin.data_knowledge.readers.read import ReadOptions, read_runs, sample_log
    from failuretwin.data_knowledge.records.store import Store, open_store
    from failuretwin.decision.acting.reach import reach
    from failuretwin.decision.acting.session import act
    from failuretwin.decision.acting.task import Target, Task
    from failuretwin.decision.chunked_diagnosis import diagnose_to_parquet
    from failuretwin.decision.evaluation import compare, evaluate
    from failuretwin.decision.expected_cost import advise
    from failuretwin.decision.learned.log_pool import HybridDiagnoser
    from failuretwin.decision.learned.storage import load_network, save_network
    from failuretwin.decision.remaining_life import remaining_life
    from failuretwin.decision.results import read_results
    from failuretwin.decision.streaming.diagnoser import StreamingDiagnoser
    from failuretwin.decision.streaming.fleet import StreamingFleet
    from failuretwin.decision.streaming.monitor import monitor
    from failuretwin.decision.test_motions.health_check import CheckResult, check
    from failuretwin.decision.training import train
    from failuretwin.digital_model.calibrated_robot import load_calibration
    from failuretwin.digital_model.robot import Robot, load_robot
    from failuretwin.digital_model.twin import DigitalTwin
    from failuretwin.failure_behavior.mode import FaultMode, SizedMode
    from failuretwin.failure_behavior.registry import register_mode
    from failuretwin.inference.diagnoser import BayesDiagnoser, Diagnoser, diagnose
    from failuretwin.inference.faults.priors import OnsetPrior, Priors
    from failuretwin.inference.isolability import IsolabilityReport, isolability
    from failuretwin.inference.set_ups.setup_prior import SetupPrior

__version__ = "0.1.0"

_HOME = {
    "Answer": "connection.links.base",
    "BayesDiagnoser": "inference.diagnoser",
    "Calibration": "connection.calibration.result",
    "CheckResult": "decision.test_motions.health_check",
    "CommandSent": "connection.links.base",
    "Commander": "connection.links.base",
    "Diagnoser": "inference.diagnoser",
    "Diagnosis": "core.hypothesis",
    "DigitalTwin": "digital_model.twin",
    "Fault": "core.hypothesis",
    "FaultMode": "failure_behavior.mode",
    "HybridDiagnoser": "decision.learned.log_pool",
    "Hypothesis": "core.hypothesis",
    "InputError": "core.errors",
    "IsolabilityReport": "inference.isolability",
    "LinkCounts": "connection.links.base",
    "OnsetPrior": "inference.faults.priors",
    "Order": "connection.links.base",
    "Plan": "data_knowledge.generate",
    "Population": "connection.population",
    "Priors": "inference.faults.priors",
    "ReadOptions": "data_knowledge.readers.read",
    "Reading": "connection.links.base",
    "Robot": "digital_model.robot",
    "SelfCalibratingDiagnoser": "connection.self_calibration",
    "SetupPrior": "inference.set_ups.setup_prior",
    "Sink": "connection.links.base",
    "SizedMode": "failure_behavior.mode",
    "Source": "connection.links.base",
    "Store": "data_knowledge.records.store",
    "StreamingDiagnoser": "decision.streaming.diagnoser",
    "StreamingFleet": "decision.streaming.fleet",
    "Target": "decision.acting.task",
    "Task": "decision.acting.task",
    "act": "decision.acting.session",
    "advise": "decision.expected_cost",
    "calibrate": "connection.calibration.calibrate",
    "check": "decision.test_motions.health_check",
    "compare": "decision.evaluation",
    "diagnose": "inference.diagnoser",
    "diagnose_to_parquet": "decision.chunked_diagnosis",
    "emulated_arm": "app.arms",
    "evaluate": "decision.evaluation",
    "isolability": "inference.isolability",
    "iterate": "data_knowledge.generate",
    "load_calibration": "digital_model.calibrated_robot",
    "load_network": "decision.learned.storage",
    "load_robot": "digital_model.robot",
    "monitor": "decision.streaming.monitor",
    "open_store": "data_knowledge.records.store",
    "reach": "decision.acting.reach",
    "read_results": "decision.results",
    "read_runs": "data_knowledge.readers.read",
    "register_mode": "failure_behavior.registry",
    "remaining_life": "decision.remaining_life",
    "run_figure": "app.reports.plots",
    "run_set": "core.runs",
    "sample_log": "data_knowledge.readers.read",
    "save_calibration": "connection.calibration.result",
    "save_network": "decision.learned.storage",
    "simulate": "data_knowledge.generate",
    "train": "decision.training",
}

__all__ = [
    "Answer",
    "BayesDiagnoser",
    "Calibration",
    "CheckResult",
    "CommandSent",
    "Commander",
    "Diagnoser",
    "Diagnosis",
    "DigitalTwin",
    "Fault",
    "FaultMode",
    "HybridDiagnoser",
    "Hypothesis",
    "InputError",
    "IsolabilityReport",
    "LinkCounts",
    "OnsetPrior",
    "Order",
    "Plan",
    "Population",
    "Priors",
    "ReadOptions",
    "Reading",
    "Robot",
    "SelfCalibratingDiagnoser",
    "SetupPrior",
    "Sink",
    "SizedMode",
    "Source",
    "Store",
    "StreamingDiagnoser",
    "StreamingFleet",
    "Target",
    "Task",
    "__version__",
    "act",
    "advise",
    "calibrate",
    "check",
    "compare",
    "diagnose",
    "diagnose_to_parquet",
    "emulated_arm",
    "evaluate",
    "isolability",
    "iterate",
    "load_calibration",
    "load_network",
    "load_robot",
    "monitor",
    "open_store",
    "reach",
    "read_results",
    "read_runs",
    "register_mode",
    "remaining_life",
    "run_figure",
    "run_set",
    "sample_log",
    "save_calibration",
    "save_network",
    "simulate",
    "train",
]


_STORE = ("the store needs SQLAlchemy and alembic", "store")
_NETWORKS = ("networks need PyTorch and scikit-learn", "learn")
_EXTRAS = {
    "Store": _STORE,
    "load_network": _NETWORKS,
    "open_store": _STORE,
    "save_network": _NETWORKS,
    "train": _NETWORKS,
}
"""Names that need an extra as soon as they are used: the libraries, and the extra."""


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'failuretwin' has no attribute {name!r}")
    if name not in _EXTRAS:
        return _loaded(name)
    from failuretwin.core.errors import needs_extra

    with needs_extra(*_EXTRAS[name]):
        return _loaded(name)


def _loaded(name: str) -> Any:
    return getattr(import_module(f"failuretwin.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return __all__
