"""How fast a finger moves, from the places that its source reports, whose errors are a millimetre.

Velocity is the slope of places over time by least squares, of the last 60 ms. Of a finger whose
places differ by less than 3 mm in that time nothing is known but that it moves slowly: it rests.
"""

import math
from dataclasses import dataclass

OVER = 0.060
"""Time [s] over which a velocity is found; of frames that are older nothing counts."""

_LEAST_TIME, _LEAST_WAY = 0.020, 0.003  # s, m; of a velocity


@dataclass(frozen=True, slots=True)
class Motion:
    """The way of a finger: places x, y [m] at times [s], the last one where it is."""

    places: tuple[tuple[float, float, float], ...] = ()

    def followed(self, time: float, x: float, y: float) -> "Motion":
        """Return it with another place at a time [s]."""
        since = time - OVER
        return Motion((*[each for each in self.places if since < each[0] < time], (time, x, y)))

    def velocity(self, now: float) -> tuple[float, float]:
        """Return the velocity [m/s] at a time [s]; zero for a finger that rests."""
        places = [each for each in self.places if each[0] > now - OVER]
        if not places or places[-1][0] - places[0][0] < _LEAST_TIME:
            return 0.0, 0.0
        mean = [sum(values) / len(places) for values in zip(*places, strict=True)]
        variance = sum((time - mean[0]) ** 2 for time, _, _ in places)
        vx = sum((time - mean[0]) * (x - mean[1]) for time, x, _ in places) / variance
        vy = sum((time - mean[0]) * (y - mean[2]) for time, _, y in places) / variance
        is_moving = math.hypot(vx, vy) * (places[-1][0] - places[0][0]) >= _LEAST_WAY
        return (vx, vy) if is_moving else (0.0, 0.0)

    @property
    def is_under_way(self) -> bool:
        """Whether it moved when its last place was reported."""
        return len(self.places) > 0 and any(self.velocity(self.places[-1][0]))


AT_REST = Motion()
"""Of a finger of which nothing is known."""
