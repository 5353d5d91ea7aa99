"""MQTT clients, a gateway's mosquitto, hostile bytes, users and permissions, on real servers."""

from __future__ import annotations

import asyncio
import json
import re
import socket
import subprocess
import time

import numpy as np
import pytest
from click.testing import CliRunner

from failuretwin.app.cli import cli
from failuretwin.connection.fleet.broker import IN, Access, open_broker, server_config
from failuretwin.connection.fleet.messages import (
    events_binary,
    profile_json,
)
from failuretwin.connection.fleet.mqtt import Retained
from failuretwin.connection.links.base import Reading
from failuretwin.core.errors import InputError
from failuretwin.decision.fleet import partition as partition_module
from fleet_messages import PROFILE_OF, events_json
from fleet_servers import Mosquitto, NatsServer
from running_fleet import alarms, ask, health, start, uncovered, until, worker_thread

READING = events_json([Reading(1.0, np.array([0.1, 0.0, 0.3]))])


class Client:
    """A plain MQTT client."""

    def __init__(self, port):
        paho = pytest.importorskip("paho.mqtt.client")
        self.got = {}
        self._client = paho.Client(
            paho.CallbackAPIVersion.VERSION2, client_id=f"test-{time.time()}"
        )
        self._client.on_message = self._take
        self._client.connect("127.0.0.1", port)
        self._client.loop_start()

    def _take(self, client, data, message):
        self.got[message.topic] = message.payload, message.retain

    def publish(self, topic, data):
        self._client.publish(topic, data, qos=1).wait_for_publish(10.0)

    def listen(self, topic):
        self._client.subscribe(topic, qos=1)

    def close(self):
        self._client.disconnect()
        self._client.loop_stop()


def robots(reports):
    return {name: one for part in reports.values() for name, one in part["robots"].items()}


def test_mqtt_clients_and_a_gateway_speak_to_the_fleet_and_hear_of_it(server, tmp_path):
    """Plain MQTT in; mosquitto by its own bridge; health out, retained; bytes that are none."""
    bridge = [
        "connection fleet",
        f"address 127.0.0.1:{server.mqtt_port}",
        "remote_clientid gateway",
        "notifications false",  # their topic has a dot, which NATS refuses
        "try_private false",
        "bridge_protocol_version mqttv311",
        "topic fleet/in/# out 1",
    ]
    gateway = Mosquitto(tmp_path / "gateway", "\n".join(bridge))
    direct, behind = Client(server.mqtt_port), Client(gateway.port)
    retained = Retained(f"mqtt://127.0.0.1:{server.mqtt_port}", "test", print)
    try:
        with retained, worker_thread(server.url, retain=retained.publish) as (_, metrics):
            for client, name in ((direct, "plain"), (behind, "gated")):
                client.publish(f"fleet/in/{name}/profile", profile_json(PROFILE_OF))
                client.publish(f"fleet/in/{name}/events", READING)
                client.publish(f"fleet/in/{name}/events", b"\xff not json")
            client.publish("fleet/in/nobody/events", READING)
            reports = until(
                server.url,
                health,
                lambda found: (
                    robots(found).keys() == {"plain", "gated"}
                    and sum(one["counts"].get("malformed", 0) for one in found.values()) == 2
                    and sum(one["counts"].get("no_profile", 0) for one in found.values()) == 1
                ),
            )
            assert {one["state"] for one in robots(reports).values()} == {"waiting"}
            later = Client(server.mqtt_port)
            later.listen("fleet/health/#")
            end = time.monotonic() + 20.0
            while len(later.got) < 2 and time.monotonic() < end:
                time.sleep(0.1)
            assert later.got.keys() == {"fleet/health/plain", "fleet/health/gated"}
            payload, flag = later.got["fleet/health/plain"]
            assert flag and json.loads(payload)["state"] == "waiting"
            later.close()
            assert metrics.registry.get_sample_value("failuretwin_messages_total") == 7.0
    finally:
        direct.close()
        behind.close()
        gateway.close()


def test_bytes_that_no_client_sends_end_neither_server_nor_worker(server):
    """A claim of 100 MB, garbage, and messages of the largest size that is let through."""
    with worker_thread(server.url) as (told, _):
        for text in (b"PUB fleet.in.arm.events 104857600\r\n", b"\x00\xff" * 500, b"CONNECT {\r\n"):
            with socket.create_connection(("127.0.0.1", server.port)) as raw:
                raw.recv(4096)
                raw.sendall(text)

        async def send(broker):
            await broker.stream.publish(f"{IN}.arm.profile", profile_json(PROFILE_OF))
            await broker.stream.publish(f"{IN}.arm.events", b"[" * 1_000_000)
            await broker.stream.publish(f"{IN}.arm.events", READING)

        ask(server.url, send)
        reports = until(server.url, health, lambda found: "arm" in robots(found))
        assert sum(one["counts"].get("malformed", 0) for one in reports.values()) == 1
    assert not [line for line in told if "Error" in line]


def test_a_message_that_breaks_the_filter_refuses_its_robot_alone(server, monkeypatch):
    """Whatever it is: the worker goes back to its snapshot and finds out whose message it was."""
    from failuretwin.connection.fleet.robot_input import RobotInput

    usual = RobotInput.take

    def broken(self, events, server_s):
        if (events.readings[:, 1] == 6.6).any():
            raise ZeroDivisionError("a fault of our own")
        return usual(self, events, server_s)

    monkeypatch.setattr(RobotInput, "take", broken)
    poison = events_binary([Reading(2.0, np.array([6.6, 0.0, 0.0]))], 4)

    async def send(broker):
        for name in ("good", "bad"):
            await broker.stream.publish(f"{IN}.{name}.profile", profile_json(PROFILE_OF))
            await broker.stream.publish(f"{IN}.{name}.events", READING)
        await broker.stream.publish(f"{IN}.bad.events", poison)
        await broker.stream.publish(f"{IN}.bad.events", READING)

    with worker_thread(server.url) as (told, _):
        ask(server.url, send)
        reports = until(
            server.url,
            health,
            lambda found: sum(one["counts"].get("refused", 0) for one in found.values()) >= 2,
        )
        assert "good" in robots(reports)
    assert any("ZeroDivisionError" in line for line in told)


def test_an_upgrade_that_cannot_read_a_snapshot_begins_anew(server, monkeypatch):
    async def send(broker):
        await broker.stream.publish(f"{IN}.arm.profile", profile_json(PROFILE_OF))
        await broker.stream.publish(f"{IN}.arm.events", READING)

    with worker_thread(server.url, "old"):
        ask(server.url, send)
        until(server.url, health, lambda found: "arm" in robots(found))
    monkeypatch.setattr(partition_module, "FORMAT", partition_module.FORMAT + 1)
    with worker_thread(server.url, "new") as (told, _):
        assert any("Its robots begin anew" in line for line in told), told
        ask(server.url, send)
        until(server.url, uncovered, lambda count: count == 0)
    reports = ask(server.url, health)
    assert {one["worker"] for one in reports.values()} == {"new"}
    assert "arm" in robots(reports)


# Users, TLS and permissions.


def certificates(folder):
    """Make an authority and a certificate of 127.0.0.1 with OpenSSL."""
    folder.mkdir()

    def openssl(*words):
        subprocess.run(["openssl", *map(str, words)], check=True, capture_output=True, cwd=folder)

    openssl(
        *("req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", 2, "-subj", "/CN=test"),
        *("-keyout", "ca.key", "-out", "ca.pem"),
    )
    openssl(
        *("req", "-newkey", "rsa:2048", "-nodes", "-subj", "/CN=localhost"),
        *("-keyout", "server.key", "-out", "server.csr"),
    )
    (folder / "names").write_text("subjectAltName=IP:127.0.0.1,DNS:localhost")
    openssl(
        *("x509", "-req", "-in", "server.csr", "-CA", "ca.pem", "-CAkey", "ca.key", "-days", 2),
        *("-CAcreateserial", "-extfile", "names", "-out", "server.pem"),
    )
    return folder


@pytest.fixture
def guarded(tmp_path):
    """A server with TLS, a user for workers, one for robots by permission, and one by NKey."""
    nkeys = pytest.importorskip("nkeys")
    from nacl.signing import SigningKey

    seed = nkeys.encode_seed(bytes(SigningKey.generate()), nkeys.PREFIX_BYTE_USER)
    pair = nkeys.from_seed(bytearray(seed))
    files = certificates(tmp_path / "tls")
    (tmp_path / "robot.nk").write_bytes(bytes(seed))
    robot = '{ publish: ["fleet.p.*.own.*"], subscribe: ["_INBOX.>"] }'
    extra = f"""
tls {{ cert_file: "{files}/server.pem", key_file: "{files}/server.key" }}
authorization {{ users: [
  {{ user: worker, password: secret }}
  {{ user: own, password: robot, permissions: {robot} }}
  {{ nkey: {pair.public_key.decode()}, permissions: {robot} }}
] }}
"""
    server = NatsServer(tmp_path / "guarded", extra)
    yield server, files, tmp_path / "robot.nk"
    server.close()


def opened(access, question):
    async def main():
        broker = await open_broker(access, "test")
        try:
            return await question(broker)
        finally:
            await broker.close()

    return asyncio.run(main())


def test_tls_users_and_permissions_are_kept(guarded):
    server, files, nkey = guarded
    ca = files / "ca.pem"
    at = f"tls://127.0.0.1:{server.port}"
    worker = Access(f"tls://worker:secret@127.0.0.1:{server.port}", ca)
    own = Access(f"tls://own:robot@127.0.0.1:{server.port}", ca)
    for refused in (
        Access(at, ca),
        Access(f"tls://worker:wrong@127.0.0.1:{server.port}", ca),
        Access(f"tls://worker:secret@127.0.0.1:{server.port}"),
    ):
        with pytest.raises(InputError, match=r"fleet server tls://127\.0\.0\.1"):
            opened(refused, lambda broker: broker.client.flush())
    with worker_thread(server.url, access=worker):

        async def announce(broker):
            await broker.stream.publish(f"{IN}.own.profile", profile_json(PROFILE_OF))
            await broker.stream.publish(f"{IN}.own.events", READING)
            with pytest.raises(Exception, match=r"(?i)no responders|timeout|permission"):
                await broker.stream.publish(f"{IN}.other.events", READING, timeout=1.0)
            return True

        for access in (own, Access(at, ca, nkey=nkey)):
            assert opened(access, announce)
        end = time.monotonic() + 20.0
        while "own" not in robots(opened(worker, health)) and time.monotonic() < end:
            time.sleep(0.3)
        assert robots(opened(worker, health)).keys() == {"own"}


# The command line.


def test_a_bridge_and_the_status_on_the_command_line(server, tmp_path):
    """Two emulated robots, one with a fault; figures; the status."""
    with worker_thread(server.url) as (told, metrics):
        words = ("bridge", "emulated", "--fleet", server.url, "--robots", "2", "--speed", "0")
        log = tmp_path / "bridge.log"
        fault = ("--fault", "motor_3:stuck@6", "--seconds", "25")
        assert start(log, *words, *fault).wait(90) == 0, log.read_text()
        assert "2 emulated robots to" in log.read_text()
        until(server.url, alarms, lambda found: len(found) == 1)
        assert any("arm_0: alarm: motor_3:stuck (episode 1)" in line for line in told)
        assert (
            metrics.registry.get_sample_value("failuretwin_alarms_total", {"state": "alarm"}) == 1
        )
        until(server.url, health, lambda found: robots(found).keys() == {"arm_0", "arm_1"})
        done = CliRunner().invoke(cli, ["fleet", "status", "--fleet", server.url])
    assert done.exit_code == 0, done.output
    for words in ("2 robots, 1 alarms", "left out so far: nothing", "inside"):
        assert words in done.output
    assert re.search(r"arm_0 +(alarm|stale) +motor_3:stuck", done.output)


def test_a_server_that_is_not_there_is_one_error():
    for words in (["worker", "nats://127.0.0.1:1"], ["fleet", "status", "--fleet", "http://x"]):
        with pytest.raises(InputError, match="fleet server"):
            CliRunner().invoke(cli, words, catch_exceptions=False, standalone_mode=False)


def plain(port, *_):
    """Return the configuration of a server as the package of Debian starts it."""
    return f"host: 127.0.0.1\nport: {port}\n"


def unmapped(port, mqtt_port, folder, partitions):
    """Return the configuration of a server that keeps streams, but maps no robots."""
    return f'{plain(port)}jetstream {{ store_dir: "{folder}" }}\n'


@pytest.mark.parametrize(
    ("config", "partitions", "said"),
    [
        (plain, 2, "no JetStream.*fleet config"),
        (unmapped, 2, "over no partitions. Expected 2.*mappings"),
        (server_config, 3, "another number of partitions. Expected 3.*--partitions"),
    ],
)
def test_a_server_that_cannot_carry_a_fleet_is_refused(tmp_path, config, partitions, said):
    server = NatsServer(tmp_path / "server", config=config)
    try:
        with pytest.raises(InputError, match=said):
            words = ["worker", server.url, "--partitions", str(partitions)]
            CliRunner().invoke(cli, words, catch_exceptions=False, standalone_mode=False)
    finally:
        server.close()


@pytest.mark.parametrize("option", ["--nkey", "--tls-ca", "--tls-cert"])
def test_a_file_of_access_that_is_none_is_named(tmp_path, option):
    (tmp_path / "file").write_text("not what is expected")
    words = ["fleet", "status", "--fleet", "tls://127.0.0.1:1", option, str(tmp_path / "file")]
    with pytest.raises(InputError, match=rf"{option} .*file: .* Expected .*"):
        CliRunner().invoke(cli, words, catch_exceptions=False, standalone_mode=False)
