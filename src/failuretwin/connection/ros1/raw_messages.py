"""Messages as they come from the wire, decoded by the definition that their publisher sends along.

So the package of a message need not be installed, and it may have any name.
"""

from __future__ import annotations

from typing import Any

from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.bags.file import message_fields
from failuretwin.data_knowledge.bags.messages import Kind, kind_of

Decoded = tuple[Any, Kind]


class Decoder:
    """Decodes messages of `rospy.AnyMsg`, and remembers the types that it has met.

    Raises:
        InputError: If rosbags is not installed.
    """

    def __init__(self) -> None:
        try:
            import rosbags.typesys  # noqa: F401
        except ImportError as error:
            raise InputError(
                f"messages are decoded by rosbags ({error}). Install it: "
                "pip install 'failuretwin[live]'."
            ) from error
        self._types: dict[str, tuple[Any, str, Kind]] = {}

    def decode(self, message: Any) -> Decoded:
        """Return a message as an object with the fields of its kind, and its kind.

        Args:
            message: A `rospy.AnyMsg` as a subscriber gets it.

        Raises:
            InputError: If it is of no kind that is understood.
            Exception: Whatever rosbags raises where bytes do not fit the definition.
        """
        header = message._connection_header
        store, type_, kind = self._type(header["type"], header["message_definition"])
        return store.deserialize_ros1(message._buff, type_), kind

    def _type(self, name: str, definition: str) -> tuple[Any, str, Kind]:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        if definition not in self._types:
            store = get_typestore(Stores.EMPTY)
            package, _, base = name.rpartition("/")
            type_ = f"{package}/msg/{base}"
            store.register(get_types_from_msg(definition, type_))
            kind = kind_of(message_fields(store, type_))
            if kind is None:
                raise InputError(f"a message of type {name} is of no kind that is understood.")
            self._types[definition] = store, type_, kind
        return self._types[definition]
