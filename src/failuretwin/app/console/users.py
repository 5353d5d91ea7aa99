"""Who may see and do what: passwords, sessions, roles.

Passwords are kept as scrypt hashes (RFC 7914). A session is a random token in a cookie that no
script reads and no other site sends; it is held in memory and expires.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
import time
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import tomli_w

from failuretwin.core.errors import InputError, check_name
from failuretwin.data_knowledge.store import write_text

SEE, CONFIRM, MOVE = "see", "confirm", "move"
ROLES = (SEE, CONFIRM, MOVE)
"""What a person may do: each role includes those before it."""
SESSION_S = 8 * 3600.0
"""Time without a request after which a session ends [s]."""
WORK = {"n": 2**14, "r": 8, "p": 1}
"""Cost of a password hash: about 50 ms."""
TRIES, TRIES_S = 5, 60.0
"""Wrong passwords of a name in so many seconds, then it waits."""


@dataclass(frozen=True)
class User:
    """A person: name, role and hash of the password."""

    name: str
    role: str
    password: str


def hashed(password: str, salt: str = "") -> str:
    """Return ``scrypt:SALT:HASH`` of a password; an empty salt: a new one."""
    salt = salt or secrets.token_hex(16)
    key = hashlib.scrypt(password.encode(), salt=bytes.fromhex(salt), **WORK)
    return f"scrypt:{salt}:{key.hex()}"


def load_users(path: Path) -> dict[str, User]:
    """Return the users in a file: a table of each, with ``role`` and ``password``.

    Raises:
        InputError: If it cannot be read or holds something else.
    """
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
        users = [User(name, one["role"], one["password"]) for name, one in tables.items()]
        for user in users:
            check_name("role", user.role, ROLES)
            _, salt, _ = user.password.split(":")
            bytes.fromhex(salt)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{path}: {error}. Expected a table of each user with role and password; "
            "`failuretwin console --users FILE --add-user NAME` writes it."
        ) from error
    return {user.name: user for user in users}


def add_user(path: Path, name: str, role: str, password: str) -> None:
    """Write a user into a file, in addition to those that are there."""
    users = load_users(path) if path.exists() else {}
    users[name] = User(name, role, hashed(password))
    tables = {one.name: {"role": one.role, "password": one.password} for one in users.values()}
    write_text(tomli_w.dumps(tables), path)
    path.chmod(0o600)


@dataclass
class Session:
    """A person who is signed in.

    Attributes:
        name: The name; empty: nobody signs in here.
        role: The role.
        seen_s: Time of the last request [s].
    """

    name: str
    role: str
    seen_s: float = field(default_factory=time.monotonic)
    ended: bool = False

    @property
    def valid(self) -> bool:
        """Whether it has not ended."""
        return not self.ended and (not self.name or time.monotonic() - self.seen_s < SESSION_S)

    def may(self, role: str) -> bool:
        """Return whether the person may do what a role may."""
        return self.valid and ROLES.index(self.role) >= ROLES.index(role)


class Sessions:
    """Sessions of a server.

    Args:
        users: Users by name; empty: everybody on this computer has all roles.
    """

    def __init__(self, users: Mapping[str, User]) -> None:
        self.users = users
        self._open: dict[str, Session] = {}
        self._wrong: dict[str, list[float]] = {}
        self._own = Session("", MOVE)

    def of(self, token: str | None) -> Session | None:
        """Return the session of a cookie, which counts as used; None: there is none."""
        if not self.users:
            return self._own
        session = self._open.get(token or "")
        if session is None or not session.valid:
            return None
        session.seen_s = time.monotonic()
        return session

    def sign_in(self, name: str, password: str) -> str:
        """Return the token of a new session; empty: name or password is wrong."""
        user = self.users.get(name)
        salt = user.password.split(":")[1] if user else "00" * 16
        right = hmac.compare_digest(hashed(password, salt), user.password if user else "")
        if user is None or not right:
            self._wrong.setdefault(name[:64], []).append(time.monotonic())
            return ""
        token = secrets.token_urlsafe(32)
        self._open[token] = Session(user.name, user.role)
        self._open = {key: one for key, one in self._open.items() if one.valid}
        return token

    def waits(self, name: str) -> bool:
        """Return whether a name was tried with wrong passwords too often."""
        now_s = time.monotonic()
        self._wrong = {
            key: recent
            for key, tries in self._wrong.items()
            if (recent := [at for at in tries if now_s - at < TRIES_S])
        }
        return len(self._wrong.get(name[:64], [])) >= TRIES

    def sign_out(self, token: str | None) -> None:
        """End a session; its pages stop as well."""
        session = self._open.pop(token or "", None)
        if session is not None:
            session.ended = True
