from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from failuretwin.core.movements import Movements
from failuretwin.core.runs import RunTable
from failuretwin.digital_model.nonidealities import Imperfections, Readings, Timing
from failuretwin.digital_model.settling import Settling
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.evidence import Evidence
from failuretwin.inference.observation.healthy_model import HealthyModel

DOF, GLITCH_RATE, ROUGHNESS_M = 4.0, 0.03, 0.002
NOISE_M = 0.0003
"""What is left of the noise where the sensor has none."""
SEEN, UNSEEN = 0.3, 12.0

MOTORS = ("motor_1", "motor_2", "motor_3", "motor_4")
SCATTER = np.array([0.005, 0.006, 0.005, 0.004])
ZERO = (0.0,) * 4
IMPERFECT = Imperfections(
    "made up",
    "test",
    settling=Settling(ZERO, ZERO, ZERO, tuple(SCATTER), 5.0, "made up"),
    timing=Timing(
        delay_s=(0.0, 0.02), lag_s=(0.02, 0.02), ramp_shortening=(0.2, 0.2),
        late_rate=0.2, late_s=(0.6, 1.6),
    ),
    readings=Readings(10.0),
)  # fmt: skip
REACH_M = 0.028505 + 0.0361 + 0.10048 + 0.094714 + 0.05071
STEPS_S = np.linspace(-0.1, 0.4, 21)
"""Delays of one motor that are tried [s]."""


class Case:
    """Runs whose motors follow ramps exactly, and the model that judges them."""

    def __init__(self, twin, late=(0.0, 0.0, 0.0, 0.0), delay=ZERO, slow=(1.0,) * 4):
        rng = np.random.default_rng(3)
        count = len(late)
        starts = np.concatenate([[0.0], 2.0 * np.arange(1, count) + np.cumsum(late)[:-1]])
        self.movements = Movements(
            np.zeros((1, 4)), rng.uniform(-0.8, 0.8, (1, count, 4)),
            np.full((1, count, 4), 0.8), starts[None],
        )  # fmt: skip
        self.late, self.delay, self.slow = np.array(late), np.array(delay), np.array(slow)
        self.twin, self.model = twin, HealthyModel(twin, IMPERFECT)
        time = np.arange(round((starts[-1] + 2.0 + late[-1]) * 100)) * 0.01
        measured = np.full((len(time), 3), np.nan)
        measured[::10] = twin.path(self.angles(time[::10]))
        runs = RunTable(
            run=["run"],
            motor=MOTORS,
            time=time,
            command=self.movements.reference(time),
            measured=measured[None],
            measured_rate_hz=10.0,
        ).to_dataset()
        found = Evidence(runs)
        self.ramps = RunLikelihood(found.settled, self.model, found.transient).transients

    def angles(self, time):
        """Lag, late starts, delays and slowness as told, (time, motor) [rad]."""
        origin, target = self.movements.origin()[0], self.movements.target[0]
        angles = np.zeros((len(time), 4))
        for m, start in enumerate(self.movements.start[0]):
            since = time[:, None] - start - self.model.lag_s - self.late[m] - self.delay
            done = np.clip(since / (0.8 * 0.8 * self.slow), 0.0, 1.0)
            here = origin[m] + done * (target[m] - origin[m])
            angles = np.where(time[:, None] >= start, here, angles)
        return angles

    def compute_posterior(self, movement, origin, destination, duration, delay):
        """Return log densities of one movement over cases; arguments (case, motor)."""
        item = np.array([0]), np.array([movement])
        return self.ramps.log_density(item, origin[None], destination[None], duration[None], delay)[
            0
        ]

    def over(self, movement, motor, *, delays=(0.0,), factors=(1.0,), off=(0.0,)):
        """Return log densities over what one motor may have done (case,)."""
        cases = max(len(delays), len(factors), len(off))
        own = np.eye(4)[motor]
        origin = np.repeat(self.movements.origin()[0, movement][None], cases, axis=0)
        end = self.movements.target[0, movement] + np.multiply.outer(off, own)
        duration = 0.8 * (1.0 + np.multiply.outer(np.array(factors) - 1.0, own))
        delay = np.multiply.outer(delays, own)
        shaped = [np.broadcast_to(x, (cases, 4)).copy() for x in (end, duration, delay)]
        return self.compute_posterior(movement, origin, *shaped)

    def at_rest(self, movement, pose):
        """Return the log density of one movement in which no motor moves."""
        still = np.broadcast_to(pose, (1, 4))
        return self.compute_posterior(
            movement, still, still, np.full((1, 4), 0.8), np.zeros((1, 4))
        )[0]


@pytest.fixture(scope="module")
def punctual(twin):
    return Case(twin)


@pytest.mark.parametrize("motor", range(4))
@pytest.mark.parametrize("delay", [0.0, 0.1, 0.3])
def test_density_is_highest_at_the_true_delay_of_a_motor(twin, motor, delay):
    case = Case(twin, delay=delay * np.eye(4)[motor])
    total = sum(case.over(m, motor, delays=STEPS_S) for m in range(4))
    assert STEPS_S[np.argmax(total)] == pytest.approx(delay, abs=0.03)


@pytest.mark.parametrize("motor", range(4))
def test_density_is_highest_at_the_true_duration(twin, motor):
    factors = np.arange(0.75, 2.5, 0.1)
    case = Case(twin, slow=1.0 + 0.55 * np.eye(4)[motor])
    total = sum(case.over(m, motor, factors=factors) for m in range(4))
    assert factors[np.argmax(total)] == pytest.approx(1.55, abs=0.11)


@pytest.mark.parametrize("motor", range(4))
def test_density_is_highest_at_the_true_end(punctual, motor):
    off = np.linspace(-0.3, 0.3, 13)
    total = sum(punctual.over(m, motor, off=off) for m in range(4))
    assert off[np.argmax(total)] == pytest.approx(0.0, abs=1e-9)


def test_a_common_late_start_is_no_delay_of_a_motor(twin):
    """The second movement starts 1.1 s late: as probable as late starts are, and no less."""
    case, punctual = Case(twin, late=(0.0, 1.1, 0.0, 0.0)), Case(twin)
    assert case.model.late(case.movements)[0].tolist() == [0.0, 1.0, 0.0, 0.2]
    late, usual = case.over(1, 1), punctual.over(1, 1)
    assert late[0] > usual[0] - 4.0
    # If motor 2 alone were late on top of that, it would not be where it was seen.
    assert late[0] > case.over(1, 1, delays=(0.4,))[0] + 4.0


@pytest.mark.parametrize("end_seen", [True, False])
def test_a_motor_at_rest_has_a_closed_form(twin, end_seen):
    """Readings of a tool that stands still are independent Student t, or glitches.

    Where the end of the movement was not seen, the arm may well stand beside it.
    """
    case = Case(twin)
    case.ramps.settled.usable[0, 1] = end_seen
    pose = case.movements.target[0, 1]
    step = 1e-6 * np.eye(4)
    slopes = ((twin.path(pose + step) - twin.path(pose - step)) / 2e-6).T
    variance = (SEEN if end_seen else UNSEEN) * np.sum((slopes * SCATTER) ** 2) / 3.0
    variance += NOISE_M**2 + ROUGHNESS_M**2
    points = case.ramps.moving.point[0, 1, case.ramps.moving.seen[0, 1]]
    kind = stats.multivariate_t(twin.path(pose), variance * np.eye(3), DOF)
    anywhere = 1.0 / (4 / 3 * np.pi * REACH_M**3)
    each = np.log((1 - GLITCH_RATE) * kind.pdf(points) + GLITCH_RATE * anywhere)
    assert case.at_rest(1, pose) == pytest.approx(each.sum(), abs=1e-6)


def test_without_readings_nothing_is_said(punctual):
    blind = Case(punctual.twin)
    blind.ramps.moving.seen[:] = False
    np.testing.assert_allclose(blind.over(1, 0, delays=STEPS_S), 0.0, atol=1e-12)


def test_cases_are_judged_one_by_one(punctual):
    together = punctual.over(2, 1, delays=STEPS_S)
    alone = [punctual.over(2, 1, delays=(step,))[0] for step in STEPS_S]
    np.testing.assert_allclose(together, alone, atol=1e-9)


def test_density_of_a_reading_has_area_one(twin):
    """Summed over spheres around the arm at rest, a single reading is somewhere for sure."""
    case = Case(twin)
    moving, pose = case.ramps.moving, case.movements.target[0, 1]
    moving.seen[:] = False
    moving.seen[0, 1, 3] = True
    radius = np.geomspace(1e-5, 0.2, 200)
    density = np.empty(len(radius))
    for i, r in enumerate(radius):
        moving.point[0, 1, 3] = twin.path(pose) + r * np.array([0.6, 0.0, -0.8])
        density[i] = np.exp(case.at_rest(1, pose))
    area = np.trapezoid(4.0 * np.pi * radius**2 * density, radius)
    inside = GLITCH_RATE * (0.2 / REACH_M) ** 3 + 1.0 - GLITCH_RATE
    assert area == pytest.approx(inside, abs=0.005)
