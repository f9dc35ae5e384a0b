"""`era` with a bug planted in it: python planted_daemon.py BUG daemon daemon.yaml."""

import sys

import pytest

from planted_bugs import Bug, Edit, plant

_DRIVE = "controller.loop.routing:_drive"
BUGS = {
    "levels are of three quarters of the stroke": Bug(
        "level", (Edit(_DRIVE, "rig.era(name).stroke", "(0.75 * rig.era(name).stroke)"),)
    ),
    "phases have the other sign": Bug(
        "phase", (Edit(_DRIVE, "_wrapped_degrees(tone.phase)", "_wrapped_degrees(-tone.phase)"),)
    ),
    "frequencies are a step too high": Bug(
        "frequency",
        (
            Edit(_DRIVE, "frequency=tone.frequency,", "frequency=tone.frequency + 40,"),
            Edit(
                "controller.loop.routing:route",
                "frequency=envelope.frequency",
                "frequency=envelope.frequency + 40",
                also=("controller.loop.orders",),
            ),
        ),
    ),
    "the last up is dropped": Bug(
        "lift",
        (
            Edit(
                "controller.sources.contacts:ContactTracker._lift",
                "self._contacts.pop(key) for key in tuple(keys)",
                "self._contacts[key] for key in tuple(keys)",
            ),
        ),
    ),
}
"""By name. The daemon believes in what it does: only who felt it can tell."""


if __name__ == "__main__":
    from controller.cli.main import main

    plant(BUGS[sys.argv.pop(1)], pytest.MonkeyPatch())
    sys.exit(main())
