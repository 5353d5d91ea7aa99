"""The result of a calibration: imperfections with error bars and where they come from."""

from __future__ import annotations

from dataclasses import dataclass

from failuretwin.digital_model.imperfections import Imperfections


@dataclass(frozen=True)
class Parameter:
    """One figure learned from the logs.

    Attributes:
        name: What it is, such as ``compliance``.
        motor: The motor it belongs to; empty for the whole robot.
        unit: Its unit.
        value: Best value.
        low: Lower end of its 95 % interval.
        high: Upper end.
        identified: Whether the logs say it; otherwise the interval is mostly that of the prior.
        note: What keeps the logs from saying it and which movement would, or empty.
    """

    name: str
    motor: str
    unit: str
    value: float
    low: float
    high: float
    identified: bool = True
    note: str = ""


@dataclass(frozen=True)
class LoopFit:
    """Servo loop of a motor as its step tests speak for it.

    Attributes:
        motor: Its name.
        P: Proportional gain [-].
        I: Integral gain [1/s].
        filter_s: Time constant of the input filter [s].
        speed_limit: Largest speed [rad/s].
    """

    motor: str
    P: float
    I: float  # noqa: E741 - the field's name for an integral gain
    filter_s: float
    speed_limit: float


@dataclass(frozen=True)
class LeftOut:
    """A movement that did not count, because it does not look like one of a healthy motor.

    Attributes:
        run: Name of the run.
        movement: Number of the movement in it, from 1; 0 for the whole run.
        motor: The motor that stands out; empty where none does by itself.
        reason: What it did.
    """

    run: str
    movement: int
    motor: str
    reason: str


@dataclass(frozen=True)
class HeldOut:
    """How well a fit to all other sessions predicts one session.

    Attributes:
        session: The session left out.
        movements: Its settled movements.
        before: Robust size of the settled error of each motor without calibration, 1.48 times its
            median size [rad]; of the three axes of the tool [m] where the log has no readings.
        after: The same about what the fit to the others predicts.
        gain: Mean log density of a movement under the fit, minus that with the generic figures of
            an uncalibrated robot [nats].
        gain_error: Standard error of `gain`.
    """

    session: str
    movements: int
    before: tuple[float, ...]
    after: tuple[float, ...]
    gain: float
    gain_error: float


@dataclass(frozen=True)
class Calibration:
    """What healthy logs teach of a robot.

    Attributes:
        imperfections: The twin's imperfections, with the doubt about them as variation.
        parameters: Every figure with its 95 % interval.
        sessions: Names of the sessions it was fitted to.
        runs: Number of runs.
        movements: Number of settled movements that count.
        used_readings: Whether the motors' own readings were used, or the tool path alone.
        left_out: What was left out.
        held_out: How well it predicts sessions that it has not seen.
        remarks: What else the user should know, in sentences.
        loops: Servo loops from step tests; motors without any keep those of the profile. Timing is
            what is left on top of them.
    """

    imperfections: Imperfections
    parameters: tuple[Parameter, ...]
    sessions: tuple[str, ...]
    runs: int
    movements: int
    used_readings: bool
    left_out: tuple[LeftOut, ...] = ()
    held_out: tuple[HeldOut, ...] = ()
    remarks: tuple[str, ...] = ()
    loops: tuple[LoopFit, ...] = ()
