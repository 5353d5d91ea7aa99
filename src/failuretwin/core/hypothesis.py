"""Faults, hypotheses, diagnoses and alarms.

Text form in files and on the command line: ``healthy``, ``unknown``, ``motor_1:stuck``, or several
faults joined by ``+`` in chain order.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from failuretwin.core.errors import InputError, unknown_name


@dataclass(frozen=True)
class Fault:
    """One fault mode of one motor, without size and onset; the mode may be registered elsewhere."""

    motor: str
    mode: str

    def __str__(self) -> str:
        return f"{self.motor}:{self.mode}"


@dataclass(frozen=True)
class Hypothesis:
    """A state of the robot: healthy, one or several faults, or unknown."""

    faults: tuple[Fault, ...] = ()
    known: bool = True

    def __str__(self) -> str:
        if not self.known:
            return "unknown"
        return "+".join(str(fault) for fault in self.faults) or "healthy"

    @property
    def is_healthy(self) -> bool:
        """Whether there is no fault."""
        return self.known and not self.faults

    @classmethod
    def parse(cls, text: str, motors: Sequence[str] | None = None) -> Hypothesis:
        """Return the hypothesis of a text form.

        Args:
            text: Such as ``"motor_1:stuck+motor_3:drift"``.
            motors: Names of the robot's motors in chain order; None: any names in any order, for
                text from results.

        Raises:
            InputError: If the text does not follow the form or names an unknown motor.
        """
        if text in ("healthy", "unknown"):
            return cls(known=text == "healthy")
        hypothesis = cls(tuple(_parse_fault(part) for part in text.split("+")))
        if motors is not None:
            hypothesis.check_motors(motors)
        return hypothesis

    def check_motors(self, motors: Sequence[str]) -> None:
        """Raise InputError for motors that are not in `motors`, repeated or out of order."""
        for fault in self.faults:
            if fault.motor not in motors:
                raise unknown_name("motor", fault.motor, motors)
        order = [motors.index(fault.motor) for fault in self.faults]
        if order != sorted(set(order)):
            raise InputError(
                f"hypothesis {str(self)!r} names its motors out of chain order or twice. "
                f"Expected each motor once, in the order {', '.join(motors)}."
            )


HEALTHY = Hypothesis()
UNKNOWN = Hypothesis(known=False)


def _parse_fault(text: str) -> Fault:
    motor, separator, mode = text.partition(":")
    if not (separator and mode):
        raise InputError(
            f"hypothesis {text!r} is not of the form MOTOR:MODE. "
            "Expected 'healthy', 'unknown', a fault such as 'motor_1:stuck', or several joined by "
            "'+' in chain order, such as 'motor_1:stuck+motor_2:drift'."
        )
    return Fault(motor, mode)


def single_faults(motors: Sequence[str], modes: Iterable[str]) -> tuple[Hypothesis, ...]:
    """Return healthy and every single fault, mode by mode and motor by motor.

    With modes ``stuck`` and ``steady_state_error`` and four motors these are the paper's nine
    classes in the order of its labels 0 to 8.
    """
    return (HEALTHY, *(Hypothesis((Fault(motor, mode),)) for mode in modes for motor in motors))


PAPER_MODES = ("stuck", "steady_state_error")


def paper_hypotheses(motors: Sequence[str]) -> tuple[Hypothesis, ...]:
    """Return the paper's classes for `motors`: healthy, stuck 1..n, steady-state error 1..n."""
    return single_faults(motors, PAPER_MODES)


def parse_hypotheses(
    given: Iterable[Hypothesis | str], motors: Sequence[str]
) -> tuple[Hypothesis, ...]:
    """Return several hypotheses."""
    if isinstance(given, str):
        raise InputError(
            f"hypotheses are the text {given!r}. Expected a list, such as ['healthy', "
            "'motor_1:stuck']."
        )
    hypotheses = tuple(_as_hypothesis(one) for one in given)
    for hypothesis in hypotheses:
        hypothesis.check_motors(motors)
    if not hypotheses:
        raise InputError("no hypotheses given. Expected at least one, such as 'healthy'.")
    if len(set(hypotheses)) < len(hypotheses):
        raise InputError("a hypothesis is given twice. Give each of them once.")
    return hypotheses


def _as_hypothesis(given: Hypothesis | str) -> Hypothesis:
    # Names of motors may hold what the text form cannot: a hypothesis is taken as it is.
    return given if isinstance(given, Hypothesis) else Hypothesis.parse(str(given).strip())


# State of a robot by its posterior.

HEALTHY_STATE, FAULTY_STATE, OPEN_STATE = "healthy", "faulty", "cannot tell"
SURE = 0.95
"""Probability from which a robot is called healthy, or a motor faulty."""


def motor_probabilities(posterior: Mapping[str, float]) -> dict[str, float]:
    """Return the probability of a fault of each motor, the sum over the hypotheses with one."""
    found: dict[str, float] = {}
    for name, probability in posterior.items():
        for fault in Hypothesis.parse(name).faults:
            found[fault.motor] = found.get(fault.motor, 0.0) + probability
    return found


def state_of(posterior: Mapping[str, float]) -> str:
    """Return `HEALTHY_STATE`, `FAULTY_STATE` or `OPEN_STATE`.

    A motor is faulty from P(motor) = 0.95 on, even if its fault mode is still uncertain.
    """
    if posterior.get(str(HEALTHY), 0.0) >= SURE:
        return HEALTHY_STATE
    if any(p >= SURE for p in motor_probabilities(posterior).values()):
        return FAULTY_STATE
    return OPEN_STATE


# Diagnosis of one run.

Interval = tuple[float, float]


RECORD = (
    *("run", "truth", "state", "diagnosis", "probability", "posterior", "runner_up"),
    *("onset_s", "onset_90", "magnitude", "magnitude_unit", "magnitude_90", "verdict"),
    *("explanation", "evidence", "quality", "protocol", "method"),
)
"""Keys of the JSON object of a diagnosis."""


@dataclass(frozen=True)
class MovementEvidence:
    """Evidence of one movement.

    Attributes:
        movement: Its number in the run, from 1.
        nats: Log Bayes factor of the most probable hypothesis over the second.
        time_s: When it was seen, where one of several readings on its way is meant [s].
    """

    movement: int
    nats: float
    time_s: float | None = None


@dataclass(frozen=True)
class MotorResidual:
    """Settled displacements of the one motor that explains a run best, movement by movement.

    Attributes:
        motor: The motor.
        unit: Unit of displacements and angles: rad, or m of a slide.
        displacement: Settled angle minus that of a healthy motor.
        deviation: Standard deviation of each.
        angle: Settled angle of a healthy motor.
        direction: Sign of its last travel; 0: it stayed.
    """

    motor: str
    unit: str
    displacement: tuple[float, ...]
    deviation: tuple[float, ...]
    angle: tuple[float, ...]
    direction: tuple[float, ...]


@dataclass(frozen=True)
class Diagnosis:
    """Diagnosis of one run. `None`: unknown or not applicable.

    Attributes:
        run: Name of the run.
        posterior: Probability of every hypothesis; sums to 1.
        truth: True hypothesis, where the run set states it.
        onset_s: Onset of the fault [s]; 0 if it was there before the run.
        onset_90: 90 % interval of the onset [s].
        magnitude: Size of the fault in `magnitude_unit`.
        magnitude_unit: Unit of the fault mode.
        magnitude_90: 90 % interval of the magnitude.
        verdict: One plain sentence.
        explanation: Reasons, alternatives and next steps, one per line.
        evidence: Evidence of each usable movement.
        quality: Problems of the log, one per line.
        undecided: Why there is no verdict; empty where there is one.
        protocol: Real data used by the method: P0, P0c, P1 or P2.
        method: Diagnoser and healthy behaviour.
        residual: Displacements of one motor, where ``unknown`` is most probable.
    """

    run: str
    posterior: Mapping[str, float]
    truth: str | None = None
    onset_s: float | None = None
    onset_90: Interval | None = None
    magnitude: float | None = None
    magnitude_unit: str | None = None
    magnitude_90: Interval | None = None
    verdict: str = ""
    explanation: tuple[str, ...] = ()
    evidence: tuple[MovementEvidence, ...] = ()
    quality: tuple[str, ...] = ()
    undecided: str = ""
    protocol: str = "P0"
    method: str = ""
    residual: MotorResidual | None = None

    @property
    def ranked(self) -> list[str]:
        """Hypotheses from the most to the least probable."""
        return sorted(self.posterior, key=lambda name: -self.posterior[name])

    @property
    def diagnosis(self) -> str | None:
        """The most probable hypothesis; None where the log allows no verdict."""
        return None if self.undecided else self.ranked[0]

    @property
    def probability(self) -> float | None:
        """Probability of the most probable hypothesis; None where the log allows no verdict."""
        return None if self.undecided else self.posterior[self.ranked[0]]

    @property
    def state(self) -> str:
        """``healthy``, ``faulty`` or ``cannot tell``; see `state_of`."""
        return OPEN_STATE if self.undecided else state_of(self.posterior)

    @property
    def runner_up(self) -> str | None:
        """The second most probable hypothesis; None where there is none."""
        return None if self.undecided or len(self.posterior) < 2 else self.ranked[1]

    def to_record(self) -> dict[str, Any]:
        """Return the JSON object of the contract."""
        record = {name: getattr(self, name) for name in RECORD}
        record["posterior"] = dict(self.posterior)
        record["evidence"] = [asdict(movement) for movement in self.evidence]
        return record | {name: list(record[name]) for name in ("explanation", "quality")}


# Alarms: the state of monitoring, and fault episodes.

CLEAR, SUSPECTED, RAISED = "clear", "suspected", "alarm"
"""States of an alarm, from best to worst."""


@dataclass(frozen=True)
class Episode:
    """A fault from its alarm to its end.

    Attributes:
        number: Its number in the stream, from 1.
        cause: The diagnosed hypothesis.
        raised_s: Time of the alarm in the stream [s].
        cleared_s: End of the fault [s]; None while it lasts.
    """

    number: int
    cause: str
    raised_s: float
    cleared_s: float | None = None

    @property
    def duration_s(self) -> float | None:
        """Its duration [s]; None while it lasts."""
        return None if self.cleared_s is None else self.cleared_s - self.raised_s


@dataclass(frozen=True)
class Alarm:
    """Result of the alarm rule, the same for all outputs.

    Attributes:
        state: `CLEAR`, `SUSPECTED` or `RAISED`.
        cause: The most probable fault; empty if the state is `CLEAR`.
        episode: The latest fault with an alarm; None before the first.
        threshold: Probability of a fault from which this alarm was raised; None: no alarm.
    """

    state: str = CLEAR
    cause: str = ""
    episode: Episode | None = None
    threshold: float | None = None

    def concerns(self, motor: str) -> bool:
        """Return whether its cause includes a motor."""
        return any(part.partition(":")[0] == motor for part in self.cause.split("+"))


ALL_CLEAR = Alarm()
"""No fault is or was suspected."""
