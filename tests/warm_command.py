"""The command line in a process of its own, without waiting for its imports each time.

A server imports the package and its libraries once, loads what is compiled, and forks for every
call. What a call says goes to files, so that it has no terminal, as with pipes.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import importlib
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import traceback
from pathlib import Path

WARM = (
    *("h5netcdf", "pandas", "scipy.integrate", "scipy.interpolate", "scipy.optimize"),
    *("scipy.signal", "scipy.stats", "xarray", "rich.progress", "rich.table"),
    *(
        "failuretwin.app.cli",
        "failuretwin.app.reports.reports",
        "failuretwin.connection.tracked_diagnosis",
    ),
    *("failuretwin.app.reports.calibration_report", "failuretwin.data_knowledge.generate"),
    *(
        "failuretwin.app.arms",
        "failuretwin.app.live",
        "failuretwin.decision.test_motions.health_check",
    ),
    *("alembic.command", "dask.array", "distributed", "matplotlib.pyplot", "mujoco"),
    *("pyarrow.dataset", "pyarrow.parquet", "sqlalchemy.dialects.sqlite", "zarr"),
    *("failuretwin.app.inputs", "failuretwin.app.learning", "failuretwin.data_knowledge.resumable"),
    *("failuretwin.app.reports.isolability_report", "failuretwin.data_knowledge.records.store"),
)
DASK_METHOD = "DASK_DISTRIBUTED__WORKER__MULTIPROCESSING_METHOD"
"""Of a fork server, workers of a command import Dask together; spawned, each by itself."""
LIMIT_S = 120.0
DISK_BYTES = 500


class WarmCommand:
    """Runs the command line as often as one likes."""

    def __init__(self):
        self._server = subprocess.Popen(
            [sys.executable, __file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1", DASK_METHOD: "forkserver"},
        )

    def run(self, *arguments, folder=None, disk_full=False):
        """Run one command and wait for it.

        Args:
            arguments: What follows `failuretwin`.
            folder: Where; none: here.
            disk_full: Whether no file may grow beyond a few bytes.
        """
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        environment.pop("COLUMNS", None)
        argv = ["failuretwin", *map(str, arguments)]
        with tempfile.TemporaryDirectory() as said:
            call = {
                "argv": argv,
                "environment": environment,
                "folder": str(folder or Path.cwd()),
                "said": said,
                "disk_full": disk_full,
            }
            self._server.stdin.write(json.dumps(call) + "\n")
            self._server.stdin.flush()
            code = int(self._server.stdout.readline())
            out, err = (Path(said, name).read_text() for name in ("out", "err"))
        return subprocess.CompletedProcess(argv, code, out, err)

    def close(self):
        """End the server."""
        self._server.communicate()


def serve():
    """Answer calls, a line each, with exit codes, until there are no more."""
    for library in WARM:
        importlib.import_module(library)
    _load_what_is_compiled()
    gc.collect()
    gc.freeze()
    for line in sys.stdin:
        call = json.loads(line)
        child = os.fork()
        if child == 0:
            _become(call)
        late = threading.Timer(LIMIT_S, os.kill, (child, signal.SIGKILL))
        late.start()
        _, status = os.waitpid(child, 0)
        late.cancel()
        print(os.waitstatus_to_exitcode(status), flush=True)


def _load_what_is_compiled():
    """Call each kind of compiled loop once: loading their code takes seconds."""
    failuretwin = importlib.import_module("failuretwin")
    failuretwin.diagnose(failuretwin.sample_log())


def _become(call):
    """Carry a call out in this process, and end it."""
    for number, name in ((1, "out"), (2, "err")):
        os.dup2(os.open(Path(call["said"], name), os.O_WRONLY | os.O_CREAT), number)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.chdir(call["folder"])
    os.environ.clear()
    os.environ.update(call["environment"])
    sys.argv, sys.path[0] = call["argv"], call["folder"]
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if call["disk_full"]:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (DISK_BYTES, DISK_BYTES))
    os._exit(_carry_out())


def _carry_out():
    code = 0
    try:
        importlib.import_module("failuretwin.app.cli").main()
    except SystemExit as end:
        code = end.code or 0
        if isinstance(code, str):
            print(code, file=sys.stderr)
            code = 1
    except BaseException:
        traceback.print_exc()
        code = 1
    with contextlib.suppress(OSError):
        atexit._run_exitfuncs()
        sys.stdout.flush()
    sys.stderr.flush()
    return code


if __name__ == "__main__":
    serve()
