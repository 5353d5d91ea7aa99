"""Fault modes: small values that say what a fault does, and when, and how strongly."""

from __future__ import annotations

from failuretwin.failure_behavior.fault_value import FaultGroup
from failuretwin.failure_behavior.modes.base import FaultMode, Range
from failuretwin.failure_behavior.modes.held import PUBLISHED_ONSET_S, Intermittent, Stuck
from failuretwin.failure_behavior.modes.motion import Backlash, Lag, LostCommands, Slow
from failuretwin.failure_behavior.modes.offsets import (
    PUBLISHED_ERROR_RAD,
    Drift,
    EncoderBias,
    EncoderScale,
    SteadyStateError,
)
from failuretwin.failure_behavior.modes.registry import MODES, load_modes, register
from failuretwin.failure_behavior.modes.sized import SignedMode, SizedMode
from failuretwin.failure_behavior.modes.torque import TorqueLoss

__all__ = [
    "MODES",
    "PUBLISHED_ERROR_RAD",
    "PUBLISHED_ONSET_S",
    "Backlash",
    "Drift",
    "EncoderBias",
    "EncoderScale",
    "FaultGroup",
    "FaultMode",
    "Intermittent",
    "Lag",
    "LostCommands",
    "Range",
    "SignedMode",
    "SizedMode",
    "Slow",
    "SteadyStateError",
    "Stuck",
    "TorqueLoss",
    "load_modes",
    "register",
]
