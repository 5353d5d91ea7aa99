"""What the physics engine needs to know of motors and gears, and where it is written down."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from failuretwin.core.config import from_table, read_toml
from failuretwin.core.errors import InputError
from failuretwin.digital_model.robot import Robot

MAY_BE_ZERO = ("derivative", "damping", "friction", "flex_damping")
MAY_BE_INFINITE = ("torque_limit",)


@dataclass(frozen=True)
class MotorPhysics:
    """A motor with its servo and its gear. For a sliding joint read N for N m and m for rad.

    Servo: torque = stiffness * (s - q) + derivative * (s' - q'), within the torque limit, with q
    the angle of the drive and s the reference after a first-order filter. The motor's largest speed
    is a fact of the robot's profile.

    Attributes:
        name: Name of the motor.
        stiffness: Proportional gain of the servo [N m/rad].
        derivative: Gain of the servo on the error's speed [N m s/rad].
        filter_s: Time constant of the set-point filter [s].
        damping: Back-EMF and viscous friction of the drive [N m s/rad]; the motor can turn no
            faster than torque_limit / damping.
        armature: Inertia of the rotor as seen behind the gear [kg m2].
        friction: Coulomb friction of the gear [N m]; the drive comes to rest up to friction /
            stiffness away from its set-point, which is all the dead band there is.
        friction_yield: How far teeth and grease give before the gear slips [rad].
        torque_limit: Stall torque [N m].
        flex_stiffness: Stiffness of the gear's output side [N m/rad].
        flex_damping: Damping of the output side [N m s/rad].
        flex_inertia: Inertia that takes part in the flexing alone, such as the gear's last stage
            [kg m2]; it bounds how fast the flex of a light link can ring.
    """

    name: str
    stiffness: float
    derivative: float
    filter_s: float
    damping: float
    armature: float
    friction: float
    friction_yield: float
    torque_limit: float
    flex_stiffness: float
    flex_damping: float
    flex_inertia: float

    def __post_init__(self) -> None:
        for field in fields(self)[1:]:
            value = getattr(self, field.name)
            fits = value >= 0.0 if field.name in MAY_BE_ZERO else value > 0.0
            if not fits or (math.isinf(value) and field.name not in MAY_BE_INFINITE):
                raise InputError(
                    f"motor {self.name!r}: {field.name} is {value}, expected a finite number "
                    f"{'of zero or more' if field.name in MAY_BE_ZERO else 'above zero'}."
                )

    @property
    def compliance(self) -> float:
        """How far the output side gives way under load at rest [rad/(N m)]."""
        return 1.0 / self.stiffness + 1.0 / self.flex_stiffness


@dataclass(frozen=True)
class PhysicsParameters:
    """The motors of one robot.

    Attributes:
        source: Where the figures come from.
        motors: One entry for each motor of the robot, in chain order.
    """

    source: str
    motors: tuple[MotorPhysics, ...]

    def check_fit(self, robot: Robot) -> None:
        """Raise an error unless the motors are those of `robot`.

        Raises:
            InputError: If names or their order differ.
        """
        names = [motor.name for motor in self.motors]
        if names != robot.motor_names:
            raise InputError(
                f"physics parameters are for motors {', '.join(names)}; {robot.name!r} has "
                f"{', '.join(robot.motor_names)}. List exactly these, in this order."
            )


def load_parameters(robot: Robot) -> PhysicsParameters | None:
    """Return the parameters in the file that the robot's profile names; None if it names none.

    Raises:
        InputError: If the file cannot be used or does not fit the robot.
    """
    path = robot.physics_file
    if path is None:
        return None
    parameters = from_table(PhysicsParameters, read_toml(path), str(path))
    parameters.check_fit(robot)
    return parameters
