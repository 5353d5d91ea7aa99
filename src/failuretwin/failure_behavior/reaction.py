"""What an arm that has to go on working does about a fault."""

from __future__ import annotations

from enum import Enum


class Reaction(Enum):
    """What an arm that goes on working does about a fault of one of its motors."""

    LOCK = "plan with the motor held where it is believed to stand"
    INVERT = "command what the fault turns into what is wanted"
    PARK = "let the motor rest in a known place, and work with the others"
    REPEAT = "look whether each command came, and send it again"
    WAIT = "give it the time that it takes"
    SPARE = "choose poses in which it carries little, and command against its sag"
