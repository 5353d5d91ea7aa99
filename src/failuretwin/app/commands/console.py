"""`failuretwin console`: a local web page on the store, the fleet and live robots."""

from __future__ import annotations

import fcntl
import shutil
import socket
import tempfile
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

import failuretwin as ft
from failuretwin.app.commands import options as opt
from failuretwin.app.commands.fleet import AccessOptions, access_options
from failuretwin.app.commands.store import StoreOptions, store_options
from failuretwin.app.terminal import tell
from failuretwin.core.errors import InputError, needs_extra, reason

if TYPE_CHECKING:
    from failuretwin.app.console.live import LiveRobot
    from failuretwin.app.remembering import RobotRecord
    from failuretwin.digital_model.calibrated_robot import CalibratedRobot

ROLES = ("see", "confirm", "move")
FOLDER, LOCK = "failuretwin-console-", "lock"
"""Names of folders of consoles, and of the file in them that each holds while it works."""


@click.command()
@click.argument("source", metavar="[SOURCE]", required=False)
@opt.flag_option("--demo", "Show emulated robots, and a fleet with a simulated year of history.")
@click.option(
    "--demo-robots",
    type=click.IntRange(0, 1000),
    default=6,
    metavar="N",
    help="With --demo: robots whose year is simulated while the console is open.",
)
@click.option("--fleet", "url", metavar="URL", help="Fleet to show, nats://HOST[:PORT].")
@click.option("--host", default="127.0.0.1", help="Address to listen on. Others need --users.")
@click.option("--port", type=click.IntRange(1, 65535), default=8080, help="Port to listen on.")
@opt.file_option("--users", "FILE.toml", "People who may sign in, with their roles.")
@click.option("--add-user", metavar="NAME", help="Ask for a password, write it to --users, end.")
@click.option("--role", type=click.Choice(ROLES), default="see", help="Role of --add-user.")
@opt.flag_option("--move", "Let people with the role `move` check the real arm of SOURCE.")
@opt.budget_option
@opt.live_options
@access_options
@store_options
@opt.plugin_option
@opt.calibrated_robot_options()
def console(
    source: str | None,
    demo: bool,
    demo_robots: int,
    url: str | None,
    host: str,
    port: int,
    users: Path | None,
    add_user: str | None,
    role: str,
    move: bool,
    budget: float,
    live: opt.LiveOptions,
    access: AccessOptions,
    memory: StoreOptions,
    robot: opt.RobotOptions,
) -> None:
    """Show robots on a local web page: the wall, the arm, why, history, checks, imports.

    SOURCE is what `watch` listens to. A store and a fleet add their robots. See docs/console.md.
    """
    from failuretwin.app.console.users import Sessions, load_users
    from failuretwin.app.console.users import add_user as write_user

    if add_user is not None:
        if users is None:
            raise InputError("--add-user needs the file to write: --users FILE.toml.")
        password = click.prompt("Password", hide_input=True, confirmation_prompt=True)
        write_user(users, add_user, role, password)
        tell(f"{add_user} ({role}) may sign in")
        return
    if host not in ("127.0.0.1", "localhost", "::1") and users is None:
        raise InputError(f"--host {host} lets others in. Name who may: --users FILE.toml.")
    sessions = Sessions({} if users is None else load_users(users))
    if users is not None and not sessions.users:
        raise InputError(f"{users}: names nobody. Add one: --add-user NAME.")
    if not (demo or source or url or memory.store):
        raise InputError("nothing to show. Name a SOURCE, --store or --fleet, or use --demo.")
    _check_free(host, port)
    with needs_extra("the console needs NiceGUI", "console"):
        import nicegui  # noqa: F401
    with ExitStack() as stack:
        folder = _own_folder(stack)
        stored, known = (None, robot.known) if memory.store is None else memory.look_up(robot)
        arms: dict[str, LiveRobot] = {}
        store = None if stored is None else stored.store
        if demo:
            store = _begin_demo(store, known, demo_robots, live.speed, folder, arms, stack)
        if source is not None:
            name = memory.robot_name or known.robot.name
            arms[name] = _live(name, source, known, live, budget, robot.seed, stored)
        from failuretwin.app.console.demo import ARMS, LOGS
        from failuretwin.app.console.desk import Desk
        from failuretwin.app.console.server import serve

        reached = access.to(url) if url is not None else None
        speed = live.speed or 1.0
        expected = len(ARMS) + len(LOGS) + demo_robots + bool(demo_robots) if demo else 0
        desk = Desk(known, store, reached, arms, move, speed, folder, expected=expected)
        serve(desk, host, port, sessions)


def _check_free(host: str, port: int) -> None:
    """Raise InputError unless the server can listen there."""
    try:
        with socket.create_server(
            (host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET
        ):
            return
    except OSError as error:
        raise InputError(
            f"cannot listen on {host}, port {port} ({reason(error)}). Choose another --port, or "
            "end the program that uses it."
        ) from error


def _own_folder(stack: ExitStack) -> Path:
    """Return a folder that goes with this process; those of consoles that were killed go now."""
    for old in Path(tempfile.gettempdir()).glob(f"{FOLDER}*"):
        with suppress(OSError), (old / LOCK).open() as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # held by a console that works
            shutil.rmtree(old)
    made = tempfile.TemporaryDirectory(prefix=FOLDER, ignore_cleanup_errors=True)
    folder = Path(stack.enter_context(made))
    fcntl.flock(stack.enter_context((folder / LOCK).open("w")), fcntl.LOCK_EX)
    return folder


def _begin_demo(
    store: ft.Store | None,
    known: CalibratedRobot,
    robots: int,
    speed: float,
    folder: Path,
    arms: dict[str, LiveRobot],
    stack: ExitStack,
) -> ft.Store:
    """Begin the demo: add its arms, and return its store."""
    from failuretwin.app.console import demo

    if store is not None:
        raise InputError("--demo has a store of its own. Leave out --store.")
    store = demo.demo_store(folder, known, stack)
    arms |= demo.demo_arms(store, known, speed)
    if robots:
        writer = demo.HistoryWriter(store, folder, known, robots)
        stack.callback(writer.stop)
        writer.start()
    return store


def _live(
    name: str,
    source: str,
    known: CalibratedRobot,
    live: opt.LiveOptions,
    budget: float,
    seed: int,
    stored: RobotRecord | None,
) -> LiveRobot:
    """Return the robot of SOURCE, not yet watched."""
    from failuretwin.app.arms import connect, is_log
    from failuretwin.app.console.live import LiveRobot, LiveSettings
    from failuretwin.app.keepers import begin_watch
    from failuretwin.connection.links.ros_link import is_network
    from failuretwin.connection.links.ros_messages import load_topics
    from failuretwin.data_knowledge.records.log_files import log_file
    from failuretwin.decision.streaming.monitor import monitor

    settings = LiveSettings(
        name,
        known,
        monitor(known.twin, known.imperfections, budget),
        lambda stack: connect(source, known.robot, live, seed, stack)[0],
        load_topics(live.topics).wait_s,
        tuple(one.partition("@")[0] for one in live.faults) if source == opt.EMULATED else None,
        source if is_network(source) else "",
        live.topics,
    )
    if stored is None:
        return LiveRobot(settings)
    basis = stored.basis("watch", "console", known)
    log = log_file(source) if is_log(source) else None
    return LiveRobot(settings, partial(begin_watch, stored, source, basis, log))
