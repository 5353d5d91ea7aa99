"""From healthy runs to a calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.connection.calibration.calibration import (
    Calibration,
    HeldOut,
    LeftOut,
    Parameter,
)
from failuretwin.connection.calibration.held_out import held_out_sessions, judge
from failuretwin.connection.calibration.motion_part import (
    Lateness,
    gap_starts,
    glitch_rates,
    lateness,
    movements_of,
    transients,
)
from failuretwin.connection.calibration.observations import observe
from failuretwin.connection.calibration.parameters import (
    loss_parameters,
    rate_parameter,
    settling_parameters,
    timing_parameters,
)
from failuretwin.connection.calibration.rates import LossRates, Rate, loss_rates, uniform_range
from failuretwin.connection.calibration.settled_part import SettledPart, fit_settled_part
from failuretwin.connection.calibration.timing_fit import TimingFit, fit_timing
from failuretwin.connection.calibration.what_if import best_payload, sense_remarks
from failuretwin.core.movements import Movements
from failuretwin.core.runs import measured_rate
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.imperfections import (
    Imperfections,
    Range,
    Readings,
    Schedule,
    Timing,
    Variation,
)
from failuretwin.digital_model.robot import Robot

if TYPE_CHECKING:
    import xarray as xr

SUSPECT = 0.9
"""A run that is faulty with at least this probability is left out."""
BOOTSTRAP_SEED = 0
FEWEST = 3
"""Values below which nothing is said of a range."""


def calibrate(
    runs: xr.Dataset,
    robot: Robot,
    name: str,
    source: str,
    *,
    suspicion: FloatArray | None = None,
    use_readings: bool = True,
    judged: xr.Dataset | None = None,
    thorough: bool = True,
) -> Calibration:
    """Learn the imperfections of a robot from healthy runs.

    Args:
        runs: Runs of the healthy robot.
        robot: The robot.
        name: What to call the imperfections in results.
        source: Which logs they come from.
        suspicion: Probability that each run is faulty, (run,); runs with 0.9 or more are left
            out. None: all count.
        use_readings: Whether to look at the motors' own readings, where the runs have them.
        judged: Healthy runs of sessions that only say how good the fit is; None: each session is
            left out once and judged by a fit to the others.
        thorough: Whether to check the fit on sessions that it has not seen, and the senses and
            payload of the robot.

    Raises:
        InputError: If too few movements come to rest near their targets.
    """
    trusted = np.ones(runs.sizes["run"], dtype=bool)
    if suspicion is not None:
        trusted = suspicion < SUSPECT
    left_out = [LeftOut(str(run), 0, "", "looks faulty") for run in runs["run"].values[~trusted]]
    kept = runs.isel(run=np.flatnonzero(trusted))
    part = fit_settled_part(observe(kept, use_readings=use_readings), robot)
    payload, remarks = 0.0, list[str]()
    if thorough:
        payload, told = best_payload(part, robot)
        remarks = [*sense_remarks(part, robot), told]
        if payload > 0.0:
            part = fit_settled_part(part.observations, robot, payload)
    movements = movements_of(kept)
    late = lateness(movements)
    losses = loss_rates(part.observations, part.lost, _late_of(part, late), robot.motor_names)
    rng = np.random.default_rng(BOOTSTRAP_SEED)
    timing = fit_timing(transients(kept, movements, late, part, robot), robot, rng)
    gaps = gap_starts(kept, movements, late.late)
    glitches = glitch_rates(kept) if part.observations.position is not None else None
    imperfections = Imperfections(
        name=name,
        source=source,
        protocol="P0c",
        settling=replace(part.settling, source=source),
        timing=_timing(timing, late, gaps),
        lost_commands=tuple(loss.entry() for loss in losses),
        schedule=_schedule(movements, late, robot),
        readings=_readings(kept, robot, glitches),
        variation=_variation(part, losses),
    )
    return Calibration(
        imperfections=imperfections,
        parameters=(
            *settling_parameters(part.fit, robot, payload),
            *timing_parameters(timing, np.random.default_rng(BOOTSTRAP_SEED)),
            *_lateness_parameters(late, gaps),
            *loss_parameters(losses),
            *_glitch_parameters(glitches, robot),
        ),
        sessions=part.observations.sessions,
        runs=int(trusted.sum()),
        movements=int(np.sum(~part.odd)),
        used_readings=part.observations.position is not None,
        left_out=(*left_out, *part.left_out(robot)),
        held_out=_held_out(part, robot, judged) if thorough else (),
        remarks=tuple(remarks),
    )


def _held_out(part: SettledPart, robot: Robot, judged: xr.Dataset | None) -> tuple[HeldOut, ...]:
    seen = part.observations
    if judged is None:
        return held_out_sessions(seen, robot, part.payload)
    unseen = observe(judged, use_readings=seen.position is not None)
    entries = [
        judge(unseen[unseen.session == index], part, robot, name)
        for index, name in enumerate(unseen.sessions)
    ]
    return tuple(entry for entry in entries if entry is not None)


def _late_of(part: SettledPart, late: Lateness) -> BoolArray:
    seen = part.observations
    return np.asarray(np.nan_to_num(late.late)[seen.run, seen.number] > 0.0)


def _late_rate(late: Lateness) -> Rate:
    after_first = late.late[:, 1:]  # nothing before the first movement of a run can stall
    known = after_first[np.isfinite(after_first)]
    return Rate(int(np.sum(known > 0.0)), len(known))


def _timing(fit: TimingFit | None, late: Lateness, gaps: FloatArray) -> Timing:
    timing = Timing()
    if fit is not None:
        timing = replace(
            timing,
            delay_s=spread_of(fit.delay),
            ramp_shortening=spread_of(fit.shortening),
            lag_s=(fit.lag, fit.lag),
        )
    if late.known:
        found = uniform_range(late.late[np.nan_to_num(late.late) > 0.0])
        timing = replace(
            timing,
            late_rate=_late_rate(late).mean if found else 0.0,
            late_s=_above_zero(found[0]) if found else (0.0, 0.0),
            gap_start_s=_above_zero(spread_of(gaps)) if len(gaps) >= FEWEST else (0.0, 0.0),
        )
    return timing


def _above_zero(values: Range) -> Range:
    return max(values[0], 0.0), max(values[1], 0.0)


def spread_of(values: FloatArray) -> Range:
    """Return the range of uniform draws, robustly: median and twice the median deviation."""
    middle = float(np.median(values))
    half = 2.0 * float(np.median(np.abs(values - middle)))
    return middle - half, middle + half


def _schedule(movements: Movements, late: Lateness, robot: Robot) -> Schedule:
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


def _readings(runs: xr.Dataset, robot: Robot, glitches: Sequence[Rate] | None) -> Readings:
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


def _variation(part: SettledPart, losses: Sequence[LossRates]) -> Variation:
    """Return the doubt about the figures: what a robot of these logs may be like."""
    deviation = part.fit.deviation[:-1].reshape(4, -1)
    bias, compliance, friction, log_scatter = deviation
    size = np.abs(part.fit.mode[:-1].reshape(4, -1)[1])
    share = np.divide(compliance, size, out=np.zeros_like(size), where=size > compliance)
    hits = sum(loss.punctual.hits + loss.late.hits for loss in losses)
    return Variation(
        bias=tuple(bias.tolist()),
        compliance=tuple(share.tolist()),
        friction=tuple(friction.tolist()),
        scatter=tuple(log_scatter.tolist()),
        rates=float(1.0 / np.sqrt(hits + 0.5)) if hits else 0.0,
    )


def _lateness_parameters(late: Lateness, gaps: FloatArray) -> list[Parameter]:
    if not late.known:
        note = "commands do not come at a steady pace; send them on a fixed schedule"
        return [Parameter("late starts", "", "share", 0.0, 0.0, 1.0, False, note)]
    rate = _late_rate(late)
    found = [rate_parameter("late starts", "", rate)]
    starts = uniform_range(late.late[np.nan_to_num(late.late) > 0.0])
    if starts is not None:
        (low, high), least, most = starts
        found.append(Parameter("late start, least", "", "s", low, *least))
        found.append(Parameter("late start, most", "", "s", high, *most))
    if len(gaps) >= FEWEST:
        low, high = (float(q) for q in np.quantile(gaps, [0.025, 0.975]))
        middle = float(np.median(gaps))
        found.append(Parameter("readings stop before a late start", "", "s", middle, low, high))
    return found


def _glitch_parameters(glitches: Sequence[Rate] | None, robot: Robot) -> list[Parameter]:
    if glitches is None:
        return []
    pairs = zip(robot.motor_names, glitches, strict=True)
    return [rate_parameter("spoilt readings", motor, rate) for motor, rate in pairs]
