"""`failuretwin demo`: the runs that come with the package, diagnosed."""

from __future__ import annotations

from pathlib import Path

import click

from failuretwin.app.commands.diagnose import diagnose
from failuretwin.app.commands.options import report_option
from failuretwin.app.terminal import tell


@click.command()
@report_option("Also write a page with pictures there (needs the extra `plots`).")
def demo(report: Path | None) -> None:
    """Diagnose three simulated runs that come with the package, as `diagnose LOG` would.

    One is healthy, one has a stuck motor, one a motor that misses its targets.
    """
    from failuretwin.data_knowledge.readers.read import sample_log

    words = [str(sample_log()), *([] if report is None else ["--report", str(report)])]
    tell(f"failuretwin diagnose {' '.join(words)}\n")
    diagnose.main(words, prog_name="failuretwin diagnose", standalone_mode=False)
