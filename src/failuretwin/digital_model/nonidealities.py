"""What a healthy robot does that its twin does not: one value, every part switchable.

Figures of a real robot live in TOML files beside the robot's profile, with their source; the way to
read one is `calibrated_robot.load_calibration`. Ranges are drawn anew for each run, rates apply to
each movement or reading.
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
"""No arm that is watched at work trails its commands by more [s]."""
LONGEST_S = 60.0
"""Longest delay or time between movements [s]: logs with a longer silence are not read."""
Seconds = Annotated[tuple[float, float], Bounds(0.0, LONGEST_S, in_order=True)]
Spreads = Annotated[tuple[float, ...], Bounds()]

PROTOCOLS = ("P0", "P0c", "P1", "P2")
"""How much real data was used: none, healthy logs, unlabelled or labelled runs of the test set."""
SETTLING_LISTS = ("bias", "compliance", "friction", "scatter")
"""Figures of `Settling` and `Variation` that have one value for each motor."""


@dataclass(frozen=True)
class Timing(Bounded):
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

    delay_s: Annotated[tuple[float, float], Bounds(-1.0, LONGEST_S, in_order=True)] = (0.0, 0.0)
    lag_s: Annotated[tuple[float, float], Bounds(0.0, LONGEST_LAG_S, in_order=True)] = (0.0, 0.0)
    ramp_shortening: Annotated[tuple[float, float], Bounds(-1.0, 0.99, in_order=True)] = (0.0, 0.0)
    late_rate: Share = 0.0
    late_s: Seconds = (0.0, 0.0)
    gap_start_s: Seconds = (0.0, 0.0)


@dataclass(frozen=True)
class LostCommand(Bounded):
    """A set of motors that lose a command together and stay where they are for one movement.

    Attributes:
        motors: Their names.
        rate: Share of punctual movements in which exactly these motors lose it [-].
        rate_when_late: The same for movements that start late [-].
    """

    motors: tuple[str, ...]
    rate: Share
    rate_when_late: Share


@dataclass(frozen=True)
class Schedule(Bounded):
    """When movements are commanded and on what scale.

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

    rate_hz: Annotated[float, Bounds(0.1, 1e5)]
    jitter_s: AtLeastZero = 0.0
    whole_counts: bool = False
    glitch_rate: Annotated[tuple[float, ...], Bounds(0.0, 1.0)] = ()
    noise_m: AtLeastZero = 0.0
    drawn_out: bool = False


@dataclass(frozen=True)
class Variation(Bounded):
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

    bias: Spreads = ()
    compliance: Spreads = ()
    friction: Spreads = ()
    scatter: Spreads = ()
    rates: AtLeastZero = 0.0
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
        sensors: What was learned of sensors beside that of the tool's position.
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

    def __post_init__(self) -> None:
        if self.protocol not in PROTOCOLS:
            raise unknown_name("protocol", self.protocol, PROTOCOLS)
        if self.highest_loss > 1.0 + 1e-9:
            raise InputError(
                f"lost_commands: the rates add up to {self.highest_loss:g}, expected 1 at most."
            )

    @property
    def highest_loss(self) -> float:
        """Share of movements in which some command is lost: punctual or late ones, the larger."""
        losses = self.lost_commands
        return max(sum(e.rate for e in losses), sum(e.rate_when_late for e in losses))


NO_IMPERFECTIONS = Imperfections("none", "the published twin")

# Robots of a kind: imperfections drawn around given ones, for training and for honest doubt.

HIGHEST_LOSS = 0.9
"""Bound on the share of movements in which some command is lost, however unlucky the draw."""


def vary(imperfections: Imperfections, rng: np.random.Generator) -> Imperfections:
    """Return the imperfections of one robot drawn from the variation of `imperfections`.

    Without a variation they are returned as they are, and nothing is drawn.
    """
    variation = imperfections.variation
    if variation is None:
        return imperfections
    settling = imperfections.settling
    if settling is not None:
        settling = _vary_settling(settling, variation, rng)
    factor = float(np.exp(variation.rates * rng.standard_normal()))
    return replace(_scale_rates(imperfections, factor), settling=settling, variation=None)


def _vary_settling(settling: Settling, variation: Variation, rng: np.random.Generator) -> Settling:
    def normal(spread: tuple[float, ...]) -> FloatArray:
        return rng.standard_normal(len(settling.bias)) * np.asarray(spread or 0.0)

    return replace(
        settling,
        bias=tuple(settling.bias + normal(variation.bias)),
        compliance=tuple(settling.compliance * np.exp(normal(variation.compliance))),
        friction=tuple(settling.friction + normal(variation.friction)),
        scatter=tuple(settling.scatter * np.exp(normal(variation.scatter))),
        payload=settling.payload + float(rng.uniform(*variation.payload)),
    )


def _scale_rates(imperfections: Imperfections, factor: float) -> Imperfections:
    """Return the imperfections with every rate multiplied by `factor`, as far as shares can be."""
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
    """Return imperfections that leave nothing to chance; ranges shrink to their middles."""
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
