"""A host that plays 1 kHz at level 0.5 on every channel of an amplifier of voltage, until killed.

    python tests/support/steady_host.py URL CHANNELS

Each channel is 30 degrees ahead of the one before. It prints `armed`. The amplifier waits for it as
long as the protocol allows, since a busy machine may hold it up.
"""

import sys

from drivers.blocking import BlockingAmplifier
from drivers.command import DriveCommand
from drivers.guard import GuardLimits
from patient_daemon import WATCHDOG
from registry.voltage import VoltageDrive

FLAT = VoltageDrive(response=((30.0, 1.0, 0.0), (2000.0, 1.0, 0.0)), frequencies=(40.0, 1000.0))
LIMITS = GuardLimits(40, 1000, 1.0)
DURATION = 60.0  # s


def main(url: str, channels: int) -> None:
    """Acknowledge a fault, arm and play."""
    with BlockingAmplifier(url, limits=LIMITS, voltage=dict.fromkeys(range(channels), FLAT)) as amp:
        amp.clear()
        amp.arm(WATCHDOG)
        sys.stdout.write("armed\n")
        sys.stdout.flush()
        tones = [
            DriveCommand(channel=n, frequency=1000, level=0.5, phase=30 * n)
            for n in range(channels)
        ]
        amp.play(tones, duration=DURATION)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
