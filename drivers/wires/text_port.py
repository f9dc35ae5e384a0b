"""A port of CAN frames on one of text, as serial adapters and servers have it."""

import contextlib
from collections.abc import Callable
from typing import final

from drivers.codec.can_bus.adapter_text import TextFormat, TextReader
from drivers.codec.can_bus.segments import pack_frames, unpack_frames
from drivers.errors import LinkError
from drivers.wires.port_above import PortAbove


@final
class TextPort(PortAbove):
    """A port of frames on one of text, below; implements `Port`.

    on_data: called with packed frames; on_other: with other text; cut_off: ends a line of which a
    port that was blocked has dropped the rest; goodbye: sent before it is closed.
    """

    def __init__(
        self,
        form: TextFormat,
        on_data: Callable[[bytes], None],
        *,
        on_other: Callable[[bytes], None] = lambda text: None,
        cut_off: bytes = b"",
        goodbye: bytes = b"",
    ) -> None:
        self._encode, self._reader, self._on_data = form.encode, TextReader(form, on_other), on_data
        self._cut_off, self._goodbye = cut_off, goodbye

    def write(self, data: bytes) -> None:
        """Send frames; raises LinkError."""
        text = b"".join(map(self._encode, unpack_frames(data)))
        self.below.write(self._cut_off + text if self.below.is_blocked else text)

    def close(self) -> None:
        """Close it; no callback is called afterwards."""
        if self._goodbye:
            with contextlib.suppress(LinkError):  # of a lost adapter
                self.below.write(self._goodbye)
        super().close()

    def received(self, data: bytes) -> None:
        """Take text of the adapter."""
        if frames := pack_frames(self._reader.feed(data)):
            self._on_data(frames)
