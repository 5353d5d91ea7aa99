"""What `worker` does: filter partitions, and write alarms into the store."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from contextlib import AsyncExitStack, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from failuretwin.app.fleet import resolver, run_until_stopped
from failuretwin.app.terminal import tell
from failuretwin.connection.fleet.broker import ALARM, ALARM_STREAM, Access, Broker, open_broker
from failuretwin.connection.fleet.mqtt import Retained
from failuretwin.core.config import from_table
from failuretwin.core.errors import FailureTwinError, InputError
from failuretwin.core.hypothesis import RAISED, Diagnosis
from failuretwin.decision.fleet.metrics import Metrics
from failuretwin.decision.fleet.worker import Outlets, Settings, Worker

if TYPE_CHECKING:
    from failuretwin.data_knowledge.records.store import Store

WRITER = "store"
"""Consumer that the workers of a store share."""
WAIT_S = 1.0
"""Longest wait for an alarm before we look whether to stop, and after a store that failed [s]."""


def work(
    access: Access,
    settings: Settings,
    profiles: Path | None,
    *,
    store: str | None,
    metrics: str | None,
    mqtt: str | None,
) -> None:
    """Work until stopped."""
    import failuretwin as ft

    figures = Metrics()
    if metrics is not None:
        figures.serve(*_address(metrics))
    records = ft.open_store(store) if store else None

    async def main(stop: asyncio.Event) -> None:
        async with AsyncExitStack() as stack:
            broker = await stack.enter_async_context(await open_broker(access, settings.name))
            retained = stack.enter_context(Retained(mqtt, settings.name, tell, access.ca))
            outlets = Outlets(tell, figures, retained.publish if mqtt else None)
            worker = Worker(broker, settings, resolver(profiles), outlets)
            tell(f"worker {settings.name} at {access.shown}; stop with Ctrl-C")
            await broker.set_up()
            await broker.check_mapping(settings.partitions)
            writer = None
            if records is not None:
                writer = asyncio.create_task(write_alarms(broker, records, stop, tell))
            await worker.run(stop)
            if writer is not None:
                await writer

    run_until_stopped(main)


def _address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not (port.isdecimal() and 0 < int(port) < 65536):
        raise InputError(f"--metrics is {text!r}, expected [HOST:]PORT.")
    return host or "127.0.0.1", int(port)


async def write_alarms(
    broker: Broker, store: Store, stop: asyncio.Event, say: Callable[[str], None]
) -> None:
    """Write alarms into a store, each once, until `stop` is set; a store that fails is waited for.

    Workers of the same store share the work; an alarm counts as written once it is stored.
    """
    from nats.errors import Error

    source, trouble = None, ""
    while not stop.is_set():
        try:
            source = source or await broker.stream.pull_subscribe(
                f"{ALARM}.>", durable=WRITER, stream=ALARM_STREAM
            )
            messages = await source.fetch(10, timeout=WAIT_S)
        except TimeoutError:
            continue
        except (Error, OSError):
            source = None
            await asyncio.sleep(WAIT_S)
            continue
        for one in messages:
            try:
                await asyncio.to_thread(_write, store, json.loads(one.data))
                await one.ack()
                trouble = ""
            except FailureTwinError as error:
                if not trouble:
                    trouble = str(error)
                    say(f"alarms wait until they can be stored: {trouble}")
                with suppress(Error, OSError, TimeoutError):
                    await one.nak(delay=WAIT_S)
            except (Error, OSError, TimeoutError):  # it comes again, and is known then
                continue


def _write(store: Store, change: dict[str, Any]) -> None:
    """Write an alarm; one that was written before changes nothing."""
    raised = change["state"] == RAISED
    verdict = f"{change['cause']} ({'alarm' if raised else 'cleared'})"
    store.keep_alarm(
        change["robot"],
        identity=f"{change['life']}.{change['episode']}.{change['state']}",
        text=verdict,
        at=datetime.fromtimestamp(change["at"], UTC),
        before=change["before"],
        now=change["cause"] if raised else "",
        diagnosis=from_table(Diagnosis, change["diagnosis"], "alarm"),
    )
