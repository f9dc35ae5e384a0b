"""Whether what an amplifier says that a set plays is the set."""

import math

from sim.witness.quantities import LEVEL
from sim.witness.seen import Answered, Asked, Complain

_FINE = 0.011  # Hz and degrees; one step of the wire


def check_achieved(
    name: str, asked: Asked, answer: Answered, time: float, *, is_warm: bool, complain: Complain
) -> None:
    """What it says that a set plays is the set: whole, and no channel more than another."""
    if answer.token != asked.token and answer.token:
        what = f"{name} answered set {asked.token} with set {answer.token}"
        complain("credit", time, what)
    if answer.achieved is None:
        return
    if answer.achieved.keys() != asked.drives.keys():
        complain(
            "commit",
            time,
            f"{name} plays channels {sorted(answer.achieved)} of a set that names "
            f"{sorted(asked.drives)}",
        )
        return
    shares = []
    for channel, drive in asked.drives.items():
        played = answer.achieved[channel]
        turn = math.remainder(played.phase - drive.phase, 360.0)
        if drive.level > 0:
            shares.append(played.level / drive.level)
        is_other = (drive.level == 0) != (played.level == 0)
        if drive.level > 0 and (
            abs(played.frequency - drive.frequency) > _FINE or abs(turn) > _FINE
        ):
            is_other = True
        if is_other:
            complain(
                "plays",
                time,
                f"{name} makes {played.frequency:g} Hz, level {played.level:g}, "
                f"{played.phase:g} degrees of {drive.frequency:g} Hz, {drive.level:g}, "
                f"{drive.phase:g} on channel {channel}",
            )
    rounded = 0.0
    if shares and min(shares) < 0.99:  # what is derated is rounded to the wire's steps again
        rounded = LEVEL.step / min(drive.level for drive in asked.drives.values() if drive.level)
    if shares and max(shares) - min(shares) > 0.01 + rounded:
        what = f"{name} plays the channels of a set at different shares of their levels"
        complain("commit", time, what)
    elif shares and not is_warm and abs(shares[0] - 1) > 0.01:
        complain("plays", time, f"{name} plays {shares[0]:.3g} of the levels it was told")
