"""Simulated years of a fleet, into the store: wear, repairs, payloads, temperature, shifts.

Each robot makes a check run a week, which is simulated and diagnosed. A motor fails with the hazard
of a Weibull law in its own working hours,

    P(t) = 1 - exp(-(t (1 + 2 payload share + heat) / 30,000 h)^2)

half of the times it sticks, else it misses its targets; a person finds and repairs it days later,
and states what the alarms were worth. All constants are assumed.

Section: docs/fleet.md#simulated-years
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import partial

import numpy as np

from failuretwin.core.errors import InputError, counted
from failuretwin.core.hypothesis import Diagnosis, Hypothesis
from failuretwin.core.progress import Progress
from failuretwin.data_knowledge.generate import Plan, simulate_runs
from failuretwin.data_knowledge.records.episodes import CONFIRMED
from failuretwin.data_knowledge.records.history import WRONG
from failuretwin.data_knowledge.records.log_files import LogFile
from failuretwin.data_knowledge.records.store import Store
from failuretwin.data_knowledge.workers import Workforce
from failuretwin.digital_model.calibrated_robot import CalibratedRobot
from failuretwin.digital_model.nonidealities import Imperfections, vary
from failuretwin.inference.diagnoser import BayesDiagnoser

WEEKS, SEASON = 52, 13
"""Weeks of a year, and weeks for which wear and temperature count as constant."""
LIFE_H, SHAPE = 30_000.0, 2.0
"""Scale [h] and shape of the Weibull law of a motor without payload at 20 degrees."""
MODES = ("stuck", "steady_state_error")
FOUND_DAYS, FOUND_SPREAD = 6.0, 0.7
"""Median time until a person repairs a fault [days], and the deviation of its logarithm."""
SHIFTS_H = (40.0, 80.0, 120.0)
"""Working hours of a week in one, two and three shifts [h]."""
LARGEST_PAYLOAD_KG = 0.05
SUMMER_DEG, WEATHER_DEG = 8.0, 2.0
"""Half the difference of summer and winter, and its deviation [degC]."""
HEAT_PER_DEG, SOFTER_PER_DEG = 0.03, 0.01
"""Growth of the hazard and of the compliance per degree above 20 [1/degC]."""
WORN_SCATTER = 0.5
"""Growth of a motor's scatter over one scale of its life."""
PERSON = "simulated technician"


@dataclass(frozen=True)
class Repair:
    """A motor that was repaired, and when (UTC)."""

    motor: str
    at: datetime


@dataclass(frozen=True)
class Week:
    """A check run: when (UTC), the true fault (empty: healthy), and its diagnosis."""

    at: datetime
    truth: str
    diagnosis: Diagnosis


@dataclass(frozen=True)
class Life:
    """What one robot went through."""

    weeks: list[Week]
    repairs: list[Repair]


@dataclass(frozen=True)
class Years:
    """A fleet and the years that it works.

    Attributes:
        known: The robot, with its healthy behaviour.
        years: How long it works [a].
        end: When the years end (UTC).
        seed: Seed of all chance.
    """

    known: CalibratedRobot
    years: float
    end: datetime
    seed: int

    def life(self, number: int) -> Life:
        """Return the life of a robot, by its number."""
        rng = np.random.default_rng([self.seed, number])
        names = self.known.robot.motor_names
        weeks = round(self.years * WEEKS)
        hours = float(rng.choice(SHIFTS_H))
        payload = float(rng.uniform(0.0, LARGEST_PAYLOAD_KG))
        own = vary(self.known.imperfections, rng)
        phase, start = rng.uniform(0.0, 2.0 * np.pi), self.end - timedelta(weeks=weeks)
        worn, left = np.zeros(len(names)), rng.weibull(SHAPE, len(names)) * LIFE_H
        truths, repairs, healthy_from = list[str](), list[Repair](), start
        seasons: list[tuple[np.ndarray, float]] = []
        for week in range(weeks):
            at = start + timedelta(weeks=week)
            warm = SUMMER_DEG * math.sin(2.0 * np.pi * week / WEEKS + phase)
            warm += WEATHER_DEG * float(rng.standard_normal())
            if week % SEASON == 0:
                seasons.append((worn.copy(), warm))
            stress = 1.0 + 2.0 * payload / LARGEST_PAYLOAD_KG + max(0.0, HEAT_PER_DEG * warm)
            worn += hours
            left -= hours * stress
            motor = int(np.argmin(left))
            if left[motor] <= 0.0 and at >= healthy_from:
                fault = f"{names[motor]}:{rng.choice(MODES)}"
                days = FOUND_DAYS * float(np.exp(FOUND_SPREAD * rng.standard_normal()))
                healthy_from = at + timedelta(days=days)
                repairs.append(Repair(names[motor], healthy_from))
                worn[motor], left[motor] = 0.0, rng.weibull(SHAPE) * LIFE_H
            truths.append(fault if at < healthy_from else "")
        diagnoses = [
            diagnosis
            for k, (wear, warm) in enumerate(seasons)
            for diagnosis in self._season(
                truths[k * SEASON : (k + 1) * SEASON],
                _as_it_is(own, wear, warm, payload),
                int(rng.integers(2**31)),
            )
        ]
        at_each = [start + timedelta(weeks=week) for week in range(weeks)]
        return Life(list(map(Week, at_each, truths, diagnoses)), repairs)

    def _season(
        self, truths: list[str], imperfections: Imperfections, seed: int
    ) -> list[Diagnosis]:
        """Return the diagnoses of check runs, by what is true in each."""
        kinds = sorted(set(truths))
        hypotheses = [Hypothesis.parse(kind or "healthy") for kind in kinds]
        count = len(truths)
        plan = Plan(self.known.robot, hypotheses, count, seed, imperfections)
        numbers = [kinds.index(truth) * count + k for k, truth in enumerate(truths)]
        runs = simulate_runs(plan, numbers).to_dataset()
        return BayesDiagnoser(self.known.twin, self.known.imperfections).diagnose(runs)


def _as_it_is(
    own: Imperfections, worn_h: np.ndarray, warm_deg: float, payload_kg: float
) -> Imperfections:
    """Return the healthy behaviour of a robot with its wear, temperature and payload."""
    settling = own.settling
    if settling is None:
        return own
    softer = 1.0 + SOFTER_PER_DEG * warm_deg
    scatter = np.asarray(settling.scatter) * (1.0 + WORN_SCATTER * worn_h / LIFE_H)
    changed = replace(
        settling,
        compliance=tuple(softer * value for value in settling.compliance),
        scatter=tuple(scatter.tolist()),
        payload=settling.payload + payload_kg,
    )
    return replace(own, settling=changed)


def write_years(
    store: Store, years: Years, robots: int, workforce: Workforce, advance: Progress
) -> str:
    """Simulate robots and write their lives into a store, and return what was written.

    Raises:
        InputError: If the store holds robots of these names.
    """
    names = [f"{years.known.robot.name}_{number:05d}" for number in range(robots)]
    known = set(store.robots()) & set(names)
    if known:
        raise InputError(
            f"{store.name}: holds {min(known)!r} already. Expected a store without such robots; "
            "make one: failuretwin store init."
        )
    runs = repaired = confirmed = wrong = 0
    with workforce.map(partial(Years.life, years), range(robots)) as lives:
        for name, life in zip(names, lives, strict=True):
            findings = _write(store, name, life, years)
            runs, repaired = runs + len(life.weeks), repaired + len(life.repairs)
            confirmed, wrong = confirmed + findings[0], wrong + findings[1]
            advance(1)
    return (
        f"{counted(robots, 'robot')}, {runs} runs, {repaired} repairs, {confirmed} episodes "
        f"confirmed, {wrong} found wrong"
    )


def _write(store: Store, name: str, life: Life, years: Years) -> tuple[int, int]:
    """Write a life in the order of its days; return episodes confirmed and found wrong."""
    confirmed = wrong = 0
    repairs = list(life.repairs)
    judged: set[int] = set()
    for week in life.weeks:
        while repairs and repairs[0].at <= week.at:
            one = repairs.pop(0)
            store.repaired(name, one.motor, person=PERSON, at=one.at)
        run = f"check_{week.at:%Y-%m-%d}"
        done = store.remember(
            [replace(week.diagnosis, run=run)],
            name,
            log=LogFile(f"simulated/{name}/{run}", None, 0, week.at),
            profile=years.known.robot,
            command="simulate",
        )
        for episode in done.episodes:
            if episode.raised and episode.number not in judged:
                judged.add(episode.number)
                right = f"{episode.motor}:{episode.mode}" == week.truth
                verdict = CONFIRMED if right else WRONG
                store.found(name, episode.number, verdict, person=PERSON, at=week.at)
                confirmed, wrong = confirmed + right, wrong + (not right)
    for one in repairs:
        store.repaired(name, one.motor, person=PERSON, at=one.at)
    return confirmed, wrong


def last_midnight() -> datetime:
    """Return the begin of today (UTC): when simulated years end."""
    return datetime.now(UTC).replace(hour=0, minute=0, second=0, microsecond=0)
