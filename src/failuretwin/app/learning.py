"""What commands need to know of the extra `learn`."""

from __future__ import annotations

from failuretwin.core.errors import InputError


def check_learning() -> None:
    """Raise InputError, saying how to install them, if the learning libraries are missing."""
    try:
        import sklearn
        import torch
    except ImportError as error:
        raise InputError(
            f"networks need PyTorch and scikit-learn ({error}). Install them: "
            "pip install 'failuretwin[learn]'."
        ) from error
    del sklearn, torch
