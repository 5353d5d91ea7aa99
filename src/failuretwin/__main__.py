"""`python -m failuretwin`."""

from __future__ import annotations

from failuretwin.app.cli import main

main()
