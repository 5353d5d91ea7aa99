from __future__ import annotations

import time
from collections import deque
from io import StringIO

import numpy as np
import pytest
from rich.console import Console

from failuretwin.app import shadow as shadow_module
from failuretwin.app.live import View, watch_until_end
from failuretwin.app.shadow import Changes, Shadow
from failuretwin.connection.links.base import OK, STALE, Answer, CommandSent, LinkCounts, Reading
from failuretwin.connection.links.ros_messages import RosTopics, SampledCommands
from failuretwin.core.hypothesis import (
    ALL_CLEAR,
    CLEAR,
    RAISED,
    SUSPECTED,
    Alarm,
    Diagnosis,
    Episode,
)
from failuretwin.decision.streaming.monitor import FaultMonitor

HEALTHY = Diagnosis("live", {"healthy": 0.99, "motor_3:stuck": 0.01}, verdict="healthy, 99 % sure")
STUCK = Diagnosis("live", {"healthy": 0.01, "motor_3:stuck": 0.99}, verdict="motor 3 stuck")


class Script:
    """A source that gives what it is told; None is a silence."""

    name = "a script"

    def __init__(self, events):
        self.events = deque(events)
        self.counts = LinkCounts()

    @property
    def ended(self):
        return not self.events

    def poll(self, timeout_s):
        return self.events.popleft() if self.events else None

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass


class Notebook:
    """A diagnoser that writes down what it is told."""

    def __init__(self, diagnosis=HEALTHY):
        self.told = []
        self.diagnosis = diagnosis

    def update(self, time, command, measured, position=None, goal=None):
        self.told.append((time, command, measured))
        return Answer(time, OK, self.diagnosis)

    def conclude(self):
        return Answer(self.told[-1][0] if self.told else 0.0, OK, self.diagnosis)


class Kept:
    """A sink that keeps everything."""

    trouble = ""

    def __init__(self):
        self.items = []

    def put(self, item):
        self.items.append(item)


@pytest.fixture
def clock(monkeypatch):
    """Our own clock, which stands unless it is moved."""
    now = [1000.0]
    monkeypatch.setattr(shadow_module.time, "monotonic", lambda: now[0])
    return now


def reading(t, tool=(0.1, 0.0, 0.2)):
    return Reading(t, np.array(tool, dtype=float), np.zeros(4))


def command(t, target):
    return CommandSent(t, np.full(4, float(target)), np.ones(4))


def run(shadow):
    while shadow.step(0.0):
        pass


@pytest.mark.parametrize("rate_hz", [2.0, 5.0, 20.0, 100.0])
def test_set_points_that_come_as_a_stream_draw_the_line_that_they_mean(twin, rate_hz):
    """Also between two of them, where a reading comes before it is known that the arm moves."""
    step, samples = 1.0 / rate_hz, SampledCommands()
    ends = np.round(np.array([1.0, 2.0, 4.0, 5.0]) * rate_hz) / rate_hz
    told = []
    for t in np.arange(0.0, 8.0, step):
        told.append((t, samples.add(t, np.full(4, np.interp(t, ends, [0.0, 0.8, 0.8, -0.5])))))
    events = [(at, sent) for at, sent in told if sent is not None]
    events += [(t, reading(t)) for t in np.arange(0.013, 7.0, 0.1)]
    in_order_of_arrival = [event for _, event in sorted(events, key=lambda one: one[0])]
    topics = RosTopics(command="/set_points", command_type="sensor_msgs/JointState")
    notebook = Notebook()
    run(Shadow(Script(in_order_of_arrival), notebook, twin, commands_late_s=topics.wait_s))
    zero = in_order_of_arrival[0].time
    seen = [(t + zero, value[0]) for t, value, measured in notebook.told if measured is not None]
    assert len(seen) == 70
    times, values = np.array(seen).T
    np.testing.assert_allclose(values, np.interp(times, ends, [0.0, 0.8, 0.8, -0.5]), atol=1e-9)


def test_a_diagnoser_is_told_the_reference_with_its_corners(twin):
    events = [reading(100.0), command(100.3, 0.8), reading(100.8), reading(102.0)]
    notebook = Notebook()
    run(Shadow(Script(events), notebook, twin))
    times = [time for time, _, _ in notebook.told]
    values = [None if value is None else value[0] for _, value, _ in notebook.told]
    np.testing.assert_allclose(times, [0.0, 0.3, 0.8, 1.3, 2.0], atol=1e-9)
    np.testing.assert_allclose(values, [0.0, 0.0, 0.4, 0.8, 0.8], atol=1e-9)
    seen = [measured is not None for _, _, measured in notebook.told]
    assert seen == [True, False, True, False, True]


def test_a_reading_without_a_tool_position_is_no_measurement(twin):
    notebook = Notebook()
    run(Shadow(Script([reading(0.0), reading(0.1, [np.nan] * 3)]), notebook, twin))
    assert notebook.told[1][2] is None


class MotorNotebook(Notebook, FaultMonitor):
    """A monitor that writes down what it is told."""

    def __init__(self):
        Notebook.__init__(self)

    def update(self, time, command, measured, position=None, goal=None):
        self.told.append((time, measured is not None, position if goal is None else goal))
        return Answer(time, OK, self.diagnosis)

    conclude = Notebook.conclude


def test_motor_readings_count_with_the_tools_reading_of_then(twin):
    """They may come in messages of their own, a little earlier."""
    nowhere, tool = np.full(3, np.nan), np.array([0.1, 0.0, 0.2])
    angles = [np.full(4, 0.1 * k) for k in range(3)]
    events = [
        Reading(0.0, nowhere, angles[0]),
        Reading(0.05, tool),
        Reading(0.4, nowhere, angles[1]),
        Reading(0.7, tool),
        Reading(1.0, tool, angles[2]),
    ]
    notebook = MotorNotebook()
    run(Shadow(Script(events), notebook, twin))
    seen = [(t, position) for t, there, position in notebook.told if there]
    assert [t for t, _ in seen] == pytest.approx([0.05, 0.7, 1.0])
    assert seen[0][1] is angles[0]
    assert seen[1][1] is None
    assert seen[2][1] is angles[2]


def test_goals_are_passed_on_when_they_come(twin):
    goal, notebook = np.full(4, 0.3), MotorNotebook()
    events = [reading(0.0), Reading(0.2, np.full(3, np.nan), goal=goal), reading(0.4)]
    run(Shadow(Script(events), notebook, twin))
    assert [told[2] is goal for told in notebook.told] == [False, True, False]


def test_commands_that_come_late_take_their_place(twin):
    events = [reading(0.0), reading(1.0), reading(2.0), command(0.5, 0.8), reading(3.0)]
    notebook = Notebook()
    run(Shadow(Script(events), notebook, twin, commands_late_s=2.0))
    reference = {round(t, 6): value[0] for t, value, _ in notebook.told}
    assert reference == pytest.approx({0.0: 0.0, 0.5: 0.0, 1.0: 0.4, 1.5: 0.8, 2.0: 0.8, 3.0: 0.8})


def test_silence_is_never_healthy(twin, clock):
    script, notebook = Script([reading(0.0)]), Notebook()
    script.events.extend([None] * 20)
    shadow = Shadow(script, notebook, twin)
    states = []
    for _ in range(15):
        shadow.step(0.0)
        states.append(shadow.snapshot.answer.state)
        clock[0] += 0.6
    assert states[0] == OK
    assert states[1:8] == [OK] * 7
    assert states[9:] == [STALE] * 6  # more than 5 s
    assert shadow.snapshot.answer.diagnosis is HEALTHY  # what was known is not forgotten
    times = [time for time, _, _ in notebook.told]
    assert times == sorted(times)  # the diagnoser was told that time went on
    assert times[-1] > 5.0
    script.events.appendleft(reading(9.0))
    shadow.step(0.0)
    assert shadow.snapshot.answer.state == OK


def test_commands_alone_are_silence(twin, clock):
    script = Script([reading(0.0), *(command(float(t), 0.1) for t in range(1, 20))])
    shadow = Shadow(script, Notebook(), twin)
    while shadow.step(0.0):
        clock[0] += 1.0
    script.events.extend([None, None])
    shadow.step(0.0)
    assert shadow.snapshot.answer.state == STALE


def test_the_user_is_told_how_late_commands_come(twin, armpi):
    events = [reading(0.0), reading(2.0), command(0.2, 0.8), reading(2.1), reading(2.2)]
    script = Script(events)
    shadow = Shadow(script, Notebook(), twin)
    told = Changes(armpi.motor_names)
    watch_until_end(shadow, told, Console(file=StringIO()), np.inf)
    late = "commands come late: put commands_late_s = 2.0 into the --topics file"
    assert late in [change.text for change in told.lines]


def test_a_source_from_which_nothing_comes_is_named(twin, armpi, clock):
    class Silent(Script):
        def poll(self, timeout_s):
            clock[0] += 1.0
            return super().poll(timeout_s)

    script = Silent([None] * 9)
    shadow = Shadow(script, Notebook(), twin)
    told = Changes(armpi.motor_names)
    watch_until_end(shadow, told, Console(file=StringIO()), np.inf)
    assert [change.text for change in told.lines] == ["nothing comes from a script"]


def test_motor_readings_alone_are_silence(twin, clock):
    script = Script([reading(0.0), *(reading(float(t), [np.nan] * 3) for t in range(1, 10))])
    shadow = Shadow(script, Notebook(), twin)
    for _ in range(9):
        shadow.step(0.0)
        clock[0] += 1.0
    assert shadow.snapshot.answer.state == STALE


def test_a_robot_that_is_silent_at_first_is_waited_for(twin, clock):
    """Until the first event there is no time of the stream."""
    script, notebook = Script([]), Notebook()
    script.events.extend([None] * 4)
    shadow = Shadow(script, notebook, twin)
    for _ in range(4):
        clock[0] += 1.0
        shadow.step(0.0)
    script.events.extend([reading(50.0), reading(50.1)])
    shadow.step(0.0)
    shadow.step(0.0)
    times = [time for time, _, _ in notebook.told]
    np.testing.assert_allclose(times[:-2], 0.0)
    np.testing.assert_allclose(times[-2:], [0.0, 0.1], atol=1e-9)


def test_before_any_data_nothing_is_known_and_our_clock_stands_in(twin):
    before = time.time()
    answer = Shadow(Script([]), Notebook(), twin).snapshot.answer
    assert (answer.state, answer.diagnosis) == (STALE, None)
    assert before <= answer.time <= time.time()


@pytest.mark.parametrize("jump", [3.15e7, -3.15e7])
def test_a_clock_that_jumps_leaves_the_diagnosers_time_as_it_was(twin, clock, jump):
    notebook, script = Notebook(), Script([])
    shadow = Shadow(script, notebook, twin)
    for k in range(100):
        script.events.append(reading(5000.0 + 0.1 * k + (jump if k >= 50 else 0.0)))
        shadow.step(0.0)
        clock[0] += 0.1
    np.testing.assert_allclose([t for t, _, _ in notebook.told], 0.1 * np.arange(100), atol=1e-6)
    assert shadow.clock.jumps == 1
    assert shadow.snapshot.answer.time == pytest.approx(5009.9 + jump)


def test_sinks_get_events_and_answers_by_the_robots_clock(twin):
    kept = Kept()
    run(
        Shadow(Script([reading(50.0), command(50.5, 0.1), reading(51.0)]), Notebook(), twin, [kept])
    )
    assert [(type(item).__name__, item.time) for item in kept.items] == [
        ("Reading", 50.0),
        ("Answer", 50.0),
        ("CommandSent", 50.5),
        ("Reading", 51.0),
        ("Answer", 51.0),
        ("Answer", 51.0),  # when all is over, all counts
    ]


def test_the_residual_is_the_distance_from_the_reference(twin):
    at_rest = twin.path(np.zeros(4))
    offset = np.array([0.0, 0.01, 0.0])
    shadow = Shadow(Script([reading(0.0, at_rest + offset)]), Notebook(), twin)
    run(shadow)
    np.testing.assert_allclose(shadow.snapshot.residual, offset, atol=1e-12)


def lines(changes, moments, counts=None, troubles=()):
    found = []
    for moment in moments:
        counts = counts or LinkCounts()
        found += [c.text for c in changes.notice(moment, counts, 0, troubles)]
    return found


def moment(time, state, diagnosis, alarm=ALL_CLEAR):
    answer = Answer(time, state, diagnosis, alarm)
    return shadow_module.Snapshot(answer, time, np.full(3, np.nan), 0.001)


CAUSE = "motor_3:stuck"
LASTS, ENDED = Episode(1, CAUSE, 3.0), Episode(1, CAUSE, 3.0, 65.0)


def test_what_changes_is_told_once(armpi):
    changes = Changes(armpi.motor_names)
    raised, over = Alarm(RAISED, CAUSE, LASTS), Alarm(CLEAR, "", ENDED)
    states = [(OK, HEALTHY)] * 3 + [(OK, STUCK, raised)] * 3 + [(STALE, STUCK, raised)] * 3
    states += [(OK, HEALTHY, over)] * 3
    told = lines(changes, [moment(float(k), *state) for k, state in enumerate(states)])
    assert told == [
        "OK: healthy, 99 % sure",
        "ALARM: motor 3 stuck",
        "STALE: no data any more",
        "data are coming",
        "CLEARED: the alarm for motor 3 stuck lasted 62 s; healthy, 99 % sure",
    ]
    assert str(changes.lines[1]) == "     3.0 s  ALARM: motor 3 stuck"


def test_alarms_that_come_and_go_are_told(armpi):
    """From the third in an hour on; one that changes its cause without an end is one alarm."""
    changes, moments = Changes(armpi.motor_names), [moment(0.0, OK, HEALTHY)]
    other = Alarm(RAISED, "motor_3:steady_state_error", LASTS)
    for at in (10.0, 40.0, 90.0, 4000.0):
        moments += [
            moment(at, OK, STUCK, Alarm(RAISED, CAUSE, LASTS)),
            moment(at + 1.0, OK, STUCK, other),
            moment(at + 2.0, OK, HEALTHY, Alarm(CLEAR, "", ENDED)),
        ]
    told = [line for line in lines(changes, moments) if "come" in line]
    line = "motor 3: 3 alarms within 80 s, each after a healthy spell: a fault that comes and goes"
    assert told == [line]
    assert changes.recurring == []  # the last alarm is by itself


def test_an_alarm_that_is_not_sure_says_why_and_then_that_it_is_sure(armpi):
    """A line for the alarm, with its threshold, and one when it becomes sure, once."""
    unsure = Diagnosis("live", {"healthy": 0.41, CAUSE: 0.59}, verdict="cannot tell yet")
    raised = Alarm(RAISED, CAUSE, LASTS, threshold=4.0 / 7.0)
    states = [HEALTHY, unsure, unsure, STUCK, STUCK, unsure, STUCK]
    moments = [moment(0.0, OK, states[0])]
    moments += [moment(1.0 + k, OK, state, raised) for k, state in enumerate(states[1:])]
    assert lines(Changes(armpi.motor_names), moments) == [
        "OK: healthy, 99 % sure",
        "ALARM: cannot tell yet; alarm threshold 57 %, by --false-alarms-per-100h",
        "ALARM: motor 3 stuck",
    ]


def test_what_is_suspected_is_told_and_that_it_passed(armpi):
    """Whatever the probabilities are: the alarm decides."""
    unsure = Diagnosis("live", {"healthy": 0.6, CAUSE: 0.4}, verdict="healthy?")
    changes, suspected = Changes(armpi.motor_names), Alarm(SUSPECTED, CAUSE)
    moments = [moment(0.0, OK, HEALTHY), moment(1.0, OK, unsure, suspected)]
    moments += [moment(2.0, OK, unsure, suspected), moment(3.0, OK, unsure)]
    assert lines(changes, moments) == [
        "OK: healthy, 99 % sure",
        "SUSPECTED: motor 3 stuck, 40 %; healthy?",
        "CLEARED: motor 3 stuck is no longer suspected; healthy?",
    ]


def test_why_nothing_can_be_said_is_told_once(armpi):
    untold = Diagnosis("live", {"healthy": 1.0}, undecided="the tool moves though no command came")
    changes = Changes(armpi.motor_names)
    moments = [moment(float(k), OK, untold) for k in range(3)] + [moment(3.0, OK, HEALTHY)]
    assert lines(changes, moments) == [
        "UNDECIDED: the tool moves though no command came",
        "OK: healthy, 99 % sure",
    ]


def test_an_alarm_stands_though_its_fault_is_in_doubt(armpi):
    other = Diagnosis("live", {"healthy": 1.0}, undecided="motor 3 late explains it better")
    raised, changes = Alarm(RAISED, CAUSE, LASTS), Changes(armpi.motor_names)
    moments = [moment(1.0, OK, STUCK, raised), moment(2.0, OK, other, raised)]
    assert lines(changes, moments)[1:] == ["ALARM: motor 3 late explains it better"]


def test_trouble_with_the_link_is_told(armpi):
    changes = Changes(armpi.motor_names)
    still = moment(0.0, OK, None)
    counts = LinkCounts(10, 2, 3, 1, "ValueError: nonsense")
    told = [c.text for c in changes.notice(still, counts, 1, ("disk full",))]
    assert told == [
        "the link is back",
        "3 events dropped so far: this computer is too slow",
        "the robot's clock jumped; going on by our own",
        "2 messages made no sense so far: ValueError: nonsense",
        "disk full",
    ]
    assert [c.text for c in changes.notice(still, counts, 1, ())] == ["over: disk full"]


def test_stamps_that_leap_without_end_are_told_ever_more_seldom(armpi):
    changes = Changes(armpi.motor_names)
    told = [changes.notice(moment(float(k), OK, None), LinkCounts(), k, ()) for k in range(70)]
    texts = [(c.stream_time, c.text) for found in told for c in found]
    assert texts == [
        (1.0, "the robot's clock jumped; going on by our own"),
        (11.0, "the robot's clock jumped, 11 times so far; going on by our own"),
        (31.0, "the robot's clock jumped, 31 times so far; going on by our own"),
    ]


def test_a_reason_is_told_anew_only_where_it_is_another(armpi):
    """More or less sure of the same is no news; a verdict after it is."""
    said = "the log does not fit the profile ({} sure): motor 2 turns the other way"
    reasons = [said.format(sure) for sure in ("97.1 %", "over 99.9 %")]
    moments = [moment(0.0, OK, HEALTHY)]
    moments += [
        moment(1.0 + k, OK, Diagnosis("live", {"healthy": 1.0}, undecided=reason))
        for k, reason in enumerate([*reasons, "no motor is told to move"])
    ]
    assert lines(Changes(armpi.motor_names), [*moments, moment(9.0, OK, HEALTHY)]) == [
        "OK: healthy, 99 % sure",
        f"UNDECIDED: {reasons[0]}",
        "UNDECIDED: no motor is told to move",
        "OK: healthy, 99 % sure",
    ]


@pytest.mark.parametrize("stamp", [0.0, 4.0e9, -1.0])
def test_a_third_of_senseless_stamps_does_not_move_the_stream(twin, clock, stamp):
    """Such a reading counts when it comes; they are counted."""
    notebook, script = Notebook(), Script([])
    shadow = Shadow(script, notebook, twin)
    senseless = np.append(False, np.random.default_rng(0).random(599) < 0.3)
    for k, bad in enumerate(senseless):
        script.events.append(reading(stamp if bad else 1.7e9 + 0.1 * k))
        shadow.step(0.0)
        clock[0] += 0.1
    np.testing.assert_allclose([t for t, _, _ in notebook.told], 0.1 * np.arange(600), atol=1e-6)
    assert shadow.clock.jumps == 0
    assert shadow.clock.senseless == senseless.sum()


def test_the_posterior_over_time_goes_by_the_robots_clock(armpi):
    """However fast a log is replayed, and with gaps where nothing was known."""
    view = View(armpi.motor_names, "a script")
    for k in range(200):
        view.remember(moment(0.1 * k, OK, HEALTHY))
    for k in range(10):
        view.remember(moment(30.0 + 0.1 * k, OK, STUCK))
    console = Console(width=120, file=StringIO())
    with console.capture() as captured:
        console.print(view.draw(moment(31.0, OK, STUCK), LinkCounts(), []))
    (row,) = [line for line in captured.get().splitlines() if "motor_3:stuck" in line]
    assert row.count("?") == 10
    assert row.split("?")[-1].lstrip().startswith("█")
    assert "█" not in row.split("?")[0]


def test_the_view_shows_motors_posterior_and_changes(armpi):
    view, changes = View(armpi.motor_names, "a script"), Changes(armpi.motor_names)
    told = moment(3.0, OK, STUCK, Alarm(RAISED, CAUSE, LASTS))
    changes.notice(told, LinkCounts(), 0, ())
    console = Console(width=120, file=StringIO())
    view.remember(told)
    with console.capture() as captured:
        console.print(view.draw(told, LinkCounts(received=7), changes.lines))
    text = captured.get()
    assert "ALARM: motor 3 stuck" in text.splitlines()[0]
    assert "7 events, 0 garbage, 0 dropped" in text
    assert "motor_3  ALARM   99.0 %" in text
    assert "motor_3:stuck" in text
    assert "3.0 s  ALARM: motor 3 stuck" in text
    stale = view.draw(moment(9.0, STALE, HEALTHY), LinkCounts(), changes.lines)
    with console.capture() as captured:
        console.print(stale)
    assert "no data for a while" in captured.get()
    assert "OK" not in captured.get()


def test_a_terminal_and_a_pipe_show_the_same_lines(twin, armpi, capsys):
    shown = StringIO()
    for console in (Console(file=StringIO()), Console(file=shown, force_terminal=True, width=120)):
        shadow = Shadow(Script([reading(0.0)]), Notebook(), twin)
        watch_until_end(shadow, Changes(armpi.motor_names), console, np.inf)
    line = "0.0 s  OK: healthy, 99 % sure"
    assert line in capsys.readouterr().out
    assert line in shown.getvalue()
