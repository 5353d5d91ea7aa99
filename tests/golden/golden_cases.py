"""The golden cases: what is worked out of the stored runs, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from golden_compare import Tolerance, plain
from golden_entry import (
    MODES,
    MONITORING,
    StreamingFleet,
    augmented_features,
    evidence_of,
    expected_log_bayes_factors,
    fit_calibration,
    healthy,
    log_quality,
    monitor,
    original_features,
    priors_of,
    robust_features,
    signals_of,
    twin,
    with_log_evidence,
)
from golden_runs import PAPER, load

import failuretwin as ft

EXACT = Tolerance(1e-6)
"""Processors round differently: what iterates ends up to some 1e-8 apart."""
FITTED = Tolerance(0.1, floor=0.02)
"""What an iterative fit gives [mostly rad or s]: of two processors, timings end up 7 % apart, and
ends of intervals 0.0013."""
CONTRADICTED = Tolerance(5e-3)
"""Where moments contradict each other, rounding decides whether a second look at them counts."""
EVERY = ("healthy", *(f"motor_{k}:{mode}" for mode in MODES for k in range(1, 5)))
PAIRS = (
    "motor_1:stuck+motor_3:stuck",
    "motor_2:stuck+motor_3:drift",
    "motor_1:encoder_bias+motor_3:steady_state_error",
)


@dataclass(frozen=True)
class Case:
    """What is worked out, as dicts and lists, and how exactly it must come out again."""

    work_out: Callable[[], dict]
    tolerance: Tolerance = EXACT


def told(diagnoser, runs):
    """Return all that is said of some runs, by run."""
    diagnoses, says = with_log_evidence(diagnoser, runs)
    names = [str(hypothesis) for hypothesis in diagnoser.hypothesis_set]
    return {
        diagnosis.run: said(diagnosis) | {"log_evidence": dict(zip(names, row, strict=True))}
        for diagnosis, row in zip(diagnoses, says, strict=True)
    }


def said(diagnosis):
    if diagnosis is None:
        return {}
    record = diagnosis.to_record()
    record["evidence"] = {f"movement {e['movement']}": e["nats"] for e in record["evidence"]}
    return record


def diagnosed(runs, change=lambda runs: runs, arm="armpi_fpv", known="own", **options):
    """Return what a diagnoser says of a stored run set; options are its own."""
    robot = twin(arm).robot
    given = options.pop("priors", None) or ft.Priors()
    priors = replace(given, setup=ft.SetupPrior.known())
    known_robot = ft.BayesDiagnoser(twin(arm), healthy(known, robot), priors=priors, **options)
    return told(known_robot, change(load(runs)))


def some(*rows):
    """Return what leaves some of the runs."""
    return lambda runs: runs.isel(run=list(rows))


def one_of_each(runs):
    return runs.isel(run=slice(0, None, 2))


def pair(row):
    """Return what is said of a run with two faults, beside two simpler hypotheses."""
    return diagnosed("pairs", some(row), hypotheses=("healthy", "motor_3:stuck", PAIRS[row]))


def onset_known():
    return priors_of(twin().robot, None, 0.49)


def errors_known():
    return priors_of(twin().robot, (5.0, 20.0), None)


def without_rate(runs):
    """Return the runs without a word on how often the tool was read."""
    some = runs.isel(run=[0, 2, 9])
    some.attrs = {name: value for name, value in runs.attrs.items() if name != "measured_rate_hz"}
    return some


def spoilt(runs):
    """Return one run broken in many ways, by name."""
    one = runs.isel(run=[4] * 7)
    time, path = one["time"].values, one["measured"].values.copy()
    path[0] = np.nan
    path[1, time > 1.0] = np.where(np.isnan(path[1, time > 1.0]), np.nan, 0.1)
    path[2, :, 2] = np.where(np.isnan(path[2, :, 2]), np.nan, 0.05)
    path[3, (time > 3.0) & (time < 6.2)] = np.nan
    read = np.flatnonzero(np.isfinite(path[4, :, 0]))
    path[4, read[[20, 50, 51, 80]]] += 0.09
    path[5, read[::3], 1] = np.nan
    path[6, np.setdiff1d(np.arange(len(time)), read[::6])] = np.nan
    names = ["unread", "dead", "dead axis", "gap", "glitches", "partial", "seldom read"]
    changed = one.assign(measured=(one["measured"].dims, path))
    return changed.assign_coords(run=np.array(names, dtype=object))


def astray(runs):
    """Return one healthy run whose tool rests beside where it should, or strays on its way."""
    one = runs.isel(run=[1] * 5)
    time, path = one["time"].values, one["measured"].values.copy()
    movement = np.minimum(time // 2.0, 4).astype(int)
    beside = np.random.default_rng(3).normal(size=(5, 3))
    for run, far in enumerate((0.0025, 0.005, 0.03, 0.1)):
        path[run] += far * beside[movement]
    path[4, :, 2] += np.where(time % 2.0 < 0.9, 0.04 * np.sin(7.0 * time), 0.0)
    names = ["2.5 mm", "5 mm", "30 mm", "100 mm", "on the way"]
    changed = one.assign(measured=(one["measured"].dims, path))
    return changed.assign_coords(run=np.array(names, dtype=object))


def defects():
    quality = log_quality(spoilt(load("nine")))
    return {
        name: {"remarks": q.remarks, "fatal": q.fatal, "spoilt": q.spoilt}
        for name, q in zip(spoilt(load("nine"))["run"].values, quality, strict=True)
    }


def evidence(runs, change=lambda runs: runs):
    """Return what is read off the runs before any hypothesis is weighed, by run."""
    some = change(load(runs))
    settled, moving = evidence_of(ft.BayesDiagnoser(twin(), hypotheses=["motor_1:lag"]), some)
    movements = settled.movements
    return {
        str(name): {
            "start": movements.start[i],
            "target": movements.target[i],
            "ramp_duration": movements.ramp_duration[i],
            "point": settled.point[i],
            "usable": settled.usable[i],
            "moving": settled.moving[i],
            "begin": settled.begin[i],
            "end": settled.end[i],
            "resumed": settled.first_reading_delay[i],
            "readings on the way": moving.seen[i].sum(axis=1),
            "their mean time": moving.since[i].mean(axis=1),
            "their mean point": moving.point[i].mean(axis=1),
        }
        for i, name in enumerate(some["run"].values)
    }


def stream(run, make):
    """Return what a stream says at a few times, and in the end."""
    one, diagnoser = load("nine").isel(run=run), make()
    time, command, measured = (one[n].values for n in ("time", "command", "measured"))
    answers = {}
    for i in range(len(time)):
        answer = diagnoser.update(float(time[i]), command[i], measured[i])
        if i % 100 == 99:
            answers[f"{time[i]:.2f} s"] = said(answer.diagnosis) | {"state": str(answer.state)}
    return answers | {"end": said(diagnoser.conclude().diagnosis)}


def plain_stream():
    return ft.StreamingDiagnoser(ft.BayesDiagnoser(twin()), 10.0)


def watching_stream():
    return monitor(twin())


def lasting_stream():
    hypotheses = ["healthy", "motor_1:stuck", "motor_2:lag"]
    return ft.StreamingDiagnoser(ft.BayesDiagnoser(twin(), hypotheses=hypotheses), 10.0, 3)


def fleet():
    """Return posteriors of three robots at once, at a few times."""
    runs = load("rough").isel(run=[0, 1, 3])
    time, command, measured = (runs[n].values for n in ("time", "command", "measured"))
    robots = StreamingFleet(ft.BayesDiagnoser(twin()), 3, 10.0)
    found = {}
    for i in range(len(time)):
        robots.update(float(time[i]), command[:, i], measured[:, i])
        if i % 125 == 124:
            found[f"{time[i]:.2f} s"] = robots.posterior
    robots.conclude()
    return found | {
        "end": robots.posterior,
        "verdicts": [said(robots.diagnosis(k)) for k in (0, 2)],
    }


def features():
    """Return sums of what networks see, by set, run and channel; some points in full."""
    runs = load("nine").isel(run=[0, 5, 11])
    signals = signals_of(runs)
    found = {
        "robust": robust_features(twin().robot, healthy("armpi_fpv", twin().robot), runs),
        "original": original_features(signals),
        "augmented": augmented_features(twin(), signals),
    }
    return {
        name: {
            "shape": values.shape,
            "sums": values.sum(axis=1),
            "squares": (values**2).sum(axis=1),
            "some": values[:, ::23],
        }
        for name, values in found.items()
    }


def apart():
    """Return what a planned motion can tell apart."""
    runs = load("nine").isel(run=[0])
    hypotheses = ["motor_2:stuck", "motor_3:steady_state_error", "motor_2:lag"]
    found = ft.isolability(
        twin(), runs["command"].values[0], runs["time"].values, hypotheses=hypotheses
    )
    names = ("hypotheses", "nats", "groups", "detected", "isolated", "typical", "largest")
    return {name: getattr(found, name) for name in names}


def separated(runs, hypotheses=None):
    some = load(runs)
    found = expected_log_bayes_factors(twin(), some, hypotheses=hypotheses)
    names = [str(hypothesis) for hypothesis in found.hypotheses]
    rows = zip(some["run"].values, found.nats, strict=True)
    return {run: dict(zip(names, nats, strict=True)) for run, nats in rows}


def calibrated(use_readings, thorough):
    """Return what healthy runs teach, every figure by its name."""
    runs = load("sessions") if use_readings else load("sessions").drop_vars("position")
    found = fit_calibration(runs, twin().robot, "golden", "stored runs", thorough=thorough)
    return {
        "figures": {
            f"{p.name} {p.motor}".strip(): [p.value, p.low, p.high, p.identified]
            for p in found.parameters
        },
        "imperfections": _figures(found.imperfections),
        "movements": found.movements,
        "left out": [[e.run, e.movement, e.motor, e.reason] for e in found.left_out],
        "held out": {
            h.session: [*h.before, *h.after, h.gain, h.gain_error] for h in found.held_out
        },
        "remarks": found.remarks,
    }


def _figures(imperfections):
    settling, timing = imperfections.settling, imperfections.timing
    return {
        "settling": [settling.bias, settling.compliance, settling.friction, settling.scatter],
        "tail": settling.tail_dof,
        "timing": [timing.delay_s, timing.lag_s, timing.ramp_shortening, timing.late_rate],
        "late": [timing.late_s, timing.gap_start_s],
        "lost": {
            "+".join(e.motors): [e.rate, e.rate_when_late] for e in imperfections.lost_commands
        },
    }


def _in_unknown(*others):
    return {"hypotheses": (*PAPER, *others, "unknown")}


CASES = {
    "nine": Case(partial(diagnosed, "nine")),
    "nine, settled": Case(partial(diagnosed, "nine", whole_run=False)),
    "nine, generic": Case(partial(diagnosed, "nine", one_of_each, known="generic")),
    "nine, measured": Case(partial(diagnosed, "nine", one_of_each, known="measured")),
    "nine, other robot": Case(partial(diagnosed, "nine", one_of_each, known="armpi_fpv_b_2024-05")),
    "nine, onset known": Case(lambda: diagnosed("nine", one_of_each, priors=onset_known())),
    "nine, errors known": Case(lambda: diagnosed("nine", one_of_each, priors=errors_known())),
    "nine, monitoring": Case(partial(diagnosed, "nine", one_of_each, priors=MONITORING)),
    "nine, unknown": Case(partial(diagnosed, "nine", one_of_each, **_in_unknown())),
    "nine, astray": Case(partial(diagnosed, "nine", astray, **_in_unknown())),
    "nine, no rate": Case(partial(diagnosed, "nine", without_rate)),
    "nine, spoilt": Case(partial(diagnosed, "nine", spoilt)),
    "ideal": Case(partial(diagnosed, "ideal", known="none")),
    "ideal, as real": Case(partial(diagnosed, "ideal")),
    "modes": Case(partial(diagnosed, "modes", hypotheses=EVERY)),
    "modes, settled": Case(
        partial(diagnosed, "modes", some(0, 3, 7, 8), hypotheses=EVERY, whole_run=False)
    ),
    "modes, unknown": Case(partial(diagnosed, "modes", some(1, 2, 4, 5, 6, 9), **_in_unknown())),
    "anywhere": Case(partial(diagnosed, "anywhere", hypotheses=EVERY)),
    "anywhere, unknown": Case(
        partial(diagnosed, "anywhere", some(0, 3, 6), known="measured", **_in_unknown())
    ),
    "rough": Case(partial(diagnosed, "rough"), CONTRADICTED),
    "rough, settled": Case(partial(diagnosed, "rough", whole_run=False), CONTRADICTED),
    "rough, every mode": Case(partial(diagnosed, "rough", hypotheses=EVERY), CONTRADICTED),
    "drawn": Case(partial(diagnosed, "drawn")),
    "drawn, every mode": Case(partial(diagnosed, "drawn", some(1), hypotheses=EVERY)),
    "two stuck": Case(partial(pair, 0)),
    "stuck and drift": Case(partial(pair, 1)),
    "bias and error": Case(partial(pair, 2)),
    "pairs, unknown": Case(partial(diagnosed, "pairs", **_in_unknown())),
    "ur5e": Case(partial(diagnosed, "ur5e", arm="ur5e")),
    "so101": Case(partial(diagnosed, "so101", arm="so101", known="generic")),
    "evidence, nine": Case(partial(evidence, "nine", one_of_each)),
    "evidence, rough": Case(partial(evidence, "rough")),
    "evidence, drawn": Case(partial(evidence, "drawn")),
    "evidence, ideal": Case(partial(evidence, "ideal")),
    "evidence, no rate": Case(partial(evidence, "nine", without_rate)),
    "log quality": Case(defects),
    "stream": Case(partial(stream, 4, plain_stream)),
    "stream, watching": Case(partial(stream, 12, watching_stream)),
    "stream, three movements": Case(partial(stream, 2, lasting_stream)),
    "fleet": Case(fleet),
    "features": Case(features),
    "ambiguity": Case(apart),
    "separation": Case(partial(separated, "nine")),
    "separation, modes": Case(partial(separated, "modes", ("healthy", *EVERY[2:40:6]))),
    "calibration": Case(partial(calibrated, True, False), FITTED),
    "calibration, tool path": Case(partial(calibrated, False, False), FITTED),
}


def outcome(name):
    """Return what a case gives now."""
    return plain(CASES[name].work_out())
