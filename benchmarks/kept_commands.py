"""What a robot was told while it was watched."""

from __future__ import annotations

from typing import Self

import numpy as np

from failuretwin.connection.links.base import CommandSent, Item
from failuretwin.core.types import FloatArray


class KeptCommands:
    """A sink that keeps commands."""

    trouble = ""

    def __init__(self) -> None:
        self.sent: list[CommandSent] = []

    def put(self, item: Item) -> None:
        """Keep a command."""
        if isinstance(item, CommandSent):
            self.sent.append(item)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing to be closed."""

    def ramp_ends(self, time: float) -> FloatArray:
        """Return when the movements that begin after a time [s] end their ramps, in order [s]."""
        ends = [one.time + float(one.duration.max()) for one in self.sent if one.time >= time]
        return np.array(ends)
