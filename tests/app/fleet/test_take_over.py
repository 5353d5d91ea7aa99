"""Workers and the server are killed and paused: no alarm is lost, doubled or another."""

from __future__ import annotations

import signal
import time

import failuretwin as ft
from failuretwin.connection.fleet.broker import IN
from failuretwin.data_knowledge.records.schema import notes
from fleet_messages import envelopes
from running_fleet import alarms, ask, start_worker, uncovered, until


def send(url, messages):
    """Publish messages as robots do, in their order."""

    async def publish(broker):
        for one in messages:
            await broker.stream.publish(f"{IN}.{one.robot}.{one.kind}", one.data)

    ask(url, publish)


def said(changes):
    """Return what was decided, whenever it came to the server."""
    return sorted(
        (c["robot"], c["episode"], c["state"], c["cause"], c["before"], c["stream_s"])
        for c in changes
    )


def test_alarms_are_those_of_one_process_whatever_is_killed(server, alone, tmp_path):
    messages = envelopes()
    part = len(messages) // 4
    store = tmp_path / "robots.db"
    ft.open_store(store, create=True)
    first = start_worker(server, "first", "--store", str(store))
    second = start_worker(server, "second", "--store", str(store))
    third = None
    try:
        send(server.url, messages[:part])
        time.sleep(4.0)  # a snapshot is made
        first.send_signal(signal.SIGKILL)
        send(server.url, messages[part : 2 * part])
        server.kill()
        server.start()
        send(server.url, messages[2 * part : 3 * part])
        third = start_worker(server, "third", "--store", str(store))
        second.send_signal(signal.SIGSTOP)
        send(server.url, messages[3 * part :])
        expected = sorted(
            (c.robot, c.episode, c.state, c.cause, c.before, c.stream_s) for c in alone
        )
        until(server.url, alarms, lambda found: len(found) >= len(expected))
        second.send_signal(signal.SIGCONT)
        until(server.url, uncovered, lambda count: count == 0)
        time.sleep(3.0)  # the one that was paused finds its leases gone
        assert said(ask(server.url, alarms)) == expected
        for process in (second, third):
            process.send_signal(signal.SIGTERM)
        for process in (second, third):
            process.wait(30)
    finally:
        for process in (first, second, third):
            if process is not None and process.poll() is None:
                process.kill()
                process.wait()
    ended = [process.returncode for process in (first, second, third)]
    assert ended == [-signal.SIGKILL, 0, 0]
    kept = ft.open_store(store)
    with kept._database.reading() as connection:
        texts = [row.text for row in connection.execute(notes.select())]
    assert len(texts) == len(set(texts)) == len(expected)
    health = {name: kept.history(name).health for name in ("arm_1", "arm_2")}
    assert "motor 3 stuck, raised" in str(health["arm_1"])
    assert "no open fault" in str(health["arm_2"])
