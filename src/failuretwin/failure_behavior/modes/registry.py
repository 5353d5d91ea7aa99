"""The fault modes that can be simulated, by id; more can be registered, others loaded."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from failuretwin.core.config import from_table, read_toml
from failuretwin.core.errors import InputError, unknown_name
from failuretwin.core.hypothesis import MAGNITUDE_UNITS
from failuretwin.failure_behavior.modes.base import FaultMode
from failuretwin.failure_behavior.modes.held import Intermittent, Stuck
from failuretwin.failure_behavior.modes.motion import Backlash, Lag, LostCommands, Slow
from failuretwin.failure_behavior.modes.offsets import (
    Drift,
    EncoderBias,
    EncoderScale,
    SteadyStateError,
)
from failuretwin.failure_behavior.modes.torque import TorqueLoss

_BUILT_IN: tuple[FaultMode, ...] = (
    Stuck(),
    SteadyStateError(),
    Slow(),
    Lag(),
    Backlash(),
    Drift(),
    Intermittent(),
    TorqueLoss(),
    EncoderBias(),
    EncoderScale(),
    LostCommands(),
)

MODES: dict[str, FaultMode] = {mode.mode: mode for mode in _BUILT_IN}
"""The modes with their default distributions; `stuck` and `steady_state_error` are the paper's."""


def register(mode: FaultMode, unit: str) -> None:
    """Add a mode of your own to `MODES`.

    Args:
        mode: The mode with its default distributions.
        unit: Unit of its magnitude, such as ``rad``; ``ratio`` for a share.

    Raises:
        InputError: If there is a mode of that name.
    """
    if mode.mode in MAGNITUDE_UNITS:
        raise InputError(f"there is a fault mode {mode.mode!r} already. Choose another name.")
    MAGNITUDE_UNITS[mode.mode] = unit
    MODES[mode.mode] = mode


def load_modes(path: Path) -> Mapping[str, FaultMode]:
    """Load distributions from a TOML file with one table for each mode.

    Args:
        path: The file. Modes that it leaves out stay as they are in `MODES`; keys that it leaves
            out have the defaults of their mode.

    Returns:
        All modes by id.

    Raises:
        InputError: If the file cannot be read, or names a mode or key that does not exist, or a
            value makes no sense.
    """
    modes = dict(MODES)
    for name, table in read_toml(path).items():
        try:
            if name not in MODES:
                raise unknown_name("fault mode", name, MODES)
            if not isinstance(table, dict):
                raise InputError(f"{name} is {table!r}, expected a table, such as [{name}].")
            modes[name] = from_table(type(MODES[name]), table, name)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
    return modes
