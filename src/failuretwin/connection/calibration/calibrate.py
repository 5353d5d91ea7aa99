"""From healthy runs to a calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.connection.calibration.observations import observe, session_names
from failuretwin.connection.calibration.parameters import (
    lateness_parameters,
    loss_parameters,
    rate_parameter,
    readings_of,
    schedule_of,
    settling_parameters,
    spring_remarks,
    timing_of,
    timing_parameters,
)
from failuretwin.connection.calibration.rates import LossRates, Rate, loss_rates
from failuretwin.connection.calibration.result import Calibration, HeldOut, LeftOut, Parameter
from failuretwin.connection.calibration.settling import SettledPart, fit_settled_part
from failuretwin.connection.calibration.timing import (
    fit_timing,
    gap_starts,
    glitch_rates,
    lateness,
    movements_of,
    transients,
)
from failuretwin.connection.calibration.validation import (
    best_payload,
    held_out_sessions,
    judge,
    sense_remarks,
)
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.nonidealities import Imperfections, Variation
from failuretwin.digital_model.robot import Robot

if TYPE_CHECKING:
    import xarray as xr

# Which runs had better not teach the twin, and why.

SUSPECT = 0.9
"""A run that is faulty with at least this probability is left out."""
MOST_SUSPECT = 0.25
"""Share of runs that may look faulty. Beyond it, and from two runs on, a session is left out as a
whole, and logs are refused. Of ten healthy runs three look faulty in one session of a thousand."""


def untrusted(
    names: Sequence[str], sessions: Sequence[str], fault_probability: FloatArray
) -> list[LeftOut]:
    """Return the runs that look faulty, and those of sessions that do.

    Args:
        names: Names of the runs.
        sessions: The session of each run.
        fault_probability: Probability that each run is faulty, (run,).
    """
    suspect, of = fault_probability >= SUSPECT, np.asarray(sessions)
    found = []
    for i, name in enumerate(names):
        inside = of == of[i]
        hits = int(suspect[inside].sum())
        if hits >= 2 and hits > MOST_SUSPECT * inside.sum():
            reason = f"its session looks faulty, in {hits} of {int(inside.sum())} runs"
            found.append(LeftOut(name, 0, "", reason))
        elif suspect[i]:
            found.append(LeftOut(name, 0, "", "looks faulty"))
    return found


BOOTSTRAP_SEED = 0


def calibrate(
    runs: xr.Dataset,
    robot: Robot,
    name: str,
    source: str,
    *,
    fault_probability: FloatArray | None = None,
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
        fault_probability: Probability that each run is faulty, (run,); runs and sessions that look
            so are left out. None: all count.
        use_readings: Whether to look at the motors' own readings, where the runs have them.
        judged: Healthy runs of sessions that only say how good the fit is; None: each session is
            left out once and judged by a fit to the others.
        thorough: Whether to check the fit on sessions that it has not seen, and the senses and
            payload of the robot.

    Raises:
        InputError: If too few movements come to rest near their targets.
    """
    names = [str(run) for run in runs["run"].values]
    doubt = np.zeros(len(names)) if fault_probability is None else fault_probability
    left_out = untrusted(names, session_names(runs), doubt)
    out = {entry.run for entry in left_out}
    kept = runs.isel(run=[i for i, run in enumerate(names) if run not in out])
    part = fit_settled_part(observe(kept, use_readings=use_readings), robot)
    payload, remarks = 0.0, list[str]()
    if thorough:
        payload, told = best_payload(part, robot)
        remarks = [*sense_remarks(part, robot), told]
        if payload > 0.0:
            part = fit_settled_part(part.observations, robot, payload)
    movements = movements_of(kept)
    late = lateness(movements)
    losses = loss_rates(
        part.observations, part.lost, late.punctual, late.delayed, robot.motor_names
    )
    rng = np.random.default_rng(BOOTSTRAP_SEED)
    timing = fit_timing(transients(kept, movements, late, part, part.settling, robot), robot, rng)
    gaps = gap_starts(kept, movements, late.late)
    glitches = glitch_rates(kept) if part.observations.position is not None else None
    imperfections = Imperfections(
        name=name,
        source=source,
        protocol="P0c",
        settling=replace(part.settling, source=source),
        timing=timing_of(timing, late, gaps),
        lost_commands=tuple(loss.entry() for loss in losses),
        schedule=schedule_of(movements, late, robot),
        readings=readings_of(kept, robot, glitches),
        variation=_variation(part, losses),
    )
    settling = settling_parameters(part.fit, robot, payload)
    return Calibration(
        imperfections=imperfections,
        parameters=(
            *settling,
            *timing_parameters(timing),
            *lateness_parameters(late, gaps),
            *loss_parameters(losses),
            *_glitch_parameters(glitches, robot),
        ),
        sessions=part.observations.sessions,
        runs=len(names) - len(out),
        movements=int(np.sum(part.fitted)),
        used_readings=part.observations.position is not None,
        left_out=(*left_out, *part.left_out(robot)),
        held_out=_held_out(part, robot, judged) if thorough else (),
        remarks=(*remarks, *part.remarks(), *spring_remarks(settling)),
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


def _glitch_parameters(glitches: Sequence[Rate] | None, robot: Robot) -> list[Parameter]:
    if glitches is None:
        return []
    pairs = zip(robot.motor_names, glitches, strict=True)
    return [rate_parameter("spoilt readings", motor, rate) for motor, rate in pairs]
