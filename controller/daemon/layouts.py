"""The surface layouts of a running daemon, of which one is in use."""

import logging
from collections.abc import Callable

from controller.api.jsonrpc import ErrorCode, RpcError
from controller.api.server import LayoutEvent
from controller.daemon.config import DaemonConfig
from controller.daemon.reload import ConfigChange, warn_of_bands
from controller.effects.player import EffectPlayer
from controller.effects.strengths import Strengths, read_strengths
from model.arrays import FloatArray
from registry.plugins import did_you_mean

_logger = logging.getLogger(__name__)


class LayoutChoice:
    """The layouts of a daemon's configuration; in use is the first until another one is chosen.

    config: made for a table; frequencies [Hz]: of that, to log bands that it lacks; changed: called
    when another layout, or the same with other content, is in use.
    """

    def __init__(
        self, config: DaemonConfig, frequencies: FloatArray, *, changed: Callable[[], None]
    ) -> None:
        self._layouts = config.layouts
        self._changed = changed
        self.name = next(iter(self._layouts))
        """Of the layout in use; None if none is configured."""
        self.player = EffectPlayer(
            self._layouts[self.name], Strengths(read_strengths(config.strengths))
        )
        """Plays the layout in use."""
        warn_of_bands(self._layouts, frequencies)

    @property
    def names(self) -> list[str]:
        """The names that may be chosen."""
        return [name for name in self._layouts if name is not None]

    def use(self, name: str) -> None:
        """Play a layout for all that comes from now on; raises RpcError for an unknown name."""
        if name not in self._layouts:
            remedy = f"{did_you_mean(name, self.names)}choose one of {', '.join(self.names)}"
            raise RpcError(
                ErrorCode.INVALID_PARAMS,
                f"unknown layout {name!a}",
                where="name",
                remedy=remedy if self.names else "name some in layouts of the daemon's file",
            )
        if name != self.name:
            self._play(name)

    def apply(self, change: ConfigChange) -> list[str]:
        """Take the layouts of a configuration that was read again; the one in use stays in use.

        If it was removed it is the first, of which it returns a note.
        """
        before, self._layouts = self.name, change.config.layouts
        name = before if before in self._layouts else next(iter(self._layouts))
        if name != before or name in change.layouts:
            self._play(name)
        return [] if name == before else [f"layout in use: {name or 'none'}"]

    def event(self) -> LayoutEvent:
        """The layout in use, as an event."""
        layout = None if self.name is None else self.player.layout.as_json()
        return LayoutEvent(name=self.name, layout=layout)

    def _play(self, name: str | None) -> None:
        self.name = name
        self.player.replace(self._layouts[name])
        _logger.info("layout: %s in use", name or "none")
        self._changed()
