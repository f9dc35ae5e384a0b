"""Interfaces of python-can: full transmit queues, error frames, losses, vendors' drivers.

A device that hangs delays nothing else.
"""

import asyncio
import errno
import logging
import os
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field, replace
from typing import Any
from unittest.mock import Mock

import can
import pytest
from can.interfaces import BACKENDS

from drivers import ports
from drivers.errors import CommandError, LinkError
from drivers.ports import Port
from drivers.urls import Endpoint
from drivers.wires import can_interfaces
from drivers.wires.can_frames import CanFrame, pack_frames
from drivers.wires.can_interfaces import BusPort, Interface, Outbox, PythonCanAddress
from drivers.wires.wire import address_of
from kit.clock import in_virtual_time
from kit.wires import until
from registry import threads
from tests.drivers.hanging_bus import hanging_interface

SOCKETCAN = Interface(is_watched=True, sends_at_once=True, full_code=105, bus_off=0x40)
"""ENOBUFS of Linux, and CAN_ERR_BUSOFF of linux/can/error.h."""
SET = [CanFrame(0x201, bytes([number])) for number in range(22)]
"""A set of 22 frames to one node."""
COMMIT = [CanFrame(0x200, b"commit")]
STOP = [CanFrame(0x201, b"stop")]


def data_of(frames: list[CanFrame]) -> list[bytes]:
    """Return the data of frames."""
    return [frame.data for frame in frames]


class Adapter(can.BusABC):
    """An adapter whose transmit queue has room for some frames."""

    def __init__(self) -> None:
        self.room = 10  # txqueuelen of Linux
        self.sent: list[bytes] = []
        self.incoming: list[can.Message] = []
        """What it receives next."""
        self.pipe = os.pipe()
        super().__init__(channel="0")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if not self.room:
            raise can.CanOperationError("no buffer space", error_code=errno.ENOBUFS)
        self.room -= 1
        self.sent.append(bytes(msg.data))

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        return (self.incoming.pop(0) if self.incoming else None), False

    def fileno(self) -> int:
        return self.pipe[0]

    def close_pipe(self) -> None:
        """Close both ends of the pipe that stands for its device."""
        for descriptor in self.pipe:
            os.close(descriptor)


@dataclass
class Bus:
    """A port of a bus, its adapter, and the losses that the port reports."""

    adapter: Adapter
    port: BusPort
    losses: list[str] = field(default_factory=list)

    def write(self, frames: list[CanFrame]) -> None:
        """Write frames at once."""
        self.port.write(pack_frames(frames))

    def receive_error(self, error_class: int) -> None:
        """Receive an error frame of a class."""
        self.adapter.incoming.append(error_frame(error_class))
        self.port.poll()


def error_frame(error_class: int) -> can.Message:
    """Return an error frame as Linux reports it."""
    return can.Message(arbitration_id=error_class, is_error_frame=True)


@asynccontextmanager
async def open_bus(
    interface: Interface = SOCKETCAN, receive: Callable[[bytes], None] = lambda data: None
) -> AsyncIterator[Bus]:
    """Open a port; receive: called with the frames that it receives."""
    adapter = Adapter()
    losses: list[str] = []
    port = BusPort(adapter, "can0", receive, losses.append, interface)
    try:
        yield Bus(adapter, port, losses)
    finally:
        port.close()
        await port.wait_closed()
        adapter.close_pipe()


# Transmit queue


@in_virtual_time
async def test_bus_port_sends_a_long_set_as_the_queue_gets_room() -> None:
    """There is room for 10 of 22 frames; the port is blocked until all are sent, in order."""
    async with open_bus() as bus:
        bus.write(SET)
        assert bus.port.is_blocked
        assert bus.adapter.sent == data_of(SET[:10])

        for _ in range(12):
            bus.adapter.room = 1
            await asyncio.sleep(0.005)

        assert not bus.port.is_blocked
        assert bus.adapter.sent == data_of(SET)
        assert bus.losses == []


@in_virtual_time
async def test_bus_port_drops_the_rest_of_a_set_but_no_broadcast_for_a_stop() -> None:
    """Ten frames of the set were sent; only the broadcast precedes the stop."""
    async with open_bus() as bus:
        for frames in (SET, COMMIT, SET, STOP):
            bus.write(frames)

        bus.adapter.room = 30
        await asyncio.sleep(0.01)

        assert not bus.port.is_blocked
        assert bus.adapter.sent[10:] == [b"commit", b"stop"]


@in_virtual_time
async def test_bus_port_drops_frames_that_waited_in_a_stuck_queue() -> None:
    """No node acknowledges; what waited is not sent when the bus is repaired much later."""
    async with open_bus() as bus:
        bus.adapter.room = 0
        bus.write(COMMIT + SET)
        await asyncio.sleep(1.0)
        assert len(bus.port.outbox) == 0
        assert bus.port.is_blocked

        bus.adapter.room = 30
        bus.write(STOP)

        assert bus.adapter.sent == [b"stop"]
        assert bus.losses == []


@in_virtual_time
async def test_bus_port_drops_a_broadcast_after_30_ms_while_requests_are_repeated() -> None:
    """A request is repeated every 20 ms, and a broadcast is too late after the time of a reply."""
    async with open_bus() as bus:
        bus.adapter.room = 0
        bus.write(COMMIT)
        for _ in range(2):
            await asyncio.sleep(0.02)
            bus.write(STOP)

        bus.adapter.room = 30
        bus.write(STOP)

        assert bus.adapter.sent == [b"stop"]


@pytest.mark.parametrize(
    ("sent_at", "next_frame"), [(0.02, SET[1]), (0.05, None)], ids=["soon", "late"]
)
def test_outbox_drops_the_rest_of_a_set_if_the_adapter_takes_too_long_for_a_frame(
    sent_at: float, next_frame: CanFrame | None
) -> None:
    """A request is given up after 30 ms without progress; a newer one is sent in any case."""
    outbox = Outbox()
    outbox.put(SET, 0.0)
    first = outbox.first(0.001)
    assert first is SET[0]

    outbox.taken(first, sent_at)

    assert outbox.first(sent_at) is next_frame
    outbox.put(STOP, sent_at)
    assert outbox.first(sent_at) is STOP[0]


def caused_by(cause: can.CanError) -> can.CanError:
    """Return an error with a cause."""
    error = can.CanOperationError()
    error.__cause__ = cause
    return error


FULL_QUEUE: dict[str, can.CanError] = {
    "socketcan": can.CanOperationError("Transmit buffer full"),
    "socketcan queue": can.CanOperationError("Failed to transmit", errno.ENOBUFS),
    "pcan": can.CanOperationError("Failed to send: The transmit queue is full."),
    "pcan controller": can.CanOperationError("Transmit buffer in CAN controller is full"),
    "kvaser": can.CanOperationError("Function canWrite failed", -13),
    "vector": can.CanOperationError("xlCanTransmit failed", 11),
    "systec": caused_by(can.CanError("Function UcanWriteCanMsgEx", 11)),
    "usb2can": can.CanOperationError("could not send message", 9),
    "ixxat": can.CanTimeoutError("Function canChannelSendMessage"),
}
"""The error of python-can 4.6 and of the vendor's library for a full transmit queue."""


async def losses_after(
    interface: str, error: can.CanError, monkeypatch: pytest.MonkeyPatch
) -> list[str]:
    """Send a frame to a bus whose first `send` fails; return the losses."""
    adapter = Adapter()
    losses: list[str] = []
    send = Mock(side_effect=[error, None])
    monkeypatch.setattr(adapter, "send", send)
    monkeypatch.setattr(can, "Bus", Mock(return_value=adapter))
    monkeypatch.setattr(can_interfaces, "FULL_TIMEOUT", 60.0)
    options = {"interface": interface, "channel": 0, "bitrate": 500_000}
    port = await can_interfaces.open_bus("can0", options, lambda data: None, losses.append)
    with suppress(LinkError):
        port.write(pack_frames(STOP))
    await until(lambda: send.call_count == 2 or bool(losses))
    port.close()
    await port.wait_closed()
    adapter.close_pipe()
    return losses


@pytest.mark.parametrize("case", FULL_QUEUE)
async def test_bus_port_is_not_lost_when_the_queue_of_any_interface_is_full(
    case: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The frame is sent again once there may be room."""
    assert await losses_after(case.split()[0], FULL_QUEUE[case], monkeypatch) == []


# Losses


async def test_bus_port_is_lost_once_after_a_bus_off_error_frame() -> None:
    """Error class 0x40 of linux/can/error.h; other error frames are no loss."""
    async with open_bus() as bus:
        bus.receive_error(0x04)
        assert bus.losses == []

        bus.receive_error(0x40)
        bus.receive_error(0x40)

        (loss,) = bus.losses
        assert "bus-off" in loss


async def test_bus_port_is_lost_when_sending_fails() -> None:
    """The request gets a LinkError, and the line is lost with the same text."""
    unplugged = can.CanOperationError("No such device", error_code=errno.ENODEV)
    async with open_bus() as bus:
        bus.adapter.send = Mock(side_effect=unplugged)  # type: ignore[method-assign]

        with pytest.raises(LinkError, match="No such device") as error:
            bus.write(STOP)

        assert bus.losses == [*error.value.args]


async def test_reader_thread_delivers_frames_in_order_until_the_adapter_is_lost() -> None:
    """Frames that arrived before are delivered first, and the loss is reported once."""
    received: list[bytes] = []
    in_thread = replace(SOCKETCAN, is_watched=False, sends_at_once=False)
    frames = [CanFrame(0x181, bytes([number])) for number in range(3)]
    async with open_bus(in_thread, received.append) as bus:
        bus.port.poll()  # does nothing: the thread reads
        for frame in frames:
            message = can.Message(arbitration_id=0x181, is_extended_id=False, data=frame.data)
            bus.adapter.incoming.append(message)
        bus.adapter.incoming.append(error_frame(0x40))
        await until(lambda: bool(bus.losses))

        assert received == [pack_frames([frame]) for frame in frames]
    assert len(bus.losses) == 1


# Devices that hang


async def test_sender_thread_sends_a_stop_next_after_a_call_that_hangs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """On a real interface; only the broadcast precedes it, and the rest of the set is dropped."""
    monkeypatch.setattr(can_interfaces, "FULL_TIMEOUT", 60.0)
    options = {"interface": "hanging", "channel": "stop first"}
    with (
        hanging_interface() as adapter,
        can.Bus(interface="virtual", channel="stop first") as receiver,
    ):
        port = await can_interfaces.open_bus("can0", options, lambda data: None, pytest.fail)
        adapter.hangs = True
        for frames in (SET, COMMIT, SET):
            port.write(pack_frames(frames))
            await until(lambda: adapter.sending == 1)
        port.write(pack_frames(STOP))
        assert port.is_blocked

        adapter.resume()

        messages = [await asyncio.to_thread(receiver.recv, 60.0) for _ in range(3)]
        assert [bytes(message.data) for message in messages] == [b"\0", b"commit", b"stop"]
        await until(lambda: not port.is_blocked)
        port.close()
        await port.wait_closed()
        assert receiver.recv(0.0) is None


@pytest.mark.parametrize("read_timeout", [None, 20.0], ids=["as requested", "20 s"])
@pytest.mark.parametrize("kind", ["serial port", "CAN adapter"])
async def test_close_does_not_wait_for_a_device_that_hangs(
    kind: str,
    read_timeout: float | None,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Closing continues in its thread, with a log line; frames that it still reads are discarded.

    read_timeout: how long the device blocks in a read [s].
    """
    received: list[bytes] = []
    pipe = os.pipe()
    may_read = threading.Event()
    may_close = threading.Event()
    is_closed = threading.Event()

    def recv(timeout: float) -> can.Message | None:
        if not may_read.wait(read_timeout or timeout):
            return None
        return can.Message(arbitration_id=0x701, is_extended_id=False, data=[5])

    def close() -> None:
        may_close.wait(60)
        for descriptor in pipe:
            os.close(descriptor)
        is_closed.set()

    device = Mock(port="/dev/ttyUSB9", recv=recv, close=close, shutdown=close)
    device.fileno.return_value = pipe[0]
    monkeypatch.setattr(ports, "open_device", lambda *_: device)
    monkeypatch.setattr(can, "Bus", lambda **_: device)
    monkeypatch.setattr(threads, "CLOSE_TIMEOUT", 0.05)
    port: Port
    if kind == "serial port":
        endpoint = Endpoint("/dev/ttyUSB9", baud=9600)
        port = await ports.open_port(endpoint, received.append, lambda cause: None)
    else:
        options = {"interface": "pcan"}
        url = "can+python-can://pcan/usb"
        port = await can_interfaces.open_bus(url, options, received.append, print)

    port.close()
    with caplog.at_level(logging.WARNING, "drivers"):
        await asyncio.wait_for(port.wait_closed(), 30)

    assert not is_closed.is_set()
    assert "era-close" in caplog.text
    may_read.set()
    may_close.set()
    assert await asyncio.to_thread(is_closed.wait, 60)
    assert received == []


# Vendors' interfaces

CHANNELS = {
    "etas": "ETAS://ETH/ES910:abcd/CAN:1",
    "nixnet": "CAN1",
    "pcan": "PCAN_USBBUS1",
    "robotell": "/dev/no-such-port",
    "seeedstudio": "/dev/no-such-port",
    "serial": "/dev/no-such-port",
    "udp_multicast": "239.74.163.2",
    "usb2can": "ED000200",
}
"""Channels as the interfaces name them, other than 0."""
OPTIONS = {
    "canalystii": {"device": 1},
    "ixxat": {"unique_hardware_id": "HW107711"},
    "neousys": {"device": 1},
    "neovi": {"serial": 4711},
    "pcan": {"device_id": 5},
    "systec": {"device_number": 2},
    "udp_multicast": {"port": 43114},
    "vector": {"app_name": "plate", "serial": 4711},
}
"""Options that distinguish adapters."""
INTERFACES = sorted(set(BACKENDS) - {"slcan", "socketcan", "socketcand"})


def interface_address(interface: str, query: str = "") -> PythonCanAddress:
    """Return the address of node 3 on a channel of an interface."""
    channel = CHANNELS.get(interface, "0")
    address = address_of(f"can+python-can://{interface}/{channel}{query}#3")
    assert isinstance(address, PythonCanAddress)
    return address


@pytest.mark.parametrize("interface", INTERFACES)
async def test_interface_is_opened_with_the_options_of_its_url(
    interface: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its channel, as a number if it is one, the bit rate, and what distinguishes adapters."""
    bus_class = Mock(side_effect=OSError("no adapter"))
    monkeypatch.setattr(can, "Bus", bus_class)
    options: dict[str, Any] = OPTIONS.get(interface, {})
    query = "".join(f"&{name}={value}" for name, value in options.items())
    address = interface_address(interface, f"?bitrate=250000{query}")

    with pytest.raises(LinkError, match="no adapter"):
        await address.open_port(lambda data: None, lambda cause: None)

    assert address.number == 3
    opened_with = bus_class.call_args.kwargs
    assert opened_with["interface"] == interface
    assert opened_with["channel"] == CHANNELS.get(interface, 0)
    assert opened_with["bitrate"] == 250_000
    assert opened_with["receive_own_messages"] is False
    assert options.items() <= opened_with.items()


@pytest.mark.parametrize("interface", sorted(set(INTERFACES) - {"virtual", "udp_multicast"}))
async def test_interface_without_its_adapter_raises_a_link_error(interface: str) -> None:
    """Whatever error the vendor's driver raises."""
    with pytest.raises(LinkError, match="cannot be opened"):
        await interface_address(interface).open_port(lambda data: None, lambda cause: None)


@pytest.mark.parametrize("rest", ["?fd=2000000#1", "#128", "?bitrate=3#1"])
def test_can_url_must_be_of_classic_can(rest: str) -> None:
    """Without CAN FD, with a node from 1 to 127, and a bit rate of CAN."""
    with pytest.raises(CommandError):
        address_of(f"can+socketcan://can0{rest}")
