"""Groups of faults that no known mode explains, judged by simulated laws and by scipy."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from itertools import combinations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

import failuretwin as ft
from failuretwin.core.hypothesis import MotorResidual
from failuretwin.data_knowledge.records.log_files import LogFile
from failuretwin.data_knowledge.records.unknown_faults import (
    LENGTH,
    MISFIT,
    UnknownEpisode,
    likeness,
    log_evidence,
    unknown_groups,
)
from store_places import diagnosis

DAY = datetime(2026, 3, 2, tzinfo=UTC)


def stop(angle, direction, rng):
    """A stop in the way: nothing beyond 0.4 rad to either side."""
    return np.clip(angle, -0.4, 0.4) - angle


def one_sided(angle, direction, rng):
    return np.where(angle > 0.3, -0.3, 0.0)


def short(angle, direction, rng):
    """Stops short by the direction of travel."""
    return -0.1 * direction


def redrawn(angle, direction, rng):
    return rng.normal(0.0, 0.2, len(angle))


def shifted(angle, direction, rng):
    return np.full(len(angle), 0.15)


def residual(law, rng, times=1.0, motor="motor_2"):
    """Return the residual of a run of five movements; the motor scatters by 0.01 rad."""
    angle, direction = rng.uniform(-1.2, 1.2, 5), rng.choice([-1.0, 1.0], 5)
    moved = times * law(angle, direction, rng) + rng.normal(0.0, 0.01, 5)
    lists = (tuple(v.tolist()) for v in (moved, np.full(5, 0.01), angle, direction))
    return MotorResidual(motor, "rad", *lists)


def episode(law, rng, robot=1, times=1.0):
    """Return an episode of four runs."""
    runs = [residual(law, rng, times) for _ in range(4)]
    names = ("displacement", "deviation", "angle", "direction")
    lists = (np.concatenate([getattr(run, name) for run in runs]) for name in names)
    return UnknownEpisode(robot, "motor_2", "rad", DAY, DAY, 4, *lists)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def test_the_evidence_of_each_law_is_that_of_its_normal_density(rng):
    """Against scipy, with the covariances written out."""
    one, other = episode(stop, rng), episode(stop, rng, times=2.0)
    x = np.concatenate([one.displacement / one.size, other.displacement / other.size])
    angle, way = (
        np.concatenate([getattr(e, n) for e in (one, other)]) for n in ("angle", "direction")
    )
    noise = np.diag(np.repeat([(0.01 / e.size) ** 2 + MISFIT**2 for e in (one, other)], 20))
    by_angle = [[np.exp(-0.5 * ((a - b) / (LENGTH * 2.0)) ** 2) for b in angle] for a in angle]
    laws = [np.ones((40, 40)), by_angle, way[:, None] == way, np.eye(40)]
    prior = np.log([0.3, 0.3, 0.3, 0.1])
    wanted = prior + [multivariate_normal.logpdf(x, cov=np.asarray(law) + noise) for law in laws]
    np.testing.assert_allclose(log_evidence([one, other], 2.0), wanted, rtol=1e-9)


@pytest.mark.parametrize(
    ("law", "told", "sign"),
    [
        (shifted, "constant", "+"),
        (stop, "by angle", "+-"),
        (one_sided, "by angle", "-"),
        (short, "by direction", "+-"),
        (redrawn, "each movement", "+-"),
    ],
)
def test_the_law_and_the_sign_of_a_group_are_told(law, told, sign, rng):
    (group,) = unknown_groups([episode(law, rng, k) for k in range(4)], dict.fromkeys(range(4), ""))
    assert (group.law, group.sign) == (told, sign)
    assert group.alike > 0.6


@pytest.mark.parametrize("laws", [*combinations([stop, one_sided, short, redrawn, shifted], 2)])
def test_two_faults_of_one_motor_are_two_groups(laws, rng):
    """Six robots, each with its own size of one of two faults."""
    sizes = rng.uniform(0.7, 1.4, 6)
    found = [episode(laws[k % 2], rng, k, sizes[k]) for k in range(6)]
    groups = unknown_groups(found, dict.fromkeys(range(6), "arm"))
    assert {frozenset(e.robot for e in g.episodes) for g in groups} == {
        frozenset({0, 2, 4}),
        frozenset({1, 3, 5}),
    }


def test_likeness_is_symmetric_and_told_in_pairs(rng):
    some = [episode(stop, rng), episode(short, rng), episode(stop, rng)]
    found = likeness(some)
    assert found[1] > 0.9 > 0.1 > max(found[0], found[2])
    np.testing.assert_allclose(likeness(some[::-1]), found[[2, 1, 0]])


# From diagnoses in a store.


@pytest.fixture
def store(place):
    return ft.open_store(place.url, create=True)


def unknown(law, rng, times=1.0, motor="motor_2"):
    told = diagnosis("run", "healthy", 0.0, residual=residual(law, rng, times, motor))
    return replace(told, posterior={"healthy": 0.02, "unknown": 0.98})


def live(store, robot, *found, profile=None):
    """Remember a diagnosis a day."""
    for day, one in enumerate(found):
        log = LogFile(f"{robot} {day}", f"{robot} {day}", 1, DAY + timedelta(days=day))
        store.remember([one], robot, log=log, profile=profile)


def test_groups_are_listed_with_what_a_person_needs(store, armpi, rng):
    """Two faults of motor 2 and one of motor 3; single, healthy and known runs are in none."""
    for robot in ("a", "b", "c"):
        live(store, robot, *(unknown(stop, rng) for _ in range(3)), profile=armpi)
    live(store, "d", *(unknown(shifted, rng) for _ in range(4)), profile=armpi)
    live(store, "e", *(unknown(short, rng, motor="motor_3") for _ in range(2)), profile=armpi)
    live(store, "f", unknown(stop, rng), diagnosis("run", "healthy"), unknown(stop, rng))
    live(store, "g", diagnosis("run", "healthy"), diagnosis("run", "motor_2:stuck"))
    answer = store.query("unknown-faults")
    rows = [dict(zip(answer.columns, row, strict=True)) for row in answer.rows]
    told = {(r["motor"], r["episodes"], r["runs"], r["robots"], r["sign"], r["law"]) for r in rows}
    assert told == {
        ("motor_2", 3, 9, 3, "+-", "by angle"),
        ("motor_2", 1, 4, 1, "+", "constant"),
        ("motor_3", 1, 2, 1, "+-", "by direction"),
    }
    assert {row["kind"] for row in rows} == {"armpi_fpv"}
    (bias,) = (row for row in rows if row["law"] == "constant")
    assert bias["size"] == "8.6 deg"
    assert (bias["since"], bias["until"], bias["alike"]) == (DAY, DAY + timedelta(days=3), None)


def test_another_diagnosis_of_a_run_replaces_the_unknown_one(store, rng):
    found = [unknown(stop, rng), unknown(stop, rng)]
    live(store, "a", *found)
    assert len(store.query("unknown-faults").rows) == 1
    live(store, "a", diagnosis("run", "motor_2:backlash"))
    assert store.query("unknown-faults").rows == ()
