"""What a healthy robot does that its twin does not: one value, every part switchable.

Figures of a real robot live in TOML files beside the robot's profile, with their source. Ranges
are drawn anew for each run, rates apply to each movement or reading.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from failuretwin.core.config import from_table, read_toml
from failuretwin.core.errors import InputError, unknown_name
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import Settling

Range = tuple[float, float]


@dataclass(frozen=True)
class Timing:
    """How motions run late against their commands.

    Attributes:
        delay_s: Range of the dead time on top of the servo loop [s].
        lag_s: Range of the time constant of a first-order lag on top of the servo loop [s].
        ramp_shortening: Range of the share by which ramps end early [-].
        late_rate: Share of movements that a stalled bus makes start late [-].
        late_s: Range of the late start, common to all motors [s].
        gap_start_s: When readings stop, after the movement before the late one began [s]; they
            come back with the late start.
    """

    delay_s: Range = (0.0, 0.0)
    lag_s: Range = (0.0, 0.0)
    ramp_shortening: Range = (0.0, 0.0)
    late_rate: float = 0.0
    late_s: Range = (0.0, 0.0)
    gap_start_s: Range = (0.0, 0.0)


@dataclass(frozen=True)
class LostCommand:
    """A set of motors that lose a command together and stay where they are for one movement.

    Attributes:
        motors: Their names.
        rate: Share of punctual movements in which exactly these motors lose it [-].
        rate_when_late: The same for movements that start late [-].
    """

    motors: tuple[str, ...]
    rate: float
    rate_when_late: float


@dataclass(frozen=True)
class Schedule:
    """When movements are commanded and on what scale.

    Attributes:
        first_start_s: Range of the first movement's start [s].
        period_s: Range of the time from one movement to the next [s].
        whole_counts: Whether targets are whole servo counts.
    """

    first_start_s: Range = (0.0, 0.0)
    period_s: Range = (2.0, 2.0)
    whole_counts: bool = False


@dataclass(frozen=True)
class Readings:
    """How the tool sensor samples the motion; without it, every grid time has a sample.

    Attributes:
        rate_hz: Nominal rate of the readings [Hz].
        jitter_s: Standard deviation of their times [s].
        whole_counts: Whether the angles behind the virtual sensor are whole servo counts.
        glitch_rate: Share of readings spoilt by each motor [-].
        noise_m: Standard deviation of noise on each axis [m].
        drawn_out: Fill the grid by straight lines between readings, glitches clamped to the
            servo's range, as the published data do; otherwise leave readings at the nearest
            grid time, and gaps and glitches missing.
    """

    rate_hz: float
    jitter_s: float = 0.0
    whole_counts: bool = False
    glitch_rate: tuple[float, ...] = ()
    noise_m: float = 0.0
    drawn_out: bool = False


@dataclass(frozen=True)
class Variation:
    """How far a robot may differ from the figures: drawn anew for every run.

    One value for each motor in chain order, or none at all for no variation.

    Attributes:
        bias: Standard deviation of the constant error [rad].
        compliance: Standard deviation of the compliance's logarithm [-].
        friction: Standard deviation of the friction [rad].
        scatter: Standard deviation of the scatter's logarithm [-].
        rates: Standard deviation of the logarithm of every rate of losses, late starts and
            glitches [-].
        payload: Range of a payload on top of the known one [kg].
    """

    bias: tuple[float, ...] = ()
    compliance: tuple[float, ...] = ()
    friction: tuple[float, ...] = ()
    scatter: tuple[float, ...] = ()
    rates: float = 0.0
    payload: Range = (0.0, 0.0)


@dataclass(frozen=True)
class Imperfections:
    """Everything that sets a healthy robot apart from the published twin.

    Attributes:
        name: What to call it in results.
        source: Where the figures come from.
        protocol: How much real data the figures have seen: P0 none, P0c healthy logs only.
        settling: Where motors settle; None: exactly at their targets.
        timing: Delays, late starts, gaps.
        lost_commands: Sets of motors whose commands never arrive, and how often.
        schedule: When movements are commanded.
        readings: The tool sensor; None: a perfect sample at every grid time.
        variation: Differences from run to run; None: every run has the same robot.
    """

    name: str
    source: str
    protocol: str = "P0"
    settling: Settling | None = None
    timing: Timing = field(default_factory=Timing)
    lost_commands: tuple[LostCommand, ...] = ()
    schedule: Schedule = field(default_factory=Schedule)
    readings: Readings | None = None
    variation: Variation | None = None


NO_IMPERFECTIONS = Imperfections("none", "the published twin")

SETTLING_LISTS = ("bias", "compliance", "friction", "scatter")
"""Figures of `Settling` and `Variation` that have one value for each motor."""

CALIBRATION_TABLE = "calibration"
"""Table of such a file that says of which robot and how the figures were found."""
GENERIC_NAME = "generic, not calibrated"
"""What results say of a robot whose healthy behaviour has not been measured."""
GENERIC_SCATTER_RAD = 0.01
"""Settled scatter assumed of a robot of which nothing is known [rad], about half a degree."""


def generic_imperfections(robot: Robot) -> Imperfections:
    """Return wide healthy offsets for a robot whose own have not been measured."""
    zero = (0.0,) * len(robot.motors)
    scatter = (GENERIC_SCATTER_RAD,) * len(robot.motors)
    settling = Settling(zero, zero, zero, scatter, 4.0, "assumed, no calibration")
    return Imperfections(GENERIC_NAME, "assumed", settling=settling)


def default_imperfections(robot: Robot) -> Imperfections:
    """Return those that the robot's profile names, or generic ones."""
    if robot.imperfections_file is None:
        return generic_imperfections(robot)
    return load_imperfections(robot.name, robot)


def load_imperfections(name_or_path: str, robot: Robot) -> Imperfections:
    """Load imperfections.

    Args:
        name_or_path: ``none``, the name of `robot` for those of its profile, or a TOML file.
        robot: The robot they are for.

    Raises:
        InputError: If there are none under this name, or they belong to another robot or do not fit
            its motors.
    """
    if name_or_path == "none":
        return NO_IMPERFECTIONS
    path: Path | None = Path(name_or_path)
    if name_or_path == robot.name:
        path = robot.imperfections_file
    if path is None or (path.suffix != ".toml" and not path.exists()):
        own = f", {robot.name!r}" if robot.imperfections_file else ""
        raise InputError(f"no imperfections {name_or_path!r}. Expected 'none'{own} or a TOML file.")
    table = read_toml(path)
    _check_robot(table.pop(CALIBRATION_TABLE, None), robot, path)
    imperfections = from_table(Imperfections, table, str(path))
    _check_fit(imperfections, robot, path)
    return imperfections


def _check_robot(calibration: object, robot: Robot, path: Path) -> None:
    owner = calibration.get("robot") if isinstance(calibration, dict) else None
    if owner not in (None, robot.name):
        raise InputError(
            f"{path}: is a calibration of robot {owner!r}, not of {robot.name!r}. Name the right "
            "robot (--robot) or calibrate this one."
        )


def _check_fit(imperfections: Imperfections, robot: Robot, path: Path) -> None:
    count = len(robot.motors)
    for name, values in _motor_lists(imperfections).items():
        if len(values) not in (0, count) or (not values and name.startswith("settling")):
            raise InputError(
                f"{path}: {name} has {len(values)} values, expected {count}, one for each motor "
                f"of {robot.name!r}."
            )
    for lost in imperfections.lost_commands:
        for motor in lost.motors:
            if motor not in robot.motor_names:
                raise InputError(
                    f"{path}: lost_commands: {unknown_name('motor', motor, robot.motor_names)}"
                )


def _motor_lists(imperfections: Imperfections) -> dict[str, tuple[float, ...]]:
    """Return every figure that has one value for each motor, by the name of its key."""
    lists: dict[str, tuple[float, ...]] = {}
    for table in ("settling", "variation"):
        value = getattr(imperfections, table)
        if value is not None:
            lists |= {f"{table}: {name}": getattr(value, name) for name in SETTLING_LISTS}
    if imperfections.readings is not None:
        lists["readings: glitch_rate"] = imperfections.readings.glitch_rate
    return lists
