"""What healthy logs say of the motors: where each movement settled, by readings or by the tool."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from failuretwin.core.runs import RunSet, measured_rate
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.digital_model.nonidealities import Readings
from failuretwin.digital_model.profile import SensorProfile
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.sensors import Encoders
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.inference.observation.evidence import Evidence, SettledEvidence
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.sensors import TOOL_ALONE

ROUNDING = float(1.0 / np.sqrt(12.0))
"""Standard deviation of what whole numbers round off."""
LEAST_READING_RAD = 1e-5
"""Noise assumed of motors that are read as they are [rad]; no reading is as fine."""
NOMINAL_HZ = 10.0
"""Rate of readings where it does not matter: poses at rest alone are weighed [Hz]."""


@dataclass(frozen=True)
class Observations:
    """Settled movements of many healthy runs.

    Flat properties have a row for each movement that came to rest, in the order of the runs.

    Attributes:
        evidence: Where the motors, or else the tool, came to rest.
        model: The robot before it was calibrated: what arms of its class do, and what is read.
        tool: Settled tool positions, (run, movement, axis) [m].
        session: Index of the session, (run,).
        sessions: Names of the sessions.
        runs: Names of the runs.
    """

    evidence: SettledEvidence
    model: HealthyModel
    tool: FloatArray
    session: IntArray
    sessions: tuple[str, ...]
    runs: tuple[str, ...]

    def __getitem__(self, kept: IntArray) -> Observations:
        """Return some of the runs."""
        names = tuple(self.runs[i] for i in kept)
        evidence, tool, session = self.evidence[kept], self.tool[kept], self.session[kept]
        return replace(self, evidence=evidence, tool=tool, session=session, runs=names)

    def __len__(self) -> int:
        """Return the number of movements that came to rest."""
        return int(self.evidence.usable.sum())

    @property
    def follows_seen(self) -> BoolArray:
        """Which movements begin a run or follow one that was seen at rest, (run, movement).

        After an unseen movement it is not known where a motor came from.
        """
        known = self.evidence.usable.copy()
        known[:, 1:] &= self.evidence.usable[:, :-1]
        return known

    def of(self, model: HealthyModel) -> Observations:
        """Return the same movements, of a robot that is thought to be another one."""
        return replace(self, model=model)

    @property
    def of_motors(self) -> bool:
        """Whether the motors were read; else the tool alone was seen."""
        return self.model.sensing == (Encoders.kind,)

    @property
    def at(self) -> tuple[IntArray, IntArray]:
        """Run and number within it of each movement, (movement,) each."""
        run, number = np.nonzero(self.evidence.usable)
        return run, number

    @property
    def origin(self) -> FloatArray:
        """Angles that the motors were told to go to before, (movement, motor) [rad]."""
        return np.asarray(self.evidence.movements.origin()[self.at])

    @property
    def target(self) -> FloatArray:
        """Commanded angles, (movement, motor) [rad]."""
        return np.asarray(self.evidence.movements.target[self.at])

    @property
    def direction(self) -> FloatArray:
        """Sign of the commanded travel, (movement, motor)."""
        return np.sign(self.target - self.origin)

    @property
    def point(self) -> FloatArray:
        """Settled tool position, (movement, axis) [m]."""
        return np.asarray(self.tool[self.at])

    @property
    def position(self) -> FloatArray | None:
        """Settled angles by the motors' readings, (movement, motor) [rad]; None: none were read."""
        if not self.of_motors:
            return None
        return self.model.sensors.angles(self.evidence.point[self.at])


def session_names(runs: RunSet) -> list[str]:
    """Return the session of each run: its name without the last part, or its own name."""
    names = [str(name) for name in runs["run"].values]
    return [name.rpartition("/")[0] or name for name in names]


def observe(runs: RunSet, robot: Robot) -> Observations:
    """Return where movements settled, by the motors' own readings where the runs have them."""
    of_motors = "position" in runs
    model = uncalibrated(robot, of_motors, measured_rate(runs))
    tool = evidence = Evidence(runs, model.settings).sound.settled
    if of_motors:
        evidence = Evidence(runs, model.settings, model.sensors).sound.settled
        evidence = replace(evidence, usable=evidence.usable & tool.usable)
    names = session_names(runs)
    sessions = tuple(dict.fromkeys(names))
    return Observations(
        evidence=evidence,
        model=model,
        tool=tool.point,
        session=np.array([sessions.index(name) for name in names]),
        sessions=sessions,
        runs=tuple(str(name) for name in runs["run"].values),
    )


def uncalibrated(
    robot: Robot, of_motors: bool, rate_hz: float = NOMINAL_HZ, payload: float = 0.0
) -> HealthyModel:
    """Return what is believed of a robot before its healthy logs: what arms of its class are like.

    Motors that are read give whole counts where the profile has any. `payload` is in [kg].
    """
    kind = generic_imperfections(robot)
    assert kind.settling is not None
    known = replace(
        kind,
        settling=replace(kind.settling, payload=payload),
        readings=Readings(rate_hz=rate_hz),
        sensors=(SensorProfile(Encoders.kind, noise=max(rounding(robot), LEAST_READING_RAD)),),
    )
    sensing = (Encoders.kind,) if of_motors else TOOL_ALONE
    return HealthyModel(DigitalTwin(robot), known, sensing=sensing)


def rounding(robot: Robot) -> float:
    """Return the standard deviation of what servo counts round off [rad]; 0 without any."""
    if robot.profile.servo_units is None:
        return 0.0
    return float(abs(robot.servo_units.rad_per_count)) * ROUNDING
