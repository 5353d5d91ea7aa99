"""Options of commands whose work can be spread over processes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import click

from failuretwin.app.commands import options as opt

if TYPE_CHECKING:
    from failuretwin.data_knowledge.workers import Workforce


@dataclass(frozen=True)
class WorkforceOptions:
    """Values of `workforce_options`: who does the work."""

    workers: int
    scheduler: str | None

    @property
    def workforce(self) -> Workforce:
        """The processes that do the work."""
        from failuretwin.data_knowledge.workers import Workforce

        return Workforce(self.workers, self.scheduler)


def workforce_options(result: str, shared: str) -> Callable[[opt.F], opt.F]:
    """Return the options `--workers N` and `--scheduler ADDRESS`.

    `result` does not depend on them; workers of a scheduler must share the files `shared`.
    """
    return opt.gathered(
        WorkforceOptions,
        "force",
        opt.count_option(
            "--workers",
            1,
            f"Processes on this machine to spread the work over; {result} do not depend on it.",
            least=1,
        ),
        click.option(
            "--scheduler",
            metavar="ADDRESS",
            help="Dask scheduler whose workers do the work instead, such as tcp://host:8786. They "
            f"must share {shared}.",
        ),
    )
