from __future__ import annotations

from failuretwin.decision.proportions import Share, count_alarms


def test_any_other_verdict_on_a_healthy_run_is_a_false_alarm():
    alarms = count_alarms(["healthy"] * 5, ["healthy", "motor_1:stuck", "unknown", None, "healthy"])
    assert alarms.false_alarms == Share(2, 5)
    assert alarms.healthy_abstained == 1
    assert alarms.missed == Share(0, 0)


def test_a_fault_is_missed_where_no_alarm_is_raised_whatever_its_name():
    said = ["motor_1:stuck", "motor_2:stuck", "unknown", "healthy", None, None]
    alarms = count_alarms(["motor_1:stuck"] * 5 + ["unknown"], said)
    assert alarms.missed == Share(3, 6)
    assert alarms.faulty_abstained == 2
    assert alarms.false_alarms == Share(0, 0)
