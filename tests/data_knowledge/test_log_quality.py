"""Twenty deliberately broken logs: every defect is named, and none without evidence is judged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from failuretwin import BayesDiagnoser
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.nonidealities import Readings
from failuretwin.inference.observation.log_quality import log_quality


@pytest.fixture(scope="module")
def clean(armpi):
    """One run of a healthy arm, read ten times a second without any defect."""
    imperfections = replace(
        load_calibration("armpi_fpv", armpi).imperfections,
        readings=Readings(rate_hz=10.0, whole_counts=True),
        lost_commands=(),
    )
    imperfections = replace(
        imperfections, timing=replace(imperfections.timing, late_rate=0.0, late_s=(0.0, 0.0))
    )
    return simulate(Plan(armpi, [Hypothesis()], 1, seed=4, imperfections=imperfections))


def measured_of(runs):
    return runs["measured"].values.copy()


def with_measured(runs, measured):
    return runs.assign(measured=(runs["measured"].dims, measured))


def readings_of(measured):
    return np.flatnonzero(np.isfinite(measured[0]).all(axis=1))


def gap(runs, begin=4.2, end=5.6):
    measured = measured_of(runs)
    measured[0, int(100 * begin) : int(100 * end)] = np.nan
    return with_measured(runs, measured)


def glitch(runs, at=(3.0,)):
    measured = measured_of(runs)
    for time in at:
        measured[0, readings_of(measured)[int(10 * time)]] += [0.1, -0.1, 0.05]
    return with_measured(runs, measured)


def frozen(runs, axes=(0, 1, 2), begin=0.0):
    measured = measured_of(runs)
    rows = readings_of(measured)
    rows = rows[rows >= 100 * begin]
    measured[0][np.ix_(rows, axes)] = measured[0][rows[0], axes]
    return with_measured(runs, measured)


def thinned(runs, keep):
    measured = measured_of(runs)
    rows = readings_of(measured)
    measured[0, np.delete(rows, np.arange(0, len(rows), keep))] = np.nan
    return with_measured(runs, measured)


def scattered(runs):
    measured = measured_of(runs)
    rows = readings_of(measured)
    moved = np.clip(rows + np.random.default_rng(0).integers(-4, 5, len(rows)), 0, 999)
    out = np.full_like(measured, np.nan)
    out[0, moved] = measured[0, rows]
    return with_measured(runs, out)


def dropped(runs):
    measured = measured_of(runs)
    rows = readings_of(measured)
    measured[0, rows[5::7]] = np.nan
    return with_measured(runs, measured)


def without_axis(runs):
    measured = measured_of(runs)
    measured[0, readings_of(measured)[20:25], 1] = np.nan
    return with_measured(runs, measured)


def empty(runs):
    return with_measured(runs, np.full_like(runs["measured"].values, np.nan))


def never_at_rest(runs):
    """Readings only while the arm moves."""
    measured = measured_of(runs)
    starts = runs["movement_start"].values[0]
    for start, end in zip(starts, [*starts[1:], np.inf], strict=True):
        rest = (runs["time"].values >= start + 0.6) & (runs["time"].values < end + 0.04)
        measured[0, rest] = np.nan
    return with_measured(runs, measured)


def still(runs):
    return runs.assign(command=runs["command"] * 0.0 + runs["command"].isel(time=0))


def scaled(runs, factor):
    return with_measured(runs, measured_of(runs) * factor)


def cut(runs, after):
    measured = measured_of(runs)
    measured[0, int(100 * after) :] = np.nan
    return with_measured(runs, measured)


NAMED = {
    "gap": (gap, ["no readings from 4.1 to 5.6 s"]),
    "two gaps": (lambda r: gap(gap(r), 7.0, 8.0), ["from 4.1 to 5.6 s, from 6.9 to 8.0 s"]),
    "long silence": (lambda r: gap(r, 2.5, 8.5), ["or the clock jumped, from 2.4 to 8.5 s"]),
    "glitch": (glitch, ["1 glitch at 3.0 s"]),
    "glitches": (lambda r: glitch(r, (1.5, 3.0, 5.5)), ["3 glitches at 1.5, 3.0, 5.5 s"]),
    "frozen z": (lambda r: frozen(r, (2,)), ["z stands still from 0.0 to", "dead sensor channel"]),
    "frozen x late": (
        lambda r: frozen(r, (0,), 7.0),
        ["x stands still from", "dead sensor channel"],
    ),
    "stands still late": (lambda r: frozen(r, begin=6.0), ["the tool stands still from 6.0"]),
    "slow": (lambda r: thinned(r, 3), ["readings come at 3.3 Hz, not at 10.0 Hz"]),
    "jitter": (scattered, ["the times of the readings scatter by"]),
    "dropped": (dropped, ["times a reading or two are missing"]),
    "lacks an axis": (without_axis, ["5 readings lack an axis, the first at 2.0 s"]),
    "gap and glitch": (lambda r: gap(glitch(r)), ["no readings from 4.1", "1 glitch at 3.0 s"]),
    "cut": (lambda r: cut(r, 5.0), ["movement 4 not used", "movement 5 not used"]),
}

WITHOUT_EVIDENCE = {
    "empty": (empty, "holds no readings of the tool"),
    "frozen": (frozen, "stands still though motors are told to move"),
    "cut early": (lambda r: cut(r, 0.5), "only 1 movement can be used"),
}


def test_a_clean_log_has_no_defects(clean):
    assert log_quality(clean)[0].remarks == ()


@pytest.mark.parametrize("name", NAMED)
def test_a_defect_is_named_and_no_healthy_arm_looks_surely_faulty(clean, twin, name):
    spoil, words = NAMED[name]
    (diagnosis,) = BayesDiagnoser(twin).diagnose(spoil(clean))

    text = "; ".join(diagnosis.quality)
    for part in words:
        assert part in text
    assert diagnosis.diagnosis in ("healthy", None) or diagnosis.posterior["healthy"] > 0.1


@pytest.mark.parametrize("name", WITHOUT_EVIDENCE)
def test_a_log_without_evidence_gets_no_verdict(clean, twin, name):
    spoil, words = WITHOUT_EVIDENCE[name]
    (diagnosis,) = BayesDiagnoser(twin).diagnose(spoil(clean))

    assert diagnosis.verdict.startswith("cannot tell, because ")
    assert words in diagnosis.verdict
    assert diagnosis.diagnosis is diagnosis.probability is None
    assert max(diagnosis.posterior.values()) == pytest.approx(1 / 9)


def test_a_log_without_rests_is_judged_on_the_way(clean, twin):
    (diagnosis,) = BayesDiagnoser(twin).diagnose(never_at_rest(clean))

    assert diagnosis.diagnosis == "healthy"
    assert diagnosis.method.startswith("bayes, readings on the way")


def test_a_noisy_sensor_that_stands_still_says_nothing_of_the_arm(clean, twin):
    noise = np.random.default_rng(1).normal(0.0, 2e-4, clean["measured"].shape)
    (diagnosis,) = BayesDiagnoser(twin).diagnose(
        with_measured(clean, measured_of(frozen(clean, begin=4.5)) + noise)
    )

    assert any("the tool stands still from 4." in remark for remark in diagnosis.quality)
    assert diagnosis.diagnosis in ("healthy", None) or diagnosis.probability < 0.9
    assert not any("movement 5" in line for line in diagnosis.explanation)


def test_milliseconds_taken_for_seconds_are_named(clean, twin):
    slow = clean.assign_coords(time=clean["time"] * 1000.0)
    (found,) = log_quality(slow)
    assert "times seem to be in milliseconds, expected seconds" in found.fatal
    assert not log_quality(clean)[0].fatal
    (told,) = BayesDiagnoser(twin, "armpi_fpv").diagnose(slow)
    assert "milliseconds" in told.undecided
