"""Start a server, 100 emulated robots and two workers here, and show their status until Ctrl-C."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROBOTS, PORT, MQTT_PORT = 100, 14222, 11884
FAULTS = ("motor_3:stuck@60", "motor_2:steady_state_error@60-180", "motor_1:stuck@120")


def failuretwin(*words: str) -> list[str]:
    """Return a command line of failuretwin."""
    return [sys.executable, "-m", "failuretwin", *words]


def main() -> None:
    """Start everything; what runs in the background writes into one folder."""
    server = shutil.which("nats-server") or shutil.which("nats-server", path="/usr/sbin")
    if server is None:
        sys.exit("no nats-server here. Install it: apt install nats-server")
    folder = Path(tempfile.mkdtemp(prefix="failuretwin-fleet-"))
    url, store = f"nats://127.0.0.1:{PORT}", str(folder / "robots.db")
    ports = ("--port", str(PORT), "--mqtt-port", str(MQTT_PORT), "--folder", str(folder / "data"))
    config = subprocess.run(
        failuretwin("fleet", "config", *ports), check=True, capture_output=True, text=True
    )
    (folder / "nats.conf").write_text(config.stdout)
    subprocess.run(failuretwin("store", "init", "--store", store), check=True)
    faults = [word for fault in FAULTS for word in ("--fault", fault)]
    robots = ("bridge", "emulated", "--fleet", url, "--robots", str(ROBOTS), *faults)
    background = {
        "nats": [server, "-c", str(folder / "nats.conf")],
        "worker_1": failuretwin("worker", url, "--store", store, "--name", "worker_1"),
        "worker_2": failuretwin("worker", url, "--store", store, "--name", "worker_2"),
        "robots": failuretwin(*robots),
    }
    processes = []
    try:
        for name, words in background.items():
            with (folder / f"{name}.log").open("wb") as log:
                processes.append(subprocess.Popen(words, stdout=log, stderr=subprocess.STDOUT))
            time.sleep(1.0)
        print(f"logs and store: {folder}")
        subprocess.run(failuretwin("fleet", "status", "--fleet", url, "--watch"), check=False)
    except KeyboardInterrupt:
        pass
    finally:
        for process in reversed(processes):
            process.terminate()
            process.wait()


if __name__ == "__main__":
    main()
