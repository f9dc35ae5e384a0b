"""Touches as JSON over UDP: [[1, 0.25, 0.5], ...], id, x and y of each finger that is down.

x and y are 0 to 1 from the top left corner. The sender repeats its datagram every 50 ms while a
finger is down, and sends [] when the last one lifts; after 150 ms without one all fingers lift.
"""

import json

from era_haptics.plugins.touch_sources import Touch, TouchFrame, UdpSource


class JsonTouch(UdpSource):
    """A source that listens at example-json:HOST:PORT."""

    max_size = 4096  # bytes of a datagram; ten fingers need 400

    def read(self, datagram: bytes, peer: tuple[str, int], arrived: float) -> TouchFrame | None:
        """Return the frame of a datagram; a malformed one is counted."""
        try:
            touches = tuple(Touch(int(id), float(x), float(y)) for id, x, y in json.loads(datagram))
        except (ValueError, TypeError, OverflowError, RecursionError) as error:
            self.rejects.count("malformed", f"datagram from {peer[0]}: {error}")
            return None
        return TouchFrame(f"{peer[0]}:{peer[1]}", arrived, touches, self.timeout)
