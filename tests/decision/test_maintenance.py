"""Least expected cost and remaining life, against closed forms and simulated wear."""

from __future__ import annotations

import numpy as np
import pytest

from failuretwin import InputError
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.decision.expected_cost import (
    Costs,
    Missed,
    advise,
    cost_of,
    cost_table,
    costs_template,
    load_costs,
)
from failuretwin.decision.remaining_life import remaining_life

MISSED = {
    "any": Missed(0.5, 0.2, 0.5),
    "stuck": Missed(0.9, 0.4, 0.8),
}


def costs(**changed):
    figures = {
        "targets": 10.0, "missed_target": 3.0, "compensate": 1.0, "slow_down": 2.0,
        "inspect": 3.0, "replace": 10.0, "stop": 15.0, "missed": MISSED,
    }  # fmt: skip
    return Costs(**(figures | changed))


def test_expected_costs_by_hand():
    posterior = {"healthy": 0.6, "motor_1:stuck": 0.3, "motor_2:drift": 0.1}
    found = {str(option): option.cost for option in advise(posterior, costs()).options}
    assert found["continue"] == pytest.approx(0.3 * 27.0 + 0.1 * 15.0)
    assert found["compensate"] == pytest.approx(1.0 + 0.3 * 12.0 + 0.1 * 6.0)
    assert found["slow down"] == pytest.approx(2.0 + 0.3 * 24.0 + 0.1 * 15.0)
    assert found["stop"] == pytest.approx(15.0)
    assert found["replace motor_1"] == pytest.approx(10.0 + 0.1 * 15.0)
    assert found["replace motor_2"] == pytest.approx(10.0 + 0.3 * 27.0)
    # Once it is known: nothing for the healthy arm, 10 for motor 1, 7 for motor 2 (compensate).
    assert found["inspect"] == pytest.approx(3.0 + 0.3 * 10.0 + 0.1 * 7.0)


def test_the_best_is_the_least_and_comes_first():
    advice = advise({"healthy": 0.5, "motor_1:stuck": 0.5}, costs())
    values = [option.cost for option in advice.options]
    assert values == sorted(values)
    assert advice.best.cost == min(values)


def test_an_inspection_is_never_worth_more_than_knowing_for_nothing():
    rng = np.random.default_rng(0)
    names = ["healthy", "motor_1:stuck", "motor_2:stuck", "motor_2:drift"]
    hypotheses = [Hypothesis.parse(name) for name in names]
    actions, table = cost_table(hypotheses, costs())
    for _ in range(50):
        p = rng.dirichlet(np.ones(4))
        expected = dict(zip(actions, (table @ p).tolist(), strict=True))
        others = min(cost for action, cost in expected.items() if action[0] != "inspect")
        assert expected["inspect", ""] <= others + 3.0 + 1e-12


def test_the_hinge_is_where_the_first_two_change_places():
    posterior = {"healthy": 0.9, "motor_1:stuck": 0.1}
    advice = advise(posterior, costs())
    assert advice.hinge in posterior
    t = advice.hinge_probability
    other = next(name for name in posterior if name != advice.hinge)
    again = advise({advice.hinge: t, other: 1.0 - t}, costs())
    by_name = {str(option): option.cost for option in again.options}
    first, second = (str(option) for option in advice.options[:2])
    assert by_name[first] == pytest.approx(by_name[second])
    assert "hinges on" in advice.verdict


def test_free_replacement_is_taken_and_dear_targets_stop_the_arm():
    sure = {"healthy": 0.01, "motor_2:stuck": 0.99}
    assert str(advise(sure, costs(replace=0.0, inspect=5.0)).best) == "replace motor_2"
    assert str(advise(sure, costs(missed_target=1e4, replace=1e6, inspect=20.0)).best) == "stop"
    assert str(advise({"healthy": 1.0, "motor_2:stuck": 0.0}, costs()).best) == "continue"


def test_two_faults_need_two_motors():
    both = Hypothesis.parse("motor_1:stuck+motor_2:stuck")
    assert cost_of("replace", "motor_1", both, costs()) == pytest.approx(10.0 + 27.0)
    assert cost_of("replace", "", Hypothesis(), costs()) == pytest.approx(10.0)


def test_costs_come_from_the_user_alone(tmp_path):
    path = tmp_path / "costs.toml"
    path.write_text(costs_template())
    found = load_costs(path)
    assert found.currency == "EUR"
    assert found.missed["stuck"].going_on == 0.9
    assert found.healthy == Missed(0.0, 0.0, 0.0)
    path.write_text(costs_template().replace("missed_target = 1.0", ""))
    with pytest.raises(InputError, match="missed_target"):
        load_costs(path)
    path.write_text(costs_template().replace("going_on = 0.9", "going_on = 1.9"))
    with pytest.raises(InputError, match="going_on"):
        load_costs(path)


def test_a_mode_without_shares_is_refused():
    only = costs(missed={"stuck": MISSED["stuck"]})
    with pytest.raises(InputError, match=r"missed\.any"):
        advise({"healthy": 0.5, "motor_1:drift": 0.5}, only)
    with pytest.raises(InputError, match="healthy"):
        advise({"motor_1:stuck": 1.0}, costs())


# Remaining life.


def wear(shape, end, now, noise, rng):
    share = (np.arange(now) + 0.5) / end
    level = {"linear": share, "square": share**2, "none": 0.0 * share,
             "exponential": np.expm1(3 * share) / np.expm1(3.0)}[shape]  # fmt: skip
    return 4.0 * level + noise * rng.standard_normal(now)


@pytest.mark.parametrize("shape", ["linear", "square", "exponential"])
def test_life_that_is_known_lies_in_the_interval(shape):
    held = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        found = remaining_life(wear(shape, 1000, 700, 0.4, rng), 0.16, 4.0, rng)
        held += found.quantile(0.05) <= 300 <= found.quantile(0.95)
    assert held >= 9


def test_sharp_linear_wear_ends_when_the_line_says():
    rng = np.random.default_rng(0)
    found = remaining_life(wear("linear", 1000, 850, 0.02, rng), 0.0004, 4.0, rng)
    assert found.quantile(0.5) == pytest.approx(150, rel=0.1)
    assert found.level == pytest.approx(3.4, abs=0.1)
    assert found.in_sight
    assert "runs left" in found.verdict


def test_a_random_walk_is_passed_as_brownian_motion_passes():
    # x = 2 now, no trend is known to be there: median of the first passage at 4 of a Brownian
    # motion from 2 is (2 / 0.6745)^2 / q; the average over trends makes it sooner, never later.
    rng, q = np.random.default_rng(1), 0.01
    level = np.cumsum(np.sqrt(q) * rng.standard_normal(400))
    level += 2.0 - level[-1]
    found = remaining_life(level + 0.01 * rng.standard_normal(400), 1e-4, 4.0, rng)
    assert found.quantile(0.05) > 30
    assert found.quantile(0.5) < 1.5 * (2.0 / 0.6745) ** 2 / q


def test_nothing_wears_no_end_in_sight():
    said = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        found = remaining_life(wear("none", 1000, 800, 0.4, rng), 0.16, 4.0, rng)
        said.append(found.verdict)
    assert sum("no end in sight" in text for text in said) >= 7


def test_of_few_runs_that_hardly_tell_it_is_not_said_when():
    """Thirty runs of no wear, each known to three of the four scatters that it may reach."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        found = remaining_life(3.0 * rng.standard_normal(30), 9.0, 4.0, rng)
        assert found.quantile(0.95) > 10.0 * found.quantile(0.05)
        assert "cannot tell when it ends" in found.verdict


def test_wear_either_way_ends_life():
    rng = np.random.default_rng(2)
    up = wear("linear", 1000, 700, 0.2, rng)
    ends = [remaining_life(sign * up, 0.04, 4.0, np.random.default_rng(3)) for sign in (1, -1)]
    assert ends[0].quantile(0.5) == pytest.approx(ends[1].quantile(0.5), rel=0.1)


def test_missing_runs_and_blocks_change_little():
    rng = np.random.default_rng(4)
    seen = wear("linear", 1500, 1000, 0.2, rng)
    whole = remaining_life(seen, 0.04, 4.0, np.random.default_rng(0))
    seen[300:420] = np.nan
    seen[-25:] = np.nan
    part = remaining_life(seen, 0.04, 4.0, np.random.default_rng(0))
    assert part.quantile(0.5) == pytest.approx(whole.quantile(0.5), rel=0.2)


def test_samples_for_progpy():
    rng = np.random.default_rng(5)
    found = remaining_life(wear("linear", 500, 300, 0.2, rng), 0.04, 4.0, rng)
    samples = found.to_progpy("bias of motor_1")
    assert len(samples) == len(found.runs)
    assert sorted(sample["bias of motor_1"] for sample in samples) == found.runs.tolist()


@pytest.mark.parametrize(
    ("level", "variance", "limit"), [(np.zeros(5), 1.0, 4.0), (np.zeros(50), 1.0, 0.0),
                                     (np.zeros(50), 0.0, 4.0)]
)  # fmt: skip
def test_what_makes_no_sense_is_refused(level, variance, limit):
    with pytest.raises(InputError):
        remaining_life(level, variance, limit, np.random.default_rng(0))


def test_a_few_jumps_are_not_taken_for_a_curve():
    """Lives that wear by jumps: late or early in few, though no shape of ours is theirs."""
    holds, late = [], []
    for seed in range(25):
        rng = np.random.default_rng(seed)
        jumps = (rng.random(6000) < 20 / 1200) * rng.exponential(0.2, 6000)
        wear = np.cumsum(jumps)
        end = int(np.flatnonzero(wear >= 4.0)[0])
        now = int(0.3 * end)
        seen = wear[:now] + 0.4 * rng.standard_normal(now)
        seen[-25:] = np.nan
        life = remaining_life(seen, 0.16, 4.0, rng)
        left = end - now
        holds.append(life.quantile(0.05) <= left <= life.quantile(0.95))
        late.append(left < life.quantile(0.05))
    assert np.mean(holds) >= 0.8
    assert np.mean(late) <= 0.1
