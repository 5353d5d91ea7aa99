"""Workforce: this process, processes of its own, or the workers of a Dask scheduler.

Needs the extra `cluster`, except for one process.
"""

from __future__ import annotations

import logging
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

from failuretwin.core.errors import FailureTwinError, InputError, needs_extra
from failuretwin.failure_behavior.registry import plugin_files

if TYPE_CHECKING:
    from distributed import Client, Future

Item = TypeVar("Item")
Result = TypeVar("Result")

WORKERS_PER_CORE = 4
"""Maximum number of processes of our own per processor."""
ANSWER_S = 5.0
"""Time limit for the answer of a scheduler [s]."""
FIRST_WORKER_S = 30.0
"""Time limit for the first worker, also after all have gone [s]."""
LOOK_S = 30.0
"""Wait for a result after which the workers are counted [s]."""
LONGEST_WAIT_S = 1800.0
"""Maximum wait for the next result [s]: many times the duration of a task on a slow machine."""
NEVER = logging.CRITICAL + 1
OWN_WORKERS: dict[str, Any] = {
    "threads_per_worker": 1,
    "processes": True,
    "memory_limit": 0,  # no limit: memory is bounded by the size of a chunk
    "host": "127.0.0.1",
    "dashboard_address": "127.0.0.1:0",  # it insists on a port: any, visible on this machine only
    "scheduler_kwargs": {"dashboard": False},
    "silence_logs": NEVER,
    # The parent process handles an interrupt and ends the workers.
    "preload": ["import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"],
    "set_as_default": False,
}
"""Options of Dask for workers of our own."""


@dataclass(frozen=True)
class Workforce:
    """Processes that do the work.

    Attributes:
        workers: Processes on this machine; 1: this process itself.
        scheduler: Address of a running Dask scheduler, such as ``tcp://host:8786``, whose
            workers do it instead.
    """

    workers: int = 1
    scheduler: str | None = None

    def __post_init__(self) -> None:
        most = WORKERS_PER_CORE * (os.cpu_count() or 1)
        if not 1 <= self.workers <= most:
            raise InputError(
                f"workers is {self.workers}, expected 1 to {most}: more than {WORKERS_PER_CORE} to "
                "each of this machine's processors only get in each other's way."
            )
        if self.scheduler is not None and self.workers > 1:
            raise InputError(
                f"{self.workers} workers here and those of scheduler {self.scheduler} at once "
                "cannot do it. Give one or the other."
            )

    @contextmanager
    def map(
        self, work: Callable[[Item], Result], items: Iterable[Item]
    ) -> Iterator[Iterator[Result]]:
        """Give the results in the order of the items; leaving the block ends the work.

        Other processes must be able to import `work`. A worker that dies is replaced and its items
        are given to others.

        Raises:
            InputError: If Dask is not installed, or the scheduler or its workers do not answer
                or cannot run the work.
            FailureTwinError: If workers keep dying, are gone for `FIRST_WORKER_S`, or do not
                finish the next item within `LONGEST_WAIT_S`.
        """
        if self.workers == 1 and self.scheduler is None:
            yield map(work, items)
            return
        with needs_extra("several workers need Dask", "cluster"):
            import distributed  # noqa: F401
        with _silence(), _dask_client(self) as client:
            for path in plugin_files():
                client.upload_file(str(path))
            futures = deque(client.map(work, list(items), pure=False))
            # They are dropped with their results, to free memory.
            yield (_result(client, futures.popleft()) for _ in range(len(futures)))


ONE_PROCESS = Workforce()


@contextmanager
def _silence() -> Iterator[None]:
    """Keep Dask from logging: errors report what matters."""
    handlers = logging.getLogger("distributed").handlers
    before = [handler.level for handler in handlers]
    for handler in handlers:
        handler.setLevel(NEVER)
    try:
        yield
    finally:
        for handler, level in zip(handlers, before, strict=True):
            handler.setLevel(level)


@contextmanager
def _dask_client(workforce: Workforce) -> Iterator[Client]:
    from distributed import Client

    if workforce.scheduler is None:
        client = Client(n_workers=workforce.workers, **OWN_WORKERS)
    else:
        client = _connected(workforce.scheduler)
    with client:
        try:
            client.wait_for_workers(1, timeout=FIRST_WORKER_S)
        except TimeoutError as error:
            raise InputError(
                f"scheduler {workforce.scheduler!r} has no workers. Start some: dask worker "
                f"{workforce.scheduler}"
            ) from error
        yield client


def _connected(scheduler: str) -> Client:
    from distributed import Client
    from distributed.comm.addressing import get_address_host_port

    try:
        get_address_host_port(scheduler)  # a client with a wrong address never closes completely
        return Client(scheduler, timeout=ANSWER_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(
            f"scheduler {scheduler!r} does not answer ({_reason(error)}). Expected the address "
            "that `dask scheduler` prints when it starts, such as tcp://host:8786."
        ) from error


def _reason(error: BaseException) -> str:
    """Return the message of an error of Dask, on one line."""
    return " ".join(str(error).split()) or type(error).__name__


def _result(client: Client, future: Future[Result]) -> Result:
    from distributed import CancelledError, KilledWorker

    try:
        return _waited_for(client, future)
    except KilledWorker as error:
        raise FailureTwinError(
            "workers died again and again over the same chunk. Look for what ends them, such as "
            "too little memory, and run the same command again."
        ) from error
    except CancelledError as error:
        raise FailureTwinError(
            "the scheduler has gone. Start it again and run the same command again."
        ) from error
    except (ImportError, AttributeError) as error:
        raise InputError(
            f"the workers cannot run failuretwin ({_reason(error)}). Install the same version "
            "there as here."
        ) from error


def _waited_for(client: Client, future: Future[Result]) -> Result:
    """Return a result, with a time limit; one that is lost with its worker is made again."""
    for _ in range(round(LONGEST_WAIT_S / LOOK_S)):
        try:
            return future.result(timeout=LOOK_S)
        except TimeoutError:
            if future.status == "error":  # that of the work itself
                raise
        _check_workers(client)
    raise FailureTwinError(
        f"workers are there, but finished nothing for {LONGEST_WAIT_S / 60:g} minutes. Look at "
        "what they do, end them or start the scheduler again, and run the same command again."
    )


def _check_workers(client: Client) -> None:
    try:
        client.wait_for_workers(1, timeout=FIRST_WORKER_S)
    except TimeoutError as error:
        raise FailureTwinError(
            f"all workers have gone, and none came back within {FIRST_WORKER_S:g} s. Look for what "
            "ended them, such as too little memory; start those of a scheduler again; and run the "
            "same command again."
        ) from error
