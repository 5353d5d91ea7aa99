"""What the readings on the way say, against scipy reading by reading."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from slide_runs import (
    LAG_S,
    NOISE_M,
    PERIOD_S,
    PLAIN,
    RAMP_S,
    SCATTER_M,
    STARTS_S,
    TARGETS,
)

from failuretwin.digital_model.nonidealities import LostCommand
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.evidence import Evidence
from failuretwin.inference.observation.healthy_model import HealthyModel

TRUST = 0.1
ROUGHNESS_M, JITTER_S = 0.0021, 0.012


def way_by_force(origin, target, moving, movement, spread_m=0.0, doubt=0.3):
    """Log density of the readings on the way of one movement, over when it may have begun.

    A reading is a Student t of 4 degrees of freedom about the ramp, wider along the motion by the
    jitter of its stamp; three in a hundred are anywhere within reach. `doubt` is what the scatter
    of the ends counts: 0.3 where both were seen, 12 where not.
    """
    seen = moving.seen[0, movement]
    since, points = moving.since[0, movement, seen], moving.point[0, movement, seen]
    variance = doubt * SCATTER_M**2 / 3.0 + NOISE_M**2 + ROUGHNESS_M**2 + spread_m**2
    steps = np.array([-0.04, -0.02, 0.0, 0.02, 0.04])
    chance = stats.norm.pdf(steps, scale=0.018)
    total = 0.0
    for step, weight in zip(steps, chance / chance.sum(), strict=True):
        says = 1.0
        for at, point in zip(since - max(LAG_S + step, 0.0), points, strict=True):
            done = np.clip(at / RAMP_S, 0.0, 1.0)
            speed = (target - origin) / RAMP_S if 0.0 < at < RAMP_S else 0.0
            shape = variance * np.eye(3)
            shape[0, 0] += (JITTER_S * speed) ** 2
            place = [origin + done * (target - origin), 0.0, 0.0]
            density = stats.multivariate_t.pdf(point, place, shape, 4.0)
            says *= 0.97 * density + 0.03 / (4.0 / 3.0 * np.pi * 0.3**3)
        total += weight * says
    return np.log(total)


@pytest.mark.parametrize(("late_s", "aside_m"), [(0.0, 0.0), (0.05, 0.0), (0.3, 0.0), (0.0, 0.04)])
def test_the_way_counts_by_a_tenth(slide, run_of, late_s, aside_m):
    """Two in a hundred movements go astray, by a tenth of the reach."""
    runs = run_of(np.array(TARGETS)[:, None], path_to(TARGETS, late_s, aside_m), ("motor_1",))
    settled, moving = Evidence(runs).settled, Evidence(runs).transient
    likelihood = RunLikelihood(settled, HealthyModel(slide, PLAIN), moving)
    assert moving.seen.any(axis=-1).all()
    for m, ends in enumerate(zip([0.0, *TARGETS[:-1]], TARGETS, strict=True)):
        usual, astray = (way_by_force(*ends, moving, m, spread) for spread in (0.0, 0.03))
        assert likelihood.log_transient[0, m] == pytest.approx(trusted(usual, astray), abs=0.02)


def path_to(stands, late_s=0.0, aside_m=0.0):
    """Return the path of a tool that goes from one place to the next, (time, axis) [m].

    Until it is nearly at rest it is off to the side by `aside_m`.
    """

    def path(time):
        since = time[:, None] - STARTS_S - LAG_S - late_s
        along = np.clip(since / RAMP_S, 0.0, 1.0) @ np.diff([0.0, *stands])
        moving = ((since > 0.0) & (since < 1.35)).any(axis=1)
        return np.stack([along, aside_m * moving, 0.0 * along], axis=-1)

    return path


def trusted(usual, astray):
    return np.logaddexp(np.log(0.98) + TRUST * usual, np.log(0.02) + TRUST * astray)


@pytest.mark.parametrize("unseen", [1, 2])
@pytest.mark.parametrize("lost", [False, True])
def test_the_way_after_tells_where_an_unseen_movement_ended(slide, run_of, lost, unseen):
    """A command in ten gets lost; from where the next movement began it is seen whether one did."""
    stands = list(TARGETS)
    if lost:
        stands[unseen] = stands[unseen - 1]
    path = path_to(stands)

    def gap(time):
        begin = PERIOD_S * unseen
        hidden = (time > begin - 0.005) & (time < begin + PERIOD_S - 0.005)
        return np.where(hidden[:, None], np.nan, path(time))

    runs = run_of(np.array(TARGETS)[:, None], gap, ("motor_1",))
    lossy = replace(PLAIN, lost_commands=(LostCommand(("motor_1",), 0.1, 0.1),))
    settled, moving = Evidence(runs).settled, Evidence(runs).transient
    assert moving.seen.any(axis=-1)[0].tolist() == [m != unseen for m in range(4)]
    likelihood = RunLikelihood(settled, HealthyModel(slide, lossy), moving)
    after = unseen + 1
    says = [
        way_by_force(place, stands[after], moving, after, doubt=12.0)
        for place in (TARGETS[unseen], TARGETS[unseen - 1])
    ]
    together = np.logaddexp(np.log(0.99 * 0.9) + says[0], np.log(0.99 * 0.1) + says[1])
    luck = trusted(together - max(says), 0.0)
    assert likelihood.log_transient[0, unseen] == pytest.approx(luck, abs=0.01)
    assert likelihood.log_transient[0, after] == pytest.approx(
        0.1 * max(says) + np.log(0.98), abs=0.1
    )
