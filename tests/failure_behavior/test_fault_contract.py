"""What every fault mode must keep, also the one that the documentation offers for copying."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import HEALTHY
from failuretwin.data_knowledge.generate import Plan, simulate_runs
from failuretwin.digital_model.nonidealities import NO_IMPERFECTIONS
from failuretwin.failure_behavior.fault import PROFILES, Arrival
from failuretwin.failure_behavior.mode import Signature
from failuretwin.failure_behavior.modes import Drift
from failuretwin.failure_behavior.registry import MODES

TIME = np.arange(1000) * 0.01
STARTS = 2.0 * np.arange(5)
ENDS = np.arange(200, 1001, 200) - 1
"""Last samples of the five plateaus."""
FROM_PAGE = "bent_shaft"
ALLOWED = {
    **{name: mode.allowed_profiles for name, mode in MODES.items()},
    FROM_PAGE: PROFILES,
}
ON_MOVEMENTS = ("steady_state_error", "slow", "lost_commands")
"""Modes that take the severity when a movement starts and keep it until the next one."""


def each_mode_with(*profiles):
    """Run a test for every mode with each of the profiles that it has."""
    pairs = [(name, p) for name, allowed in ALLOWED.items() for p in profiles if p in allowed]
    return pytest.mark.parametrize(("mode", "profile"), pairs, indirect=["mode"])


@pytest.fixture(params=ALLOWED)
def mode(request, template):
    return template if request.param == template.mode else MODES[request.param]


@pytest.fixture
def simulate(mode, runs_of, sagging):
    """Simulate runs with a mode, or without, of an arm in which it can show."""
    world = sagging if mode.needs_compliance else NO_IMPERFECTIONS
    return lambda mode=None, **options: runs_of(mode, imperfections=world, **options)


def sized(mode, magnitude):
    """Return the mode with fixed magnitude; without one (stuck), as it is."""
    return replace(mode, magnitude=(magnitude,) * 2) if hasattr(mode, "magnitude") else mode


def details(runs):
    return [detail["faults"][0] for detail in runs.truth.detail]


def assert_same(runs, others):
    for name in ("command", "measured", "position"):
        np.testing.assert_array_equal(getattr(runs, name), getattr(others, name))


@each_mode_with(*PROFILES)
def test_no_magnitude_is_healthy_bit_for_bit(mode, simulate, profile):
    nothing = sized(replace(mode, profiles=(profile,)), 0.0)
    if mode.mode == "stuck":
        nothing = replace(nothing, onset_s=(20.0, 20.0))
    assert_same(simulate(nothing), simulate())


@each_mode_with(*PROFILES)
def test_same_seed_same_bytes(mode, simulate, profile):
    chosen = replace(mode, profiles=(profile,))
    one, same, other = simulate(chosen), simulate(chosen), simulate(chosen, seed=2)
    for name in ("command", "measured", "position"):
        assert getattr(one, name).tobytes() == getattr(same, name).tobytes()
    assert details(one) == details(same)
    assert all(a != b for a, b in zip(details(one), details(other), strict=True))


@each_mode_with(*PROFILES)
@pytest.mark.parametrize("motor", ["motor_2", "motor_4"])
def test_only_its_motor_changes_and_only_after_the_onset(mode, simulate, profile, motor):
    runs = simulate(replace(mode, profiles=(profile,), onset_s=(2.0, 6.0)), motor=motor)
    healthy = simulate()
    change = np.abs(runs.position - healthy.position)

    np.testing.assert_array_equal(runs.command, healthy.command)
    after = runs.truth.onset[:, None] <= TIME
    own = runs.motor.index(motor)
    assert not change[~after].any()
    assert (change[after][:, own] > 0.01).any()
    # As one motor gives way, the load of the others shifts by some hundredths of that.
    shifted = 0.1 * change[..., own].max() if runs.truth.fault[0].endswith("torque_loss") else 0.0
    assert np.delete(change, own, axis=-1).max() <= shifted


def test_truth_has_the_declared_unit_and_all_parameters(mode, simulate):
    every = replace(mode, profiles=mode.allowed_profiles, onset_s=(1.0, 4.0))
    runs = simulate(every, count=40)
    low, high = getattr(mode, "magnitude", (0.0, np.inf))
    shapes = set()
    for i, detail in enumerate(details(runs)):
        assert json.loads(json.dumps(detail, allow_nan=False)) == detail
        assert (detail["motor"], detail["mode"]) == ("motor_2", mode.mode)
        assert detail["unit"] == mode.unit
        assert detail["onset_s"] == runs.truth.onset[i]
        assert detail["magnitude"] == runs.truth.magnitude[i]
        assert 1.0 <= detail["onset_s"] <= 4.0
        if mode.mode != "steady_state_error":  # its size is that of all movements together
            assert low <= abs(detail["magnitude"]) <= high
        shapes.add(detail["profile"]["shape"])
    assert shapes == set(mode.allowed_profiles)


def deviation(runs, healthy, first_s, last_s):
    """Return the mean distance from the healthy motion of motor 2 within a time [rad]."""
    part = (first_s <= TIME) & (last_s > TIME)
    return np.abs(runs.position - healthy.position)[:, part, 1].mean()


@each_mode_with("ramp")
def test_a_ramp_grows_to_what_a_step_is_at_once(mode, simulate, profile):
    slow = replace(mode, profiles=(profile,), onset_s=(0.0, 0.0), rise_s=(6.0, 6.0))
    ramp, step, healthy = (
        simulate(m, count=80) for m in (slow, replace(slow, profiles=("step",)), None)
    )
    # The first movement is struck at its start, when the ramp is still at nothing.
    early = (2.0, 4.0) if mode.mode in ON_MOVEMENTS else (0.0, 2.0)
    assert 0.0 < deviation(ramp, healthy, *early) < 0.6 * deviation(step, healthy, *early)
    late = deviation(ramp, healthy, 8.0, 10.0), deviation(step, healthy, 8.0, 10.0)
    if mode.mode == "drift":  # half of the rise is lost for good
        assert late[0] / late[1] == pytest.approx((9.0 - 3.0) / 9.0, rel=0.02)
    else:  # where a lost command leaves the motor hangs on those lost before
        tolerance = 0.2 if mode.mode == "lost_commands" else 0.1
        assert late[0] == pytest.approx(late[1], rel=tolerance)


def in_episodes(detail, time):
    inside = [(start <= time) & (time < end) for start, end in detail["profile"]["episodes_s"]]
    return np.any(inside, axis=0)


@each_mode_with("intermittent")
def test_intermittent_comes_and_goes(mode, simulate, profile):
    chosen = replace(mode, profiles=(profile,), onset_s=(1.0, 3.0), episode_s=(0.8, 1.5))
    runs, healthy = simulate(chosen, count=40), simulate(count=40)
    change = (runs.position - healthy.position)[..., 1]
    worst, quiet = {True: 0.0, False: 0.0}, 0
    for i, detail in enumerate(details(runs)):
        assert detail["profile"]["episodes_s"][0][0] == detail["onset_s"]
        there = in_episodes(detail, TIME)
        if mode.mode in ON_MOVEMENTS:
            there = np.repeat(in_episodes(detail, STARTS), 200)
        # Ramps take a second at most; soon after that all transients have died down.
        well_after = np.convolve(there, np.ones(120))[: len(TIME)] == 0
        shift = np.diff(change[i], prepend=0.0) if mode.mode == "drift" else change[i]
        for where, part in ((True, there), (False, well_after)):
            worst[where] = max(worst[where], np.abs(shift[part]).max(initial=0.0))
        quiet += np.count_nonzero(well_after & (detail["onset_s"] <= TIME))
    assert worst[False] < 1e-3 * worst[True]
    assert quiet > 1000


def test_a_motor_settles_where_diagnosis_expects_it(mode, runs_of, sagging):
    """At the end of movements farther than any play; of modes that hold it, of the first one."""
    size = {"slow": 0.2, "intermittent": 1.0, "lost_commands": 1.0}.get(mode.mode)
    shape = "step" if "step" in mode.allowed_profiles else "intermittent"
    chosen = replace(mode, profiles=(shape,), onset_s=(0.0, 0.0))
    settling = replace(sagging.settling, compliance=(0.05,) * 4)  # so stiff that loads stay
    world = replace(sagging, settling=settling) if mode.needs_compliance else NO_IMPERFECTIONS
    runs = runs_of(sized(chosen, size) if size else chosen, imperfections=world, count=20)
    healthy = runs_of(imperfections=world, count=20)
    origin = np.stack([run[ENDS - 200, 1] for run in runs.command])
    origin[:, 0], target = 0.0, runs.command[:, ENDS, 1]
    arrival = Arrival(
        origin,
        target,
        np.sign(target - origin),
        TIME[ENDS] + 0.01,
        (healthy.position - healthy.command)[:, ENDS, 1],
    )
    said = [detail.get("offset_rad", detail["magnitude"]) for detail in details(runs)]
    size = np.reshape(said, (len(said), -1)).astype(float)
    expected = np.broadcast_to(mode.settled_offset(size, arrival), target.shape)
    found = (runs.position - healthy.position)[:, ENDS, 1]
    far = np.abs(target - origin) > 0.15
    if mode.signature in (Signature.HELD, Signature.MISSED):
        far[:, 1:] = False
    assert far.sum() >= 6
    np.testing.assert_allclose(found[far], expected[far], rtol=0.05, atol=1e-3)
    assert (np.abs(expected[far]) > 0.01).any() == (mode.signature is not Signature.TRANSIENT)


def test_profiles_that_make_no_sense_are_refused(mode):
    assert mode.allowed_profiles == ALLOWED[mode.mode]
    for profile in {*PROFILES, "sudden"} - set(mode.allowed_profiles):
        with pytest.raises(InputError, match=f"{mode.mode}: unknown profile '{profile}'"):
            replace(mode, profiles=(profile,))


def test_several_faults_act_each_on_its_own_motor(armpi, runs_of):
    drift = Drift(magnitude=(0.03, 0.03), onset_s=(4.0, 4.0))
    modes = {**MODES, "drift": drift}
    text = "motor_1:stuck+motor_3:drift+motor_4:encoder_bias"
    state = type(HEALTHY).parse(text, armpi.motor_names)
    runs = simulate_runs(Plan(armpi, [state], 6, seed=1, modes=modes), range(6))
    change = runs.position - runs_of(count=6).position

    np.testing.assert_array_equal(np.ptp(runs.position[:, 49:, 0], axis=1), 0.0)
    assert not change[..., 1].any()
    np.testing.assert_allclose(np.abs(change[:, -1, 2]), 0.03 * 5.99, rtol=0.01)
    for i, detail in enumerate(runs.truth.detail):
        stuck, slipping, off = detail["faults"]
        assert stuck["magnitude"] == runs.truth.magnitude[i] == runs.position[i, -1, 0]
        assert slipping["magnitude"] == pytest.approx(np.sign(change[i, -1, 2]) * 0.03)
        assert off["magnitude"] == pytest.approx(change[i, -1, 3], abs=1e-4)
        assert runs.truth.onset[i] == min(f["onset_s"] for f in detail["faults"])
