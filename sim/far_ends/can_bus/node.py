"""A CANopen node: NMT, heartbeat, EMCY, and the dispatch of frames.

Written from protocol.yaml, without code of the host's side. Not modelled: frames missed while busy.
"""

import asyncio
import struct
from collections.abc import Callable

from drivers import clock
from drivers.codec.can_bus.canopen import CanFrame
from drivers.protocol.messages import AmplifierEvent, AmplifierState, Fault, Ping, Stop
from sim.bench.simulated_device import SimulatedDevice
from sim.far_ends.can_bus.objects import CANOPEN, IDS, ObjectDictionary
from sim.far_ends.can_bus.requests import CallLater, RequestHandler
from sim.far_ends.can_bus.sdo import SdoServer
from sim.far_ends.can_bus.set_buffer import NO_CHANNEL, Action

_NMT = CANOPEN["nmt"]
_NMT_STATES = CANOPEN["nmt_states"]
_OPERATIONAL, _STOPPED = _NMT_STATES["OPERATIONAL"], _NMT_STATES["STOPPED"]
_PRE_OPERATIONAL = _NMT_STATES["PRE_OPERATIONAL"]
_SHORTEST_RAMP = 0.005  # s
_POLL_INTERVAL = 0.02  # s; between checks whether the supply is back


class CanNode:
    """An amplifier as a node of a bus; send: puts a frame on the bus."""

    def __init__(
        self, device: SimulatedDevice, node: int, *, send: Callable[[CanFrame], None]
    ) -> None:
        self._device = device
        self._send = send
        self._state = _PRE_OPERATIONAL
        self._take_number(node)
        self._fault = Fault.NONE
        self._was_off = False
        self._poll_timer: asyncio.TimerHandle | None = None
        self._heartbeat_timer: asyncio.TimerHandle | None = None

    def _take_number(self, node: int) -> None:
        """Take a node number, with the objects and identifiers that follow from it."""
        self._node = node
        self._objects = ObjectDictionary(self._device, node, pdo_written=self._pdo)
        self._sdo = SdoServer(
            read=self._objects.read,
            write=self._objects.write,
            send=lambda data: self._send(CanFrame(IDS["sdo_answer"] + node, data)),
        )
        self._requests = RequestHandler(
            self._device,
            node,
            objects=self._objects,
            send=self._send,
            call_later=lambda delay, callback: self._call_later(delay, callback),
        )

    def start(self, call_later: CallLater | None = None) -> None:
        """Boot; call_later: the running event loop's by default."""
        self._call_later = call_later or asyncio.get_running_loop().call_later
        self._device.listen(self._send_event)
        self._boot()
        self._poll_supply()

    def close(self) -> None:
        """Stop the timers."""
        self._requests.forget()
        for timer in (self._poll_timer, self._heartbeat_timer):
            if timer is not None:
                timer.cancel()

    def receive(self, frame: CanFrame) -> None:
        """Receive a frame from the bus."""
        if not self._is_awake():
            return
        if frame.id == IDS["nmt"]:
            self._nmt_command(frame.data)
        elif frame.id == IDS["sdo_request"] + self._node and self._state != _STOPPED:
            self._sdo.receive(frame.data)
        elif frame.id == IDS["heartbeat"] + self._objects.host and self._objects.host:
            self._device.exchange(Ping())
        else:
            self._pdo(frame.id, frame.data, fd=frame.fd)

    # network management

    def _nmt_command(self, data: bytes) -> None:
        if len(data) != 2 or data[1] not in (0, self._node):
            return
        if data[0] == _NMT["start"]:
            self._state = _OPERATIONAL
        elif data[0] == _NMT["stop"]:
            self._leave_operation(_STOPPED)
        elif data[0] == _NMT["pre_operational"]:
            self._leave_operation(_PRE_OPERATIONAL)
        elif data[0] == _NMT["reset_communication"]:
            self._leave_operation(_PRE_OPERATIONAL)
            if self._objects.next_node != self._node:
                self._take_number(self._objects.next_node)
            self._boot()
        elif data[0] == _NMT["reset_node"]:
            self._device.restart()
            self._boot()

    def _leave_operation(self, state: int) -> None:
        """Stop the outputs, then leave OPERATIONAL, the only state with requests."""
        if self._device.status().state is AmplifierState.OPERATION_ENABLED:
            self._device.exchange(Stop(_SHORTEST_RAMP))
        self._state = state
        self._requests.forget()

    def _boot(self) -> None:
        self._objects.reset()
        self._sdo.reset()
        self._requests.forget()
        self._state = _PRE_OPERATIONAL
        self._send(CanFrame(IDS["heartbeat"] + self._node, b"\x00"))
        if self._heartbeat_timer is not None:
            self._heartbeat_timer.cancel()
        self._next_heartbeat()

    def _next_heartbeat(self) -> None:
        period = self._objects.heartbeat
        delay = period / 1000 if period else _POLL_INTERVAL  # 0: no heartbeat
        self._heartbeat_timer = self._call_later(delay, self._heartbeat)

    def _heartbeat(self) -> None:
        if self._is_awake() and self._objects.heartbeat:
            self._send(CanFrame(IDS["heartbeat"] + self._node, bytes([self._state])))
        self._next_heartbeat()

    def _poll_supply(self) -> None:
        """Boot when the supply is back."""
        self._is_awake()
        self._poll_timer = self._call_later(_POLL_INTERVAL, self._poll_supply)

    def _is_awake(self) -> bool:
        is_off = self._device.faults.now("reboot", clock.now())
        if self._was_off and not is_off:
            self._was_off = False
            self._boot()
        self._was_off = is_off
        return self._device.is_answering

    # requests and events

    def _pdo(self, cob_id: int, data: bytes, *, fd: bool = False) -> None:
        if self._state == _OPERATIONAL:
            self._requests.take(cob_id, data, fd=fd)

    def _send_event(self, event: AmplifierEvent) -> None:
        """Send a change of state: EMCY for faults, else an unsolicited reply."""
        concerns_fault = event.fault is not Fault.NONE or self._fault is not Fault.NONE
        self._fault = event.fault
        if not self._device.is_answering or self._state == _STOPPED:
            return
        channel = NO_CHANNEL if event.channel is None else event.channel
        if concerns_fault:
            emergency = CANOPEN["emergencies"][event.fault.name]
            head = (emergency["code"], emergency["error_register"], event.state | event.fault << 4)
            data = struct.pack("<HBBB3x", *head, channel)
            self._send(CanFrame(IDS["emergency"] + self._node, data))
        elif self._state == _OPERATIONAL:
            data = struct.pack("<BBBBHH", 0, Action.STATUS, event.state, channel, 0, 0)
            self._send(CanFrame(IDS["answer"] + self._node, data))
