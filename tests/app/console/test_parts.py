from __future__ import annotations

import time
from contextlib import ExitStack, suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("nicegui")

from failuretwin.app.console import (
    act,
    charts,
    demo,
    history,
    live,
    parts,
    robot,
    state,
    texts,
    users,
    wall,
)
from failuretwin.app.console.checking import HANGS_S, Stoppable, beat_watch
from failuretwin.app.console.desk import Desk
from failuretwin.app.console.layout import Visit
from failuretwin.app.console.live import LiveRobot, LiveSettings
from failuretwin.connection.links.base import Order, Reading
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.data_knowledge.readers.read import read_runs
from failuretwin.data_knowledge.records.queries import RobotGlance
from failuretwin.data_knowledge.records.store import open_store
from failuretwin.decision.acting.work import Halted
from failuretwin.digital_model.calibrated_robot import calibrated
from failuretwin.digital_model.inverse_kinematics import InverseKinematics
from failuretwin.inference.advice import NOTHING_TO_DO

NOW = datetime(2026, 3, 1, tzinfo=UTC)


def test_the_end_waits_for_the_logs_that_the_demo_writes(armpi, tmp_path):
    # cut off, the thread keeps HDF5's lock, and the interpreter never ends
    with ExitStack() as stack:
        store = demo.demo_store(tmp_path, calibrated(armpi), stack)
    assert set(demo.LOGS) <= {one.robot for one in store.overview()}
    for logs in demo.LOGS.values():
        for name, _ in logs:
            assert read_runs(tmp_path / f"{name}.nc", armpi).sizes["run"] == 1


def glance(days=1.0, verdict_state="healthy", faults=None, remarks=()):
    at = None if days is None else NOW - timedelta(days=days)
    return RobotGlance("hall-arm", "armpi_fpv", at, verdict_state, "said", faults or {}, remarks)


@pytest.mark.parametrize(
    ("one", "expected"),
    [
        (glance(), state.HEALTHY),
        (glance(faults={"motor_3:stuck": True}), state.ALARM),
        (glance(verdict_state="cannot tell"), state.UNDECIDED),
        (glance(days=31.0), state.STALE),
        (glance(days=31.0, faults={"motor_3:stuck": False}), state.STALE),
        (glance(days=None), state.WAITING),
    ],
)
def test_the_state_of_a_stored_robot(one, expected):
    tile = state.stored_tile(one, NOW)
    assert (tile.state, tile.site) == (expected, "hall")


DOUBT = "the log does not fit the profile (97.0 % sure): the sense of motor 2 is wrong"


@pytest.mark.parametrize(
    ("given", "states"),
    [
        ({}, (state.SET_UP,)),
        ({"verdict_state": "cannot tell"}, (state.SET_UP,)),
        ({"faults": {"motor_3:stuck": True}}, (state.ALARM, state.SET_UP)),
        ({"days": 31.0}, (state.STALE, state.SET_UP)),
    ],
)
def test_a_robot_whose_set_up_is_uncertain_is_shown_so(given, states):
    tile = state.stored_tile(glance(**given, remarks=("", "readings glitch", DOUBT)), NOW)
    assert (tile.states, tile.set_up) == (states, DOUBT)
    assert DOUBT in tile.said
    assert tile.record()["states"] == states


def test_an_arm_whose_fleet_doubts_its_set_up_is_shown_so():
    robot = {"state": "undecided", "cause": DOUBT, "heard": 100.0}
    status = {"partitions": {"p1": {"at": 100.0, "robots": {"a": robot}}}}
    (tile,) = state.fleet_tiles(status, {}, 101.0)
    assert (tile.states, tile.said) == ((state.SET_UP,), DOUBT)


def test_a_text_that_is_cut_ends_with_an_ellipsis():
    assert state.shortened("whole", 5) == "whole"
    assert state.shortened("cut in half", 5) == "cut…"


def test_the_wall_is_told_that_it_is_loaded_even_if_there_is_no_robot():
    shown = wall.Wall.__new__(wall.Wall)
    shown._shown, sent = None, []
    shown.run_method = lambda *told: sent.append(told)
    for _ in range(2):
        shown.show({})
    assert sent == [("update", [], [])]


def test_the_worst_robot_comes_first():
    tiles = [state.Tile(s, "", s, "", "", None) for s in reversed(state.WORST_FIRST)]
    assert [t.state for t in state.worst_first(tiles)] == list(state.WORST_FIRST)


def test_a_fleet_whose_worker_is_silent_is_stale():
    robot = {"state": "clear", "cause": "", "heard": 100.0}
    status = {"partitions": {"p1": {"at": 100.0, "robots": {"a": robot}}}}
    (fresh,), (late,) = (state.fleet_tiles(status, {}, now) for now in (101.0, 200.0))
    assert (fresh.state, late.state) == (state.HEALTHY, state.STALE)
    assert late.said == "last word: healthy"


def test_a_stuck_motor_is_drawn_where_it_is_held_while_the_others_trail(armpi):
    arm, motors = InverseKinematics.of(armpi), armpi.motor_names
    command = np.array([0.3, 0.4, -0.5, 0.6])
    trailing = command - np.array([0.2, 0.1, 0.0, 0.3])
    trailing[2] = 0.1
    found = Diagnosis(
        "",
        {"healthy": 0.01, "motor_3:stuck": 0.99},
        magnitude=0.1,
        magnitude_unit="rad",
    )
    suspect = state.suspected_motors(motors, found)
    held = state.held_motor(motors, suspect, found)
    drawn = state.seen_pose(arm, command, arm.tool(trailing[None])[0][0], suspect, held)
    assert drawn == pytest.approx([0.3, 0.4, 0.1, 0.6])
    assert state.held_motor(motors, ~suspect, found) is None
    off = replace(found, posterior={"healthy": 0.01, "motor_3:steady_state_error": 0.99})
    assert state.held_motor(motors, suspect, off) is None


def test_only_the_suspected_motor_of_the_drawn_arm_differs(armpi):
    arm = InverseKinematics.of(armpi)
    command = np.array([0.3, 0.4, -0.5, 0.6])
    true = command + np.array([0.0, 0.0, 0.35, 0.0])
    tool = arm.tool(true[None])[0][0]
    suspect = state.suspected_motors(
        armpi.motor_names, Diagnosis("", {"healthy": 0.1, "motor_3:stuck": 0.9})
    )
    assert state.seen_pose(arm, command, tool, suspect) == pytest.approx(true, abs=1e-4)
    left = state.residuals(arm, command[None], tool[None])[0]
    assert np.argmin(left) == 2
    assert left[2] < 1e-5
    assert left[-1] == pytest.approx(np.linalg.norm(tool - arm.tool(command[None])[0][0]))


def test_lines_are_not_drawn_across_times_without_readings(armpi):
    time_s = np.r_[np.arange(0.0, 1.0, 0.1), np.arange(5.0, 6.0, 0.1)]
    command = np.zeros((len(time_s), 4))
    tool, _ = InverseKinematics.of(armpi).tool(command)
    trace = state.Trace("run", time_s, command, tool, np.zeros(0), None)
    measured, commanded = charts.tool_lines(trace, calibrated(armpi), -np.inf)[:2]
    assert measured[1][np.isnan(measured[2])] == pytest.approx([2.95])
    assert np.isfinite(commanded[2]).all()
    for _, at, value in charts.residual_lines(trace, InverseKinematics.of(armpi), -np.inf):
        assert at[np.isnan(value)] == pytest.approx([2.95])


def test_a_movement_ends_before_the_next_begins():
    time_s, still = np.array([3.0, 3.5, 4.0, 4.5, 6.0]), np.zeros((5, 4))
    starts = np.array([2.0, 3.0, 4.2, 5.0, 5.5])
    trace = state.Trace("live", time_s, still, still[:, :3], starts, None, first=7)
    ends = [trace.end_of(number) for number in range(6, 13)]
    assert ends == [None, None, 4.0, 4.5, None, 6.0, None]


@pytest.mark.parametrize("time_s", [[], [1.0], [0.0, 0.1, 0.2]])
def test_readings_without_a_gap(time_s):
    assert len(charts.silences(np.array(time_s))) == 0


HEALTHY = Diagnosis("", {"healthy": 1.0, "motor_3:stuck": 0.0})


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"days": 40.0}, ["silent since Monday", "Its last word is old"]),
        ({"remarks": ("", DOUBT)}, ["Put the set-up right first", "the sense of motor 2 is wrong"]),
        ({"faults": {"motor_3:stuck": True}}, ["'motor 3 stuck' is still open"]),
    ],
)
def test_a_robot_that_needs_somebody_is_never_told_to_be_left_alone(armpi, given, said):
    one = glance(**given)
    tile = state.stored_tile(one, NOW)
    lines = parts.step_lines(armpi, tile, "Monday", HEALTHY, list(one.faults))
    assert all(words in " ".join(lines) for words in said)
    assert NOTHING_TO_DO not in lines


def test_a_healthy_robot_is_left_alone_and_an_alarm_that_its_run_shows_is_told_once(armpi):
    stuck = Diagnosis("", {"healthy": 0.0, "motor_3:stuck": 1.0})
    tile = state.stored_tile(glance(), NOW)
    assert parts.step_lines(armpi, tile, "Monday", HEALTHY, []) == [NOTHING_TO_DO]
    assert len(parts.step_lines(armpi, tile, "Monday", stuck, ["motor_3:stuck"])) == 1


def test_an_overview_of_the_store_and_a_repair_that_is_taken_back(armpi, tmp_path):
    store = open_store(tmp_path / "robots.db", create=True)
    stuck = Diagnosis("run", {"healthy": 0.01, "motor_3:stuck": 0.99}, verdict="motor 3 stuck")
    store.remember([stuck], "arm", profile=armpi)
    (one,) = store.overview()
    assert (one.robot, one.kind, one.state) == ("arm", "armpi_fpv", "faulty")
    assert one.faults == {"motor_3:stuck": False}
    assert history.suspected_motor(store.history("arm"), armpi.motor_names) == "motor_3"
    desk = Desk(calibrated(armpi), store, None, {}, False, 1.0, tmp_path)
    desk.look()
    assert desk.open_faults("arm") == ["motor_3:stuck"]
    assert desk.last_diagnosis("arm").posterior == stuck.posterior
    (run,) = store.runs("arm")
    assert (run.name, run.posterior, run.position) == ("run", dict(stuck.posterior), 0)
    store.found("arm", 1, "wrong")
    assert store.overview()[0].faults == {}
    assert history.suspected_motor(store.history("arm"), armpi.motor_names) == "motor_1"
    store.repaired("arm", "motor_3", part="gear")
    assert len(store.history("arm").repairs) == 1
    store.withdraw_repair("arm", "motor_3", person="Ada")
    assert store.history("arm").repairs == ()
    with pytest.raises(InputError, match="no repair to withdraw"):
        store.withdraw_repair("arm", "motor_3")


def test_a_field_that_may_not_be_empty_says_which_it_is():
    assert history._filled(SimpleNamespace(value=" Ada "), texts.YOUR_NAME) == "Ada"
    with pytest.raises(InputError, match="Fill in the field 'Your name' first"):
        history._filled(SimpleNamespace(value=" "), texts.YOUR_NAME)


def test_a_robot_whose_wear_is_not_tracked_has_a_sentence_for_people(armpi, tmp_path):
    store = open_store(tmp_path / "robots.db", create=True)
    store.remember([Diagnosis("run", {"healthy": 1.0})], "arm", profile=armpi)
    desk = Desk(calibrated(armpi), store, None, {}, False, 1.0, tmp_path)
    desk.look()
    assert desk.remaining_life("arm") == [texts.NOT_TRACKED]


def test_passwords_are_salted_and_files_of_users_are_checked(tmp_path):
    path = tmp_path / "users.toml"
    users.add_user(path, "ada", "move", "secret")
    users.add_user(path, "bob", "see", "secret")
    known = users.load_users(path)
    assert known["ada"].password != known["bob"].password
    assert path.stat().st_mode & 0o077 == 0
    sessions = users.Sessions(known)
    token = sessions.sign_in("ada", "secret")
    assert sessions.of(token).may("confirm")
    assert sessions.sign_in("ada", "Secret") == ""
    path.write_text('[ada]\nrole = "king"\npassword = "scrypt:00:00"\n')
    with pytest.raises(InputError, match="role"):
        users.load_users(path)


def test_sessions_expire(tmp_path, monkeypatch):
    known = {"ada": users.User("ada", "see", users.hashed("secret"))}
    sessions = users.Sessions(known)
    session = sessions.of(sessions.sign_in("ada", "secret"))
    assert not session.may("confirm")
    session.seen_s -= users.SESSION_S + 1.0
    assert not session.may("see")


@pytest.mark.parametrize("name", ["../../x.csv", "a/b\\c.csv", "<b>.csv", ".csv", "x\x00.csv"])
def test_a_log_lies_in_our_folder_whatever_its_name(tmp_path, name):
    with suppress(InputError):
        assert act.placed(tmp_path, name, b"x").parent.parent == tmp_path


@pytest.mark.parametrize("name", ["x.exe", "x.html", "x", "x.csv.svg", "x.parquet"])
def test_other_files_are_refused(tmp_path, name):
    with pytest.raises(InputError, match=r"Expected a file that ends in .nc, .csv"):
        act.placed(tmp_path, name, b"x")


class FakeArm:
    name, ended, counts, standing = "fake", False, None, np.zeros(2)

    def __init__(self):
        self.sent = []

    def poll(self, timeout_s):
        return Reading(0.0, position=np.array([0.1, 0.2]))

    def send(self, order):
        self.sent.append(order)


def test_a_stopped_arm_is_told_to_stay_where_it_was_read():
    arm, why = FakeArm(), []
    stoppable = Stoppable(arm, lambda: why[0] if why else "")
    stoppable.poll(0.1)
    stoppable.send(Order(np.ones(2), np.ones(2)))
    why.append("stopped by ada")
    for use in (lambda: stoppable.poll(0.1), lambda: stoppable.send(arm.sent[0])):
        with pytest.raises(Halted, match="stopped by ada"):
            use()
        assert arm.sent[-1].target.tolist() == [0.1, 0.2]


def test_a_check_that_is_stopped_before_it_began_sends_nothing():
    arm = FakeArm()
    with pytest.raises(Halted, match="stopped by ada; nothing was sent"):
        Stoppable(arm, lambda: "stopped by ada").poll(0.1)
    assert arm.sent == []


def test_an_arm_whose_motors_are_not_read_is_not_told_to_stay_anywhere():
    arm, why = FakeArm(), []
    stoppable = Stoppable(arm, lambda: why[0] if why else "")
    stoppable.send(Order(np.ones(2), np.ones(2)))
    why.append("stopped by ada")
    with pytest.raises(Halted, match="use the emergency stop"):
        stoppable.poll(0.1)
    assert len(arm.sent) == 1


def test_a_check_stops_by_itself_if_the_console_hangs_or_its_page_is_gone():
    now = time.monotonic()
    late = now - HANGS_S - 1.0
    assert beat_watch(lambda: now, lambda: now)() == ""
    assert beat_watch(lambda: late, lambda: now)() == texts.HANG
    assert beat_watch(lambda: now, lambda: late)() == texts.GONE


class Unheard:
    """A diagnoser of a robot that nobody is heard of."""

    set_up = None


def watched(robot, open_source):
    known = calibrated(robot)
    return LiveRobot(LiveSettings("arm", known, Unheard(), open_source))


def test_the_store_of_the_demo_knows_its_arms_at_work(armpi, tmp_path):
    store = open_store(tmp_path / "robots.db", create=True)
    for arm in demo.demo_arms(store, calibrated(armpi), 1.0).values():
        arm._begin_keeping()
    assert set(store.robots()) == set(demo.ARMS)


def test_the_end_of_a_watch_is_waited_for(armpi):
    def slow(stack):
        time.sleep(0.1)
        raise InputError("no robot")

    arm = watched(armpi, slow)
    arm.wait(5.0)  # it was never begun
    arm.start()
    arm.stop()
    arm.wait(5.0)
    assert arm.tile.said.startswith("no robot; last word")


def test_a_robot_whose_watch_fails_or_hangs_is_stale(armpi):
    def broken(stack):
        raise ZeroDivisionError("broken")

    failed, hung = watched(armpi, broken), watched(armpi, broken)
    assert hung.tile.state == state.WAITING
    with pytest.raises(ZeroDivisionError):
        failed._run()
    assert failed.tile.state == state.STALE
    assert failed.tile.said.startswith("the watch has failed: ZeroDivisionError: broken; last word")
    hung._seen_s = time.monotonic() - live.HANGS_S - 1.0
    assert (hung.tile.state, hung.tile.said) == (state.STALE, "last word: nothing was heard yet")


@pytest.mark.parametrize(
    ("unit", "text", "said"),
    [
        ("deg", "motor 3 stuck at 26 deg since 0.5 s", "motor 3 stuck at 26 deg since 0.5 s"),
        ("rad", "motor 3 stuck at 26 deg since 0.5 s", "motor 3 stuck at 0.454 rad since 0.5 s"),
        (
            "counts",
            "motor 3 stuck at 26 deg since 0.5 s",
            "motor 3 stuck at 392 counts since 0.5 s",
        ),
        ("rad", "motor 2 drifts by -9.0 deg/s", "motor 2 drifts by -0.157 rad/s"),
        ("counts", "motor 2 drifts by +9.00 deg/s", "motor 2 drifts by -38 counts/s"),
        ("counts", "misses by about 2.4 deg", "misses by about 10 counts"),
        ("rad", "+1.80 +- 0.90 deg", "0.031 +- 0.016 rad"),
        ("counts", "-1.80 +- 0.90 deg", "8 +- 4 counts"),
        ("rad", "from 90 to 180 deg", "from 1.571 to 3.142 rad"),
    ],
)
def test_angles_in_texts_are_in_the_unit_of_the_reader(armpi, unit, text, said):
    visit = Visit(None, None, "auto", unit, None)
    assert visit.words(text, armpi) == said


@pytest.mark.parametrize("unit", ["deg", "rad", "counts"])
def test_an_angle_that_is_typed_is_meant_as_it_is_shown(armpi, unit):
    visit = Visit(None, None, "auto", unit, None)
    told = float(visit.angle(0.3, armpi, 2).split()[0])
    assert visit.held(told, armpi, 2) == pytest.approx(0.3, abs=0.005)


@pytest.mark.parametrize(
    ("told", "said"), [(None, "Fill in the field"), (9999.0, "can stand from")]
)
def test_an_angle_where_no_motor_stands_is_refused(armpi, told, said):
    visit = Visit(None, None, "auto", "deg", None)
    with pytest.raises(InputError, match=said):
        robot.held_angle(visit, armpi, "motor_3", told)
    assert robot.held_angle(visit, armpi, "motor_3", 20.0) == pytest.approx(np.deg2rad(20.0))


def test_the_reach_is_asked_for_the_suspected_motor_where_it_stands(armpi):
    stuck = Diagnosis("", {"healthy": 0.01, "motor_3:stuck": 0.99})
    said = "motor 3 stuck at -20 deg since 0.5 s, over 99.9 % sure"
    assert robot.suspect_and_angle(armpi, stuck, said) == ("motor_3", np.deg2rad(-20.0))
    assert robot.suspect_and_angle(armpi, stuck, "motor 3 stuck")[0] == "motor_3"
    assert robot.suspect_and_angle(armpi, HEALTHY, "healthy") == ("", 0.0)
