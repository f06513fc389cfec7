"""What a kernel shows of a bus in trouble. Frames are kept in its queue by a plug, as on a bus without power."""

import errno
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

from robotctl.hal.can.channel import Channel, open_channel
from robotctl.hal.can.outbox import prove_empty
from robotctl.hal.can.transport import Transport
from robotctl.hal.clock import MonotonicClock
from robotctl.hal.errors import BusError
from robotctl.hal.robot import load_robot

if not Path("/sys/class/net/vcan0").exists():
    pytest.skip("needs a vcan0 interface; tests/interop/test_kernel_can.py boots one", allow_module_level=True)
if Path("/sys/module/vcan/parameters/echo").read_text().strip() != "Y":
    pytest.skip(
        "this kernel's vcan tells what was sent, not what has left: load it with echo=1", allow_module_level=True
    )

ROBOT = load_robot("openarm")
PROBE = (0x7FF, bytes([1, 0, 0xCC, 0, 0, 0, 0, 0]))
COMMANDS = range(1, 9)


def run(command: str) -> None:
    subprocess.run(command.split(), check=True, capture_output=True)


@pytest.fixture
def wire() -> Iterator[str]:
    """An interface of its own, with nobody on it."""
    run("ip link add dev vcan1 type vcan")
    run("ip link set vcan1 mtu 72 up")
    yield "vcan1"
    subprocess.run(["ip", "link", "del", "dev", "vcan1"], check=False, capture_output=True)


@pytest.fixture
def channel(wire: str) -> Iterator[Channel]:
    opened = open_channel(f"socketcan:{wire}", ROBOT, MonotonicClock())
    yield opened
    opened.close()


@pytest.fixture
def transport(channel: Channel) -> Transport:
    return Transport(channel, MonotonicClock())


def plug(wire: str, limit: int = 100_000) -> None:
    """Nothing leaves from now on; `limit` bytes wait."""
    run(f"tc qdisc add dev {wire} root handle 1: plug limit {limit}")


def unplug(wire: str) -> None:
    """What waits leaves, and everything after it."""
    run(f"tc qdisc change dev {wire} root handle 1: plug release_indefinite")


def seen(bus: can.BusABC) -> list[int]:
    frames = iter(lambda: bus.recv(0.05), None)
    return [frame.arbitration_id for frame in frames if not frame.is_error_frame]


def prove(transport: Transport) -> None:
    transport.prove_empty(PROBE, COMMANDS)


def test_frames_that_wait_are_taken_back_and_never_sent(transport: Transport, channel: Channel, wire: str) -> None:
    plug(wire)
    assert transport.send_all([(identifier, bytes(8)) for identifier in COMMANDS]) == 8
    time.sleep(0.01)
    assert transport.send_all([(identifier, bytes(8)) for identifier in COMMANDS]) == 0  # none joins them
    transport.purge()
    assert not transport.waiting
    listener = channel.outbox.witness()
    unplug(wire)
    assert seen(listener) == []
    listener.shutdown()
    transport.drain()  # that the interface was down is no news
    prove(transport)


def test_without_the_purge_they_are_sent_and_noticed(transport: Transport, channel: Channel, wire: str) -> None:
    plug(wire)
    with can.Bus(wire, interface="socketcan") as another:
        for identifier in (1, 2):
            another.send(can.Message(arbitration_id=identifier, is_extended_id=False, data=bytes(8)))

        def request(arbitration_id: int, data: bytes) -> bool:
            taken = transport.send(arbitration_id, data)
            unplug(wire)  # the power comes back
            return taken

        with pytest.raises(BusError, match=r"2 frames that were not sent now .* 0x001, 0x002"):
            prove_empty(channel.outbox, request, PROBE, COMMANDS, MonotonicClock())


def test_frames_that_a_closed_socket_left_behind_are_taken_back(
    transport: Transport, channel: Channel, wire: str
) -> None:
    plug(wire)
    with can.Bus(wire, interface="socketcan") as gone:
        for _ in range(5):
            gone.send(can.Message(arbitration_id=1, is_extended_id=False, data=bytes(8)))
    with pytest.raises(BusError, match="nobody acknowledges"):
        prove(transport)
    assert not transport.waiting  # the probe was taken back, too
    listener = channel.outbox.witness()
    unplug(wire)
    assert seen(listener) == []
    listener.shutdown()


def test_a_purge_that_fails_says_what_a_person_has_to_do(transport: Transport, wire: str, monkeypatch) -> None:
    plug(wire)
    transport.send(1, bytes(8))
    monkeypatch.setattr("robotctl.hal.can.kernel_queue.shutil.which", lambda *_, **__: "/bin/false")
    with pytest.raises(BusError, match="ip link set vcan1 down; ip link set vcan1 up"):
        transport.purge()
    assert transport.waiting


@pytest.mark.parametrize(("limit", "number"), [(10_000_000, None), (160, errno.ENOBUFS)])
def test_a_full_queue_has_two_faces(transport: Transport, channel: Channel, wire: str, limit: int, number) -> None:
    plug(wire, limit)
    message = can.Message(arbitration_id=1, is_extended_id=False, data=bytes(8))
    with pytest.raises(can.CanOperationError) as caught:  # noqa: PT012 - which of them fails is the kernel's affair
        for _ in range(1000):
            channel.bus.send(message, 0.001)
    assert caught.value.error_code == number
    assert not transport.send(*PROBE)  # counted, not fatal
    transport.purge()
    unplug(wire)
    assert transport.send(*PROBE)


def test_bus_off_and_restart_as_another_node_reports_them(transport: Transport, wire: str) -> None:
    with can.Bus(wire, interface="socketcan") as other:
        for error, leaves in ((0x40, False), (0x100, True)):
            other.send(can.Message(arbitration_id=error, is_error_frame=True, data=bytes(8)))
            transport.drain()
            assert transport.send(*PROBE) is leaves


def test_an_adapter_that_is_unplugged_is_told_at_once_and_for_good(transport: Transport, wire: str) -> None:
    run(f"ip link del dev {wire}")
    for _ in range(2):
        with pytest.raises(BusError, match="check the adapter"):
            transport.send(*PROBE)
    transport.close()


def test_an_interface_that_goes_down_and_up_has_to_be_opened_again(transport: Transport, wire: str) -> None:
    run(f"ip link set {wire} down")
    with pytest.raises(BusError, match="check the adapter and that the interface is up"):
        transport.send(*PROBE)
    run(f"ip link set {wire} up")
    for call in (lambda: transport.send(*PROBE), transport.drain):
        with pytest.raises(BusError):
            call()
    again = open_channel(f"socketcan:{wire}", ROBOT, MonotonicClock())
    prove(Transport(again, MonotonicClock()))
    again.close()
