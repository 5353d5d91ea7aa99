"""From healthy logs to a calibration: fit, suspect runs, fit again to what is trusted, check."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from failuretwin.connection.calibration.cross_validation import cross_validate, judge
from failuretwin.connection.calibration.observations import (
    observe,
    session_names,
    uncalibrated,
)
from failuretwin.connection.calibration.parameters import (
    LossRates,
    Rate,
    glitch_rates,
    lateness_parameters,
    loss_parameters,
    loss_rates,
    rate_parameter,
    readings_of,
    schedule_of,
    settling_parameters,
    spring_remarks,
    timing_of,
    timing_parameters,
    zero_remarks,
)
from failuretwin.connection.calibration.result import Calibration, HeldOut, LeftOut, Parameter
from failuretwin.connection.calibration.sensor_fit import (
    LEAST_MOVEMENTS,
    SensorFit,
    fit_sensors,
)
from failuretwin.connection.calibration.settling_fit import (
    PAYLOADS_KG,
    SettlingFit,
    best_payload,
    fit_settling,
)
from failuretwin.connection.calibration.timing_fit import (
    fit_timing,
    gap_starts,
    lateness,
    movements_of,
    punctual,
    transients,
)
from failuretwin.connection.population import stated_variation
from failuretwin.connection.self_calibration import SelfCalibratingDiagnoser
from failuretwin.core.errors import InputError
from failuretwin.core.progress import Progress, unseen
from failuretwin.core.runs import RunSet, check_motors, truth_of
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.readers.read import RunsLike, as_runs
from failuretwin.digital_model.arm_classes import class_of, generic_imperfections
from failuretwin.digital_model.nonidealities import Imperfections, Variation
from failuretwin.digital_model.robot import Robot, load_robot, shown_unit
from failuretwin.inference.isolability import fault_probabilities
from failuretwin.inference.observation.evidence import Evidence
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.on_the_way import hardly_rest
from failuretwin.inference.observation.sensors import TOOL_ALONE, sensing_of

# Which runs had better not teach the twin, and why.

SUSPECT = 0.9
"""A run that is faulty with at least this probability is left out."""
MOST_SUSPECT = 0.25
"""Share of runs that may look faulty. Beyond it, and from two runs on, a session is left out as a
whole, and logs are refused. Of ten healthy runs three look faulty in one session of a thousand."""


def exclude_suspect_runs(
    names: Sequence[str], sessions: Sequence[str], fault_probability: FloatArray
) -> list[LeftOut]:
    """Return the runs that look faulty, and those of sessions that do."""
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


def fit_calibration(
    runs: RunSet,
    robot: Robot,
    name: str,
    source: str,
    *,
    fault_probability: FloatArray | None = None,
    judged: RunSet | None = None,
    thorough: bool = True,
    on_progress: Progress = unseen,
) -> Calibration:
    """Learn the imperfections of a robot from healthy runs.

    Args:
        runs: Runs of the healthy robot.
        robot: The robot.
        name: What to call the imperfections in results.
        source: Which logs they come from.
        fault_probability: That of each run, (run,); runs and sessions that look faulty are left
            out. None: all count.
        judged: Healthy runs of sessions that only say how good the fit is; None: each session is
            left out once and judged by a fit to the others.
        thorough: Whether to check the fit on sessions that it has not seen, and the payload.
        on_progress: Called with the number of further fits.

    Raises:
        InputError: If too few movements come to rest near their targets.
    """
    names = [str(run) for run in runs["run"].values]
    doubt = np.zeros(len(names)) if fault_probability is None else fault_probability
    left_out = exclude_suspect_runs(names, session_names(runs), doubt)
    out = {entry.run for entry in left_out}
    kept = runs.isel(run=[i for i, run in enumerate(names) if run not in out])
    part = fit_settling(observe(kept, robot))
    on_progress(1)
    payload, remarks = 0.0, list[str]()
    if thorough:
        payload, told = best_payload(part, robot, on_progress)
        remarks = [told]
        if payload > 0.0:
            model = uncalibrated(robot, part.observations.of_motors, payload=payload)
            part = fit_settling(part.observations.of(model))
    movements = movements_of(kept)
    late = lateness(movements)
    seen, became = part.observations, part.sorted
    losses = loss_rates(seen, became.lost, punctual(late), late > 0.0, robot)
    ramps = transients(kept, movements, late, seen, became, part.settling, robot)
    timing = fit_timing(ramps, robot)
    gaps = gap_starts(kept, movements, late)
    glitches = glitch_rates(kept) if part.observations.of_motors else None
    imperfections = Imperfections(
        name=name,
        source=source,
        protocol="P0c",
        settling=replace(part.settling, source=source),
        timing=timing_of(timing, late, gaps),
        lost_commands=tuple(loss.entry() for loss in losses),
        schedule=schedule_of(movements, late, robot),
        readings=readings_of(kept, robot, glitches),
        variation=_variation(part, losses, robot),
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
        used_readings=part.observations.of_motors,
        left_out=(*left_out, *part.left_out(robot)),
        held_out=_held_out(part, robot, judged, on_progress) if thorough else (),
        remarks=(
            *remarks,
            *part.remarks(),
            *spring_remarks(settling),
            *zero_remarks(settling, robot),
        ),
    )


def _held_out(
    part: SettlingFit,
    robot: Robot,
    judged: RunSet | None,
    on_progress: Progress,
) -> tuple[HeldOut, ...]:
    if judged is None:
        return cross_validate(part, robot, on_progress)
    unseen = observe(judged, robot)
    entries = [
        judge(unseen[np.flatnonzero(unseen.session == index)], part, robot, name)
        for index, name in enumerate(unseen.sessions)
    ]
    return tuple(entry for entry in entries if entry is not None)


def _variation(part: SettlingFit, losses: Sequence[LossRates], robot: Robot) -> Variation:
    """Return the doubt about the figures: what a robot of these logs may be like.

    Logs do not tell what will change until they are used: what arms of the class do is added.
    """
    deviation = part.fit.deviation[:-1].reshape(4, -1)
    bias = np.hypot(deviation[0], class_of(robot).session_rad)
    hits = sum(loss.punctual.hits + loss.late.hits for loss in losses)
    rates = float(1.0 / np.sqrt(hits + 0.5)) if hits else 0.0
    others = Variation(scatter=tuple(deviation[3].tolist()), rates=rates)
    found = stated_variation(np.stack([bias, *deviation[1:3]]), part.settling, others)
    known = tuple(share if share < 1.0 else 0.0 for share in found.compliance)
    return replace(found, compliance=known)


def _glitch_parameters(glitches: Sequence[Rate] | None, robot: Robot) -> list[Parameter]:
    if glitches is None:
        return []
    pairs = zip(robot.motor_names, glitches, strict=True)
    return [rate_parameter("spoilt readings", motor, rate) for motor, rate in pairs]


# The whole procedure: fit, suspect, fit again what is trusted, and check.

MOST_LEFT_OUT = 0.3
"""Share of movements that may be odd, or in which one motor may lose its command, before the logs
are refused: a lossy bus loses commands of all motors."""

MOST_SCATTER_RAD = 0.03
"""Settled scatter beyond which a motor is no healthy one [rad], three times what is assumed of a
robot of which nothing is known: errors redrawn for every movement pass for scatter."""


def calibrate(
    runs: RunsLike,
    robot: Robot | str | Path = "armpi_fpv",
    name: str = "calibrated",
    source: str = "",
    hold_out: str | None = None,
    on_progress: Progress = unseen,
) -> Calibration:
    """Calibrate a robot from logs that should be healthy.

    Args:
        runs: The logs as a run set, or where they are.
        robot: The robot, its name or its profile.
        name: What to call the calibration in results.
        source: Which logs these are.
        hold_out: Text in the names of sessions that are not learned from, only judged; None: all
            sessions are learned from, and each is judged by a fit to the others.
        on_progress: Called with the number of further fits, of `number_of_fits` about.

    Raises:
        InputError: If the logs are labelled faulty or look so, or too few movements are left.
    """
    robot = load_robot(robot)
    runs = as_runs(runs, robot)
    check_motors(runs, robot.name, robot.motor_names)
    runs, labelled = _without_faulty_labels(runs)
    if sensing_of(runs, None) != TOOL_ALONE:
        return replace(_of_sensors_alone(runs, robot, name, source), left_out=labelled)
    if hold_out is None and _never_rests(runs, robot):
        return replace(_of_the_way(runs, robot, name, source), left_out=labelled)
    inside = _held_out_runs(runs, hold_out)
    learning = runs.isel(run=np.flatnonzero(~inside))
    first = fit_calibration(learning, robot, name, source, thorough=False, on_progress=on_progress)
    _refuse_scatter(first, robot)
    doubt = fault_probabilities(learning, robot, first.imperfections)
    _refuse_suspects(learning, doubt)
    judged = runs.isel(run=np.flatnonzero(inside)) if inside.any() else None
    found = fit_calibration(
        learning,
        robot,
        name,
        source,
        fault_probability=doubt,
        judged=judged,
        on_progress=on_progress,
    )
    _refuse_left_out(found)
    found = replace(found, left_out=(*labelled, *found.left_out))
    model = HealthyModel.of(found.applied_to(robot).twin, found.imperfections)
    return _with_sensors(found, fit_sensors(learning, model))


def number_of_fits(runs: RunSet, hold_out: str | None) -> int:
    """Return how many fits a calibration takes: to be trusted or not, payloads, sessions left out.

    Args:
        runs: The logs.
        hold_out: As of `calibrate`.
    """
    sessions = len(set(session_names(runs))) if hold_out is None else 0
    return 2 + len(PAYLOADS_KG) + sessions


def _with_sensors(found: Calibration, fits: Sequence[SensorFit]) -> Calibration:
    sensors = tuple(fit.profile for fit in fits)
    parameters = tuple(parameter for fit in fits for parameter in fit.parameters)
    return replace(
        found,
        imperfections=replace(found.imperfections, sensors=sensors),
        parameters=(*found.parameters, *parameters),
    )


def _of_sensors_alone(runs: RunSet, robot: Robot, name: str, source: str) -> Calibration:
    """Return a calibration of sensors by runs of which nobody saw the tool's position.

    Raises:
        InputError: If no sensor comes to rest often enough.
    """
    model = HealthyModel.of(robot)
    fits = fit_sensors(runs, model)
    if not fits:
        raise InputError(
            "nobody watched the tool's position, and no other sensor is seen at rest after "
            f"{LEAST_MOVEMENTS} movements. Expected longer logs, or those of a tool sensor."
        )
    remark = (
        "nobody watched the tool's position: constant errors and noise of the sensors were "
        f"learned, and the motors taken to be as {model.imperfections.name} has them"
    )
    motors = replace(model.imperfections, name=name, source=source or model.imperfections.source)
    sessions = tuple(dict.fromkeys(session_names(runs)))
    count = max(fit.movements for fit in fits)
    plain = Calibration(motors, (), sessions, runs.sizes["run"], count, False, remarks=(remark,))
    return _with_sensors(plain, fits)


def _never_rests(runs: RunSet, robot: Robot) -> bool:
    """Return whether most of the runs are judged by readings on the way."""
    model = HealthyModel.of(robot, generic_imperfections(robot))
    return bool(hardly_rest(Evidence(runs, model.settings).sound, model).mean() > 0.5)


def _of_the_way(runs: RunSet, robot: Robot, name: str, source: str) -> Calibration:
    """Return a calibration by readings on the way, of an arm that never rests.

    It is the posterior of what arms of the class are like (`SelfCalibratingDiagnoser`); runs that
    look faulty teach it little.

    Raises:
        InputError: If many of the runs look faulty.
    """
    found = SelfCalibratingDiagnoser(robot).learn(runs)
    _refuse_suspects(runs, np.array([1.0 - d.posterior["healthy"] for d in found.diagnoses]))
    learned = replace(found.calibration.imperfections, name=name, source=source, protocol="P0c")
    remark = (
        "the arm never rests in these logs: it was calibrated by readings on the way, from what "
        "arms of its class are like"
    )
    remarks = (remark, *found.calibration.remarks)
    return replace(found.calibration, imperfections=learned, remarks=remarks)


def _without_faulty_labels(runs: RunSet) -> tuple[RunSet, tuple[LeftOut, ...]]:
    truth = truth_of(runs)
    if truth is None:
        return runs, ()
    healthy = np.array([fault == "healthy" for fault in truth])
    if not healthy.any():
        raise InputError(
            "every run is labelled faulty. Expected healthy logs: a twin that learns from a fault "
            "takes it for normal."
        )
    names = runs["run"].values
    labelled = tuple(
        LeftOut(str(names[i]), 0, "", f"labelled {truth[i]}") for i in np.flatnonzero(~healthy)
    )
    return runs.isel(run=np.flatnonzero(healthy)), labelled


def _held_out_runs(runs: RunSet, hold_out: str | None) -> np.ndarray:
    sessions = session_names(runs)
    inside = np.array([hold_out is not None and hold_out in session for session in sessions])
    known = ", ".join(dict.fromkeys(sessions))
    if hold_out is not None and not inside.any():
        raise InputError(f"--hold-out {hold_out!r} is in no session's name. There are: {known}.")
    if inside.all():
        raise InputError(f"--hold-out {hold_out!r} leaves nothing to learn from: {known}.")
    return inside


def _refuse_scatter(first: Calibration, robot: Robot) -> None:
    for parameter in first.parameters:
        if parameter.name == "scatter" and parameter.low > MOST_SCATTER_RAD:
            scale, unit = shown_unit("rad", robot, parameter.motor)
            raise InputError(
                f"{parameter.motor} misses its targets by {scale * parameter.value:.1f} {unit}, "
                f"typically; expected {scale * MOST_SCATTER_RAD:.1f} at most. Nothing is learned "
                "from these logs; give logs of a healthy robot. `failuretwin doctor LOG` tells a "
                "zero that is off, which is so in every movement, from a fault."
            )


def _refuse_suspects(runs: RunSet, doubt: FloatArray) -> None:
    suspects = np.flatnonzero(doubt >= SUSPECT)
    if len(suspects) > MOST_SUSPECT * len(doubt):
        names = [str(runs["run"].values[i]) for i in suspects[:5]]
        raise InputError(
            f"{len(suspects)} of {len(doubt)} runs look faulty ({', '.join(names)}"
            f"{', ...' if len(suspects) > 5 else ''}), so nothing is learned from these logs. Give "
            "logs of a healthy robot; `failuretwin diagnose` shows what is wrong with each run."
        )


def _refuse_left_out(found: Calibration) -> None:
    movements = [entry for entry in found.left_out if entry.movement > 0]
    of = Counter(motor for entry in movements for motor in entry.motor.split(" and "))
    if max(of.values(), default=0) > MOST_LEFT_OUT * max(found.movements, 1):
        reasons = Counter(f"{e.motor} {e.reason}".strip() for e in movements).most_common(3)
        told = "; ".join(f"{reason} ({count} times)" for reason, count in reasons)
        raise InputError(
            f"{len(movements)} movements do not look healthy beside {found.movements} that do: "
            f"{told}. Nothing is learned from these logs; give logs of a healthy robot."
        )
