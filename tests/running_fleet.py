"""Workers and messages on a real server."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from contextlib import contextmanager

from executed import command_line
from failuretwin.app.fleet import resolver
from failuretwin.connection.fleet.broker import (
    ALARM_STREAM,
    EVENTS_STREAM,
    HEALTH_BUCKET,
    Access,
    open_broker,
)
from failuretwin.decision.fleet.metrics import Metrics
from failuretwin.decision.fleet.worker import Outlets, Settings, Worker

PATIENCE_S = 30.0


def ask(url, question):
    """Return the answer of a coroutine function that gets a broker."""

    async def main():
        broker = await open_broker(Access(url), "test")
        try:
            return await question(broker)
        finally:
            await broker.close()

    return asyncio.run(main())


async def alarms(broker):
    """Return all changes of alarms that the server keeps."""
    state = (await broker.stream.stream_info(ALARM_STREAM)).state
    first = state.first_seq if state.messages else state.last_seq + 1
    messages = [
        await broker.stream.get_msg(ALARM_STREAM, n) for n in range(first, state.last_seq + 1)
    ]
    return [json.loads(one.data) for one in messages]


async def uncovered(broker):
    """Return the number of messages that no snapshot covers."""
    return (await broker.stream.stream_info(EVENTS_STREAM)).state.messages


async def health(broker):
    """Return the reports of all partitions, by key."""
    bucket = await broker.bucket(HEALTH_BUCKET)
    return {key: json.loads((await bucket.get(key)).value) for key in await bucket.keys()}


def until(url, question, holds):
    """Return an answer once it holds; fail if it does not for long."""
    end = time.monotonic() + PATIENCE_S
    while True:
        try:
            answer = ask(url, question)
            if holds(answer):
                return answer
        except Exception as error:
            answer = error
        assert time.monotonic() < end, answer
        time.sleep(0.2)


@contextmanager
def worker_thread(url, name="inside", retain=None, access=None):
    """Run a worker of a server with two partitions in a thread; give it and what it told."""
    told, metrics, ready = [], Metrics(), threading.Event()
    made = {}

    def run():
        async def main():
            broker = await open_broker(access or Access(url), name)
            made["stop"], made["loop"] = asyncio.Event(), asyncio.get_running_loop()
            settings = Settings(name, partitions=2, snapshot_s=1.0)
            worker = Worker(broker, settings, resolver(None), Outlets(told.append, metrics, retain))
            ready.set()
            await worker.run(made["stop"])
            await broker.close()

        asyncio.run(main())

    thread = threading.Thread(target=run)
    thread.start()
    assert ready.wait(20.0)
    end = time.monotonic() + PATIENCE_S
    while sum("from message" in line for line in told) < 2:  # it holds both partitions
        assert thread.is_alive() and time.monotonic() < end, told
        time.sleep(0.05)
    try:
        yield told, metrics
    finally:
        made["loop"].call_soon_threadsafe(made["stop"].set)
        thread.join(30.0)
        assert not thread.is_alive()


def start(log, *words):
    """Start the command line in a process of its own, whose output goes to a file."""
    log.touch()
    return command_line().begin(*words, out=log)


def start_worker(server, name, *more):
    """Start a worker, and wait until it works; its output is NAME.log beside the server's."""
    log = server.folder / f"{name}.log"
    words = ("worker", server.url, "--partitions", "2", "--name", name, "--snapshot", "2")
    process = start(log, *words, *more)
    end = time.monotonic() + PATIENCE_S
    while f"worker {name} at" not in log.read_text():
        assert process.poll() is None and time.monotonic() < end, log.read_text()
        time.sleep(0.1)
    return process
