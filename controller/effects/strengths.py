"""Strengths: a gain on all that a touch source or a client brings, by its name."""

from collections.abc import Callable, Collection, Mapping

MAX_STRENGTHS = 64
"""How many names may have a strength, and how many touch sources are remembered."""


class Strengths:
    """Gains [dB] by name, 0 at most, which is what holds where none is set.

    A name is that of a touch input of the configuration, of a sender there (`table:left@10.0.0.2`),
    of a touch source as its client calls it, or of a client. At a finger the gains of its names and
    of the client that plays its effect add up, each once.
    """

    def __init__(self, gains_db: Mapping[str, float] | None = None) -> None:
        self.gains_db: Mapping[str, float] = gains_db or {}
        """Those that are set, by name."""
        self.clients: dict[str, str] = {}
        """Names of clients with touch sources, by the origin with which the keys of these begin."""
        self.sources: Mapping[str, None] = {}
        """Names of touch sources that had fingers, the newest last."""
        self.players: Collection[str] = ()
        """Names of clients that are connected and have played an effect."""
        self.changed: Callable[[], None] = lambda: None
        """Called when a gain was set, or a source or client is new."""

    def note(self, source: str) -> None:
        """Note that a touch source has a finger."""
        name, _ = self._names_of(source)
        if name not in self.sources:
            self.sources = dict.fromkeys([*self.sources, name][-MAX_STRENGTHS:])
            self.changed()

    def gain_db(self, source: str, player: str | None = None) -> float:
        """Return the gain at a finger of a source; player: the client that plays its effect."""
        if not self.gains_db:
            return 0.0
        names = {*self._names_of(source), player}
        return sum([gain for name, gain in self.gains_db.items() if name in names])

    def set(self, name: str, gain_db: float) -> None:
        """Set the gain [dB] of a name from now on; 0 removes it."""
        gains = {**self.gains_db, name: gain_db}
        self.gains_db = {name: gain for name, gain in gains.items() if gain}
        self.changed()

    def played(self, players: Collection[str]) -> None:
        """Note which clients that are connected have played an effect."""
        if players != self.players:
            self.players = players
            self.changed()

    def _names_of(self, source: str) -> tuple[str, str]:
        """Return the two names of a source, its own first."""
        first, second, *rest = f"{source}::".split(":", 2)
        client = self.clients.get(f"{first}:{second}")
        return (source, first) if client is None else (rest[0][:-2], client)
