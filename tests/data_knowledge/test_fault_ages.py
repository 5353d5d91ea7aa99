"""Confirmed faults by the age of the motor, judged by lives that are written out."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import pytest

import failuretwin as ft
from failuretwin.connection.fault_rates import WEIGHT, LearnedRates
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.data_knowledge.records.log_files import LogFile
from store_places import diagnosis

START = datetime(2026, 1, 1, tzinfo=UTC)
MOTORS = [f"motor_{k}" for k in range(1, 5)]


def live(store, robot, profile, *days):
    """Remember a diagnosis at each day, and confirm every fault."""
    for day, name in days:
        log = LogFile(f"{robot} {day}", f"{robot} {day}", 1, START + timedelta(days=day))
        done = store.remember([diagnosis("run", name)], robot, log=log, profile=profile)
        for one in done.episodes:
            if one.until is None:
                store.found(robot, one.number, "confirmed")


@pytest.fixture
def store(place, armpi):
    """100 days of a robot whose motor 1 is repaired on day 10."""
    store = ft.open_store(place.url, create=True)
    stuck, well = "motor_1:stuck", "healthy"
    first = [(0, well), (3, stuck), (4, well), (12, stuck), (13, well)]
    live(store, "arm_7", armpi, *first, (60, stuck), (61, well), (100, well))
    store.repaired("arm_7", "motor_1", at=START + timedelta(days=10))
    return store


def test_time_at_risk_and_faults_are_those_of_each_age(store):
    """Motor 1 was 10 and 90 days old; the others 100. Bands end at 7 and 91 days."""
    bands = store.fleet_faults("armpi_fpv").by_age
    told = {
        motor: [(band.hours / 24.0, band.confirmed.get("motor_1:stuck", 0)) for band in of_motor]
        for motor, of_motor in bands.items()
    }
    assert told["motor_1"] == [(7.0 + 7.0, 2), (3.0 + 83.0, 1), (0.0, 0)]
    assert told["motor_2"] == told["motor_4"] == [(7.0, 0), (84.0, 0), (9.0, 0)]
    ages = store.motor_ages("arm_7")
    assert ages == {"motor_1": 24.0 * 90.0, **dict.fromkeys(MOTORS[1:], 24.0 * 100.0)}
    assert store.motor_ages("arm_8") == {}


def test_the_rate_of_a_motor_is_that_of_its_age(store):
    """Gamma-Poisson by hand, with the table's 10 faults of a motor in 1000 h, shared by 2 modes."""
    seen, table = store.fleet_faults("armpi_fpv"), 0.005
    for age_h, count, hours in ((10.0, 2, 336.0), (500.0, 1, 2064.0), (3000.0, 0, 0.0)):
        learned = LearnedRates.of(seen, paper_hypotheses(MOTORS), {"motor_1": age_h})
        rate = (WEIGHT + count) / (WEIGHT / table + hours)
        assert learned.factors["motor_1:stuck"] == pytest.approx(rate / table)
        all_ages = WEIGHT / (WEIGHT / table + 2400.0)
        counted = sum(one.confirmed for one in learned.rates)
        told = f"{counted} of 3 confirmed faults of " if counted < 3 else "3 confirmed faults of "
        assert learned.line.startswith(told)
        assert learned.factors["motor_2:stuck"] == pytest.approx(all_ages / table)


def test_faults_by_age_are_a_ready_question(store):
    answer = store.query("rates-by-age")
    rows = [row for row in answer.rows if row[1] == "motor_1"]
    assert rows == [
        ("armpi_fpv", "motor_1", "0 to 7", 14.0, 2, pytest.approx(1000.0 * 2 / 336.0)),
        ("armpi_fpv", "motor_1", "7 to 91", 86.0, 1, pytest.approx(1000.0 / 2064.0)),
    ]
    assert [row[2] for row in answer.rows if row[1] == "motor_2"] == [
        "0 to 7",
        "7 to 91",
        "from 91",
    ]


def test_withdrawing_a_wrong_confirmation_restores_the_priors_bit_for_bit(store, armpi):
    hypotheses, ages = paper_hypotheses(MOTORS), store.motor_ages("arm_7")

    def factors():
        return LearnedRates.of(store.fleet_faults("armpi_fpv"), hypotheses, ages).factors

    store.withdraw("arm_7", 3)
    before = factors()
    store.found("arm_7", 3, "confirmed")
    moved = {name: after / before[name] for name, after in factors().items()}
    assert moved.pop("motor_1:stuck") == pytest.approx(1.0 + 1.0 / WEIGHT)
    assert set(moved.values()) == {1.0}
    store.withdraw("arm_7", 3)
    assert factors() == before
