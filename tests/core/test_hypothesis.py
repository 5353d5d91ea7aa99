from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import (
    HEALTHY,
    UNKNOWN,
    Fault,
    Hypothesis,
    paper_hypotheses,
    parse_hypotheses,
)
from failuretwin.failure_behavior.registry import MODES

UNITS = {
    "stuck": "rad",
    "steady_state_error": "rad",
    "slow": "ratio",
    "lag": "s",
    "backlash": "rad",
    "drift": "rad/s",
    "intermittent": "ratio",
    "torque_loss": "ratio",
    "encoder_bias": "rad",
    "encoder_scale": "ratio",
    "lost_commands": "ratio",
}
MOTORS = ("motor_1", "motor_2", "motor_3", "motor_4")


@st.composite
def hypotheses(draw):
    faulty = draw(st.lists(st.sampled_from(MOTORS), unique=True))
    modes = st.sampled_from(list(UNITS))
    faults = tuple(Fault(motor, draw(modes)) for motor in sorted(faulty))
    return Hypothesis(faults) if faults else draw(st.sampled_from([HEALTHY, UNKNOWN]))


@given(hypotheses())
def test_text_form_is_read_back(hypothesis):
    assert Hypothesis.parse(str(hypothesis), MOTORS) == hypothesis


def test_text_form_is_the_contract():
    several = Hypothesis((Fault("motor_1", "stuck"), Fault("motor_3", "drift")))
    assert str(several) == "motor_1:stuck+motor_3:drift"
    assert (str(HEALTHY), str(UNKNOWN)) == ("healthy", "unknown")


def test_only_healthy_is_healthy():
    assert HEALTHY.is_healthy
    assert not UNKNOWN.is_healthy
    assert not Hypothesis((Fault("motor_1", "stuck"),)).is_healthy


def test_paper_classes_are_in_the_order_of_the_labels():
    assert [str(h) for h in paper_hypotheses(MOTORS)] == [
        "healthy",
        "motor_1:stuck",
        "motor_2:stuck",
        "motor_3:stuck",
        "motor_4:stuck",
        "motor_1:steady_state_error",
        "motor_2:steady_state_error",
        "motor_3:steady_state_error",
        "motor_4:steady_state_error",
    ]


def test_every_mode_has_its_unit():
    assert {name: mode.unit for name, mode in MODES.items()} == UNITS


def test_the_page_on_fault_modes_names_every_unit():
    page = (Path(__file__).parents[2] / "docs" / "fault_modes.md").read_text()
    rows = re.findall(r"^\| `(\w+)` \|[^|]*\|[^|]*\|([^|]*)\|", page, re.MULTILINE)
    units = {mode: re.findall(r"\[([^]]+)\]", told) for mode, told in rows if mode in UNITS}
    assert {mode: (found or ["ratio"])[0] for mode, found in units.items()} == UNITS


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "motor_9:stuck",
            "unknown motor 'motor_9'. Did you mean 'motor_4'? "
            "Valid: motor_1, motor_2, motor_3, motor_4.",
        ),
        (
            "helthy",
            "hypothesis 'helthy' is not of the form MOTOR:MODE. "
            "Expected 'healthy', 'unknown', a fault such as 'motor_1:stuck', or several joined by "
            "'+' in chain order, such as 'motor_1:stuck+motor_2:drift'.",
        ),
        (
            "motor_3:drift+motor_1:stuck",
            "hypothesis 'motor_3:drift+motor_1:stuck' names its motors out of chain order or "
            "twice. Expected each motor once, in the order motor_1, motor_2, motor_3, motor_4.",
        ),
        (
            "motor_1:drift+motor_1:stuck",
            "hypothesis 'motor_1:drift+motor_1:stuck' names its motors out of chain order or "
            "twice. Expected each motor once, in the order motor_1, motor_2, motor_3, motor_4.",
        ),
    ],
)
def test_text_that_cannot_be_read_says_what_is_expected(text, message):
    with pytest.raises(InputError) as error:
        Hypothesis.parse(text, MOTORS)
    assert str(error.value) == message


@pytest.mark.parametrize("text", ["motor_1:stuk", "motor_1:stuck:"])
def test_misspelt_mode_names_the_nearest(text):
    (fault,) = Hypothesis.parse(text, MOTORS).faults
    with pytest.raises(InputError, match=r"unknown fault mode .* Did you mean 'stuck'\?"):
        MODES.find(fault.mode)


@pytest.mark.parametrize(
    "text", ["", "motor_1:stuck+", "motor_1:", "+", "healthy+motor_1:stuck", "Healthy"]
)
def test_text_without_motor_and_mode_is_refused(text):
    with pytest.raises(InputError, match="not of the form MOTOR:MODE"):
        Hypothesis.parse(text, MOTORS)


def test_list_of_hypotheses_may_have_spaces():
    assert parse_hypotheses(["healthy", " motor_2:stuck "], MOTORS) == (
        HEALTHY,
        Hypothesis((Fault("motor_2", "stuck"),)),
    )


def test_list_may_hold_hypotheses_and_their_text_form():
    stuck = Hypothesis((Fault("motor_2", "stuck"),))
    assert parse_hypotheses([UNKNOWN, "motor_2:stuck"], MOTORS) == (UNKNOWN, stuck)
    with pytest.raises(InputError, match="unknown motor 'motor_9'"):
        parse_hypotheses([Hypothesis((Fault("motor_9", "stuck"),))], MOTORS)


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        ([], "no hypotheses given"),
        (["healthy", "healthy "], "given twice"),
        ("motor_1:stuck", r"the text 'motor_1:stuck'. Expected a list, such as \['healthy', "),
    ],
)
def test_empty_list_and_repeats_are_refused(texts, message):
    with pytest.raises(InputError, match=message):
        parse_hypotheses(texts, MOTORS)
