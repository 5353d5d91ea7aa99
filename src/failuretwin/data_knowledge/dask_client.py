"""Clients of Dask: of a scheduler that runs somewhere, or of processes of our own.

Needs the extra `cluster`.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from failuretwin.core.errors import InputError

if TYPE_CHECKING:
    from distributed import Client

ANSWER_S = 5.0
"""Time that a scheduler has to answer [s]."""
FIRST_WORKER_S = 30.0
"""Time that a scheduler's first worker has to come [s]."""
NEVER = logging.CRITICAL + 1
IGNORE_INTERRUPTS = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"
"""What our own workers run first: an interrupt is for the parent, which then ends them."""


@contextmanager
def dask_client(workers: int, scheduler: str | None) -> Iterator[Client]:
    """Give a client of a scheduler; leaving the block closes it.

    Args:
        workers: Processes of our own on this machine, if there is no scheduler.
        scheduler: Address of a running one.

    Raises:
        InputError: If Dask is not installed, or the scheduler does not answer or has no workers.
    """
    try:
        import distributed  # noqa: F401
    except ImportError as error:
        raise InputError(
            f"several workers need Dask ({error}). Install it: pip install 'failuretwin[cluster]'."
        ) from error
    with _silence():
        if scheduler is None:
            with _own_cluster(workers) as client:
                yield client
        else:
            with _connected(scheduler) as client:
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
        memory_limit=0,  # no limit: memory is bounded by the size of a piece
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
        get_address_host_port(address)  # a client of what is no address is never quite closed
        client = Client(address, timeout=ANSWER_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(
            f"scheduler {address!r} does not answer ({reason(error)}). Expected the address that "
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


def reason(error: BaseException) -> str:
    """Return what Dask says of an error, on one line."""
    return " ".join(str(error).split()) or type(error).__name__
