"""`python -m failuretwin`."""

from failuretwin.app.cli import main

main()
