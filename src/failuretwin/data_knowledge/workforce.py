"""Who does the work: this process, processes of its own, or the workers of a Dask scheduler.

Needs the extra `cluster`, except for one process.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING, TypeVar

from failuretwin.core.errors import FailureTwinError, InputError
from failuretwin.data_knowledge.dask_client import dask_client, reason

if TYPE_CHECKING:
    from distributed import Client, Future

Item = TypeVar("Item")
Result = TypeVar("Result")

TASKS_PER_THREAD = 2
"""Tasks given out at a time: one to do, one that waits, so that no worker is ever idle."""


@dataclass(frozen=True)
class Workforce:
    """Who does the work.

    Attributes:
        workers: Processes on this machine; 1: this process itself.
        scheduler: Address of a running Dask scheduler, such as ``tcp://host:8786``, whose
            workers do it instead.
    """

    workers: int = 1
    scheduler: str | None = None

    def __post_init__(self) -> None:
        if self.workers < 1:
            raise InputError(f"workers is {self.workers}, expected 1 or more.")
        if self.scheduler is not None and self.workers > 1:
            raise InputError(
                f"{self.workers} workers here and those of scheduler {self.scheduler} at once "
                "cannot do it. Give one or the other."
            )

    @contextmanager
    def at_work(
        self, work: Callable[[Item], Result], items: Iterable[Item]
    ) -> Iterator[Iterator[tuple[Item, Result]]]:
        """Give every item with its result, in the order in which they are done.

        A worker that dies is replaced and its items are given to others. Leaving the block ends
        the work.

        Args:
            work: What to do; a function that other processes can import.
            items: What to do it to.

        Raises:
            InputError: If Dask is not installed, or the scheduler or its workers do not answer
                or cannot run the work.
            FailureTwinError: If workers keep dying.
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
    """Give items with their results; only as many are given out as workers can do soon."""
    from distributed import as_completed

    waiting = iter(items)
    given: dict[Future[Result], Item] = {}

    def give_out() -> list[Future[Result]]:
        threads = max(1, sum(client.nthreads().values()))
        futures = []
        for item in islice(waiting, max(0, TASKS_PER_THREAD * threads - len(given))):
            future = client.submit(work, item, pure=False)
            given[future] = item
            futures.append(future)
        return futures

    running = as_completed(give_out(), loop=client.loop)
    for future in running:
        yield given.pop(future), _result(future)
        running.update(give_out())


def _result(future: Future[Result]) -> Result:
    from distributed import CancelledError, KilledWorker

    try:
        return future.result()
    except KilledWorker as error:
        raise FailureTwinError(
            "workers died again and again over the same piece. Look for what ends them, such as "
            "too little memory, and run the same command again."
        ) from error
    except CancelledError as error:
        raise FailureTwinError(
            "the scheduler has gone. Start it again and run the same command again."
        ) from error
    except (ImportError, AttributeError) as error:
        raise InputError(
            f"the workers cannot run failuretwin ({reason(error)}). Install the same version "
            "there as here."
        ) from error
