"""Senses, zeros and frame of an arm of which nothing is known, found from coarse to fine.

For every set of senses the frame has a closed form; zeros are tried joint by joint only where no
senses bring the poses together. The best few are then fitted. Sets of senses that fit equally well
are one arm seen in two ways: what decides is told with them.

Section: docs/inference.md#calibration-and-geometry
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations, product

import numpy as np

from failuretwin.connection.registration.arm import Arm, Poses, Posterior, Start, fit
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.geometry import with_tool
from failuretwin.inference.set_ups.registration import Frame, align
from failuretwin.inference.set_ups.set_ups import extent
from failuretwin.inference.set_ups.wrong_setup import NEAR

COARSE_POSES = 80
"""So many poses are looked at while senses are searched for."""
COARSE_ROUNDS = 3
"""Rounds of the weights meanwhile."""
MOST_SENSES = 8
"""Motors up to which all sets of senses are tried."""
FINER = 6
"""Sets of senses that are fitted, beside those that differ from the best in one."""
WORTH = 4.0
"""A set of senses this many times farther from the poses than the best is not fitted [-]."""
SURE_NATS = 5.0
"""Log odds from which one set of senses is told to be better than another."""
TURN_NATS = 3.0
"""Log odds of a motor that turns as its profile says against one that does not."""
ZEROS_TRIED = np.arange(0.0, 2.0 * np.pi, np.pi / 6.0)
"""Zeros that are tried where no senses fit [rad]."""
TURNED_WORTH = 0.1
"""Nor is one that differs in one sense and is farther than this share of the poses' extent."""
LEAST_M = 1e-6
"""Distances below this are no difference between senses [m]."""
STARTS, SWEEPS = 6, 3
"""Starts of that search, and rounds over all joints in each."""
SEED = 0


def search(arm: Arm, poses: Poses) -> tuple[Posterior, list[Posterior]]:
    """Return senses, zeros and frame that bring settled poses together.

    They are those of the most probable arm, then of others that the poses cannot tell from it.
    """
    few = poses.spread(COARSE_POSES)
    ranked = _ranked(arm, few)
    if ranked[0].frame.away > NEAR * extent(few.point):
        ranked = _with_zeros(arm, few, ranked)
    found = _fitted(arm, ranked[:FINER], few)
    best = max(found, key=lambda one: _score(arm, one))
    found += [_registered(arm, one, few) for one in _one_turned(arm, few, best)]
    found.sort(key=lambda one: one.told.log_likelihood)
    known = {tuple(one.start.sense.tolist()): one for one in found}
    order = sorted(known.values(), key=lambda one: -_score(arm, one))
    top = order[0]
    ties = [f for f in order[1:] if f.told.log_likelihood > top.told.log_likelihood - SURE_NATS]
    return _registered(arm, _as_start(top), poses), ties


def _fitted(arm: Arm, starts: list[Start], poses: Poses) -> list[Posterior]:
    """Return those fitted that are worth it."""
    nearest = min(start.frame.away for start in starts)
    worth = [c for c in starts if c.frame.away <= max(WORTH * nearest, LEAST_M)]
    return [_registered(arm, start, poses) for start in worth]


def _score(arm: Arm, found: Posterior) -> float:
    """Return the log posterior of senses: the profile's own, and a base that is upright."""
    own = arm.robot.sensor_sense
    turned = int(np.sum(found.start.sense != own))
    upright = found.turn[2, 2] > 0.0
    return found.told.log_likelihood - TURN_NATS * turned + TURN_NATS * upright


def _as_start(found: Posterior) -> Start:
    zero = np.array([found.zero(j) for j in range(found.arm.motors)])
    return Start(found.start.sense, zero, Frame(found.turn, found.origin, found.told.sigma))


def _registered(arm: Arm, start: Start, poses: Poses) -> Posterior:
    return fit(arm, start, arm.frames(), poses)


def _ranked(arm: Arm, poses: Poses) -> list[Start]:
    """Return sets of senses with the zeros of the profile, best first."""
    found = [_placed(arm, poses, sense, arm.start_zero) for sense in _senses(arm)]
    return sorted(found, key=lambda start: start.frame.away)


def _senses(arm: Arm) -> Iterator[FloatArray]:
    own = arm.robot.sensor_sense
    if arm.motors <= MOST_SENSES:
        yield from (own * np.array(signs) for signs in product((1.0, -1.0), repeat=arm.motors))
        return
    for count in range(3):
        for turned in combinations(range(arm.motors), count):
            yield _turned(own, turned)


def _turned(sense: FloatArray, motors: tuple[int, ...]) -> FloatArray:
    return np.where(np.isin(np.arange(len(sense)), motors), -sense, sense)


def _placed(arm: Arm, poses: Poses, sense: FloatArray, zero: FloatArray) -> Start:
    model = with_tool(arm.chain, arm.robot.profile.tool_xyz).position(sense * poses.target + zero)
    return Start(sense, zero, align(model, poses.point, rounds=COARSE_ROUNDS))


def _one_turned(arm: Arm, poses: Poses, best: Posterior) -> list[Start]:
    found = _as_start(best)
    turned = [_turned(found.sense, (j,)) for j in range(arm.motors)]
    placed = [_placed(arm, poses, sense, found.zero) for sense in turned]
    return [one for one in placed if one.frame.away <= TURNED_WORTH * extent(poses.point)]


def _with_zeros(arm: Arm, poses: Poses, ranked: list[Start]) -> list[Start]:
    """Return arms with zeros searched for joint by joint, best first."""
    rng = np.random.default_rng(SEED)
    found: list[Start] = []
    for start in ranked[:STARTS]:
        found.append(_descended(arm, poses, start, rng))
        if found[-1].frame.away <= NEAR * extent(poses.point):
            break
    return sorted([*found, *ranked], key=lambda start: start.frame.away)


def _descended(arm: Arm, poses: Poses, found: Start, rng: np.random.Generator) -> Start:
    """Return the best of what is reached by changing sense and zero of one joint after another."""
    for _ in range(SWEEPS):
        before = found
        for j in rng.permutation(arm.motors):
            tried = [found]
            zeros = [0.0] if arm.slides[j] else ZEROS_TRIED
            for sign, zero in product((1.0, -1.0), zeros):
                sense, zeros_now = found.sense.copy(), found.zero.copy()
                sense[j], zeros_now[j] = sign, (zero + np.pi) % (2.0 * np.pi) - np.pi
                tried.append(_placed(arm, poses, sense, zeros_now))
            found = min(tried, key=lambda start: start.frame.away)
        if found is before:
            break
    return found
