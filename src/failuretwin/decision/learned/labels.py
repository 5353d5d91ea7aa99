"""Truth of runs, as the motor-wise network learns it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.types import FloatArray, IntArray, as_floats

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True)
class Labels:
    """Truth of runs.

    Attributes:
        motor: Index of the faulty motor, (run,); 0 if healthy.
        mode: Index of its mode, (run,); -1 if healthy.
        onset: (run,) [s]; NaN if healthy.
        size: In the unit of the mode, (run,); NaN if healthy.
    """

    motor: IntArray
    mode: IntArray
    onset: FloatArray
    size: FloatArray

    def __getitem__(self, runs: IntArray | slice) -> Labels:
        """Return some runs."""
        return Labels(self.motor[runs], self.mode[runs], self.onset[runs], self.size[runs])

    @classmethod
    def joined(cls, parts: Sequence[Labels]) -> Labels:
        """Return the runs of several sets."""
        names = cls.__dataclass_fields__
        return cls(**{n: np.concatenate([getattr(part, n) for part in parts]) for n in names})

    @classmethod
    def of_runs(
        cls, runs: xr.Dataset, faults: Sequence[str], motors: Sequence[str], modes: Sequence[str]
    ) -> Labels:
        """Return the labels of a run set.

        Args:
            runs: The runs, with onset and magnitude of their faults.
            faults: Name of the class of each.
            motors: Names of the motors.
            modes: Ids of the modes.

        Raises:
            InputError: If a class is none of a single fault of these modes, or onset or size are
                missing.
        """
        known = [Hypothesis.parse(name).faults for name in faults]
        for name, fault in zip(faults, known, strict=True):
            if len(fault) > 1 or any(one.mode not in modes for one in fault):
                raise InputError(f"class {name!r}: expected healthy or one of {', '.join(modes)}.")
        missing = [name for name in ("onset", "magnitude") if name not in runs]
        if missing:
            raise InputError(f"the run set lacks {' and '.join(missing)} of its faults.")
        motor = np.array([motors.index(fault[0].motor) if fault else 0 for fault in known])
        mode = np.array([modes.index(fault[0].mode) if fault else -1 for fault in known])
        onset, size = (as_floats(runs[name].values) for name in ("onset", "magnitude"))
        return cls(motor, mode, onset, size)
