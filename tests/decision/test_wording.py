from __future__ import annotations

import numpy as np
import pytest

from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import (
    HEALTHY,
    UNKNOWN,
    Diagnosis,
    Fault,
    Hypothesis,
    MovementEvidence,
)
from failuretwin.failure_behavior.mode import FaultMode
from failuretwin.failure_behavior.modes import EncoderBias
from failuretwin.failure_behavior.registry import MODES, register_mode
from failuretwin.inference.explanation import (
    explanation,
    percent,
    plain_name,
    possible_hypotheses,
    size_words,
    verdict,
)
from user_modes import forgotten_afterwards

SIZED = {
    "stuck": (np.deg2rad(-12.3), "motor 3 stuck at -12 deg since 2.5 s, 98 % sure"),
    "steady_state_error": (
        np.deg2rad(4.2),
        "motor 3 misses its targets by about 4.2 deg since 2.5 s, 98 % sure",
    ),
    "slow": (0.4, "motor 3 slow by 40 % since 2.5 s, 98 % sure"),
    "lag": (0.123, "motor 3 late by 0.12 s since 2.5 s, 98 % sure"),
    "backlash": (np.deg2rad(2.0), "motor 3 has play of 2.0 deg since 2.5 s, 98 % sure"),
    "drift": (np.deg2rad(-1.5), "motor 3 drifts by -1.50 deg/s since 2.5 s, 98 % sure"),
    "intermittent": (
        0.3,
        "motor 3 sticks now and then (30 % of the time) since 2.5 s, 98 % sure",
    ),
    "torque_loss": (0.55, "motor 3 weak by 55 % since 2.5 s, 98 % sure"),
    "encoder_bias": (
        np.deg2rad(7.04),
        "motor 3 has a shifted zero by +7.0 deg since 2.5 s, 98 % sure",
    ),
    "encoder_scale": (-0.25, "motor 3 has a wrong scale by -25 % since 2.5 s, 98 % sure"),
    "lost_commands": (0.6, "motor 3 loses commands (60 % of them) since 2.5 s, 98 % sure"),
}
PAIR = Hypothesis.parse("motor_1:stuck+motor_3:drift")


def told(hypothesis, chance=0.98, others=(), **facts):
    """Return the verdict on a hypothesis and others with the rest of the probability."""
    ranked = (hypothesis, *(h for h, _ in others))
    posterior = {str(hypothesis): chance, **{str(h): p for h, p in others}}
    return verdict(Diagnosis("run", posterior, **facts), ranked)


def single(mode):
    return Hypothesis.parse(f"motor_3:{mode}")


@pytest.mark.parametrize("mode", SIZED)
def test_verdicts_say_motor_size_onset_and_how_sure(mode):
    size, expected = SIZED[mode]
    unit = MODES[mode].unit
    assert told(single(mode), onset_s=2.5, magnitude=size, magnitude_unit=unit) == expected


def test_every_mode_has_its_words():
    assert set(SIZED) == set(MODES)


@pytest.mark.parametrize("onset_s", [0.0, 0.04])
@pytest.mark.parametrize("mode", SIZED)
def test_what_was_there_before_the_run_has_no_time(mode, onset_s):
    size, expected = SIZED[mode]
    got = told(single(mode), onset_s=onset_s, magnitude=size, magnitude_unit=MODES[mode].unit)
    before = " since before the run" if mode == "stuck" else ""
    assert got == expected.replace(" since 2.5 s", before)


@pytest.mark.parametrize(
    ("unit", "size", "words"),
    [
        ("rad", 0.05, " (2.86 deg)"),
        ("rad/s", -0.01, " (-0.573 deg/s)"),
        ("m", 0.0025, " (2.5 mm)"),
        ("ratio", 1.0, " (100 %)"),
        ("s", 0.12, " (0.12 s)"),
        ("N m", 1.54, " (1.54 N m)"),
    ],
)
def test_size_and_unit_of_a_registered_mode_are_told_alike(unit, size, words):
    own = {"mode": "bent_shaft", "unit": unit, "size_words": FaultMode.size_words}
    with forgotten_afterwards():
        register_mode(type("BentShaft", (EncoderBias,), own)())
        assert size_words(Fault("motor_3", "bent_shaft"), size) == words


def test_a_mode_that_is_not_known_here_is_told_with_what_to_do():
    with pytest.raises(InputError, match=r"'stuk'\. Did you mean 'stuck'\?.*--plugin"):
        size_words(Fault("motor_3", "stuk"), 0.1)


def test_a_mode_without_words_is_told_by_its_id():
    shaft = Hypothesis.parse("motor_3:bent_shaft+motor_4:drift")
    assert plain_name(shaft) == "motor 3 bent shaft and motor 4 drifts"


def test_a_motor_held_near_zero_is_told_without_a_sign():
    assert size_words(Fault("motor_3", "stuck"), -0.005) == " at 0 deg"


@pytest.mark.parametrize(
    ("onset_90", "words"),
    [((11.8, 12.6), "since 12.3 s (11.8 to 12.6 s), "), ((12.2, 12.4), "since 12.3 s, ")],
)
def test_an_onset_that_is_open_is_told_with_its_interval(onset_90, words):
    facts = {"magnitude": 0.1, "magnitude_unit": "rad", "onset_s": 12.3}
    assert words in told(single("stuck"), onset_90=onset_90, **facts)


def test_two_faults_are_both_named():
    assert told(PAIR, onset_s=1.26) == "motor 1 stuck and motor 3 drifts since 1.3 s, 98 % sure"
    assert told(PAIR, onset_s=0.0) == "motor 1 stuck and motor 3 drifts, 98 % sure"


def test_no_fault_and_no_known_fault():
    assert told(HEALTHY) == "healthy, 98 % sure"
    assert told(UNKNOWN, onset_s=3.0) == (
        "something that none of the known faults explains since 3.0 s, 98 % sure"
    )
    assert told(HEALTHY, undecided="the log is empty") == "cannot tell, because the log is empty"


@pytest.mark.parametrize(
    ("chance", "text"),
    [
        (0.5, "50 %"),
        (0.98, "98 %"),
        (0.994, "99.4 %"),
        (0.9999, "over 99.9 %"),
        (1.0, "over 99.9 %"),
    ],
)
def test_nothing_is_certain(chance, text):
    assert percent(chance) == text


def test_what_else_it_may_be_is_told():
    others = [(single("stuck"), 0.3), (PAIR, 0.08), (UNKNOWN, 0.02)]
    assert told(HEALTHY, 0.6, others) == (
        "cannot tell yet; most probable: healthy, 60 % "
        "(or motor 3 stuck 30 %, motor 1 stuck and motor 3 drifts 8 %)"
    )


@pytest.mark.parametrize(
    ("nats", "told_so"),
    [((0.1, 0.2, 6.0), True), ((0.1, 3.0, 6.0), False), ((0.1, 6.0, 0.1), False)],
)
def test_a_stop_that_the_last_movement_alone_shows_may_be_a_lost_command(nats, told_so):
    evidence = tuple(MovementEvidence(m + 1, shown) for m, shown in enumerate(nats))
    said = told(single("stuck"), 0.99, [(HEALTHY, 0.01)], evidence=evidence)
    assert said.endswith("a lost command looks the same") is told_so
    other = told(single("slow"), 0.99, [(HEALTHY, 0.01)], evidence=evidence)
    assert "lost command" not in other


@pytest.mark.parametrize("chances", [(0.96, 0.04), (0.5, 0.44, 0.03, 0.03), (0.2,) * 5, (1.0,)])
def test_possible_hypotheses_are_the_fewest_that_are_sure(chances):
    names = [HEALTHY, *(single(mode) for mode in SIZED)][: len(chances)]
    diagnosis = Diagnosis("run", {str(h): p for h, p in zip(names, chances, strict=True)})
    count = len(possible_hypotheses(diagnosis, names))
    assert sum(chances[:count]) >= 0.95 - 1e-9
    assert count == 1 or sum(chances[: count - 1]) < 0.95


def test_explanation_says_which_movements_speak_for_it_and_what_to_do():
    evidence = (MovementEvidence(1, 3.21), MovementEvidence(2, 0.4), MovementEvidence(4, -1.5))
    stuck = single("stuck")
    diagnosis = Diagnosis("run", {str(PAIR): 0.94, str(stuck): 0.06}, evidence=evidence)
    lines = explanation(diagnosis, (PAIR, stuck), ["movement 2: motor 4 did not get the command"])
    pair = "motor 1 stuck and motor 3 drifts"
    assert lines[:4] == (
        f"movement 1: 3.2 nats for {pair} over motor 3 stuck",
        f"movement 4: 1.5 nats for motor 3 stuck over {pair}",
        "movement 2: motor 4 did not get the command",
        f"cannot be told apart in this run: {pair} or motor 3 stuck",
    )
    told = [line.split(":")[0] for line in lines[4:]]
    assert told == ["possible causes", "possible causes", "what to do"]
    assert "record again" in lines[-1].lower()
    sure = Diagnosis("run", {str(PAIR): 0.96, str(stuck): 0.04})
    told = [line.split(":")[0] for line in explanation(sure, (PAIR, stuck), [])]
    assert told == ["possible causes", "what to do"] * 2
