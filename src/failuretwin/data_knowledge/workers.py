"""Workforce: this process, processes of its own, or the workers of a Dask scheduler.

Needs the extra `cluster`, except for one process.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from itertools import islice
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, TypeVar

from failuretwin.core.errors import FailureTwinError, InputError, needs_extra
from failuretwin.failure_behavior.registry import plugin_files

if TYPE_CHECKING:
    from distributed import Client, Future

# Clients of Dask: of a scheduler that runs somewhere, or of processes of our own.

ANSWER_S = 5.0
"""Time that a scheduler has to answer [s]."""
FIRST_WORKER_S = 30.0
"""Time that a first worker has to come, also after all have gone [s]."""
NEVER = logging.CRITICAL + 1
IGNORE_INTERRUPTS = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"
"""First code of our own workers: an interrupt is for the parent, which then ends them."""


@contextmanager
def dask_client(workers: int, scheduler: str | None) -> Iterator[Client]:
    """Give a client of a scheduler, whose workers know all modes; leaving the block closes it.

    Args:
        workers: Processes of our own on this machine, if there is no scheduler.
        scheduler: Address of a running one.

    Raises:
        InputError: If Dask is not installed, or the scheduler does not answer or has no workers.
    """
    with needs_extra("several workers need Dask", "cluster"):
        import distributed  # noqa: F401
    cluster = _own_cluster(workers) if scheduler is None else _connected(scheduler)
    with _silence(), cluster as client:
        for path in plugin_files():
            client.upload_file(str(path))
        yield client


@contextmanager
def _silence() -> Iterator[None]:
    """Keep Dask's log to ourselves: what matters comes back as an error."""
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
def _own_cluster(workers: int) -> Iterator[Client]:
    from distributed import Client, LocalCluster

    cluster = LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        processes=True,
        memory_limit=0,  # no limit: memory is bounded by the size of a chunk
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",  # it insists on a port: any, seen from here alone
        scheduler_kwargs={"dashboard": False},
        silence_logs=NEVER,
        preload=[IGNORE_INTERRUPTS],
    )
    with cluster, Client(cluster, set_as_default=False) as client:
        yield client


@contextmanager
def _connected(address: str) -> Iterator[Client]:
    from distributed import Client
    from distributed.comm.addressing import get_address_host_port

    try:
        get_address_host_port(address)  # a client with a wrong address never closes completely
        client = Client(address, timeout=ANSWER_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(
            f"scheduler {address!r} does not answer ({_reason(error)}). Expected the address that "
            "`dask scheduler` prints when it starts, such as tcp://host:8786."
        ) from error
    with client:
        try:
            client.wait_for_workers(1, timeout=FIRST_WORKER_S)
        except TimeoutError as error:
            raise InputError(
                f"scheduler {address!r} has no workers. Start some: dask worker {address}"
            ) from error
        yield client


def _reason(error: BaseException) -> str:
    """Return what Dask says of an error, on one line."""
    return " ".join(str(error).split()) or type(error).__name__


Item = TypeVar("Item")
Result = TypeVar("Result")

TASKS_PER_THREAD = 2
"""Tasks submitted at a time: one to do and one that waits, which keeps every worker busy."""
LOOK_S = 30.0
"""Time without a result after which it is looked whether there are workers at all [s]."""
LONGEST_WAIT_S = 1800.0
"""Longest wait for the next result [s]: many times what a piece takes on a slow machine."""


WORKERS_PER_CORE = 4
"""Most processes of our own for each processor."""


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
    def map_unordered(
        self, work: Callable[[Item], Result], items: Iterable[Item]
    ) -> Iterator[Iterator[tuple[Item, Result]]]:
        """Give every item with its result, in the order in which they are done.

        A worker that dies is replaced and its items are given to others. Leaving the block ends
        the work.

        Args:
            work: A function that other processes can import.
            items: Its arguments, one a call.

        Raises:
            InputError: If Dask is not installed, or the scheduler or its workers do not answer
                or cannot run the work.
            FailureTwinError: If workers keep dying, are gone for `FIRST_WORKER_S`, or finish
                nothing for `LONGEST_WAIT_S`.
        """
        if self.workers == 1 and self.scheduler is None:
            yield ((item, work(item)) for item in items)
            return
        with (
            dask_client(self.workers, self.scheduler) as client,
            closing(_spread(client, work, items)) as results,
        ):
            yield results


ONE_PROCESS = Workforce()


def _spread(
    client: Client, work: Callable[[Item], Result], items: Iterable[Item]
) -> Generator[tuple[Item, Result]]:
    """Give items with their results; only as many are submitted as workers can do soon."""
    waiting = iter(items)
    submitted: dict[Future[Result], Item] = {}
    done: SimpleQueue[Future[Result]] = SimpleQueue()

    def submit() -> None:
        threads = max(1, sum(client.nthreads().values()))
        for item in islice(waiting, max(0, TASKS_PER_THREAD * threads - len(submitted))):
            future = client.submit(work, item, pure=False)
            submitted[future] = item
            future.add_done_callback(done.put)

    submit()
    while submitted:
        future = _next_done(client, done)
        yield submitted.pop(future), _result(future)
        submit()


def _next_done(client: Client, done: SimpleQueue[Future[Result]]) -> Future[Result]:
    """Wait for the next future that is done, but not for ever."""
    for _ in range(round(LONGEST_WAIT_S / LOOK_S)):
        try:
            return done.get(timeout=LOOK_S)
        except Empty:
            _check_workers(client)
    raise _nothing_done()


def _check_workers(client: Client) -> None:
    try:
        client.wait_for_workers(1, timeout=FIRST_WORKER_S)
    except TimeoutError as error:
        raise FailureTwinError(
            f"all workers have gone, and none came back within {FIRST_WORKER_S:g} s. Look for what "
            "ended them, such as too little memory; start those of a scheduler again; and run the "
            "same command again."
        ) from error


def _nothing_done() -> FailureTwinError:
    return FailureTwinError(
        f"workers are there, but finished nothing for {LONGEST_WAIT_S / 60:g} minutes. Look at "
        "what they do, end them or start the scheduler again, and run the same command again."
    )


def _result(future: Future[Result]) -> Result:
    from distributed import CancelledError, KilledWorker

    try:
        return future.result(timeout=LONGEST_WAIT_S)
    except TimeoutError as error:
        if future.status == "error":  # that of the work itself
            raise
        raise _nothing_done() from error  # it was lost with its worker, and is made again
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
