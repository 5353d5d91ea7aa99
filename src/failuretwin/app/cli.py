"""The command line: `failuretwin VERB ...`.

Verbs import what they need when they run, so that `--help` answers at once. Errors meant for
users end in one line and exit code 2.
"""

from __future__ import annotations

import os
import signal
import sys

import click

from failuretwin import __version__
from failuretwin.app.commands.act import act, reach, stop
from failuretwin.app.commands.benchmark import benchmark, data
from failuretwin.app.commands.check import check, design, isolability
from failuretwin.app.commands.console import console
from failuretwin.app.commands.data import import_, robot, simulate
from failuretwin.app.commands.diagnose import demo, diagnose
from failuretwin.app.commands.doctor import doctor
from failuretwin.app.commands.fleet import bridge, fleet, worker
from failuretwin.app.commands.learn import calibrate, study, train
from failuretwin.app.commands.live import emulate, watch
from failuretwin.app.commands.results import advise, evaluate
from failuretwin.app.commands.store import found, history, query, repaired, store
from failuretwin.app.terminal import tell
from failuretwin.core.errors import FailureTwinError

RENAMED = {"imperfections": "calibration", "plot": "report"}
"""Options that still work under an old name."""
CONTEXT = {
    "help_option_names": ["-h", "--help"],
    "max_content_width": 100,
    "show_default": True,
    "token_normalize_func": lambda name: RENAMED.get(name, name),
}


@click.group(context_settings=CONTEXT)
@click.version_option(__version__, prog_name="failuretwin")
def cli() -> None:
    """Tell from commands and the tool path alone which motor of a robot arm failed, and how."""


for command in (
    *(demo, import_, doctor, simulate, diagnose, evaluate, calibrate),
    *(train, study, benchmark, data, emulate, watch, act, stop, reach, check, design, isolability),
    *(advise, robot, store, history, found, repaired, query, bridge, worker, fleet, console),
):
    cli.add_command(command)


def main() -> None:
    """Run the command line."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends work as Ctrl-C does
    try:
        cli(standalone_mode=False)
        sys.stdout.flush()
    except click.exceptions.Abort:
        sys.exit("interrupted")
    except click.ClickException as error:
        error.show()
        sys.exit(2)
    except FailureTwinError as error:
        tell(f"error: {error}", err=True)
        sys.exit(2)
    except OSError as error:  # the output itself: a full disk, or a reader that has gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(error, BrokenPipeError):
            tell(f"error: output could not be written ({error.strerror}).", err=True)
        sys.exit(2)
