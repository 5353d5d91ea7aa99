"""`failuretwin bridge`, `worker` and `fleet`: many robots behind a broker."""

from __future__ import annotations

import os
import socket
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from failuretwin.app.commands import options as opt
from failuretwin.app.commands.store import store_option
from failuretwin.app.terminal import console, tell

if TYPE_CHECKING:
    from failuretwin.connection.fleet.broker import Access

SERVER = "nats://127.0.0.1:4222"
server_option = click.option(
    "--fleet",
    "url",
    envvar="FAILURETWIN_FLEET",
    show_envvar=True,
    default=SERVER,
    metavar="URL",
    help="NATS server, nats://[USER:PASSWORD@]HOST[:PORT] or tls://...",
)


@dataclass(frozen=True)
class AccessOptions:
    """Files that the server asks for."""

    tls_ca: Path | None
    tls_cert: Path | None
    nkey: Path | None

    def to(self, url: str) -> Access:
        """Return how to reach a server."""
        from failuretwin.connection.fleet.broker import Access

        return Access(url, self.tls_ca, self.tls_cert, self.nkey)


access_options = opt.gathered(
    AccessOptions,
    "access",
    opt.file_option("--tls-ca", "FILE", "Authority that signs the server's certificate (PEM)."),
    opt.file_option("--tls-cert", "FILE", "Our certificate and its key in one file (PEM)."),
    opt.file_option("--nkey", "FILE", "Seed of our NKey."),
)
partitions_option = click.option(
    "--partitions",
    type=click.IntRange(1, 1024),
    default=8,
    metavar="N",
    help="Partitions of the fleet, as the mapping of the server says.",
)


@click.command()
@click.argument("source", metavar="SOURCE")
@server_option
@click.option("--name", help="Name of the robot. Default: that of its profile.")
@click.option(
    "--robots",
    type=click.IntRange(1, 100_000),
    default=1,
    metavar="N",
    help="With `emulated`: how many; each --fault is that of one of them.",
)
@access_options
@opt.live_options
@opt.plugin_option
@opt.calibrated_robot_options()
def bridge(
    source: str,
    url: str,
    name: str | None,
    robots: int,
    access: AccessOptions,
    live: opt.LiveOptions,
    robot: opt.RobotOptions,
) -> None:
    """Put a robot on the broker of a fleet: readings and commands, as messages.

    SOURCE is that of `watch`: `ros1`, `ros2[://HOST[:PORT]]`, `rosbridge://HOST[:PORT]`, a log to
    replay, `emulated` (with --robots N a fleet), or MODULE:CLASS. Its profile is announced first,
    with the calibration of --calibration.
    """
    from failuretwin.app.fleet import bridge_emulated, bridge_one

    to = access.to(url)
    if source == opt.EMULATED:
        bridge_emulated(to, name or "arm", robots, live, robot)
        return
    if robots != 1:
        opt.refuse_unused("only emulated robots are many", "robots")
    bridge_one(to, source, name or robot.model.name, live, robot)


@click.command()
@click.argument("url", metavar="nats://HOST", default=SERVER, envvar="FAILURETWIN_FLEET")
@store_option
@click.option("--name", help="Name of the worker, one of its own. Default: host and process.")
@click.option(
    "--profiles",
    type=click.Path(exists=True, file_okay=False, path_type=Path),
    metavar="FOLDER",
    help="Folder of profiles (NAME.toml) beside those that come with failuretwin.",
)
@opt.budget_option
@click.option(
    "--snapshot",
    "snapshot_s",
    type=click.FloatRange(1.0, 3600.0),
    default=30.0,
    metavar="SECONDS",
    help="Time between two snapshots of a partition.",
)
@click.option(
    "--metrics",
    metavar="[HOST:]PORT",
    help="Serve figures for Prometheus; on 127.0.0.1 unless a host is named.",
)
@click.option(
    "--mqtt",
    metavar="mqtt://HOST[:PORT]",
    help="Publish alarms and health as retained MQTT messages too; mqtts:// for TLS.",
)
@partitions_option
@access_options
@opt.plugin_option
def worker(
    url: str,
    store: str | None,
    name: str | None,
    profiles: Path | None,
    budget: float,
    snapshot_s: float,
    metrics: str | None,
    mqtt: str | None,
    partitions: int,
    access: AccessOptions,
) -> None:
    """Filter the robots of a fleet; start as many workers as you like, anywhere.

    Workers share the robots by partitions. When one is killed or cut off, the others go on from its
    last snapshot. With --store alarms are stored as episodes of the robots. Ctrl-C hands over.
    """
    from failuretwin.app.fleet_worker import work
    from failuretwin.decision.fleet.worker import Settings

    own = name or f"{socket.gethostname().replace('.', '-')}-{os.getpid()}"
    settings = Settings(own, partitions, snapshot_s, budget)
    work(access.to(url), settings, profiles, store=store, metrics=metrics, mqtt=mqtt)


@click.group()
def fleet() -> None:
    """Look after a fleet of robots behind a broker."""


@fleet.command()
@server_option
@opt.flag_option("--watch", "Draw it again every second until Ctrl-C.")
@access_options
def status(url: str, watch: bool, access: AccessOptions) -> None:
    """Show robots by health, stale ones as stale, and the workers with their lag."""
    from failuretwin.app.fleet import show_status

    show_status(access.to(url), console(), watch)


@fleet.command("config")
@click.option("--port", type=click.IntRange(1, 65535), default=4222, metavar="N")
@click.option("--mqtt-port", type=click.IntRange(1, 65535), default=1884, metavar="N")
@click.option(
    "--folder",
    type=click.Path(path_type=Path),
    default=Path("fleet-data"),
    help="Folder in which the server keeps its streams.",
)
@partitions_option
def config(port: int, mqtt_port: int, folder: Path, partitions: int) -> None:
    """Print a configuration for nats-server, for this computer alone.

    See docs/fleet.md for one with users, TLS and permissions.
    """
    from failuretwin.connection.fleet.broker import server_config

    tell(server_config(port, mqtt_port, folder.absolute(), partitions))
