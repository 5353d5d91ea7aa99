"""Readings that say nothing of the motors: motion without a command, two robots on one topic."""

from __future__ import annotations

import numpy as np
import pytest

from failuretwin import BayesDiagnoser
from failuretwin.app.shadow import Shadow
from failuretwin.connection.links.replay import (
    AS_FAST_AS_POSSIBLE,
    Pace,
    PacedSource,
    session_events,
)
from failuretwin.data_knowledge.readers.raw_sessions import read_session
from failuretwin.decision.streaming.monitor import FaultMonitor
from failuretwin.decision.streaming.trouble import FrozenSensorDetector, TwoPlaces, UntoldMotion

UNTOLD = "the tool moves though no command came"
TWO = "readings jump between two places"
TOLD = np.array([True])
NEAR_M = 0.002, 0.02


def told_place(place):
    """Return what says where tools were told to go."""
    return lambda some: np.broadcast_to(place, (len(some), 3))


def undecided(watcher, samples):
    """Return when it was said that nothing can be said, and why, (time, reason)."""
    rows = []
    for sample in samples:
        answer = watcher.update(*sample)
        if answer.diagnosis is not None:
            rows.append((answer.time, answer.diagnosis.undecided))
    return rows


def test_an_arm_that_moves_on_without_commands_is_told_at_once(watcher, work):
    """And not before; it stands until a command comes, and nothing of it is taken for a fault."""
    samples = work(14)
    last = next(i for i, (t, *_) in enumerate(samples) if t > 0.5 + 2.04 * 6 - 0.05)
    silent = [(t, samples[last][1], point) for t, _, point in samples[last:]]
    rows = undecided(watcher, [*samples[:last], *silent])
    moved = samples[last][0]
    assert not any(reason for at, reason in rows if at <= moved)
    told = [at for at, reason in rows if reason.startswith(UNTOLD)]
    assert told[0] < moved + 1.0
    assert all(reason for at, reason in rows if at >= told[0])
    assert watcher.update(60.0, None, None).alarm.state == "clear"


def test_an_arm_that_nobody_commands_is_told(watcher, work):
    rows = undecided(watcher, [(t, np.zeros(4), point) for t, _, point in work(4)])
    assert rows[0][1].startswith(UNTOLD)
    assert rows[0][0] < 1.5


def test_a_command_ends_it(watcher, work):
    samples = work(12)
    rest = samples[64][1]  # before the fourth movement, which is not told of
    rows = undecided(watcher, [(t, rest if 6.4 < t < 8.6 else c, p) for t, c, p in samples])
    assert any(reason.startswith(UNTOLD) for _, reason in rows)
    assert not rows[-1][1]


def test_two_robots_on_one_topic_are_told(watcher, work):
    one, two = work(8), work(8)
    both = [
        (t, c, p if k % 2 else q)
        for k, ((t, c, p), (_, _, q)) in enumerate(zip(one, two, strict=True))
    ]
    rows = undecided(watcher, both)
    assert {reason[:32] for at, reason in rows if at > 3.0} == {TWO}


@pytest.mark.parametrize("pattern", ["ab", "aab", "abb", "aabb"])
def test_two_robots_may_speak_at_any_rate(pattern):
    places = {"a": np.zeros((1, 3)), "b": np.full((1, 3), 0.1)}
    seen, told = TwoPlaces.empty(run=1, axis=3), []
    for k in range(60):
        told.append(bool(seen.see(places[pattern[k % len(pattern)]], 0.02)[0]))
    assert told[-1] == (pattern != "aabb")
    alone = [bool(seen.see(places["a"], 0.02)[0]) for _ in range(301)]
    assert alone[200] == told[-1]  # one that pauses is still there
    assert not alone[-1]


def test_a_glitch_is_neither(rng):
    """A reading or two that lie elsewhere, now and then."""
    jumps, untold = TwoPlaces.empty(run=1, axis=3), UntoldMotion.empty(run=1, axis=3)
    rest = np.zeros((1, 3))
    for k in range(400):
        point = np.full((1, 3), 0.1) if k % 20 in (3, 4) or k % 33 == 7 else rest
        assert not jumps.see(point, 0.02)[0]
        untold.see(np.array([0.1 * k]), point, rest, TOLD, ~TOLD, TOLD, NEAR_M, told_place(0.0))
        assert not untold.untold[0]


def test_a_movement_that_is_under_way_is_no_motion_without_a_command():
    seen = UntoldMotion.empty(run=1, axis=3)
    nowhere = np.full((1, 3), np.nan)
    for k in range(50):
        point = np.full((1, 3), 0.01 * k)
        seen.see(np.array([0.1 * k]), point, nowhere, TOLD, ~TOLD, TOLD, NEAR_M, told_place(0.0))
    assert not seen.untold[0]


@pytest.mark.parametrize(("aim", "untold"), [(0.3, False), (-0.3, True), (0.0, True)])
def test_a_lost_command_that_is_sent_again_is_a_command(aim, untold):
    """The tool rests elsewhere than it was told to, and goes there; not away from there."""
    seen, rest = UntoldMotion.empty(run=1, axis=3), np.zeros((1, 3))
    for k in range(40):
        point = np.array([[min(max(0.02 * (k - 10), 0.0), 0.3), 0.0, 0.0]])
        aims = told_place(np.array([aim, 0.0, 0.0]))
        seen.see(np.array([0.1 * k]), point, rest, TOLD, ~TOLD, TOLD, NEAR_M, aims)
    assert seen.untold[0] == untold


@pytest.mark.parametrize("moved_after_s", [0.4, 3.0])
def test_a_reading_from_before_a_stall_of_the_bus_shows_no_dead_tool(moved_after_s):
    """It bears the time at which it was asked for, and says where the arm went since then.

    A tool that the next readings show as still, too, while motors are told to move, is dead.
    """
    seen, place, told = FrozenSensorDetector.empty(run=1, axis=3, value=4, motor=4), 0.2, []
    for time in (0.3, *np.arange(2.4, 8.0, 0.1)):
        command = np.full((1, 4), 0.0 if time < moved_after_s else 1.0)
        point = np.full((1, 3), place + 1e-4 * np.sin(time))
        told.append(seen.see(np.array([time]), TOLD, point, command, 0.002)[0][0])
    assert any(told) == (moved_after_s == 3.0)


def test_an_arm_that_lags_after_a_long_rest_is_not_dead():
    """Its axes report the very same number at rest: they are rounded, or without noise."""
    seen, told = FrozenSensorDetector.empty(run=1, axis=3, value=4, motor=4), []
    for time in np.arange(0.0, 8.0, 0.1):
        command = np.full((1, 4), np.clip(time - 4.0, 0.0, 1.0))
        point = np.full((1, 3), 0.2 + 0.1 * np.clip(time - 4.4, 0.0, 1.0))
        told.append(seen.see(np.array([time]), TOLD, point, command, 0.002)[0][0])
    assert not any(told)


FEW = ("healthy", "motor_1:stuck", "motor_3:steady_state_error")


@pytest.mark.parametrize(
    ("label", "hypotheses"),
    [(0, FEW), *(pytest.param(k, None, marks=pytest.mark.slow) for k in range(5))],
)
def test_healthy_sessions_get_no_other_verdict(data, twin, label, hypotheses):
    """Real sessions with lost commands that are sent again and stalls of the bus of seconds."""
    folder = next((data / f"real_robot_b_20241003/label_{label}").iterdir())
    events = session_events(read_session(folder, twin.robot), twin.robot)
    source = PacedSource("session", events, Pace(AS_FAST_AS_POSSIBLE))
    watch = FaultMonitor(BayesDiagnoser(twin, hypotheses=hypotheses, whole_run=False))
    shadow, said = Shadow(source, watch, twin), set()
    while shadow.step(0.0):
        found = shadow.snapshot.answer.diagnosis
        if found is not None:
            said.add(found.undecided or str(found.diagnosis))
    assert said == {"healthy"}


def test_an_arm_that_moves_long_after_it_should_rest_is_told_without_a_rest_seen():
    """Its bus stalled while it rested; it may still be on its way, and then must have arrived."""
    seen, nowhere, first = UntoldMotion.empty(run=1, axis=3), np.full((1, 3), np.nan), None
    for k in range(60):
        point = np.full((1, 3), 0.01 * k)
        overdue = np.array([k > 30])
        seen.see(np.array([0.1 * k]), point, nowhere, TOLD, overdue, TOLD, NEAR_M, told_place(0.0))
        first = k if first is None and seen.untold[0] else first
    assert first == 34


def test_the_first_command_of_a_recording_is_one(watcher, work):
    """Nobody says where the arm stood before it, so its reference does not move."""
    samples = work(6)
    start = next(i for i, (t, *_) in enumerate(samples) if t > 0.5)
    first = [(t, None, p) for t, _, p in samples[:start]]
    told = [(t, samples[start + 10][1], p) for t, _, p in samples[start : start + 10]]
    rows = undecided(watcher, [*first, *told, *samples[start + 10 :]])
    assert not any(reason for _, reason in rows)
