"""Retained MQTT messages: what a client that comes later gets at once."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Self
from urllib.parse import unquote, urlsplit

from failuretwin.core.errors import InputError, needs_extra

if TYPE_CHECKING:
    from paho.mqtt.client import Client

PORTS = {"mqtt": 1883, "mqtts": 8883}
"""Default ports, plain and with TLS."""


class Retained:
    """Publishes retained messages; a broker that is away gets them when it is back.

    Args:
        url: ``mqtt://[USER:PASSWORD@]HOST[:PORT]``, or ``mqtts://``; None: nowhere.
        name: Our name there.
        tell: Takes a line for the user.
        ca: File of the authority that signs the broker's certificate; None: those of the system.

    Raises:
        InputError: If the URL is none, or nobody answers.
    """

    def __init__(
        self, url: str | None, name: str, tell: Callable[[str], None], ca: Path | None = None
    ) -> None:
        self._client: Client | None = None
        if url is None:
            return
        with needs_extra("MQTT needs paho-mqtt", "fleet"):
            from paho.mqtt.client import Client
            from paho.mqtt.enums import CallbackAPIVersion
        parts = urlsplit(url)
        if parts.scheme not in PORTS or not parts.hostname:
            raise InputError(f"--mqtt is {url!r}, expected mqtt://HOST[:PORT] or mqtts://...")
        client = Client(CallbackAPIVersion.VERSION2, client_id=f"failuretwin-{name}")
        if parts.username:
            client.username_pw_set(parts.username, unquote(parts.password or ""))
        if parts.scheme == "mqtts":
            client.tls_set(None if ca is None else str(ca))
        port = parts.port or PORTS[parts.scheme]
        try:
            client.connect(parts.hostname, port)
        except OSError as error:
            raise InputError(f"MQTT broker {parts.hostname}:{port}: {error}.") from error
        client.on_disconnect = lambda *_: tell("the MQTT broker is gone; trying again")
        client.loop_start()
        self._client = client

    def publish(self, topic: str, data: bytes) -> None:
        """Publish a message at least once, retained."""
        if self._client is not None:
            self._client.publish(topic, data, qos=1, retain=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Close the connection."""
        if self._client is not None:
            self._client.on_disconnect = None
            self._client.disconnect()
            self._client.loop_stop()
