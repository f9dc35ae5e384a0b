"""Records of what one amplifier is sent and replies, for the guards whose sets it plays."""

import weakref

from drivers.guard.guard import SafeCommandSet, SafeEnvelope
from drivers.guard.record import PlayRecord
from drivers.protocol.messages import (
    Achieved,
    Apply,
    Arm,
    Commit,
    Disarm,
    Loaded,
    LoadEnvelope,
    Reply,
    Request,
    Stage,
    Status,
    Stop,
)

RECORDED = frozenset((Apply, Stage, Commit, Stop, Disarm, Arm))
"""Requests that change what plays, or may: those that are recorded when they are sent."""

_ARMING_RAMP = 0.005  # s; within it an amplifier that is armed while it plays falls silent


class PlayRecorder:
    """Tells every guard about requests and replies; guards are known by their sets."""

    def __init__(self) -> None:
        self._references: list[weakref.ref[PlayRecord]] = []

    def sending(self, request: Request) -> None:
        """Record a request that is about to be sent.

        Raises CommandRefused for a set that must no longer play.
        """
        match request:
            case Apply(command_set=SafeCommandSet() as safe):
                self._add(safe.record)
                safe.record.send(safe)
            case Stage(command_set=SafeCommandSet() as safe):
                self._add(safe.record)
                safe.record.stage(safe)
            case Commit(token=token):
                for record in self._records:
                    record.commit(token)
            case Stop() | Disarm() | Arm():
                for record in self._records:
                    record.silence_sent()

    @property
    def _records(self) -> list[PlayRecord]:
        """The records that still exist."""
        return [record for each in self._references if (record := each()) is not None]

    def _add(self, record: PlayRecord) -> None:
        records = self._records
        if not any(each is record for each in records):
            self._references = [weakref.ref(each) for each in (*records, record)]

    def left(self, request: Request) -> None:
        """Record that a request is not pending any more, with or without its reply."""
        match request:
            case Apply(command_set=SafeCommandSet() as safe):
                safe.record.left(safe.token)
            case Commit(token=token):
                for record in self._records:
                    record.left(token)
            case _:
                pass

    def refused(self, request: Request, *, may_play: bool) -> None:
        """Record that the amplifier refused a set; may_play: see `CommandRefused`."""
        match request:
            case (
                Apply(command_set=SafeCommandSet() as safe)
                | Stage(command_set=SafeCommandSet() as safe)
            ) if not may_play:
                safe.record.refuse(safe.token)
            case Commit(token=token) if not may_play:
                for record in self._records:
                    record.refuse_commit(token)
            case _:
                pass

    def replied(self, request: Request, reply: Reply) -> None:
        """Record what a reply confirms."""
        if isinstance(request, LoadEnvelope) and isinstance(reply, Loaded):
            if isinstance(request.envelope, SafeEnvelope):
                request.envelope.record.load(request.envelope)
            return
        for record in self._records:
            match reply:
                case Achieved(token=token):
                    record.achieve(reply)
                    if isinstance(request, Stage):
                        record.confirm_staged(token)
                    else:
                        record.confirm(token)
                case Status():
                    if isinstance(request, Stop | Disarm):
                        record.silenced(request.ramp)
                    elif isinstance(request, Arm):
                        record.silenced(_ARMING_RAMP)
                    record.report(reply)
