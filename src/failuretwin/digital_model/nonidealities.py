"""Imperfections: differences of a healthy robot from its twin, each part optional.

Values of a real robot lie in TOML files beside its profile, with their source; read them with
`calibrated_robot.load_calibration`. Ranges are drawn for each run, rates apply to each movement or
reading.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np

from failuretwin.core.config import AtLeastZero, Bounded, Bounds, Share
from failuretwin.core.errors import InputError, unknown_name
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.profile import SensorProfile
from failuretwin.digital_model.settling import Settling

Range = Annotated[tuple[float, float], Bounds(in_order=True)]
"""Lowest and highest value, from zero on."""
LONGEST_LAG_S = 5.0
"""Longest lag of an arm behind its commands [s]."""
LONGEST_S = 60.0
"""Longest delay or time between movements [s]: logs with a longer silence are not read."""
Seconds = Annotated[tuple[float, float], Bounds(0.0, LONGEST_S, in_order=True)]
Spreads = Annotated[tuple[float, ...], Bounds()]

PROTOCOLS = ("P0", "P0c", "P1", "P2")
"""Real data used: none, healthy logs, unlabelled or labelled runs of the test set."""
SETTLING_LISTS = ("bias", "compliance", "friction", "scatter")
"""Fields of `Settling` and `Variation` with one value per motor."""


@dataclass(frozen=True)
class Timing(Bounded):
    """Delays of motions behind their commands.

    Attributes:
        delay_s: Range of the dead time in addition to the servo loop [s].
        lag_s: Range of the time constant of a first-order lag in addition to the servo loop [s].
        ramp_shortening: Range of the share by which ramps end early [-].
        late_rate: Share of movements that start late because of a stalled bus [-].
        late_s: Range of the late start, common to all motors [s].
        gap_start_s: Time from the start of the previous movement until readings stop [s]; they
            resume with the late start.
    """

    delay_s: Annotated[tuple[float, float], Bounds(-1.0, LONGEST_S, in_order=True)] = (0.0, 0.0)
    lag_s: Annotated[tuple[float, float], Bounds(0.0, LONGEST_LAG_S, in_order=True)] = (0.0, 0.0)
    ramp_shortening: Annotated[tuple[float, float], Bounds(-1.0, 0.99, in_order=True)] = (0.0, 0.0)
    late_rate: Share = 0.0
    late_s: Seconds = (0.0, 0.0)
    gap_start_s: Seconds = (0.0, 0.0)


@dataclass(frozen=True)
class LostCommand(Bounded):
    """A set of motors that miss one command together and stay at their angles.

    Attributes:
        motors: Their names.
        rate: Share of punctual movements missed by exactly these motors [-].
        rate_when_late: The same for movements that start late [-].
    """

    motors: tuple[str, ...]
    rate: Share
    rate_when_late: Share


@dataclass(frozen=True)
class Schedule(Bounded):
    """Times and scale of commands.

    Attributes:
        first_start_s: Range of the first movement's start [s].
        period_s: Range of the time from one movement to the next [s].
        whole_counts: Whether targets are whole servo counts.
    """

    first_start_s: Seconds = (0.0, 0.0)
    period_s: Annotated[tuple[float, float], Bounds(0.05, LONGEST_S, in_order=True)] = (2.0, 2.0)
    whole_counts: bool = False


@dataclass(frozen=True)
class Readings(Bounded):
    """Sampling of the tool sensor; without it, every grid time has a sample.

    Attributes:
        rate_hz: Nominal rate [Hz].
        jitter_s: Standard deviation of the sample times [s].
        whole_counts: Whether the angles behind the virtual sensor are whole servo counts.
        glitch_rate: Share of readings corrupted by each motor [-].
        noise_m: Standard deviation of noise on each axis [m].
        drawn_out: Interpolate the grid between readings, with glitches clamped to the servo's
            range, as the published data do; otherwise readings lie at the nearest grid time, and
            gaps and glitches are missing.
    """

    rate_hz: Annotated[float, Bounds(0.1, 1e5)]
    jitter_s: AtLeastZero = 0.0
    whole_counts: bool = False
    glitch_rate: Annotated[tuple[float, ...], Bounds(0.0, 1.0)] = ()
    noise_m: AtLeastZero = 0.0
    drawn_out: bool = False


@dataclass(frozen=True)
class Variation(Bounded):
    """Differences of a robot from the stated values, drawn for every run.

    One value per motor in chain order; empty for no variation.

    Attributes:
        bias: Standard deviation of the constant error [rad].
        compliance: Standard deviation of the compliance, as a share s of its mean c [-]. It is
            log-normal: c exp(u z - u^2 / 2), u^2 = log(1 + s^2), with a standard normal z.
        friction: Standard deviation of the friction [rad].
        scatter: Standard deviation of the scatter's logarithm [-].
        rates: Standard deviation of the logarithm of every rate of losses, late starts and glitches
            [-].
        payload: Range of the additional payload [kg].
    """

    bias: Spreads = ()
    compliance: Spreads = ()
    friction: Spreads = ()
    scatter: Spreads = ()
    rates: AtLeastZero = 0.0
    payload: Range = (0.0, 0.0)


@dataclass(frozen=True)
class Imperfections:
    """All differences of a healthy robot from the published twin.

    Attributes:
        name: Name in results.
        source: Source of the values.
        protocol: Real data used: P0 none, P0c healthy logs only.
        settling: Settled errors; None: motors reach their targets exactly.
        timing: Delays, late starts, gaps.
        lost_commands: Sets of motors whose commands are lost, and how often.
        schedule: Times of commands.
        readings: Tool sensor; None: a perfect sample at every grid time.
        variation: Differences from run to run; None: the same robot in every run.
        sensors: Calibrated sensors in addition to the tool's position.
        of_class: Whether these are figures of a class of arms rather than of one robot.
        frames_in_doubt: Whether the figures of one robot were learned beside joint frames that may
            stand off its URDF, and do not count without them.
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
    sensors: tuple[SensorProfile, ...] = ()
    of_class: bool = False
    frames_in_doubt: bool = False

    def __post_init__(self) -> None:
        if self.protocol not in PROTOCOLS:
            raise unknown_name("protocol", self.protocol, PROTOCOLS)
        if self.highest_loss > 1.0 + 1e-9:
            raise InputError(
                f"lost_commands: the rates add up to {self.highest_loss:g}, expected 1 at most."
            )

    @property
    def highest_loss(self) -> float:
        """Share of movements with any lost command: of punctual or late ones, the larger."""
        losses = self.lost_commands
        return max(sum(e.rate for e in losses), sum(e.rate_when_late for e in losses))


NO_IMPERFECTIONS = Imperfections("none", "the published twin")

# Robots of a class: imperfections drawn around given ones.

HIGHEST_LOSS = 0.9
"""Upper bound on the share of movements with any lost command."""


def vary(imperfections: Imperfections, rng: np.random.Generator) -> Imperfections:
    """Return the imperfections of one robot drawn from their variation.

    Without a variation they are returned unchanged, and no random number is drawn.
    """
    variation = imperfections.variation
    if variation is None:
        return imperfections
    settling = imperfections.settling
    if settling is not None:
        settling = _vary_settling(settling, variation, rng)
    factor = float(np.exp(variation.rates * rng.standard_normal()))
    return replace(with_rates(imperfections, factor), settling=settling, variation=None)


def _vary_settling(settling: Settling, variation: Variation, rng: np.random.Generator) -> Settling:
    def normal(spread: tuple[float, ...]) -> FloatArray:
        return rng.standard_normal(len(settling.bias)) * np.asarray(spread or 0.0)

    log_variance = np.log1p(np.square(variation.compliance or 0.0))
    bias = normal(variation.bias)
    log_factor = rng.standard_normal(len(bias)) * np.sqrt(log_variance) - 0.5 * log_variance
    return replace(
        settling,
        bias=tuple(settling.bias + bias),
        compliance=tuple(settling.compliance * np.exp(log_factor)),
        friction=tuple(settling.friction + normal(variation.friction)),
        scatter=tuple(settling.scatter * np.exp(normal(variation.scatter))),
        payload=settling.payload + float(rng.uniform(*variation.payload)),
    )


def with_rates(imperfections: Imperfections, factor: float) -> Imperfections:
    """Return the imperfections with every rate multiplied by `factor`, capped at 1."""
    timing, readings = imperfections.timing, imperfections.readings
    share = min(factor, HIGHEST_LOSS / max(imperfections.highest_loss, 1e-9))
    if readings is not None:
        glitch_rate = tuple(min(1.0, factor * rate) for rate in readings.glitch_rate)
        readings = replace(readings, glitch_rate=glitch_rate)
    return replace(
        imperfections,
        timing=replace(timing, late_rate=min(1.0, factor * timing.late_rate)),
        lost_commands=tuple(
            replace(entry, rate=share * entry.rate, rate_when_late=share * entry.rate_when_late)
            for entry in imperfections.lost_commands
        ),
        readings=readings,
    )


def deterministic(imperfections: Imperfections) -> Imperfections:
    """Return the imperfections without randomness; ranges shrink to their middles."""
    timing, settling = imperfections.timing, imperfections.settling
    if settling is not None:
        settling = replace(settling, scatter=(0.0,) * len(settling.scatter))
    return replace(
        imperfections,
        settling=settling,
        timing=replace(
            timing,
            delay_s=_middle(timing.delay_s),
            lag_s=_middle(timing.lag_s),
            ramp_shortening=_middle(timing.ramp_shortening),
            late_rate=0.0,
        ),
        lost_commands=(),
        readings=None,
        variation=None,
    )


def _middle(ends: Range) -> Range:
    middle = 0.5 * (ends[0] + ends[1])
    return middle, middle
