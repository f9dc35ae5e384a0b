"""Touch source for JSON over UDP: [[id, x, y], ...] with all fingers on the plate.

x and y are 0 to 1 from the top left corner. The sender repeats its datagram every 50 ms while any
finger is down, and sends [] when the last finger lifts. After 150 ms without a datagram all fingers
are lifted.
"""

import json

from era_haptics.plugins.touch_sources import Touch, TouchFrame, UdpSource


class JsonTouch(UdpSource):
    """Source at the URL example-json:HOST:PORT."""

    max_size = 4096  # bytes per datagram; ten fingers need 400

    def read(self, datagram: bytes, peer: tuple[str, int], arrived: float) -> TouchFrame | None:
        """Return the touches in a datagram; count malformed datagrams."""
        try:
            rows = json.loads(datagram)
            touches = tuple(Touch(int(id), float(x), float(y)) for id, x, y in rows)
        except (ValueError, TypeError, OverflowError, RecursionError) as error:
            self.rejects.count("malformed", f"datagram from {peer[0]}: {error}")
            return None
        return TouchFrame(f"{peer[0]}:{peer[1]}", arrived, touches, self.timeout)
