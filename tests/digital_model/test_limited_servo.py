from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import cont2discrete, lfilter

from failuretwin.digital_model.servo import ServoLoop, respond, respond_limited

LOOP = ServoLoop(P=0.25, I=30.0, filter_s=0.011)
STEP_S = 0.002
TIME = np.arange(0.0, 0.8, STEP_S)


def limited(travel, limit, ramp_s=0.02, loop=LOOP):
    reference = 0.3 + travel * np.clip(TIME / ramp_s, 0.0, 1.0)
    gains = np.array([[loop.P, loop.I, loop.filter_s]])
    return respond_limited(gains, np.array([limit]), reference[None, None], STEP_S)[0, 0]


def test_without_a_limit_it_is_the_published_loop():
    loops = [LOOP, ServoLoop(P=0.1, I=15.0, filter_s=0.02)]
    reference = 0.3 + np.clip(np.stack([TIME / 0.02, TIME / 0.3], axis=1), 0.0, 1.0)
    angles = respond(loops, np.stack([reference, -reference]), STEP_S)
    for motor, loop in enumerate(loops):
        tau, begin = loop.filter_s, reference[0, motor]
        transfer = [loop.P, loop.I], [tau**2, 2.0 * tau, 1.0 + loop.P, loop.I]
        b, a, _ = cont2discrete(transfer, STEP_S, method="foh")
        expected = begin + lfilter(b.ravel(), a, reference[:, motor] - begin)
        assert angles[0, :, motor] == pytest.approx(expected, abs=1e-9)
        assert angles[1, :, motor] == pytest.approx(-expected, abs=1e-9)


def test_variants_and_tests_do_not_mix():
    gains = np.array([[0.25, 30.0, 0.011], [0.1, 15.0, 0.02]])
    limit = np.array([4.0, 3.0])
    ramp = np.clip(TIME / 0.02, 0.0, 1.0)
    reference = np.array([0.5, 2.0])[:, None] * ramp + np.zeros((2, 1, 1))
    together = respond_limited(gains, limit, reference, STEP_S)
    for v in range(2):
        for t in range(2):
            single = reference[v : v + 1, t : t + 1]
            alone = respond_limited(gains[v : v + 1], limit[v : v + 1], single, STEP_S)
            assert together[v, t] == pytest.approx(alone[0, 0], abs=1e-12)


@pytest.mark.parametrize("travel", [2.0, -2.0])
def test_a_large_step_runs_at_the_limit(travel):
    speed = np.diff(limited(travel, 4.0)) / STEP_S
    assert np.abs(speed).max() == pytest.approx(4.0, rel=1e-3)
    assert np.mean(np.abs(speed) > 3.99) > 0.4


def test_nothing_winds_up():
    free, slow = limited(2.0, np.inf), limited(2.0, 4.0)
    assert slow.max() <= free.max() + 1e-9
    assert slow[-1] == pytest.approx(2.3, abs=1e-4)


def test_an_integrator_of_other_people_says_the_same():
    travel, limit, ramp_s = 1.5, 4.0, 0.02

    def slope(t, x):
        reference, moving = travel * min(t / ramp_s, 1.0), travel / ramp_s * (t < ramp_s)
        speed = (x[1] - x[2]) / LOOP.filter_s
        asked = LOOP.P * (moving - speed) + LOOP.I * (reference - x[2])
        return [np.clip(asked, -limit, limit), (x[0] - x[1]) / LOOP.filter_s, speed]

    solved = solve_ivp(slope, (0.0, 0.8), [0.0] * 3, max_step=5e-4, rtol=1e-8, t_eval=TIME)
    assert limited(travel, limit) == pytest.approx(0.3 + solved.y[2], abs=1e-4)
