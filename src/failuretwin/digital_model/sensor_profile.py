"""What a profile or a calibration says of a sensor: mount, noise, bias.

Section: docs/sensors.md#sensors-in-the-profile
"""

from __future__ import annotations

from dataclasses import dataclass

from failuretwin.core.config import AtLeastZero, Bounded
from failuretwin.core.errors import InputError, unknown_name

KINDS = ("orientation", "accelerometer", "gyroscope", "wire", "encoders")
"""Sensors beside that of the tool's position, which the rest of a profile describes."""


@dataclass(frozen=True)
class SensorProfile(Bounded):
    """What a profile or a calibration says of a sensor: a table of its own, ``[[sensors]]``.

    Attributes:
        kind: ``orientation``, ``accelerometer``, ``gyroscope``, ``wire`` or ``encoders``.
        noise: Standard deviation of a reading on each channel [unit of the kind]; 0: the usual.
        bias: Constant error of each channel that is known, and taken off; empty: none.
        doubt: Standard deviation of what is not known of it; of simulated runs, drawn for each.
            Negative: the usual.
        turn_doubt: The same of how the sensor is turned on its mount, about each axis [rad].
        rpy: How it is turned on the tool link; roll, pitch, yaw as of a URDF [rad].
        anchor: Where a wire begins, in the base link's frame [m]; empty: as usual.
    """

    kind: str
    noise: AtLeastZero = 0.0
    bias: tuple[float, ...] = ()
    doubt: float = -1.0
    turn_doubt: AtLeastZero = 0.0
    rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)
    anchor: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kind not in KINDS:
            raise unknown_name("sensor", self.kind, KINDS)
        if len(self.anchor) not in (0, 3):
            raise InputError(f"anchor is {list(self.anchor)}, expected x, y and z [m].")
