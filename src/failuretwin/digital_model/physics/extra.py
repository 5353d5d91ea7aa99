"""MuJoCo, an optional package that is loaded only where it is used."""

from __future__ import annotations

from typing import Any

from failuretwin.core.errors import InputError


def load_mujoco() -> Any:
    """Return the module `mujoco`.

    Raises:
        InputError: If it is not installed.
    """
    try:
        import mujoco
        import mujoco.rollout
    except ImportError as error:
        raise InputError(
            f"the physics engine needs mujoco ({error}). Install it: "
            "pip install 'failuretwin[physics]'."
        ) from error
    return mujoco
