"""The far end's SDO server against the client of `canopen`, and against frames by hand."""

import struct
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import canopen
import pytest
from canopen.objectdictionary import ODVariable
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoAbortedError
from hypothesis import given
from hypothesis import strategies as st

import drivers
from can_eds import eds_text
from can_session import Timers
from drivers.codec.can_bus.canopen import CanFrame
from drivers.protocol.messages import Fault
from fake_device import FakeDevice
from sim.far_ends.can_bus import sdo
from sim.far_ends.can_bus.node import CanNode
from sim.far_ends.can_bus.sdo import NO_OBJECT, SdoAbort, SdoServer
from vendor_pages import SENSORS, ScriptedSensors

INDEX = 0x2100
DOCS = Path(drivers.__file__).parent.parent / "docs" / "reference"


@pytest.fixture(autouse=True, scope="module")
def clock() -> Iterator[SimpleNamespace]:
    """A clock advanced by hand, so that a busy machine causes no timeout."""
    stopped = SimpleNamespace(time=0.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sdo, "clock", SimpleNamespace(now=lambda: stopped.time))
        yield stopped


class Memory(canopen.Network):
    """A network on which one server keeps whatever is written to one object."""

    def __init__(self) -> None:
        super().__init__()
        self.value = b""
        self.server = SdoServer(read=self._get, write=self._put, send=self._answer)
        self.client = SdoClient(0x601, 0x581, canopen.ObjectDictionary())
        self.client.network = self
        self.client.RESPONSE_TIMEOUT = 1.0

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """To the server."""
        assert can_id == 0x601
        self.server.receive(bytes(data))

    def _answer(self, data: bytes) -> None:
        self.client.on_response(0x581, bytearray(data), 0.0)

    def _get(self, index: int, subindex: int) -> bytes:
        if index != INDEX:
            raise SdoAbort(NO_OBJECT)
        return self.value

    def _put(self, index: int, subindex: int, data: bytes) -> None:
        self._get(index, subindex)
        self.value = data


@given(value=st.binary(max_size=1000))
def test_sdo_reads_what_was_written(value: bytes) -> None:
    """Any length, expedited or in segments, both ways."""
    memory = Memory()
    memory.client.download(INDEX, 1, value)
    assert memory.value == value
    assert memory.client.upload(INDEX, 1) == value


@given(value=st.binary(min_size=1, max_size=1000))
def test_sdo_block_download_checks_the_crc(value: bytes) -> None:
    """Block download of any length, up to two blocks of 127 segments."""
    memory = Memory()
    with memory.client.open(
        INDEX, 1, "wb", buffering=7, size=len(value), block_transfer=True
    ) as stream:
        stream.write(value)
    assert memory.value == value


def test_sdo_block_download_refuses_a_wrong_crc() -> None:
    """A wrong CRC at its end is an abort, and nothing is written."""
    memory = Memory()
    memory.server.receive(bytes.fromhex("C6 0021 01 07000000"))
    memory.server.receive(bytes.fromhex("81 01020304050607"))
    memory.server.receive(bytes.fromhex("C1 1234 0000000000"))
    answers = [memory.client.responses.get() for _ in range(3)]
    assert [answer[0] for answer in answers] == [0xA4, 0xA2, 0x80]
    assert answers[2][4:] == bytes.fromhex("04000405")
    assert memory.value == b""


def test_sdo_block_download_repeats_a_lost_segment() -> None:
    """The acknowledgement names the last segment that came in order."""
    memory = Memory()
    memory.server.receive(bytes.fromhex("C2 0021 01 15000000"))
    for number in (1, 3):
        memory.server.receive(bytes([number | (0x80 if number == 3 else 0)]) + bytes(7))
    memory.client.responses.get()
    assert memory.client.responses.get()[:2] == bytes([0xA2, 1])
    for number in (1, 2):
        memory.server.receive(bytes([number | (0x80 if number == 2 else 0)]) + bytes(7))
    assert memory.client.responses.get()[:2] == bytes([0xA2, 2])
    memory.server.receive(bytes.fromhex("C1 0000 0000000000"))
    assert memory.value == bytes(21)


@pytest.mark.parametrize(("pause", "answer"), [(0.99, 0xA2), (1.01, 0x80)])
def test_sdo_transfer_times_out(clock: SimpleNamespace, pause: float, answer: int) -> None:
    """A segment after more than a second belongs to no transfer."""
    memory = Memory()
    memory.server.receive(bytes.fromhex("C2 0021 01 07000000"))
    clock.time += pause
    memory.server.receive(bytes.fromhex("81 01020304050607"))
    assert [memory.client.responses.get()[0] for _ in range(2)] == [0xA4, answer]


def test_sdo_aborts_on_missing_objects() -> None:
    """An unknown object, and a length that no amplifier keeps."""
    memory = Memory()
    with pytest.raises(SdoAbortedError) as caught:
        memory.client.upload(0x3000, 0)
    assert caught.value.code == 0x06020000
    with pytest.raises(SdoAbortedError):
        memory.client.download(INDEX, 1, bytes(1025))


@given(frames=st.lists(st.binary(min_size=8, max_size=8), max_size=30))
def test_sdo_sends_at_most_one_reply(frames: list[bytes]) -> None:
    """No request brings more than one answer, none an exception, and the next read works."""
    memory = Memory()
    for frame in frames:
        before = memory.client.responses.qsize()
        memory.server.receive(frame)
        assert memory.client.responses.qsize() <= before + 1
    memory.server.receive(bytes.fromhex("80 0021 01 00000000"))
    memory.value = b"good"
    assert memory.client.upload(INDEX, 1) == b"good"


@pytest.fixture
def device() -> FakeDevice:
    """The amplifier of the far end."""
    return FakeDevice()


@pytest.fixture
def node(device: FakeDevice) -> canopen.RemoteNode:
    """A far end as `canopen` sees it with the data sheet."""

    class Wire(canopen.Network):
        def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
            """To the far end."""
            far.receive(CanFrame(can_id, bytes(data)))

    device.amplifier.attach(ScriptedSensors(SENSORS * 2))  # one for each channel
    device.capabilities = device.amplifier.capabilities
    network = Wire()
    far = CanNode(
        device,  # type: ignore[arg-type]
        5,
        send=lambda frame: network.notify(frame.id, bytearray(frame.data), 0.0),
    )
    remote = canopen.RemoteNode(5, canopen.import_od(str(DOCS / "era-amplifier.eds"), 5))
    network.add_node(remote)
    far.start(Timers().call_later)
    return remote


def test_object_dictionary_matches_the_eds(node: canopen.RemoteNode) -> None:
    """`canopen` reads each by the EDS; the count in subindex 0 and the defaults agree with it."""
    read = 0
    for index, item in node.object_dictionary.items():
        is_single = isinstance(item, ODVariable)
        for variable in [item] if is_single else item.values():
            if not variable.readable:
                continue
            value = node.sdo.upload(index, variable.subindex)
            read += 1
            if not is_single and variable.subindex == 0:
                assert value[0] == max(item.subindices)
            if variable.default is not None:
                assert int.from_bytes(value, "little") == variable.default, variable.name
    assert read > 100


def test_capabilities_read_by_the_eds(node: canopen.RemoteNode) -> None:
    """By name and in their units: what the amplifier says of itself."""
    capabilities = node.sdo["capabilities"]
    assert capabilities["channels"].raw == 4
    assert capabilities["frequency_max"].raw == 65535
    assert capabilities["watchdog_min"].raw == 100
    assert node.sdo["texts"]["vendor"].raw == "era-haptics"
    assert node.sdo["status"]["temperature"].raw == 250
    assert node.sdo[0x1400][1].raw == 0x205
    assert node.sdo[0x1600][1].raw == 0x20200140


def test_node_is_driven_by_a_canopen_master(node: canopen.RemoteNode, device: FakeDevice) -> None:
    """By EDS and page alone: it plays a set, and sends EMCY 8130 without heartbeats."""
    network = node.network
    node.nmt.state = "OPERATIONAL"
    arm = struct.pack("<HHHBB", 100, 0, 600, 4, 1)  # by host 100, for 600 ms
    node.sdo["order"].raw = int.from_bytes(arm, "little")
    assert node.sdo["heartbeat_consumer"][1].raw == 100 << 16 | 600
    for channel, level in ((0, 2500), (3, 5000)):
        command = struct.pack("<HHhBB", 11000, level, 0, channel << 4, 2)
        network.send_message(0x205 + 0x100 * channel, command)
    network.send_message(0x485, struct.pack("<HHHBB", 7, 0, 0, 1 | 2 << 3, 2))
    for _ in range(8):
        device.pass_time(0.5)
        network.send_message(0x700 + 100, b"\x05")
    assert node.sdo["status"]["active_token"].raw == 7
    levels = [node.sdo["channel_levels"][channel].raw for channel in range(1, 5)]
    assert levels == [2500, 0, 0, 5000]
    device.pass_time(0.601)
    assert [(each.code, each.register) for each in node.emcy.log] == [(0x8130, 0x11)]
    assert device.amplifier.fault is Fault.WATCHDOG


def test_eds_of_sixteen_channels(tmp_path: Path) -> None:
    """Its RPDOs of channels 4 and on have the identifiers of the next nodes."""
    path = tmp_path / "sixteen.eds"
    path.write_text(eds_text(16), encoding="utf-8")
    dictionary = canopen.import_od(str(path), 2)
    assert dictionary[0x1404][1].default == 0x203
    assert dictionary[0x140F][1].default == 0x505
    assert dictionary[0x1410][1].default == 0x482
