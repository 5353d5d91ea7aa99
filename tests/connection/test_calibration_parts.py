from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy import stats

from failuretwin import DigitalTwin
from failuretwin.connection.calibration.cross_validation import cross_validate, judge
from failuretwin.connection.calibration.observations import Observations, rounding, uncalibrated
from failuretwin.connection.calibration.parameters import (
    Rate,
    glitch_rates,
    loss_rates,
    median_interval,
    settling_parameters,
    spread_of,
    spring_remarks,
)
from failuretwin.connection.calibration.settling_fit import (
    PAYLOADS_KG,
    best_payload,
    fit_settling,
)
from failuretwin.connection.calibration.timing_fit import (
    Transients,
    fit_timing,
    gap_starts,
    lateness,
    punctual,
)
from failuretwin.core.errors import InputError
from failuretwin.core.movements import Movements
from failuretwin.core.runs import RunTable
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.digital_model.disturbances import lagged
from failuretwin.digital_model.settling import Settling
from failuretwin.inference.observation.evidence import SettledEvidence
from failuretwin.inference.observation.healthy_model import HealthyModel

COUNT = np.deg2rad(0.24)
NAMES = ["motor_1", "motor_2", "motor_3", "motor_4"]
TYPICAL = Settling(
    bias=(0.002, 0.005, 0.0, -0.003),
    compliance=(0.0, 0.137, 0.168, 0.194),
    friction=(0.0065, 0.005, 0.01, 0.011),
    scatter=(0.005, 0.006, 0.005, 0.003),
    tail_dof=5.0,
    source="made up",
)


IN_A_RUN = 5
"""Movements of a run."""


@pytest.fixture(scope="module")
def settle(armpi):
    """Draw settled movements from the model; motors are read in whole counts."""

    def draw(
        settling, seed, movements=120, sessions=1, readings=True, robot=armpi, stay=None, odd=()
    ):
        rng = np.random.default_rng(seed)
        angles = random_angles(robot, movements, rng)
        wide = np.sqrt(settling.tail_dof / rng.chisquare(settling.tail_dof, (movements, 1)))
        wanted = np.asarray(settling.scatter) * wide * rng.standard_normal((movements, 4))
        pose, target, came = np.empty((movements, 4)), angles[1:], angles[0]
        for i in range(movements):
            came = angles[i] if i % IN_A_RUN == 0 else came
            here = np.zeros(4, dtype=bool) if stay is None else stay[i]
            aimed, rest = target[i] + wanted[i], target[i] + wanted[i]
            for _ in range(6):  # the sag depends on the pose that it leads to
                rest = aimed + settling.offset(robot, rest, np.sign(target[i] - came))
            pose[i] = np.where(here, pose[i - 1] if i % IN_A_RUN else angles[i], rest)
            came = np.where(here, came, target[i])
        units = robot.servo_units
        pose = units.to_rad(np.rint(units.to_counts(pose)))
        pose[list(odd)] += 0.4
        noise = wide * rng.standard_normal((movements, 3))
        return observed(robot, angles, pose, sessions, readings, noise)

    return draw


def random_angles(robot, movements, rng):
    low, high = np.array([motor.movement_range for motor in robot.motors]).T
    return rng.uniform(low, high, (movements + 1, 4))


def observed(robot, angles, pose, sessions=1, readings=True, noise=0.0):
    """Return observations of runs of five movements each, by the readings or by a noisy tool.

    Scatter and noise of a movement are one multivariate Student t, as the model has them.
    """
    count = len(pose)
    at = np.divmod(np.arange(count), IN_A_RUN)
    shape = (at[0][-1] + 1, min(IN_A_RUN, count))
    model = uncalibrated(robot, readings)
    target, tool = np.full((*shape, 4), np.nan), np.zeros((*shape, 3))
    point = np.zeros((*shape, 4 if readings else 3))
    usable = np.zeros(shape, dtype=bool)
    target[at], tool[at], usable[at] = angles[1:], DigitalTwin(robot).path(pose), True
    point[at] = model.sensors.value(pose)
    if not readings:
        point[at] = tool[at] = tool[at] + model.path_noise * noise
    start = np.where(usable, 2.0 * np.arange(shape[1]), np.nan)
    ramp = np.where(usable[..., None], 0.8, np.nan) * np.ones(4)
    evidence = replace(
        SettledEvidence.empty(run=shape[0], movement=shape[1], motor=4, axis=point.shape[-1]),
        movements=Movements(angles[:-1:IN_A_RUN], target, ramp, start),
        point=point,
        usable=usable,
    )
    return Observations(
        evidence=evidence,
        model=model,
        tool=tool,
        session=np.arange(shape[0]) % sessions,
        sessions=tuple(f"day_{i}" for i in range(sessions)),
        runs=tuple(f"run_{i}" for i in range(shape[0])),
    )


def random_settling(seed):
    rng = np.random.default_rng(seed)
    return Settling(
        bias=tuple(rng.normal(0.0, 0.01, 4)),
        compliance=(0.0, *rng.uniform(0.05, 0.3, 3)),
        friction=tuple(rng.uniform(0.0, 0.015, 4)),
        scatter=tuple(np.exp(rng.normal(np.log(0.006), 0.3, 4))),
        tail_dof=float(rng.uniform(3.0, 12.0)),
        source="drawn",
    )


def as_vector(settling):
    lists = (settling.bias, settling.compliance, settling.friction, np.log(settling.scatter))
    return np.concatenate([*lists, [np.log(settling.tail_dof)]])


# Rates and ranges


@pytest.mark.parametrize("count", [6, 9, 40])
def test_interval_of_a_median_holds_it_whatever_the_distribution(count):
    rng = np.random.default_rng(count)
    for draws, truth in (
        (rng.uniform(0.3, 1.7, (2000, count)), 1.0),
        (rng.standard_exponential((2000, count)), np.log(2.0)),
    ):
        found = np.array([median_interval(values) for values in draws])
        inside = np.mean((found[:, 1] <= truth) & (truth <= found[:, 2]))
        # As many lie below the median as coins show heads: the interval can be too wide, by one
        # order statistic, never too narrow.
        below = stats.binom.ppf(0.025, count, 0.5)
        expected = 1.0 - 2.0 * stats.binom.cdf(below - 1, count, 0.5)
        assert expected >= 0.95
        assert abs(inside - expected) < 4.0 * np.sqrt(0.95 * 0.05 / 2000)


def test_spread_of_uniform_draws_is_their_range_whatever_stands_out():
    values = np.random.default_rng(3).uniform(0.2, 0.8, 4000)
    np.testing.assert_allclose(spread_of(values), (0.2, 0.8), atol=0.03)
    spoilt = np.concatenate([values, np.full(40, 1e3)])
    np.testing.assert_allclose(spread_of(spoilt), (0.2, 0.8), atol=0.05)


def test_what_never_or_always_happened_may_never_or_always_happen():
    assert Rate(0, 50).interval[0] == 0.0
    assert Rate(0, 50).interval[1] > 0.03
    assert not Rate(0, 50).identified
    assert Rate(50, 50).interval[1] == 1.0
    assert Rate(0, 0).interval == (0.0, 1.0)


def test_lost_commands_are_counted_by_set_of_motors_and_lateness(settle, armpi):
    seen = settle(TYPICAL, seed=1, movements=10)
    near = np.abs(seen.target - seen.origin) < 0.1
    lost = np.zeros((10, 4), dtype=bool)
    lost[0, :2] = lost[1, 0] = lost[2, 0] = True
    delayed = np.arange(10).reshape(2, 5) < 2
    punctual = ~delayed
    punctual[1, 4] = False  # of the last movement nobody knows
    lost[9] = True
    found = {loss.motors: loss for loss in loss_rates(seen, lost, punctual, delayed, armpi)}
    pairs = set(combinations(NAMES, 2))  # also those that were not seen: they may come tomorrow
    assert set(found) == {*pairs, tuple(NAMES), *((name,) for name in NAMES)}
    unseen = found["motor_3", "motor_4"].punctual
    assert unseen.hits == 0 < unseen.trials
    assert unseen.mean == pytest.approx(30 * 0.005 / (unseen.trials + 30))
    first = found["motor_1",]
    assert (first.late.hits, first.punctual.hits) == (1, 1)
    assert first.late.trials == 2 - near[:2, 0].sum()
    assert first.punctual.trials == 7 - near[2:9, 0].sum()
    both = found["motor_1", "motor_2"]
    assert (both.late.hits, both.punctual.hits) == (1, 0)
    assert found["motor_3",].late.hits == found["motor_3",].punctual.hits == 0
    assert found[tuple(NAMES)].punctual.hits == 0
    trials = both.punctual.trials  # hobby servos lose both commands of a pair once in 200 movements
    assert both.punctual.mean == pytest.approx(30 * 0.005 / (trials + 30))
    assert both.late.mean == pytest.approx((1 + 2 * both.punctual.mean) / (both.late.trials + 2))


# Late starts, gaps, glitches


def movements_at(start, motors=4):
    start = np.asarray(start, dtype=float)
    target = np.tile(np.where(np.arange(start.shape[1]) % 2, -0.3, 0.4)[:, None], (1, motors))
    return Movements(
        initial=np.zeros((len(start), motors)),
        target=np.where(np.isfinite(start)[..., None], target, np.nan),
        ramp_duration=np.where(np.isfinite(start)[..., None], 0.8, np.nan) * np.ones(motors),
        start=start,
    )


def test_a_late_start_holds_up_the_next_command():
    start = [[0.1, 2.11, 4.13, 6.93, 8.93], [0.05, 2.05, 4.06, 6.06, np.nan]]
    found = lateness(movements_at(start))
    expected = [[0.0, 0.0, 2.80 - 2.01, 0.0, np.nan], [0.0, 0.0, 0.0, np.nan, np.nan]]
    np.testing.assert_allclose(found, expected, atol=0.011)
    np.testing.assert_array_equal(np.argwhere(found > 0.0), [[0, 2]])
    assert not punctual(found)[0, 4]  # nothing follows it
    assert punctual(found).sum() == 3 + 3


@pytest.mark.parametrize("start", [[[0.0, 1.1, 3.9, 5.0, 8.7]], [[0.0, 2.0, 4.0]]])
def test_commands_at_no_steady_pace_tell_of_no_late_start(start):
    assert np.isnan(lateness(movements_at(start))).all()


def runs_at(movements, position=None, silent=((0.0, 0.0),)):
    """Return runs read at 10 Hz, with silence from one time to another."""
    time = np.arange(1000) * 0.01
    count = len(movements.start)
    measured = np.zeros((count, 1000, 3))
    measured[:, np.arange(1000) % 10 != 0] = np.nan
    for begin, end in silent:
        measured[:, (time > begin) & (time < end)] = np.nan
    return RunTable(
        run=[f"run_{i}" for i in range(count)],
        motor=NAMES,
        time=time,
        command=movements.reference(time),
        measured=measured,
        position=position,
        measured_rate_hz=10.0,
    ).to_dataset()


def test_gaps_before_late_starts_are_dated_from_the_movement_before():
    movements = movements_at([[0.1, 2.11, 5.31, 7.32]])
    late = np.array([[0.0, 1.2, 0.0, np.nan]])
    runs = runs_at(movements, silent=((0.85, 3.31), (6.0, 6.15)))
    np.testing.assert_allclose(gap_starts(runs, movements, late), [0.85 - 0.1], atol=0.051)
    assert len(gap_starts(runs_at(movements), movements, late)) == 0
    assert len(gap_starts(runs, movements, np.zeros((1, 4)))) == 0


def test_spoilt_readings_are_counted_by_motor_among_the_rows_read():
    position = np.full((2, 1000, 4), np.nan)
    position[:, ::10] = 0.3
    position[0, [10, 20, 30], 3] = np.nan
    position[1, 500, 1] = np.nan
    runs = runs_at(movements_at([[0.0, 2.0], [0.0, 2.0]]), position)
    assert [(r.hits, r.trials) for r in glitch_rates(runs)] == [
        (0, 200),
        (1, 200),
        (0, 200),
        (3, 200),
    ]
    assert glitch_rates(runs.drop_vars("position")) is None


# Lost commands


@pytest.mark.parametrize("readings", [True, False])
def test_motors_that_stay_are_seen(settle, readings):
    clear = settle(TYPICAL, seed=5, movements=60)
    far = np.flatnonzero((np.abs(clear.target - clear.origin) > 0.3).all(axis=1))
    far = far[far % IN_A_RUN > 0]
    held = np.zeros((60, 4), dtype=bool)
    held[far[0], 0] = held[far[2], 1] = held[far[4], 2] = held[far[6], :2] = True
    seen = settle(TYPICAL, seed=5, movements=60, readings=readings, stay=held)
    np.testing.assert_array_equal(fit_settling(seen).sorted.lost, held)


def test_a_motor_that_hardly_had_to_move_lost_nothing(armpi):
    angles = random_angles(armpi, 60, np.random.default_rng(5))
    angles[:, 0] = 0.2 + 0.003 * (np.arange(61) % 2)
    pose = angles[1:].copy()
    pose[::3, 0] = angles[:-1][::3, 0]
    part = fit_settling(observed(armpi, angles, pose))
    assert not part.sorted.lost[:, 0].any()
    rates = loss_rates(part.observations, part.sorted.lost, *np.ones((2, 12, 5), dtype=bool), armpi)
    assert all(rate.punctual.hits == 0 for rate in rates)


# Where motors settle


@pytest.mark.parametrize(("readings", "shares"), [(True, 1.0), (False, 1.6)])
def test_settling_of_a_known_robot_comes_back(settle, armpi, readings, shares):
    seen = settle(TYPICAL, seed=2, movements=300, readings=readings)
    found = fit_settling(seen).settling
    # Four standard errors of a mean, and of a slope over the loads that the movements meet.
    error = 4.0 * shares * np.asarray(TYPICAL.scatter) * np.sqrt(5.0 / 3.0) / np.sqrt(300)
    load = np.std(armpi.loads.torque(seen.target * armpi.sense, 0.0), axis=0)[1:]
    assert np.all(np.abs(np.subtract(found.bias, TYPICAL.bias)) < error)
    assert np.all(np.abs(np.subtract(found.friction, TYPICAL.friction)) < error)
    off = np.abs(np.subtract(found.compliance, TYPICAL.compliance))
    assert np.all(off[1:] < 1.5 * error[1:] / load)
    assert off[0] < 1e-6
    np.testing.assert_allclose(found.scatter, TYPICAL.scatter, rtol=0.25 if readings else 0.5)
    assert 3.0 < found.tail_dof < 9.0


@pytest.mark.parametrize(
    ("readings", "draws"),
    [(True, 2), (False, 2), *(pytest.param(r, 6, marks=pytest.mark.slow) for r in (True, False))],
)
def test_settling_intervals_hold_the_truth(settle, armpi, readings, draws):
    inside = []
    for seed in range(draws):
        truth = random_settling(seed)
        seen = settle(truth, 1000 + seed, movements=80, readings=readings)
        fit = fit_settling(seen).fit
        told = fit.deviation < 0.3 * fit.prior_deviation
        told[4] = False  # gravity does not load motor 1
        off = np.abs(fit.mode - as_vector(truth)) / fit.deviation
        inside += (off[told] < 1.96).tolist()
    assert len(inside) > 10 * draws
    assert 0.88 < np.mean(inside) < 0.995


def test_what_the_logs_do_not_say_keeps_its_prior(settle):
    fit = fit_settling(settle(TYPICAL, seed=3, movements=40)).fit
    share = fit.deviation / fit.prior_deviation
    assert share[4] == pytest.approx(1.0, rel=0.05)  # compliance of motor 1
    assert share[[5, 6, 7]].max() < 0.3


def test_lost_commands_and_odd_movements_do_not_bend_the_fit(settle, armpi):
    clean = fit_settling(settle(TYPICAL, seed=4, movements=80))
    way = np.abs(clean.observations.target - clean.observations.origin)[:, 0]
    far = np.flatnonzero((way > 0.3) & (np.arange(80) % IN_A_RUN > 0))
    stay = far[np.append(True, np.diff(far) > 1)][:6]  # none missed two in a row
    held = np.zeros((80, 4), dtype=bool)
    held[stay, 0] = True
    odd = np.setdiff1d(np.arange(4, 80, 5), stay)[:5]
    part = fit_settling(settle(TYPICAL, seed=4, movements=80, stay=held, odd=odd))
    assert {(e.motor, e.reason) for e in part.left_out(armpi)} == {
        ("motor_1", "did not get its command"),
        ("", "is far off its target"),
    }
    np.testing.assert_array_equal(np.flatnonzero(part.sorted.lost[:, 0]), stay)
    np.testing.assert_array_equal(np.flatnonzero(part.sorted.odd), odd)
    assert np.all(np.abs(part.fit.mode - clean.fit.mode) < 2.0 * clean.fit.deviation + 1e-12)


def test_commands_lost_on_short_ways_do_not_make_the_tails(settle):
    rigid = replace(TYPICAL, compliance=(0.0,) * 4)  # no motor's sag depends on where others are
    clean = fit_settling(settle(rigid, seed=7, movements=200))
    way = np.abs(clean.observations.target - clean.observations.origin)
    rng = np.random.default_rng(7)
    stay = (way > 8 * COUNT) & (rng.random((200, 4)) < np.where(way < 25 * COUNT, 0.3, 0.05))
    stay &= (np.arange(200) % IN_A_RUN > 0)[:, None]
    short = stay & (way < 25 * COUNT)
    assert short.sum() > 8
    part = fit_settling(settle(rigid, seed=7, movements=200, stay=stay))
    lost = part.sorted.lost
    assert np.mean(lost[short]) > 0.8
    assert np.mean(lost[~stay]) < 0.02
    moved = np.abs(part.fit.mode - clean.fit.mode)[12:] / clean.fit.deviation[12:]
    assert moved.max() < 1.0


def test_too_few_movements_are_refused(settle, armpi):
    with pytest.raises(InputError, match=r"only 5 of 5 movements .* expected 6 at least"):
        fit_settling(settle(TYPICAL, seed=6, movements=5))


# Timing

TIME = np.arange(1000) * 0.01
DELAY = np.array([0.0, 0.01, 0.02, 0.03, 0.04, 0.015])
SHORTENING = np.array([0.02, 0.05, 0.0, 0.03, 0.04, 0.01])


def ramps(armpi, lag, rate, read):
    """Return six runs made with known timing and read at `rate` through `read`."""
    rng = np.random.default_rng(8)
    movements = Movements(
        initial=np.zeros((6, 4)),
        target=rng.uniform(-0.8, 0.8, (6, 5, 4)),
        ramp_duration=np.repeat(rng.choice([0.6, 0.8, 1.0], (6, 5, 1)), 4, axis=2),
        start=0.05 + 2.0 * np.arange(5) * np.ones((6, 1)),
    )
    real = replace(
        movements,
        start=movements.start + DELAY[:, None],
        ramp_duration=movements.ramp_duration * (1.0 - SHORTENING)[:, None, None],
    )
    reference = lagged(real.reference(TIME), TIME, np.full(6, lag))
    reading = read(DigitalTwin(armpi).respond(reference, TIME))
    used = np.broadcast_to(np.arange(1000) % round(100 / rate) == 0, (6, 1000))
    of_motors = reading.shape[2] == 4
    reading = np.where(used[..., None], reading, np.nan)
    return Transients(movements, np.zeros((6, 1000, 4)), reading, of_motors, used, TIME)


@pytest.mark.parametrize(("lag", "tool"), [(0.015, False), (0.03, True)])
def test_timing_comes_back_from_clean_motion(armpi, twin, lag, tool):
    clean = ramps(armpi, lag, 100.0, twin.path if tool else np.array)
    fit = fit_timing(clean, armpi)
    assert fit.lag == pytest.approx(lag, abs=0.002)
    np.testing.assert_allclose(fit.delay, DELAY, atol=0.002)
    np.testing.assert_allclose(fit.shortening, SHORTENING, atol=0.003)


def test_timing_comes_back_from_whole_counts_ten_times_a_second(armpi):
    rounded = ramps(armpi, 0.03, 10.0, lambda angle: np.rint(angle / COUNT) * COUNT)
    fit = fit_timing(rounded, armpi)
    assert fit.lag == pytest.approx(0.03, abs=0.005)
    np.testing.assert_allclose(fit.delay, DELAY, atol=0.006)
    np.testing.assert_allclose(fit.shortening, SHORTENING, atol=0.008)


def test_two_runs_tell_no_timing(armpi):
    clean = ramps(armpi, 0.03, 100.0, np.array)
    few = replace(clean, used=clean.used & (np.arange(6) < 2)[:, None])
    assert fit_timing(few, armpi) is None


# What the robot might be instead


def test_a_motor_that_turns_the_other_way_seems_to_rise_against_gravity(settle, armpi):
    motors = tuple(replace(motor, sense=1.0) for motor in armpi.motors)
    straight = replace(armpi, profile=replace(armpi.profile, motors=motors))
    seen = settle(TYPICAL, seed=9, movements=60, robot=straight)
    for robot, told in ((armpi, ["motor_3"]), (straight, [])):
        fit = fit_settling(seen.of(uncalibrated(robot, of_motors=True))).fit
        remarks = spring_remarks(settling_parameters(fit, robot, 0.0))
        named = [remark.split()[2].rstrip(":") for remark in remarks]
        assert named == told
        assert all("check its sense" in remark for remark in remarks)


def test_no_payload_is_told_where_there_is_none(settle, armpi):
    payload, told = best_payload(fit_settling(settle(TYPICAL, seed=10, movements=30)), armpi)
    assert payload == 0.0
    assert "do not tell one from a softer motor" in told


def test_a_heavy_payload_on_a_precise_arm_is_told(settle, armpi):
    loaded = replace(TYPICAL, compliance=(0.0, 0.05, 0.05, 0.05), scatter=(3e-4,) * 4, payload=0.5)
    seen = settle(loaded, seed=10, movements=50, readings=False)
    fits = []
    payload, told = best_payload(fit_settling(seen), armpi, fits.append)
    assert sum(fits) == len(PAYLOADS_KG)
    assert payload == 0.5
    assert "about 0.5 kg at the tool point" in told


# Unseen sessions


def test_unseen_sessions_are_left_with_the_scatter_alone(settle, armpi):
    whole, fits = fit_settling(settle(TYPICAL, seed=11, movements=300, sessions=3)), []
    entries = cross_validate(whole, armpi, fits.append)
    assert sum(fits) == 3
    assert [entry.session for entry in entries] == ["day_0", "day_1", "day_2"]
    # 1.48 times the median size of a Student t of this scale, plus what counts round off.
    size = 1.4826 * stats.t.ppf(0.75, TYPICAL.tail_dof)
    expected = np.hypot(size * np.asarray(TYPICAL.scatter), rounding(armpi))
    after = np.mean([entry.after for entry in entries], axis=0)
    np.testing.assert_allclose(after, expected, rtol=0.15)
    for entry in entries:
        assert entry.before[1] > 2.5 * entry.after[1]
        assert entry.gain - 1.96 * entry.gain_error > 0.5


@pytest.fixture(scope="module")
def typical(settle):
    """A fit to one session of a typical robot."""
    return fit_settling(settle(TYPICAL, seed=12, movements=80))


def test_gain_is_the_mean_difference_of_log_densities(settle, typical, armpi, twin):
    seen = settle(TYPICAL, seed=13, movements=40)
    entry = judge(seen, typical, armpi, "other day")
    kind = HealthyModel.of(twin, generic_imperfections(armpi))
    generic = replace(kind.settling, scatter=tuple(kind.scatter))
    gain = log_densities(seen, typical.settling, armpi, twin) - log_densities(
        seen, generic, armpi, twin
    )
    assert entry.movements == 40
    assert entry.gain == pytest.approx(gain.mean(), rel=1e-9)
    assert entry.gain_error == pytest.approx(stats.sem(gain), rel=1e-9)


def log_densities(seen, settling, robot, twin):
    direction = np.sign(seen.target - seen.origin)
    near = seen.target + settling.offset(robot, seen.target, direction)
    pose = seen.target + settling.offset(robot, near, direction)
    mean, jacobian = twin.path_and_jacobian(pose)
    spread = jacobian @ np.diag(np.square(settling.scatter)) @ jacobian.transpose(0, 2, 1)
    spread += 0.001**2 * np.eye(3)
    return np.array(
        [
            stats.multivariate_t(m, s, df=settling.tail_dof).logpdf(x)
            for m, s, x in zip(mean, spread, seen.point, strict=True)
        ]
    )


def test_a_shift_of_the_whole_session_counts_as_error(settle, typical, armpi):
    shifted = replace(TYPICAL, bias=tuple(np.add(TYPICAL.bias, 0.03)))
    entry = judge(settle(shifted, seed=13), typical, armpi, "shifted")
    np.testing.assert_allclose(entry.after, 0.03 * 1.4826, rtol=0.15)
    assert entry.gain < 0.0


def test_a_fit_to_another_robot_does_not_beat_none(settle, armpi):
    ideal = Settling((0.0,) * 4, (0.0,) * 4, (0.0,) * 4, (0.003,) * 4, 10.0, "straight")
    soft = replace(TYPICAL, compliance=(0.0, 0.3, 0.3, 0.3))
    part = fit_settling(settle(soft, seed=14))
    entry = judge(settle(ideal, seed=15), part, armpi, "another robot")
    assert entry.gain + 1.96 * entry.gain_error < 0.0


def test_one_session_or_one_movement_judges_nothing(settle, typical, armpi):
    assert cross_validate(typical, armpi) == ()
    one = settle(TYPICAL, seed=16, movements=1)
    assert judge(one, typical, armpi, "short") is None
