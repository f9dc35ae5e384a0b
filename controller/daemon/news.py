"""What happens in the daemon, as its clients are told of it: the news, and what is so now."""

import asyncio
import contextlib
import logging
from collections.abc import Callable, Sequence

from controller.api.hub import Hub
from controller.api.schema import AmplifierStatus
from controller.api.topics import (
    AmplifiersEvent,
    LatencyEvent,
    LayoutEvent,
    LinkEvent,
    LogEvent,
    SilenceEvent,
    StateEvent,
)
from controller.daemon.latency import Latencies
from controller.daemon.states import Machine, State
from controller.daemon.view import Scene
from controller.effects.layout import Layout
from controller.loop.observer import Applied, Observer, Silenced
from controller.sources.contacts import Change, Contact, ContactKey
from drivers import clock

_logger = logging.getLogger(__name__)


class News:
    """Keeps what is so now, and tells every change of it to whoever has subscribed at `hub`.

    machine: the daemon's state; amplifiers: how they are; effect_of: what plays for a finger;
    plain_because: why onsets are plain; layout: the surface layout, None without one.
    """

    def __init__(
        self,
        *,
        machine: Callable[[], Machine],
        amplifiers: Callable[[], list[AmplifierStatus]],
        effect_of: Callable[[ContactKey], str | None],
        plain_because: Callable[[], str | None],
        layout: Layout | None,
    ) -> None:
        self.scene = Scene(effect_of)
        self.latencies = Latencies()
        self.amplifiers = amplifiers
        self._machine = machine
        self._layout = layout
        self._retried = ""  # what came of the last attempt to reopen a link
        self._loop = asyncio.get_running_loop()
        self.hub = Hub(
            {
                "state": self._state_event,
                "contacts": self.scene.contacts_event,
                "pattern": self.scene.pattern_event,
                "silence": self.scene.silence_event,
                "amplifiers": lambda: AmplifiersEvent(amplifiers=amplifiers()),
                "latency": lambda: LatencyEvent(
                    latency_ms=self.latencies.summary(), plain_because=plain_because()
                ),
                "layout": self.layout_event,
            },
            clock=clock.now,
        )

    def observer(self) -> Observer:
        """Hears of the control loop."""
        return Observer(
            contacts_changed=self._contacts_changed,
            pattern_applied=self._pattern_applied,
            silenced=self._silenced,
            refused=lambda reason: _logger.warning("refused: %s", reason),
        )

    def state_changed(self, old: Machine, new: Machine) -> None:
        """The daemon's state is another."""
        self.hub.publish(
            "state",
            lambda: StateEvent(
                old=old.state.value, new=new.state.value, cause=new.cause, remedy=new.remedy
            ),
        )
        if self.scene.applied is not None and new.state is not State.OPERATION_ENABLED:
            # The control loop does not tell of what others end; without a link it cannot.
            self.scene.ended()
            over = SilenceEvent(
                contacts=self.scene.contact_statuses(), reason=new.cause, latency_ms=None
            )
            self.hub.publish("silence", lambda: over)

    def layout_changed(self, layout: Layout | None) -> None:
        """There is another surface layout, or there are other effects without one."""
        self._layout = layout
        self.hub.publish("layout", self.layout_event)

    def link_told(self, event: str, lost: Sequence[str], message: str) -> None:
        """A link was lost (lost: to which amplifiers), is tried again (retry), or is reopened."""
        if event == "retry" and message != self._retried:  # the state tells of loss and return
            _logger.warning("the link is tried again: %s", message, extra={"topic": "link"})
        self._retried = message
        if event != "retry":  # fingers are not followed without a link, and begin anew with one
            self._contacts_changed((), Change())
        told = {
            "event": event,
            "amplifier": lost[0] if len(lost) == 1 else None,
            "message": message,
            "remedy": None if event == "reopened" else "look at cables and supply",
        }
        self.hub.publish("link", lambda: LinkEvent.model_validate(told))

    def logged(self, record: logging.LogRecord) -> None:
        """There is a line in the log; called in any thread.

        A line that is marked with another topic is told there.
        """
        if hasattr(record, "topic"):
            return
        told = {
            "level": "error" if record.levelno >= logging.ERROR else record.levelname.lower(),
            # A file's name may hold bytes that are no text, and JSON has none of these.
            "message": record.getMessage()[:1000].encode(errors="backslashreplace").decode(),
            "cause": getattr(record, "cause", None),
            "remedy": getattr(record, "remedy", None),
        }

        def publish() -> None:
            self.hub.publish("log", lambda: LogEvent.model_validate(told))

        with contextlib.suppress(RuntimeError):  # the loop may be over
            self._loop.call_soon_threadsafe(publish)

    def layout_event(self) -> LayoutEvent:
        """The surface layout as it is told."""
        return LayoutEvent(layout=None if self._layout is None else self._layout.drawn())

    def _state_event(self) -> StateEvent:
        now = self._machine()
        return StateEvent(
            old=now.state.value, new=now.state.value, cause=now.cause, remedy=now.remedy
        )

    def _contacts_changed(self, contacts: tuple[Contact, ...], change: Change) -> None:
        self.scene.changed(contacts)
        self.hub.publish("contacts", self.scene.contacts_event)

    def _pattern_applied(self, applied: Applied) -> None:
        self.scene.played(applied)
        self.latencies.note(applied.latency)
        self.hub.publish("pattern", self.scene.pattern_event)

    def _silenced(self, silenced: Silenced) -> None:
        self.scene.fell_silent(silenced)
        if silenced.latency is not None:
            self.latencies.note(silenced.latency)
        self.hub.publish("silence", self.scene.silence_event)
