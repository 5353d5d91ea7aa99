"""What was learned between the plateaus, as values of the digital model and as parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.connection.calibration.calibration import Parameter
from failuretwin.connection.calibration.motion_part import Lateness
from failuretwin.connection.calibration.parameters import rate_parameter
from failuretwin.connection.calibration.rates import Rate, median_interval, spread_of
from failuretwin.connection.calibration.timing_fit import TimingFit
from failuretwin.core.movements import Movements
from failuretwin.core.runs import measured_rate
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.imperfections import Range, Readings, Schedule, Timing
from failuretwin.digital_model.robot import Robot

if TYPE_CHECKING:
    import xarray as xr

FEWEST = 6
"""Values below which nothing is said of how they spread."""


def timing_of(fit: TimingFit | None, late: Lateness, gaps: FloatArray) -> Timing:
    """Return how motions run late.

    Args:
        fit: Delay, lag and shortening; None: the logs do not say.
        late: Late starts.
        gaps: When readings stopped before them [s].
    """
    timing = Timing()
    if fit is not None:
        timing = replace(
            timing,
            delay_s=spread_of(fit.delay),
            ramp_shortening=spread_of(fit.shortening),
            lag_s=(fit.lag, fit.lag),
        )
    starts = late_starts(late)
    if len(starts) < FEWEST:
        return timing
    return replace(
        timing,
        late_rate=late_rate(late).mean,
        late_s=_above_zero(spread_of(starts)),
        gap_start_s=_above_zero(spread_of(gaps)) if len(gaps) else (0.0, 0.0),
    )


def late_starts(late: Lateness) -> FloatArray:
    """Return how late the late movements started, (late movement,) [s]."""
    return late.late[late.delayed]


def late_rate(late: Lateness) -> Rate:
    """Return the share of late movements; nothing before the first one of a run can stall."""
    after_first = late.late[:, 1:]
    known = after_first[np.isfinite(after_first)]
    return Rate(int(np.sum(known > 0.0)), len(known))


def _above_zero(values: Range) -> Range:
    return max(values[0], 0.0), max(values[1], 0.0)


def schedule_of(movements: Movements, late: Lateness, robot: Robot) -> Schedule:
    """Return the schedule of the logs; runs of another length keep its pace."""
    first = movements.start[:, 0]
    spacing = np.diff(movements.start, axis=1)
    punctual = spacing[np.nan_to_num(late.late[:, :-1], nan=1.0) == 0.0]
    if len(punctual) == 0:
        return Schedule()
    whole = False
    if robot.profile.servo_units is not None:
        counts = robot.servo_units.to_counts(movements.target[movements.exists])
        whole = bool(np.max(np.abs(counts - np.rint(counts))) < 1e-6)
    return Schedule(
        first_start_s=(float(np.nanmin(first)), float(np.nanmax(first))),
        period_s=(float(punctual.min()), float(punctual.max())),
        whole_counts=whole,
    )


def readings_of(runs: xr.Dataset, robot: Robot, glitches: Sequence[Rate] | None) -> Readings:
    """Return how the sensors sample: their rate, whole counts, spoilt readings."""
    whole = False
    if robot.profile.servo_units is not None and "position" in runs:
        position = runs["position"].values
        counts = robot.servo_units.to_counts(position[np.isfinite(position)])
        whole = bool(np.mean(np.abs(counts - np.rint(counts)) < 1e-3) > 0.95)
    return Readings(
        rate_hz=measured_rate(runs),
        whole_counts=whole,
        glitch_rate=tuple(rate.mean for rate in glitches or ()),
    )


def lateness_parameters(late: Lateness, gaps: FloatArray) -> list[Parameter]:
    """Return the rate of late starts, how late they are, and when readings stop before them."""
    if not late.known:
        note = "commands do not come at a steady pace; send them on a fixed schedule"
        return [Parameter("late starts", "", "share", 0.0, 0.0, 1.0, False, note)]
    found = [rate_parameter("late starts", "", late_rate(late))]
    starts = late_starts(late)
    for name, values in (("late start, median", starts), ("readings stop, median", gaps)):
        if len(values) >= FEWEST:
            found.append(Parameter(name, "", "s", *median_interval(values)))
    return found
