"""Advice on certain faults by class of arm.

The `advice` of a mode is for hobby servos: no brake, a horn on a splined shaft. Industrial drives
have a holding brake and an error log; cables stretch and slip on pulleys. By engineering judgement.
"""

from __future__ import annotations

from collections.abc import Mapping

from failuretwin.failure_behavior.mode import FaultMode

INDUSTRIAL, CABLE_DRIVEN = "industrial", "cable-driven"
"""Classes of arms with advice of their own; see `failuretwin.digital_model.arm_classes`."""

ADVICE: Mapping[str, Mapping[str, str]] = {
    INDUSTRIAL: {
        "stuck": (
            "Secure the arm and cut the power: the holding brake then locks the joint, so do not "
            "force it by hand. Read the error log of the drive, and check whether the brake lets "
            "go when the drive is switched on; then supply and cables of motor and encoder."
        ),
        "intermittent": (
            "Check the cables of motor and encoder where they bend, and the relay that releases "
            "the holding brake."
        ),
        "slow": (
            "Read speed and torque limits and the error log of the drive; check that the holding "
            "brake releases fully and the gear is greased."
        ),
        "lag": (
            "Check the load of the field bus and of the controller, then the coupling between "
            "motor and gear."
        ),
        "backlash": (
            "Secure the arm, measure the play of the joint with the holding brake set, and have "
            "the gear adjusted if it is above the maker's figure."
        ),
        "lost_commands": (
            "Check connectors, cable lengths and shields of the field bus; count the errors of "
            "its protocol."
        ),
        "steady_state_error": (
            "Read the error log of the drive, master the joint anew by its zero mark, and repeat "
            "a few movements of it alone. If it misses again, have coupling and encoder looked at."
        ),
        "encoder_bias": (
            "Master the joint anew by its zero mark, as the maker says; check the battery of the "
            "encoder."
        ),
        "encoder_scale": (
            "Command both ends of the range and measure the angle; check gear ratio and encoder "
            "resolution in the parameters of the drive."
        ),
        "drift": (
            "Let the motor cool down and repeat; check the coupling for slip, and whether the "
            "joint sinks when the holding brake is set."
        ),
        "torque_loss": (
            "Take off the payload and repeat; read current and temperature of the drive, and check "
            "that the holding brake does not drag."
        ),
    },
    CABLE_DRIVEN: {
        "stuck": (
            "Cut the power and turn the joint by hand. If it turns freely, check the cable's "
            "clamps and the supply of the motor; if not, look for a cable that has left its pulley."
        ),
        "backlash": "Tighten the cable to the maker's figure; look for slack at its clamps.",
        "steady_state_error": (
            "Check tension and clamps of the cable and the zero position; repeat a few movements "
            "of this motor alone."
        ),
        "encoder_bias": "Re-zero the joint and check that the cable has not slipped on its pulley.",
        "drift": "Let the motor cool down and repeat; check the cable for creep and slip.",
        "torque_loss": (
            "Take off the payload and repeat; check the friction of the pulleys, then voltage and "
            "temperature of the motor."
        ),
    },
}
"""Advice by class of arm and mode; default: the mode's own."""


def advice_for(mode: FaultMode, arm_class: str) -> str:
    """Return the advice on a certain fault of this mode; empty: the mode has none.

    Args:
        mode: The mode.
        arm_class: Class of arm, such as ``industrial``; empty: unknown.
    """
    return ADVICE.get(arm_class, {}).get(mode.mode, mode.advice)
