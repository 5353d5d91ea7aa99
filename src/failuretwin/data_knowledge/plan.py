"""What to simulate: robot, states, imperfections, chance; small enough to write down."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from failuretwin import __version__
from failuretwin.core.errors import InputError, unknown_name
from failuretwin.core.fingerprint import canonical, fingerprint
from failuretwin.core.hypothesis import Fault, Hypothesis
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.digital_model.imperfections import NO_IMPERFECTIONS, Imperfections
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import Settling, loads_in_range
from failuretwin.failure_behavior.modes import MODES, FaultMode
from failuretwin.failure_behavior.random_movements import RandomMovements

STEP_S = 0.01
"""Step of the time grid [s], as published."""
ENGINES = ("servo", "physics")
LATE_STARTS = 2
"""Late starts that a run has room for; what more of them push beyond the grid is cut off."""
LEAST_SAG_RAD = 1e-6
"""A motor that its load moves by less than this in any pose counts as rigid [rad]."""


@dataclass(frozen=True)
class Plan:
    """What to simulate.

    Attributes:
        robot: The robot.
        hypotheses: States of the robot, in the order in which their runs come.
        runs_per_class: Runs of each.
        seed: Seed of all chance.
        imperfections: What the healthy robot does that its twin does not.
        movements: How movements are drawn.
        modes: Fault modes with their distributions, by id.
        engine: What moves the robot: ``servo`` (the published loops) or ``physics``.
    """

    robot: Robot
    hypotheses: Sequence[Hypothesis]
    runs_per_class: int
    seed: int = 0
    imperfections: Imperfections = NO_IMPERFECTIONS
    movements: RandomMovements = field(default_factory=RandomMovements)
    modes: Mapping[str, FaultMode] = field(default_factory=lambda: MODES)
    engine: str = "servo"

    def __post_init__(self) -> None:
        if self.runs_per_class < 1:
            raise InputError(f"runs per class is {self.runs_per_class}, expected 1 or more.")
        if self.engine not in ENGINES:
            raise unknown_name("engine", self.engine, ENGINES)
        if len(set(self.hypotheses)) < len(self.hypotheses):
            raise InputError("a hypothesis is given twice. Give each of them once.")
        for hypothesis in self.hypotheses:
            if not hypothesis.known:
                raise InputError("'unknown' cannot be simulated. Name the faults to simulate.")
            for fault in hypothesis.faults:
                if fault.mode not in self.modes:
                    raise InputError(
                        f"fault mode {fault.mode!r} cannot be simulated. "
                        f"Expected one of {', '.join(self.modes)}."
                    )
                if self.modes[fault.mode].needs_compliance and self.engine == "servo":
                    self._check_compliance(fault)

    def _check_compliance(self, fault: Fault) -> None:
        """Refuse a loss of stiffness in a motor that does not give way at all."""
        motor = self.robot.motor_names.index(fault.motor)
        settling = self.imperfections.settling or Settling.ideal(len(self.robot.motors))
        load = np.abs(loads_in_range(self.robot, settling.payload)[:, motor]).max()
        if settling.compliance[motor] * load < LEAST_SAG_RAD:
            raise InputError(
                f"'{fault}' would not show: with imperfections {self.imperfections.name!r}, "
                f"{fault.motor} does not give way under load. Choose imperfections in which it "
                "sags (--imperfections), or another motor."
            )

    @property
    def size(self) -> int:
        """Number of runs."""
        return len(self.hypotheses) * self.runs_per_class

    @property
    def time(self) -> FloatArray:
        """Time grid of every run, (time,) [s]; long enough for a run of two late starts.

        What is drawn out as published is cut to the published length.
        """
        length = self.movements.duration_s
        if not self.as_published and self.imperfections.timing.late_rate > 0.0:
            length += LATE_STARTS * self.imperfections.timing.late_s[1]
        return as_floats(np.arange(round(length / STEP_S)) * STEP_S)

    @property
    def as_published(self) -> bool:
        """Whether readings are drawn out to the grid as the published data are."""
        readings = self.imperfections.readings
        return readings is not None and readings.drawn_out

    def hypothesis_of(self, run: int) -> Hypothesis:
        """Return the true state of a run."""
        return self.hypotheses[run // self.runs_per_class]

    def attributes(self) -> dict[str, str | int]:
        """Return what a run set says of where it comes from."""
        configuration = {
            "hypotheses": [str(h) for h in self.hypotheses],
            "runs_per_class": self.runs_per_class,
            "imperfections": self.imperfections.name,
            "engine": self.engine,
            "movements": vars(self.movements),
            "modes": {name: vars(mode) for name, mode in self.modes.items()},
        }
        return {
            "robot": self.robot.name,
            "source": f"simulated by the {self.engine} engine",
            "seed": self.seed,
            "failuretwin_version": __version__,
            "configuration": json.dumps(configuration),
        }

    def manifest(self) -> dict[str, Any]:
        """Return all that decides what the runs are, as JSON can hold it, and its hash."""
        urdf = (self.robot.folder / self.robot.profile.urdf).read_bytes()
        content = {"plan": canonical(self), "urdf_sha256": hashlib.sha256(urdf).hexdigest()}
        return {**content, "plan_sha256": fingerprint(content)}
