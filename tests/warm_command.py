"""The command line in a process of its own, without waiting for its imports each time.

A server imports the package and its libraries once, loads what is compiled, and forks for every
call. What a call says goes to files, or to pipes if it is begun and not waited for.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import importlib
import json
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
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
DASK_SETTING = "distributed.worker.multiprocessing-method"
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
        argv = ["failuretwin", *map(str, arguments)]
        with tempfile.TemporaryDirectory() as said:
            call = _call_of(argv, folder)
            files = {name: str(Path(said, name)) for name in ("out", "err")}
            code = self.ask(call | files | {"disk_full": disk_full})
            out, err = (Path(said, name).read_text() for name in ("out", "err"))
        return subprocess.CompletedProcess(argv, code, out, err)

    def begin(self, *arguments, folder=None, environment=None, code="", out=None):
        """Begin a command, in a session of its own, and do not wait for it.

        Args:
            arguments: What follows `failuretwin`.
            folder: Where; none: here.
            environment: All its variables; none: ours.
            code: Python to run instead of the command line; the arguments are its `sys.argv[1:]`.
            out: File for all that it says; none: pipes.
        """
        argv = ["failuretwin", *map(str, arguments)]
        return BegunCommand(self, _call_of(argv, folder, environment) | {"code": code}, out)

    def ask(self, call):
        """Return what the server answers to a call, a number."""
        self._server.stdin.write(json.dumps(call) + "\n")
        self._server.stdin.flush()
        return int(self._server.stdout.readline())

    def close(self):
        """End the server."""
        self._server.communicate()


def remarks(stderr):
    """Return what is said beside progress, which only slow machines show."""
    progress = re.compile(r"[a-z -]+: (\d+ of \d+, about \d+ s left|\d+ s so far)")
    return "".join(line for line in stderr.splitlines(True) if not progress.match(line))


def _call_of(argv, folder, environment=None):
    variables = {**(os.environ if environment is None else environment), "OMP_NUM_THREADS": "1"}
    variables.pop("COLUMNS", None)
    return {"argv": argv, "environment": variables, "folder": str(folder or Path.cwd())}


def _reader(pipe):
    return Path(pipe).open(encoding="utf-8")


class BegunCommand:
    """A command that was begun, as `subprocess.Popen` gives one; to be waited for.

    Attributes:
        pid: Its number, and that of its group and session.
        stdout: What it says, line by line; none if that goes to a file.
        stderr: The same of its errors.
        returncode: Its exit code once it was waited for.
    """

    def __init__(self, warm, call, out):
        self._warm, self.returncode = warm, None
        self.stdout = self.stderr = None
        if out is not None:
            self.pid = warm.ask(call | {"out": str(out), "err": str(out), "begin": True})
            return
        with tempfile.TemporaryDirectory() as said:
            pipes = {name: str(Path(said, name)) for name in ("out", "err")}
            for pipe in pipes.values():
                os.mkfifo(pipe)
            # It opens them in this order, and each waits for the other end.
            self.pid = warm.ask(call | pipes | {"begin": True})
            self.stdout, self.stderr = map(_reader, pipes.values())

    def poll(self):
        """Return its exit code, or none while it runs."""
        if self.returncode is None and self._warm.ask({"ended": self.pid}):
            self.returncode = self._warm.ask({"code_of": self.pid})
        return self.returncode

    def wait(self, timeout=LIMIT_S):
        """Wait until it ends, and return its exit code."""
        end = time.monotonic() + timeout
        while self.poll() is None:
            if time.monotonic() > end:
                raise subprocess.TimeoutExpired("failuretwin", timeout)
            time.sleep(0.02)
        return self.returncode

    def communicate(self, timeout=LIMIT_S):
        """Wait until it ends, and return what it has said that nobody has read."""
        with self.stdout, self.stderr:
            said = self.stdout.read(), self.stderr.read()
        self.wait(timeout)
        return said

    def send_signal(self, number):
        """Send it a signal, if it still runs."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self):
        """Ask it to end."""
        self.send_signal(signal.SIGTERM)

    def kill(self):
        """End it at once."""
        self.send_signal(signal.SIGKILL)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        if error[0] is not None:
            self.kill()
        for pipe in filter(None, (self.stdout, self.stderr)):
            pipe.close()
        self.wait()


def serve():
    """Answer calls, a line each, with numbers, until there are no more."""
    for library in WARM:
        importlib.import_module(library)
    _load_what_is_compiled()
    gc.collect()
    gc.freeze()
    codes = {}
    for line in sys.stdin:
        print(_answer(json.loads(line), codes), flush=True)


def _answer(call, codes):
    """Return the number that answers a call: of a process, or an exit code."""
    if "ended" in call:
        child, status = os.waitpid(call["ended"], os.WNOHANG)
        codes[child] = os.waitstatus_to_exitcode(status)
        return child
    if "code_of" in call:
        return codes[call["code_of"]]
    child = os.fork()
    if child == 0:
        _become(call)
    if call.get("begin"):
        return child
    late = threading.Timer(LIMIT_S, os.kill, (child, signal.SIGKILL))
    late.start()
    _, status = os.waitpid(child, 0)
    late.cancel()
    return os.waitstatus_to_exitcode(status)


def _load_what_is_compiled():
    """Call each kind of compiled loop once: loading their code takes seconds."""
    failuretwin = importlib.import_module("failuretwin")
    failuretwin.diagnose(failuretwin.sample_log())


def _become(call):
    """Carry a call out in this process, and end it."""
    if call.get("begin"):
        os.setsid()
        sys.stdout.reconfigure(line_buffering=True)
        dask = importlib.import_module("dask")
        dask.config.set({DASK_SETTING: "spawn"})  # as it is for users
    for number, name in ((1, "out"), (2, "err")):
        os.dup2(os.open(call[name], os.O_WRONLY | os.O_CREAT | os.O_APPEND), number)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.chdir(call["folder"])
    os.environ.clear()
    os.environ.update(call["environment"])
    sys.argv, sys.path[0] = call["argv"], call["folder"]
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if call.get("disk_full"):
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (DISK_BYTES, DISK_BYTES))
    os._exit(_carry_out(call.get("code")))


def _carry_out(text):
    code = 0
    try:
        if text:
            exec(compile(text, "<begun>", "exec"), {"__name__": "__begun__"})
        else:
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
