"""What the calibrations of a fleet say of the next robot, judged by populations that are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq

import failuretwin as ft
from calibration_files import read_calibration
from failuretwin.connection.self_calibration import SelfCalibratingDiagnoser
from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.decision.evaluation import evaluate
from failuretwin.digital_model.calibrated_robot import CalibratedLoop, load_calibration, with_loops
from failuretwin.digital_model.nonidealities import (
    Imperfections,
    LostCommand,
    Readings,
    Schedule,
    Timing,
    Variation,
    vary,
)
from failuretwin.digital_model.settling import Settling
from failuretwin.failure_behavior.random_movements import RandomMovements

MEAN = {
    "bias": np.array([0.004, -0.006, 0.0, 0.01]),
    "compliance": np.array([0.0, 0.12, 0.2, 0.3]),
    "friction": np.array([0.01, 0.006, 0.012, 0.009]),
    "scatter": np.array([0.004, 0.006, 0.005, 0.008]),
}
DEVIATION = {
    "bias": np.array([0.003, 0.004, 0.006, 0.009]),
    "compliance": np.array([0.0, 0.03, 0.04, 0.1]),
    "friction": np.array([0.002, 0.003, 0.004, 0.005]),
    "scatter": np.array([0.2, 0.3, 0.4, 0.3]),
}
"""Of one population; those of the scatter are of its logarithm."""
CLASS_MEAN = {"bias": 0.0, "friction": 0.007, "scatter": 0.006}
CLASS_DEVIATION = {"bias": 0.0065, "friction": 0.005, "scatter": 0.3}
"""Of hobby servos."""
SESSION = 0.001
"""What the bias of a hobby servo does from day to day."""
NAMES = ("bias", "compliance", "friction", "scatter")


def robot_of(figures, number=0, doubt=None, **other):
    """Return a calibration by hand; `figures` and `doubt` by name, (motor,) each."""
    settling = Settling(
        **{name: tuple(np.asarray(values).tolist()) for name, values in figures.items()},
        tail_dof=5.0,
    )
    variation = None
    if doubt is not None:
        variation = Variation(**{n: tuple(np.asarray(v).tolist()) for n, v in doubt.items()})
    told = {"name": f"robot {number}", "source": "made up", "protocol": "P0c", **other}
    return Imperfections(**told, settling=settling, variation=variation)


def drawn(rng, count):
    """Return true figures of robots of the population, by name, (robot, motor)."""
    found = {n: MEAN[n] + DEVIATION[n] * rng.normal(size=(count, 4)) for n in NAMES[:3]}
    factor = np.exp(DEVIATION["scatter"] * rng.normal(size=(count, 4)))
    return {**found, "scatter": MEAN["scatter"] * factor}


def row(figures, index):
    return {name: values[index] for name, values in figures.items()}


def fitted(robots, robot="armpi_fpv"):
    """Return mean and deviation by name; of compliance in its unit, of scatter the logarithm's."""
    found = ft.Population.fit(robots, robot).imperfections
    mean = {name: np.array(getattr(found.settling, name)) for name in NAMES}
    deviation = {name: np.array(getattr(found.variation, name)) for name in NAMES}
    deviation["compliance"] = deviation["compliance"] * np.abs(mean["compliance"])
    return mean, deviation


# A known population comes back.


@pytest.fixture(scope="module")
def exact():
    """Of 200 robots whose calibrations are exact."""
    truth = drawn(np.random.default_rng(0), 200)
    return truth, fitted([robot_of(row(truth, i), i) for i in range(200)])


def test_mean_and_deviation_come_back_within_statistical_error(exact):
    _, (mean, deviation) = exact
    for name in NAMES:
        away = mean[name] - MEAN[name]
        if name == "scatter":
            away = np.log(mean[name] / MEAN[name])
        spread = DEVIATION[name]
        assert np.all(np.abs(away) <= 3.5 * spread / np.sqrt(200.0) + 1e-12)
        if name == "bias":
            spread = np.hypot(spread, SESSION)
        off = np.abs(deviation[name] - spread)
        # The class counts for three robots of 202: a hundredth of its excess at most here.
        assert np.all(off <= (3.5 / np.sqrt(400.0) + 0.06) * spread + 1e-12)


@pytest.mark.parametrize("name", ["bias", "friction", "scatter"])
def test_exact_calibrations_have_a_closed_form(exact, name):
    """Then tau^2 = (3 tau_0^2 + 199 S^2) / 202 with S^2 the sample variance."""
    truth, (mean, deviation) = exact
    y, middle, spread = truth[name], CLASS_MEAN[name], CLASS_DEVIATION[name]
    if name == "scatter":
        y, middle = np.log(y), np.log(middle)
    between2 = (3.0 * spread**2 + 199.0 * y.var(axis=0, ddof=1)) / 202.0
    precision = 1.0 / spread**2 + 200.0 / between2
    expected = (middle / spread**2 + y.sum(axis=0) / between2) / precision
    told = np.log(mean[name]) if name == "scatter" else mean[name]
    np.testing.assert_allclose(told, expected, rtol=1e-9, atol=1e-12)
    variance = between2 + 1.0 / precision + (SESSION**2 if name == "bias" else 0.0)
    np.testing.assert_allclose(deviation[name], np.sqrt(variance), rtol=1e-9)


def test_doubt_of_the_calibrations_is_no_difference_between_robots():
    """Where each says its robot's friction with a deviation twice that between robots, or less.

    Not taken off, the deviation would be 1.7 times too large; taken off twice, nothing.
    """
    rng = np.random.default_rng(1)
    truth = drawn(rng, 400)
    doubt = DEVIATION["friction"] * rng.uniform(0.5, 2.0, size=(400, 4))
    robots = []
    for i in range(400):
        figures = row(truth, i)
        figures["friction"] = figures["friction"] + doubt[i] * rng.normal(size=4)
        robots.append(robot_of(figures, i, {"friction": doubt[i]}))
    mean, deviation = fitted(robots)
    np.testing.assert_allclose(deviation["friction"], DEVIATION["friction"], rtol=0.25)
    ratio = deviation["friction"] / DEVIATION["friction"]
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.12)
    error = np.sqrt(np.mean(DEVIATION["friction"] ** 2 + doubt**2, axis=0) / 400.0)
    assert np.all(np.abs(mean["friction"] - MEAN["friction"]) < 3.5 * error)


def test_robots_that_differ_by_less_than_their_doubt():
    """Then tau_y = 0, and tau solves tau^2 (3 + 99 (tau^2 / (tau^2 + s^2))^2) = 3 tau_0^2."""
    doubt = {"bias": np.full(4, 0.003)}
    robots = [robot_of({**MEAN, "bias": np.full(4, 0.01)}, i, doubt) for i in range(100)]
    mean, deviation = fitted(robots)
    between2 = brentq(
        lambda t2: t2 * (3.0 + 99.0 * (t2 / (t2 + 0.003**2)) ** 2) - 3.0 * 0.0065**2, 0.0, 1e-3
    )
    weight = 1.0 / (between2 + 0.003**2)
    variance = 1.0 / (1.0 / 0.0065**2 + 100.0 * weight)
    np.testing.assert_allclose(mean["bias"], variance * weight * 100.0 * 0.01, rtol=1e-6)
    expected = np.sqrt(between2 + variance + 0.001**2)
    np.testing.assert_allclose(deviation["bias"], expected, rtol=1e-4)
    assert expected < 0.5 * 0.0065


def test_few_robots_that_doubt_alike():
    """Then tau_y^2 = S^2 - s^2 with S^2 the sample variance, whatever the weights."""
    seen, doubt2 = np.array([0.0, 0.01, 0.035]), 0.006**2
    doubt = {"friction": np.full(4, 0.006)}
    figures = [{**MEAN, "friction": np.full(4, value)} for value in seen]
    _, deviation = fitted([robot_of(f, i, doubt) for i, f in enumerate(figures)])
    excess = seen.var(ddof=1) - doubt2

    def off(t2):
        freedom = 2.0 * (t2 / (t2 + doubt2)) ** 2
        return t2 * (3.0 + freedom) - 3.0 * 0.005**2 - freedom * excess

    between2 = brentq(off, 0.0, excess)
    variance = 1.0 / (1.0 / 0.005**2 + 3.0 / (between2 + doubt2))
    np.testing.assert_allclose(deviation["friction"], np.sqrt(between2 + variance), rtol=1e-6)


def test_compliances_differ_by_no_more_than_their_mean():
    """As files state it of what is self-calibrated."""
    figures = [{**MEAN, "compliance": np.full(4, value)} for value in (-0.5, 0.8)]
    found = ft.Population.fit([robot_of(f, i) for i, f in enumerate(figures)]).imperfections
    assert found.variation.compliance == (0.0, 1.0, 1.0, 1.0)


def test_surer_calibrations_count_for_more():
    figures = [{**MEAN, "friction": np.full(4, value)} for value in (0.01, 0.01, 0.03)]
    doubts = [{"friction": np.full(4, value)} for value in (0.0003, 0.0003, 0.02)]
    triples = zip(figures, range(3), doubts, strict=True)
    mean, deviation = fitted([robot_of(*each) for each in triples])
    sure, _ = fitted([robot_of(figures[0], 0, doubts[0]), robot_of(figures[1], 1, doubts[1])])
    np.testing.assert_allclose(mean["friction"], sure["friction"], atol=0.0008)
    assert np.all(mean["friction"] > sure["friction"])
    assert np.all(deviation["friction"] < 0.006)


# Few robots say little, and what is not known says nothing.


def test_two_robots_are_as_different_as_their_class():
    """tau^2 = (3 tau_0^2 + S^2) / 4, and the mean lies between theirs and the class's."""
    figures = [{**MEAN, "bias": np.full(4, value)} for value in (0.0040, 0.0042)]
    mean, deviation = fitted([robot_of(f, i) for i, f in enumerate(figures)])
    between2 = (3.0 * 0.0065**2 + 0.0002**2 / 2.0) / 4.0
    precision = 1.0 / 0.0065**2 + 2.0 / between2
    np.testing.assert_allclose(mean["bias"], 0.0082 / between2 / precision, rtol=1e-9)
    spread = np.sqrt(between2 + 1.0 / precision + 0.001**2)
    np.testing.assert_allclose(deviation["bias"], spread, rtol=1e-9)
    assert np.all(np.abs(deviation["bias"] / 0.0065 - 1.0) < 0.1)


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_a_compliance_that_is_not_known_is_that_of_the_class(share):
    """A file states a doubt as large as the compliance as none, or as a share of 1."""
    doubt = {"compliance": (0.0, 0.1, share, 0.1)}
    figures = {**MEAN, "compliance": np.array([0.0, 0.12, 7.0, 0.3])}
    robots = [robot_of(figures, i, doubt) for i in range(2)]
    robots = [replace(r, source=str(i)) for i, r in enumerate(robots)]
    population = ft.Population.fit(robots)
    usual = load_calibration("generic").imperfections
    found = population.imperfections
    assert found.settling.compliance[2] == pytest.approx(usual.settling.compliance[2])
    assert found.variation.compliance[2] == pytest.approx(1.0)
    assert found.settling.compliance[1] != pytest.approx(usual.settling.compliance[1], rel=0.05)
    told = {p.motor: p for p in population.parameters if p.name == "compliance"}
    assert [told[f"motor_{i}"].identified for i in (1, 2, 3, 4)] == [False, True, False, True]
    assert told["motor_1"].note == "gravity does not load this motor"
    assert told["motor_3"].note == "no calibration tells it: as arms of its class"


def test_what_was_drawn_to_the_class_is_let_go():
    """Self-calibrated figures are posterior means: they differ by less than robots do."""
    rng = np.random.default_rng(3)
    truth = drawn(rng, 300)
    noise, robots = 0.004, []
    posterior2 = 1.0 / (1.0 / 0.0065**2 + 1.0 / noise**2)
    doubt = {"bias": np.full(4, np.sqrt(posterior2))}
    for i in range(300):
        seen = truth["bias"][i] + noise * rng.normal(size=4)
        figures = {**row(truth, i), "bias": posterior2 * seen / noise**2}
        robots.append(robot_of(figures, i, doubt, protocol="P1"))
    mean, deviation = fitted(robots)
    expected = np.hypot(DEVIATION["bias"], SESSION)
    np.testing.assert_allclose(deviation["bias"], expected, rtol=0.2)
    error = np.hypot(DEVIATION["bias"], noise) / np.sqrt(300.0)
    assert np.all(np.abs(mean["bias"] - MEAN["bias"]) < 3.5 * error)


def test_what_runs_did_not_tell_says_nothing():
    doubt = {"friction": np.full(4, 0.0045)}  # nine tenths of the class's deviation
    robots = [robot_of({**MEAN, "bias": [i] * 4}, i, doubt, protocol="P1") for i in (0.0, 0.001)]
    mean, deviation = fitted(robots)
    np.testing.assert_allclose(mean["friction"], 0.007)
    np.testing.assert_allclose(deviation["friction"], 0.005)


# Rates, times, readings.


def test_rates_times_and_tails_are_pooled():
    first = robot_of(
        MEAN,
        1,
        timing=Timing((0.0, 0.01), (0.02, 0.02), (0.0, 0.1), 0.2, (0.5, 1.0), (0.1, 0.2)),
        lost_commands=(LostCommand(("motor_1",), 0.3, 0.6),),
        schedule=Schedule((0.0, 0.1), (2.0, 2.2), True),
        readings=Readings(10.0, whole_counts=True, glitch_rate=(0.0, 0.0, 0.1, 0.0)),
    )
    second = robot_of(
        MEAN,
        2,
        timing=Timing((0.01, 0.02), (0.04, 0.04)),
        lost_commands=(LostCommand(("motor_2", "motor_1"), 0.02, 0.05),),
        readings=Readings(20.0, whole_counts=True, noise_m=0.002),
    )
    second = replace(second, settling=replace(second.settling, tail_dof=20.0))
    found = ft.Population.fit([first, second]).imperfections
    assert (found.name, found.protocol) == ("population of 2 robots", "P0")
    assert found.source == "robot 1, robot 2"
    assert found.settling.tail_dof == pytest.approx(10.0)
    timing = found.timing
    np.testing.assert_allclose([timing.delay_s, timing.lag_s], [(0.005, 0.015), (0.03, 0.03)])
    np.testing.assert_allclose(timing.ramp_shortening, (0.0, 0.05))
    assert (timing.late_rate, timing.late_s) == (pytest.approx(0.1), (0.5, 1.0))
    assert found.schedule == first.schedule
    assert (found.readings.rate_hz, found.readings.noise_m) == (15.0, 0.001)
    assert found.readings.glitch_rate == (0.0, 0.0, 0.1, 0.0)
    rates = {frozenset(e.motors): (e.rate, e.rate_when_late) for e in found.lost_commands}
    assert len(rates) == len(found.lost_commands) == 10
    # With the class as a third robot: 0.03 of each motor, 0.005 of any two.
    assert rates[frozenset({"motor_1"})] == pytest.approx((0.33 / 3.0, 0.63 / 3.0))
    assert rates[frozenset({"motor_2"})] == pytest.approx((0.01, 0.01))
    assert rates[frozenset({"motor_1", "motor_2"})] == pytest.approx((0.025 / 3.0, 0.055 / 3.0))
    log = np.log([0.3, 0.02])
    between2 = (3.0 * 0.7**2 + log.var(ddof=1)) / 4.0
    expected = np.sqrt(between2 + 1.0 / (1.0 / 0.7**2 + 2.0 / between2))
    assert found.variation.rates == pytest.approx(expected)


def test_normal_tails_count_as_fifty_degrees(armpi):
    robots = [robot_of(MEAN, i) for i in range(2)]
    normal = [replace(r, settling=replace(r.settling, tail_dof=np.inf)) for r in robots]
    assert ft.Population.fit(normal).imperfections.settling.tail_dof == pytest.approx(50.0)


def test_timing_on_top_of_other_servo_loops_does_not_count(armpi, tmp_path):
    timing = Timing((0.01, 0.01), (0.02, 0.02))
    plain, other = (robot_of(MEAN, i, timing=timing) for i in range(2))
    other = replace(other, timing=Timing((0.05, 0.05), (0.08, 0.08)))
    loop = CalibratedLoop("motor_1", 0.5, 9.0, 0.01, 1.0)
    assert with_loops(armpi, [loop]) != armpi
    path = tmp_path / "looped.toml"
    saved = ft.Population.fit([plain, replace(plain, name="b")]).calibration
    ft.save_calibration(replace(saved, imperfections=other, loops=(loop,)), armpi, path)
    assert ft.Population.fit([plain, path], armpi).imperfections.timing == timing


# What comes of it.


def test_a_file_holds_a_population(armpi, tmp_path):
    truth = drawn(np.random.default_rng(4), 5)
    robots = [robot_of(row(truth, i), i) for i in range(5)]
    population = ft.Population.fit(robots, armpi)
    path = tmp_path / "fleet.toml"
    ft.save_calibration(population.calibration, armpi, path)
    again = load_calibration(path, armpi).imperfections
    there = population.imperfections
    assert (again.name, again.source, again.protocol) == (there.name, there.source, "P0")
    for table in ("settling", "variation"):
        for name in NAMES:
            ours, theirs = (getattr(getattr(each, table), name) for each in (there, again))
            np.testing.assert_allclose(theirs, ours, rtol=1e-5, atol=1e-12)
    told = read_calibration(path, armpi)
    assert told.sessions == tuple(f"robot {i}" for i in range(5))
    assert (told.runs, told.movements, len(told.parameters)) == (0, 0, 16)
    (bias,) = [p for p in told.parameters if (p.name, p.motor) == ("bias", "motor_2")]
    spread = there.variation.bias[1]
    assert bias.value == pytest.approx(there.settling.bias[1], rel=1e-5)
    assert bias.high - bias.value == pytest.approx(1.96 * spread, rel=1e-4)
    (scatter,) = [p for p in told.parameters if (p.name, p.motor) == ("scatter", "motor_1")]
    ratio = np.exp(1.96 * there.variation.scatter[0])
    assert scatter.high / scatter.value == pytest.approx(ratio, rel=1e-4)
    files = [tmp_path / f"{i}.toml" for i in range(5)]
    for one, file in zip(robots, files, strict=True):
        ft.save_calibration(replace(population.calibration, imperfections=one), armpi, file)
    reread = ft.Population.fit(files, armpi).imperfections.settling
    np.testing.assert_allclose(reread.bias, there.settling.bias, atol=1e-7)


FLEET = Imperfections(
    "a fleet",
    "made up",
    settling=Settling(
        (0.012, -0.012, 0.01, -0.01), (0.0, 0.15, 0.2, 0.45), (0.012,) * 4, (0.004,) * 4, 8.0
    ),
    variation=Variation((0.002,) * 4, (0.0, 0.1, 0.1, 0.1), (0.002,) * 4, (0.1,) * 4),
)
TRUTHS = ["motor_3:steady_state_error", "motor_4:steady_state_error"]
AMONG = ["healthy", *TRUTHS, "motor_3:stuck", "motor_4:stuck"]


def test_strangers_of_a_fleet_are_judged_better_than_by_their_class(armpi):
    """Two of a fleet, of each two runs of three movements; twelve others are calibrated."""
    rng = np.random.default_rng(0)
    known = [replace(vary(FLEET, rng), name=f"robot {i}") for i in range(12)]
    population = ft.Population.fit(known, armpi)
    scores = {"fleet": [], "class": []}
    for seed in (6, 7):
        runs = simulate(Plan(armpi, TRUTHS, 1, seed, vary(FLEET, rng), RandomMovements(count=3)))
        for name, prior in (("fleet", population), ("class", None)):
            found = SelfCalibratingDiagnoser(armpi, prior, hypotheses=AMONG).diagnose(runs)
            scores[name].append(evaluate(found, runs).judged.scores.log_score)
    assert np.mean(scores["fleet"]) < min(0.3, 0.6 * np.mean(scores["class"]))
    one = ft.BayesDiagnoser(armpi, population.imperfections).diagnose(runs.isel(run=[0]))
    assert (one[0].protocol, "population of 12 robots" in one[0].method) == ("P0", True)


# What is no fleet.


def test_what_is_no_fleet_is_refused(armpi):
    one, other = robot_of(MEAN, 0), robot_of(MEAN, 1)
    with pytest.raises(InputError, match="of 1 calibrations: expected those of two robots"):
        ft.Population.fit([one])
    with pytest.raises(InputError, match="of 1 calibrations"):
        ft.Population.fit("armpi_fpv")
    with pytest.raises(InputError, match="robot 0: is given twice"):
        ft.Population.fit([one, other, one])
    with pytest.raises(InputError, match="generic: says nothing of where one robot settles"):
        ft.Population.fit([one, "generic"])
    with pytest.raises(InputError, match="none: says nothing of where one robot settles"):
        ft.Population.fit(["none", one])
    with pytest.raises(InputError, match="bias has 4 values, expected 5"):
        ft.Population.fit([one, other], "ur5e")
    still = replace(other, settling=replace(other.settling, scatter=(0.0,) * 4))
    with pytest.raises(InputError, match="expected more than 0 of each motor"):
        ft.Population.fit([one, still], armpi)
