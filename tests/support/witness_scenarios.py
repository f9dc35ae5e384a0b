"""What is played before the witness: an ordinary day, and days on which something is wrong."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from operator import methodcaller
from typing import Any

import hand_written as hand
from witnessed_chain import Scene

Step = Callable[[Scene], Any]
operate, touch, rest = (partial(methodcaller, name) for name in ("operate", "touch", "rest"))
"""Each makes a step: a method of the scene with its arguments."""

SCENARIOS: Mapping[str, Sequence[Step]] = {
    # An amplifier trips amid a touch, is asked for its faults, cleared and identified again.
    "arc": [
        *(operate("arm"), touch(1, rest=0.06), methodcaller("trip"), methodcaller("poll", 5)),
        *(methodcaller("ask", "GetFaults"), touch(rest=0.1), operate("clear", rest=0.05)),
        *(methodcaller("identify"), methodcaller("trip"), methodcaller("ask", "GetFaults")),
    ],
    # Touches, a neighbour, a lift, a stop amid a touch, clearing, arming, disarming.
    "day": [
        *(operate("arm", rest=0.12), touch(1, rest=0.1), touch(1, 2, rest=0.12)),
        *(touch(1, rest=0.05), touch(rest=0.1), touch(1, rest=0.1), touch(rest=0.1)),
        *(touch(3, rest=0.1), operate("stop", rest=0.1), touch(), operate("clear")),
        *(operate("arm"), touch(4, rest=0.06), operate("disarm", rest=0.1), touch()),
    ],
    # Other fingers touch every 4 ms, within the ramp of a pattern; then all is opened again.
    "hasty": [
        operate("arm", rest=0.12),
        *(touch(1, rest=0.004), touch(1, 2, rest=0.004)) * 5,
        *(rest(0.1), touch(rest=0.06), methodcaller("reopen")),
        *(operate("arm"), touch(1, rest=0.06), touch(rest=0.05)),
    ],
    # The control loop stalls during a touch; a client polls the status, clears and rearms.
    "hung": [
        *(operate("arm"), touch(1, rest=0.1), methodcaller("hang"), methodcaller("poll", 20)),
        *(touch(), operate("clear", rest=0.05), methodcaller("run"), operate("arm")),
        *(touch(2, rest=0.06), touch(rest=0.06)),
    ],
    # The last finger is lifted, then an amplifier is stopped, each before a late reply.
    "slow": [
        *(operate("arm", rest=0.02), methodcaller("delayed", 0.025), touch(1, rest=0.001)),
        *(touch(rest=0.05), touch(1, rest=0.001), operate("stop"), touch(rest=0.05)),
        *(methodcaller("delayed", 0.0), rest(0.05)),
    ],
    # A finger beside the plate is none; the source of touches dies with a finger down.
    "source_dies": [
        *(operate("arm", rest=0.05), methodcaller("touch_beside"), rest(0.1)),
        *(touch(1, rest=0.1), methodcaller("fall_silent"), rest(0.1)),
    ],
    # Another program sends a silent set while disarmed, later a heartbeat of its own session.
    "stranger": [
        rest(0.1),
        methodcaller("inject", hand.SET, hand.part(7, hand.layer(0), now=True)),
        *(rest(0.01), operate("arm", rest=0.05), touch(1, rest=0.06)),
        lambda scene: scene.inject(hand.PING, (scene.amplifier.session % 65535 + 1,)),
        *(rest(0.01), touch(rest=0.05)),
    ],
    # The table asks for more than full level on one ERA, 620 Hz, or is damaged: NaN.
    "too_much": [
        operate("arm"),
        *(
            step
            for tone in ((150.0, 0.7), (620.0, 0.4), (150.0, 0.4, float("nan")))
            for step in (methodcaller("touch_for", *tone), rest(0.1), touch(rest=0.05))
        ),
    ],
}
"""By name, in the order of the names."""
