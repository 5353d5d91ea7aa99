"""Simulated years in the store: what learned rates and histories are tried on."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest
from click.testing import CliRunner

import failuretwin as ft
from failuretwin.app.cli import cli
from failuretwin.app.simulated_years import WEEKS, Years, write_years
from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.workers import Workforce
from failuretwin.digital_model.calibrated_robot import load_calibration

END = datetime(2026, 1, 1, tzinfo=UTC)


@pytest.fixture(scope="module")
def lives(tmp_path_factory):
    """A store with the lives of two robots, and what was said of it."""
    path = tmp_path_factory.mktemp("years") / "robots.db"
    store = ft.open_store(path, create=True)
    years = Years(load_calibration("armpi_fpv"), 0.25, END, seed=3)
    done = []
    said = write_years(store, years, 2, Workforce(1), done.append)
    assert done == [1, 1]
    return store, years, said


def test_lives_are_in_the_store_with_their_days(lives):
    store, years, said = lives
    names = ["armpi_fpv_00000", "armpi_fpv_00001"]
    assert store.robots() == names
    assert said.startswith(f"2 robots, {WEEKS // 2} runs, ")
    faults = store.fleet_faults("armpi_fpv")
    assert faults.hours == 2 * (WEEKS // 4 - 1) * 168.0
    for number, name in enumerate(names):
        life = years.life(number)
        ages = store.motor_ages(name)
        repaired = {one.motor: one.at for one in life.repairs if one.at < life.weeks[-1].at}
        for motor, age in ages.items():
            since = repaired.get(motor, life.weeks[0].at)
            assert age == pytest.approx((life.weeks[-1].at - since).total_seconds() / 3600.0)


def test_wear_makes_faults_more_frequent():
    """Without diagnoses: the hazard of a motor grows with its hours, as Weibull's law says."""
    years = Years(load_calibration("armpi_fpv"), 20.0, END, seed=0)
    object.__setattr__(years, "_season", lambda truths, *_: [None] * len(truths))
    lives = [years.life(number) for number in range(40)]
    repairs = [len(life.repairs) for life in lives]
    assert 1.0 < sum(repairs) / len(repairs) < 40.0
    first = [(life.repairs[0].at - life.weeks[0].at).days for life in lives if life.repairs]
    gaps = len([days for days in first if days < 365.0])
    assert gaps < len(first) / 3  # few in the first of many years


def test_a_store_with_these_robots_is_refused(lives):
    store, years, _ = lives
    with pytest.raises(InputError, match="holds 'armpi_fpv_00000' already"):
        write_years(store, years, 1, Workforce(1), print)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--fleet", "3"), "need --fleet N, --years Y and --store URL"),
        (("--fleet", "3", "--years", "1", "--out", "runs.nc"), "leave out --out"),
        ((), "nothing says where to write"),
    ],
)
def test_what_lives_need_is_said(words, said):
    with pytest.raises(InputError, match=said):
        CliRunner().invoke(cli, ["simulate", *words], catch_exceptions=False, standalone_mode=False)
