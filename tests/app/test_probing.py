"""A watched arm is asked by movements: only while it is open, idle and nobody else commands it."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import replace
from threading import Event, Thread

import numpy as np
import pytest

from failuretwin.app.shadow import Shadow
from failuretwin.connection.links.base import OK, Answer, CommandSent, LinkCounts, Order, Reading
from failuretwin.connection.links.ros_messages import RosTopics, RosWriter
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import (
    ALL_CLEAR,
    CLEAR,
    RAISED,
    SUSPECTED,
    Alarm,
    Diagnosis,
    Hypothesis,
)
from failuretwin.core.numerics import Weighted
from failuretwin.decision.acting.safety import SafetyGate
from failuretwin.decision.streaming.monitor import Believed, monitor
from failuretwin.decision.test_motions.probing import Prober, ProbeRules
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.inference.observation.healthy_model import HealthyModel
from fake_rosbridge import FakeRosbridge
from roscores import free_port
from waiting import WAIT_S, wait_for

COUNT_RAD = np.deg2rad(0.24)
HEALTHY_MOVES, FAULTY_MOVES, PERIOD_S = 11, 4, 2.2


@pytest.fixture(scope="module")
def known():
    return load_calibration(None, "armpi_fpv")


class Arm:
    """An arm that ramps to what it is told and settles as its model says, read ten times a second.

    Errors of one motor are drawn anew by each order after the first `sound` ones.
    """

    name, ended, counts = "an arm", False, LinkCounts()

    def __init__(self, known, program, off=(3, 0.0), sound=0):
        self.model = HealthyModel.of(known.twin, known.imperfections)
        self.standing = np.zeros(4)
        self.now, self.begun, self.ramp = 0.0, 0.0, 1.0
        self.origin = self.goal = np.zeros(4)
        self.program, self.events = deque(program), deque()
        self.off, self.sound, self.heard, self.sent = off, sound, 0, []
        self.rng, self.swings = np.random.default_rng(4), 0.0

    def send(self, order):
        self.sent.append(order)
        self.obey(order)

    def obey(self, order):
        travel, self.origin = np.sign(order.target - self.standing), self.pose
        self.standing, self.begun, self.ramp = order.target, self.now, order.duration.max()
        self.goal = self.model.settle(order.target, travel, self.model.none_held)
        self.goal += 0.5 * self.model.scatter * self.rng.standard_normal(4)
        self.heard += 1
        if self.heard > self.sound:
            self.goal[self.off[0]] += self.off[1] * self.rng.choice([-1.0, 1.0])
        self.events.append(CommandSent(self.now, order.target, order.duration))

    @property
    def pose(self):
        share = np.clip((self.now - self.begun) / self.ramp, 0.0, 1.0)
        return self.origin + share * (self.goal - self.origin)

    def poll(self, timeout_s):
        if not self.events:
            self.now += 0.1
            if self.program and self.program[0][0] <= self.now:
                self.obey(self.program.popleft()[1])
            else:
                point = self.model.twin.path(self.pose)
                point = point + self.swings * np.sin(9.0 * self.now)
                self.events.append(Reading(self.now, point, self.pose))
        return self.events.popleft()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass


def program(count=HEALTHY_MOVES + FAULTY_MOVES, seed=1, start_s=1.0):
    """Return usual movements with the last link in the line of the others but for the first ones.

    There motors 3 and 4 move the tool along the same line.
    """
    rng = np.random.default_rng(seed)
    targets = rng.uniform(-0.7, 0.7, (count, 4))
    targets[HEALTHY_MOVES - 1 :, 3] = 0.0
    return [
        (start_s + PERIOD_S * k, Order(target, np.full(4, 0.8))) for k, target in enumerate(targets)
    ]


class Watched:
    """A watch of an arm, with all that was told."""

    def __init__(self, known, arm, rules, watch):
        self.arm, self.watch, self.said, self.asked_at = arm, watch, [], []
        self.prober = Prober(watch, SafetyGate(known.robot), arm, rules)
        self.shadow = Shadow(arm, watch, known.twin, [self.prober])

    def until(self, end_s):
        while self.arm.now < end_s:
            self.shadow.step(0.0)
            if self.prober.due:
                self.asked_at.append(self.arm.now)
                self.prober.ask(self.shadow.hear, self.said.append)
        return self

    @property
    def alarm(self):
        return self.shadow.snapshot.answer.alarm


LAST_S = 1.0 + PERIOD_S * (HEALTHY_MOVES + FAULTY_MOVES - 1)
OVER_S = LAST_S + 0.8
ERRORS = {2: 12 * COUNT_RAD, 3: 28 * COUNT_RAD}
"""Of motors 3 and 4, that move the tool alike."""


def watched_arm(known, motor=3, sound=HEALTHY_MOVES):
    """Return a watch of an arm of which a motor errs after the first movements."""
    arm = Arm(known, program(), (motor, ERRORS[motor]), sound)
    return Watched(known, arm, ProbeRules(4, 5.0), monitor(known.twin, known.imperfections))


def shares(watched):
    """Return the shares of motors 3 and 4 among all faults."""
    believed = watched.watch.believed
    names = [str(h) for h in believed.hypotheses]
    of = {
        motor: sum(p for p, n in zip(believed.probability, names, strict=True) if motor in n)
        for motor in ("motor_1", "motor_2", "motor_3", "motor_4")
    }
    return of["motor_3"] / sum(of.values()), of["motor_4"] / sum(of.values())


@pytest.mark.parametrize("motor", [pytest.param(2, marks=pytest.mark.slow), 3])
def test_two_motors_that_are_suspected_are_told_apart_and_the_arm_is_back(known, motor):
    watched = watched_arm(known, motor).until(LAST_S + 5.0)
    assert watched.alarm.state != CLEAR
    assert max(shares(watched)) < 0.95
    assert watched.arm.sent == []
    home, before = program()[-1][1].target, watched.arm.pose
    watched.until(LAST_S + 15.0)
    assert (watched.alarm.state, watched.alarm.cause) == (
        RAISED,
        f"motor_{motor + 1}:steady_state_error",
    )
    assert shares(watched)[motor - 2] > 0.95
    asked, back = watched.arm.sent[::2], watched.arm.sent[1::2]
    assert 1 <= len(asked) <= 2
    assert len(back) == len(asked)
    assert all(np.array_equal(order.target, home) for order in back)
    sound = np.arange(4) != motor
    np.testing.assert_allclose(watched.arm.pose[sound], before[sound], atol=0.03)
    assert all(at >= OVER_S + 5.0 for at in watched.asked_at)
    assert watched.said[-1].endswith("the arm is back where it was")
    gate, at = SafetyGate(known.robot), home
    low, high = np.array([m.movement_range for m in known.robot.motors]).T
    for order in watched.arm.sent:
        assert gate.wrong(order, [(at, order.target)]) == ""
        assert np.all((order.target >= low) & (order.target <= high))
        at = order.target


def test_a_healthy_arm_is_never_asked(known):
    watched = watched_arm(known, sound=10**6).until(LAST_S + 15.0)
    assert (watched.alarm.state, watched.arm.sent, watched.said) == (CLEAR, [], [])


# What decides when to ask, by a watch that is never sure.


class Unsure:
    """A watch that suspects motors 3 and 4 from a time on, whatever it sees."""

    def __init__(self, known, alarm=None, since_s=0.0, undecided=""):
        sizes = [None, *[Weighted(np.array([0.02, 0.05]), np.ones(2))] * 2]
        names = ("healthy", "motor_3:steady_state_error", "motor_4:steady_state_error")
        hypotheses = [Hypothesis.parse(name) for name in names]
        model = HealthyModel.of(known.twin, known.imperfections)
        self.believed = Believed(model, hypotheses, np.array([0.9, 0.05, 0.05]), sizes)
        self.alarm, self.since_s, self.time = alarm or Alarm(SUSPECTED, names[1]), since_s, 0.0
        posterior = dict(zip(names, self.believed.probability.tolist(), strict=True))
        self.diagnosis = Diagnosis("stream", posterior, undecided=undecided)

    def update(self, time, command, measured, position=None, goal=None):
        alarm = self.alarm if time >= self.since_s else ALL_CLEAR
        return Answer(time, OK, self.diagnosis, alarm)


TWICE = ProbeRules(2, 5.0)


def unsure(known, rules=TWICE, then=(), **told):
    """Return an unsure watch of an arm that makes three movements, the last at 5.4 s."""
    arm = Arm(known, [*program(3), *then])
    return Watched(known, arm, rules, Unsure(known, **told))


def test_so_many_movements_at_most_and_no_more_until_somebody_commands(known):
    watched = unsure(known).until(60.0)
    assert len(watched.arm.sent) == 2 * 2
    assert len(watched.asked_at) == 1
    assert watched.asked_at[0] == pytest.approx(5.4 + 0.8 + 5.0, abs=0.3)
    assert watched.said[-1] == "asked by 2 movements, the arm is back where it was"


def test_another_suspicion_is_asked_again_once_somebody_has_commanded(known):
    watched = unsure(known).until(40.0)
    watched.watch.since_s = 45.0
    watched.until(60.0)
    assert len(watched.arm.sent) == 4
    watched.arm.program.append((61.0, program(1)[0][1]))
    watched.until(80.0)
    assert len(watched.arm.sent) == 8


def test_nothing_is_asked_that_is_settled_or_where_nothing_is_decided(known):
    clear = unsure(known, alarm=ALL_CLEAR)
    strange = unsure(known, undecided="the log does not fit the profile")
    named = unsure(known, alarm=Alarm(RAISED, "motor_3:steady_state_error"))
    named.watch.believed = replace(named.watch.believed, probability=np.array([0.03, 0.96, 0.01]))
    for watched in (clear, strange, named, unsure(known, ProbeRules(0))):
        assert watched.until(20.0).arm.sent == []
    unnamed = unsure(known, alarm=Alarm(RAISED, "motor_3:steady_state_error"))
    assert unnamed.until(20.0).arm.sent != []
    unsettled = unsure(known, alarm=Alarm(RAISED, "motor_3:steady_state_error"))
    doubtful = np.array([0.64, 0.359, 0.001])  # the fault is the only one, healthy more probable
    unsettled.watch.believed = replace(unsettled.watch.believed, probability=doubtful)
    assert len(unsettled.until(40.0).arm.sent) == 4


def test_an_arm_that_is_commanded_or_moves_is_never_asked(known):
    """Movements of the operator, each within the time that the arm must be left alone."""
    small = [Order(np.full(4, 0.1 + 0.02 * (k % 2)), np.full(4, 0.8)) for k in range(8)]
    then = [(5.4 + 5.0 * (k + 1), order) for k, order in enumerate(small)]
    assert unsure(known, then=then).until(45.0).arm.sent == []
    watched = unsure(known)
    watched.arm.swings = 0.05
    assert watched.until(30.0).arm.sent == []


def test_without_a_command_heard_it_is_not_known_where_to_go_back_to(known):
    watched = Watched(known, Arm(known, []), ProbeRules(2, 5.0), Unsure(known)).until(30.0)
    assert watched.arm.sent == []


def test_a_real_arm_is_told_what_would_be_ordered(known):
    watched = unsure(known, ProbeRules(2, 5.0, moves=False)).until(30.0)
    assert watched.arm.sent == []
    assert [text.split(" ")[:2] for text in watched.said[1:]] == [["would", "order"]]


@pytest.mark.parametrize("after_s", [1.0, 4.0])
def test_a_person_who_commands_the_arm_ends_it(known, after_s):
    """The order of somebody else, such as of `failuretwin stop`: away, or on the way back."""
    watched = unsure(known, ProbeRules(9, 5.0)).until(11.0)
    stop = Order(np.array([0.1, 0.1, 0.0, 0.0]), np.full(4, 0.5))
    watched.arm.program.append((11.2 + after_s, stop))
    watched.until(60.0)
    sent = len(watched.arm.sent)
    assert 1 <= sent <= 4
    np.testing.assert_array_equal(watched.arm.standing, stop.target)
    assert any("somebody else commands the arm" in text for text in watched.said)
    watched.arm.program.append((61.0, program(1)[0][1]))
    watched.until(90.0)
    assert len(watched.arm.sent) == sent


def test_an_arm_that_is_left_away_from_its_place_is_told(known):
    """The gate refuses the way back: nothing is sent, and it is said."""
    watched = unsure(known).until(11.0)
    gate = watched.prober._gate

    class OneWay(SafetyGate):
        def wrong(self, order, ways):
            back = np.array_equal(order.target, watched.arm.program_end)
            return "it is Sunday" if back and len(ways) == 1 else gate.wrong(order, ways)

    watched.arm.program_end = program(3)[-1][1].target
    watched.prober._gate = OneWay(gate.robot)
    watched.until(60.0)
    assert len(watched.arm.sent) == 1
    assert watched.said[-1] == "the arm was not sent back to where it was"


def test_numbers_that_make_no_sense():
    for most, idle_s in ((-1, 10.0), (3, -1.0), (3, np.inf), (3, np.nan)):
        with pytest.raises(InputError, match="expected a number from 0"):
            ProbeRules(most, idle_s)


# Over a network.


STANDARD = RosTopics(
    command="/arm/command", command_type="trajectory_msgs/JointTrajectory",
    position="/joint_states", position_type="sensor_msgs/JointState",
)  # fmt: skip
FASTER = 4.0
"""The arm's time in ours."""


def arm_on_rosbridge(server, arm, robot, over):
    """Let a server say what an arm does, orders of others too, and the arm do what it hears."""
    writer, done = RosWriter(robot, STANDARD), 0
    writer.origin = arm.pose
    while not over.wait(0.1 / FASTER):
        for call in server.published[done:]:
            last = call["msg"]["points"][-1]
            at, target = last["time_from_start"], np.array(last["positions"])
            arm.send(Order(target, np.full(4, at["secs"] + 1e-9 * at["nsecs"])))
            done += 1
        event = arm.poll(0.0)
        while isinstance(event, CommandSent):
            message = writer.command(event)
            server.publish(message.topic, message.content)
            event = arm.poll(0.0)
        for message in writer.messages(event):
            server.publish(message.topic, message.content)


def test_an_arm_is_asked_over_rosbridge_and_is_back(known):
    pytest.importorskip("roslibpy")
    from failuretwin.connection.links.ros_link import RosCommander, open_transport

    arm, server, over = Arm(known, program(3)), FakeRosbridge(free_port()), Event()
    address = f"rosbridge://127.0.0.1:{server.port}"
    robot = Thread(target=arm_on_rosbridge, args=(server, arm, known.robot, over))
    try:
        with open_transport(address) as transport:
            link = RosCommander(known.robot, STANDARD, transport)
            wait_for(lambda: server.has_subscriber("/arm/command"))
            wait_for(lambda: server.has_subscriber("/joint_states"))
            robot.start()
            watched = Watched(known, link, ProbeRules(1, 2.0), Unsure(known))
            until = time.monotonic() + WAIT_S
            while not watched.said and time.monotonic() < until:
                watched.shadow.step(0.02)
                if watched.prober.due:
                    watched.prober.ask(watched.shadow.hear, watched.said.append)
            wait_for(lambda: len(arm.sent) == 2)
    finally:
        over.set()
        robot.join()
        server.stop()
    assert watched.said[-1] == "asked by 1 movement, the arm is back where it was"
    np.testing.assert_allclose(arm.sent[-1].target, program(3)[-1][1].target, atol=1e-6)


# From the command line.


def test_an_emulated_arm_is_watched_that_may_be_asked(failuretwin):
    pytest.importorskip("mujoco")
    answer = failuretwin("watch", "emulated", "--probe", 2, "--speed", 0, "--seconds", 8)
    assert answer.returncode == 0, answer.stderr
    assert "last answer: OK: healthy" in answer.stdout


@pytest.mark.parametrize("source", [".", "recorded.mcap"])
def test_sources_that_only_listen_are_refused(failuretwin, tmp_path, source):
    (tmp_path / "recorded.mcap").touch()
    answer = failuretwin("watch", source, "--probe", 2, folder=tmp_path)
    assert answer.returncode == 2
    assert "can only be listened to, but --probe orders movements" in answer.stderr
    assert answer.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("nosuch.csv", "--probe", 2), "source 'nosuch.csv' does not exist"),
        (("emulated", "--move"), "without --probe N: leave out --move"),
        (("emulated", "--idle", 20, "--floor", 0.1), "leave out --idle and --floor"),
    ],
)
def test_what_is_refused(failuretwin, tmp_path, arguments, said):
    answer = failuretwin("watch", *arguments, folder=tmp_path)
    assert answer.returncode == 2
    assert said in answer.stderr


LISTENER = """
from failuretwin import LinkCounts


class Deaf:
    name, ended, counts = "deaf", True, LinkCounts()

    def __init__(self, robot):
        pass

    def poll(self, timeout_s):
        return None

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass
"""


def test_a_source_of_ones_own_must_take_orders(failuretwin, tmp_path):
    (tmp_path / "mine.py").write_text(LISTENER)
    answer = failuretwin("watch", "mine:Deaf", "--probe", 2, folder=tmp_path)
    assert answer.returncode == 2
    assert "can only be listened to" in answer.stderr
