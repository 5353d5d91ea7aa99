"""The profile of a robot: what a TOML file states in addition to the URDF.

Section: docs/sensors.md#sensors-in-the-profile
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from failuretwin.core.config import AtLeastZero, Bounded, Bounds
from failuretwin.core.errors import InputError, unknown_name
from failuretwin.digital_model.geometry import AS_STATED, NO_OFFSET, NOT_MOVED, Geometry, Pose
from failuretwin.digital_model.servo import ServoLoop, ServoUnits
from failuretwin.digital_model.urdf.file import Triple

POSES = ("log", "physical")
FASTEST = 1e3
"""Largest accepted speed limit [rad/s or m/s]."""
FARTHEST = 1e3
"""Largest accepted target and tool coordinate [rad or m]."""
SpeedLimit = Annotated[float, Bounds(1e-6, FASTEST)]
Angles = Annotated[tuple[float, float], Bounds(-FARTHEST, FARTHEST, in_order=True)]
Place = Annotated[Triple, Bounds(-FARTHEST, FARTHEST)]

KINDS = ("orientation", "accelerometer", "gyroscope", "wire", "encoders")
"""Kinds of sensors that have a table ``[[sensors]]``; the tool's position is described by the
other keys."""


@dataclass(frozen=True)
class Motor(Bounded):
    """One motor that can move the tool point.

    Attributes:
        name: Name in run sets and hypotheses, such as ``motor_1``.
        joint: Name of its URDF joint.
        loop: Its closed position loop.
        speed_limit: Largest speed [rad/s].
        movement_range: Lowest and highest target of random movements [rad].
        travel: Lowest and highest possible angle [rad]; None: the limits of its joint.
        sense: Physical angle = sense * angle in commands and logs; +1 or -1.
        log_column: Its column in raw logs.
        home: Rest angle, the centre of random movements where the limits are wide [rad]; None: the
            middle of the limits.
    """

    name: str
    joint: str
    loop: ServoLoop
    speed_limit: SpeedLimit
    movement_range: Angles
    travel: tuple[float, float] | None = None
    sense: float = 1.0
    log_column: str = ""
    home: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        where = f"motor {self.name!r}:"
        if self.sense not in (1.0, -1.0):
            raise InputError(f"{where} sense is {self.sense}, expected 1 or -1.")
        for name in ("movement_range", "travel"):
            ends = getattr(self, name)
            if ends is not None and not -FARTHEST <= ends[0] < ends[1] <= FARTHEST:
                raise InputError(
                    f"{where} {name} is {list(ends)}, expected the lowest and the highest angle "
                    "[rad]."
                )
        if self.home is not None and not abs(self.home) <= FARTHEST:
            raise InputError(f"{where} home is {self.home:g}, expected an angle [rad].")
        if set(self.name) & set(":+,") or not self.name:
            raise InputError(
                f"motor name {self.name!r} cannot stand in hypotheses. Leave out ':', '+', ','."
            )


@dataclass(frozen=True)
class SensorProfile(Bounded):
    """Mount, noise and bias of one sensor: a table ``[[sensors]]``.

    Attributes:
        kind: One of `KINDS`.
        noise: Standard deviation of a reading on each channel [unit of the kind]; 0: default of
            the kind.
        bias: Known constant error of each channel, subtracted from readings; empty: none.
        doubt: Standard deviation of the unknown constant error, drawn for each simulated run;
            negative: default of the kind.
        turn_doubt: Standard deviation of the mount's rotation about each axis [rad].
        rpy: Rotation of the sensor on the tool link; roll, pitch, yaw as in a URDF [rad].
        anchor: Start of a wire in the base link's frame [m]; empty: default.
    """

    kind: str
    noise: AtLeastZero = 0.0
    bias: tuple[float, ...] = ()
    doubt: float = -1.0
    turn_doubt: AtLeastZero = 0.0
    rpy: Triple = NO_OFFSET
    anchor: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kind not in KINDS:
            raise unknown_name("sensor", self.kind, KINDS)
        if len(self.anchor) not in (0, 3):
            raise InputError(f"anchor is {list(self.anchor)}, expected x, y and z [m].")


@dataclass(frozen=True)
class Profile(Bounded):
    """Contents of a TOML profile.

    Attributes:
        name: Name of the robot.
        urdf: URDF file, relative to the profile.
        base_link: Link that carries the base frame.
        tool_link: Link that carries the tool point.
        motors: Motors that can move the tool point, in chain order.
        tool_xyz: The tool point, in the frame of the tool link [m].
        base_xyz_rpy: Pose of the base link in the sensor's frame; see
            `failuretwin.digital_model.geometry`.
        geometry: Differences of the arm from its URDF and of the sensor from a true one.
        sensor_pose: Angles to which the tool path belongs: ``log`` (a virtual sensor that applies
            the kinematics to angles in the log's sense) or ``physical``.
        servo_units: Count scale of commands and readings in raw logs, if they use one.
        imperfections: Imperfections of the healthy robot, a TOML file relative to the profile.
        physics: Motors and gears for the physics engine, a TOML file relative to the profile.
        inference: Values that differ from the defaults of `InferenceSettings`.
        arm_class: Kind of arm, which decides the priors of an uncalibrated robot; see
            `failuretwin.digital_model.arm_classes`. Empty: by its reach.
        sources: Source of each group of numbers.
        sensors: Sensors in addition to the tool's position that differ from the defaults.
    """

    name: str
    urdf: str
    base_link: str
    tool_link: str
    motors: tuple[Motor, ...]
    tool_xyz: Place = NO_OFFSET
    base_xyz_rpy: Annotated[Pose, Bounds(-FARTHEST, FARTHEST)] = NOT_MOVED
    geometry: Geometry = AS_STATED
    sensor_pose: str = "physical"
    servo_units: ServoUnits | None = None
    imperfections: str | None = None
    physics: str | None = None
    inference: dict[str, float] = field(default_factory=dict)
    arm_class: str = ""
    sources: dict[str, str] = field(default_factory=dict)
    sensors: tuple[SensorProfile, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.sensor_pose not in POSES:
            raise unknown_name("sensor_pose", self.sensor_pose, POSES)
        if not self.motors:
            raise InputError(f"profile {self.name!r} has no motors. Expected at least one.")
