"""Resting fingers of TUIO senders that speak only on change, as the reference implementation."""

import logging
from collections.abc import Callable, Mapping

import pytest

from controller.sources.contacts import Change, ContactTracker
from controller.sources.reject_counter import RejectCounter
from controller.sources.tuio import TuioReader
from model.structure.plate import Plate
from paper_plate import make_paper_rig
from tuio_reference_sender import Place, ReferenceSender

PLATE: Plate = make_paper_rig(12, 9).plate
PEER = ("127.0.0.1", 40000)
CAMERA = 1 / 64  # s; exact in binary


class Scene:
    """A sender's camera at 64 frames a second, and the changes of contacts that come of it."""

    def __init__(self, sender: ReferenceSender, *, timeout: float = 3.0) -> None:
        self.now = 0.0
        self.log: list[tuple[float, str, int]] = []
        self.sent = 0
        self._sender = sender
        self._reader = TuioReader(RejectCounter(logging.getLogger("test")), timeout=timeout)
        self._tracker = ContactTracker(PLATE)

    def play(self, duration: float, cursors: Callable[[float], Mapping[int, Place]]) -> None:
        """Film cursors for a duration [s]; expiry is checked between frames."""
        end = self.now + duration
        while self.now < end:
            self.send(self._sender.frame(cursors(self.now), self.now))
            self._note(self._tracker.expire(self.now))
            self.now += CAMERA

    def send(self, datagram: bytes | None) -> None:
        """Deliver a datagram, if there is one."""
        frame = None if datagram is None else self._reader.read(datagram, PEER, now=self.now)
        if frame is not None:
            self.sent += 1
            self._note(self._tracker.update(frame))

    def _note(self, change: Change) -> None:
        self.log += [(self.now, "down", contact.key.id) for contact in change.down]
        self.log += [(self.now, "up", contact.key.id) for contact in change.up]


@pytest.mark.parametrize(("periodic", "ends"), [(False, [(3.0, "up", 1)]), (True, [])])
def test_resting_finger_of_a_silent_sender_is_lifted_after_three_seconds(
    periodic: bool, ends: list[tuple[float, str, int]]
) -> None:
    """A sender that repeats what is alive keeps its finger, without positions."""
    scene = Scene(ReferenceSender(periodic=periodic))
    scene.play(10.0, lambda now: {1: (0.25, 0.5)})
    assert scene.log == [(0.0, "down", 1), *ends]


def test_timeout_of_the_url_replaces_the_default() -> None:
    """A sender that is known to repeat itself may have half a second."""
    scene = Scene(ReferenceSender(), timeout=0.5)
    scene.play(1.0, lambda now: {1: (0.25, 0.5)})
    assert scene.log == [(0.0, "down", 1), (0.5, "up", 1)]
