"""Networks by their names on the command line: ``ros1``, ``ros2``, ``rosbridge://HOST``."""

from __future__ import annotations

from urllib.parse import urlsplit

from failuretwin.connection.links.ros1 import Ros1Transport
from failuretwin.connection.links.ros2 import ROUTER_PORT, Ros2Transport
from failuretwin.connection.links.ros_link import Transport
from failuretwin.connection.links.rosbridge import BRIDGE_PORT, RosbridgeTransport
from failuretwin.core.errors import InputError

ROS1, ROS2, ROSBRIDGE = "ros1", "ros2", "rosbridge"
NETWORKS = f"{ROS1}, {ROS2}[://HOST[:PORT]], {ROSBRIDGE}://HOST[:PORT]"
"""Names of networks, for messages to the user."""


def is_network(text: str) -> bool:
    """Return whether a text names a network, whether or not it can be reached."""
    return text in (ROS1, ROS2) or text.startswith((f"{ROS2}://", f"{ROSBRIDGE}://"))


def open_transport(text: str) -> Transport:
    """Return a connection to a network.

    Raises:
        InputError: If the address is invalid, the network does not answer, or an extra is missing.
    """
    if text == ROS1:
        return Ros1Transport()
    if text == ROS2:
        return Ros2Transport()
    if text.startswith(f"{ROS2}://"):
        return Ros2Transport(*address_of(text, ROUTER_PORT))
    return RosbridgeTransport(*address_of(text, BRIDGE_PORT))


def address_of(text: str, usual_port: int) -> tuple[str, int]:
    """Return host and port of an address such as ``rosbridge://HOST[:PORT]``.

    Raises:
        InputError: If it is not an address.
    """
    try:
        address = urlsplit(text)
        host, port = address.hostname, address.port or usual_port
    except ValueError:
        host, port = None, 0
    if not host:
        kind = text.partition("://")[0]
        raise InputError(f"{text!r} is no address. Expected {kind}://HOST[:PORT].")
    return host, port
