"""Sends are bounded, nothing that arrives is fatal, and a lost interface is told at once."""

import errno
import itertools
import threading
import time
from collections import deque

import can
import pytest

from robotctl.hal.can.channel import Channel
from robotctl.hal.can.transport import DRAIN_LIMIT, FAILING_LIMIT_NS, Transport, route_key
from robotctl.hal.clock import MonotonicClock, VirtualClock
from robotctl.hal.errors import BusError


class LooseBus(can.BusABC):
    """What comes is what a test put into `queue`: messages, None, or exceptions to raise."""

    def __init__(self):
        self.queue = deque()
        self.sent = []
        self.error = None
        self.broken_shutdown = False
        super().__init__("loose")

    def send(self, msg, timeout=None):
        assert timeout is not None
        assert timeout <= 0.001
        if self.error is not None:
            raise self.error
        self.sent.append(msg)

    def _recv_internal(self, timeout):
        assert timeout == 0.0
        item = self.queue.popleft() if self.queue else None
        if isinstance(item, Exception):
            raise item
        return item, True

    def shutdown(self):
        super().shutdown()
        if self.broken_shutdown:
            raise OSError(errno.EBADF, "gone")


@pytest.fixture
def bus():
    made = LooseBus()
    yield made
    made.broken_shutdown = False
    made.shutdown()


@pytest.fixture
def clock():
    return VirtualClock(1_000_000)


@pytest.fixture
def transport(bus, clock):
    return Transport(Channel(bus, fd=True, simulated=True), clock)


def message(arbitration_id, data=bytes(8), **flags):
    return can.Message(arbitration_id=arbitration_id, is_extended_id=False, data=data, **flags)


def failing(cause):
    """An exception as pyserial and python-can chain them: the errno is one level down."""
    error = can.CanOperationError("Could not write to serial device")
    error.__cause__ = cause
    return error


LOST = [errno.ENODEV, errno.ENXIO, errno.ENETDOWN, errno.ENETUNREACH, errno.EBADF]


def test_frames_are_fd_only_when_asked(transport, bus):
    transport.send(1, bytes(8))
    transport.send(1, bytes(8), fd=True)
    transport.send_all([(1, bytes(8))])
    assert [(m.is_fd, m.bitrate_switch, m.is_extended_id, m.dlc) for m in bus.sent] == [
        (False, False, False, 8),
        (True, True, False, 8),
        (True, True, False, 8),
    ]
    assert transport.sent == 3


@pytest.mark.parametrize(
    "error", [can.CanOperationError("Transmit buffer full"), can.CanOperationError("No buffer space", errno.ENOBUFS)]
)
def test_a_full_queue_is_counted_in_both_its_faces(transport, bus, clock, error):
    bus.error = error
    assert not transport.send(1, bytes(8))
    assert transport.send_all([(1, bytes(8))] * 8) == 0
    assert transport.send_failures == 2
    bus.error = None
    assert transport.send_all([(1, bytes(8))] * 8) == 8


@pytest.mark.parametrize(
    "error", [can.CanOperationError("Transmit buffer full"), can.CanOperationError("No buffer space", errno.ENOBUFS)]
)
def test_a_queue_that_stays_full_ends_in_a_bus_error(transport, bus, clock, error):
    bus.error = error
    transport.send(1, bytes(8))
    clock.sleep_until(clock.now_ns() + FAILING_LIMIT_NS + 1)
    with pytest.raises(BusError, match="transmit queue stays full") as caught:
        transport.send(1, bytes(8))
    assert "down and up" in str(caught.value)


def test_a_short_stall_does_not_add_up(transport, bus, clock):
    for _ in range(10):
        bus.error = can.CanOperationError("Transmit buffer full")
        transport.send(1, bytes(8))
        clock.sleep_until(clock.now_ns() + FAILING_LIMIT_NS // 2)
        bus.error = None
        assert transport.send(1, bytes(8))


@pytest.mark.parametrize("code", LOST)
@pytest.mark.parametrize(
    "wrap",
    [
        lambda code: can.CanOperationError("x", code),
        lambda code: OSError(code, "x"),
        lambda code: failing(OSError(code, "x")),
    ],
)
def test_a_lost_interface_is_told_at_once_and_stays_lost(transport, bus, code, wrap):
    bus.error = wrap(code)
    with pytest.raises(BusError, match="interface is gone"):
        transport.send(1, bytes(8))
    bus.error = None
    for call in (lambda: transport.send(1, bytes(8)), lambda: transport.send_all([]), transport.drain):
        with pytest.raises(BusError):
            call()


@pytest.mark.parametrize("code", LOST)
def test_a_lost_interface_shows_when_receiving(transport, bus, code):
    bus.queue.append(can.CanOperationError("Error receiving", code))
    with pytest.raises(BusError):
        transport.drain()


@pytest.mark.parametrize("error", [ValueError("invalid literal for int()"), IndexError(), can.CanOperationError("odd")])
def test_a_reader_that_stumbles_goes_on(transport, bus, error):
    seen = []
    transport.routes[route_key(0x11, 1)] = lambda data, stamp: bool(seen.append(stamp)) or True
    bus.queue.extend([error, message(0x11, b"\x11" + bytes(7))])
    transport.drain()
    assert seen == [1_000_000]
    assert transport.unexpected == 1


def test_a_reader_that_always_fails_does_not_hold_the_loop(transport, bus):
    bus.queue.extend(ValueError() for _ in range(1000))
    transport.drain()
    assert len(bus.queue) > 900


def test_a_babbling_node_does_not_hold_the_loop(transport, bus):
    bus.queue.extend(message(0x55) for _ in range(DRAIN_LIMIT + 5))
    transport.drain()
    assert len(bus.queue) == 5
    assert transport.unexpected == DRAIN_LIMIT


def test_error_frames_are_counted_and_never_decoded(transport, bus):
    transport.routes[route_key(0x04, 0)] = lambda data, stamp: pytest.fail("decoded")
    bus.queue.append(message(0x004, bytes([0, 0x20, 0, 0, 0, 0, 0, 0]), is_error_frame=True))
    transport.drain()
    assert (transport.error_frames, transport.received, transport.state) == (1, 0, "passive")
    bus.queue.append(message(0x004, b"", is_error_frame=True))
    bus.queue.append(message(0x004, bytes([0, 0x40, 0, 0, 0, 0, 0, 0]), is_error_frame=True))
    transport.drain()
    assert transport.state == "active"


def test_bus_off_holds_the_frames_back_until_the_restart(transport, bus):
    bus.queue.append(message(0x040, is_error_frame=True))
    transport.drain()
    assert not transport.send(1, bytes(8))
    assert transport.send_all([(1, bytes(8))]) == 0
    assert transport.send(1, bytes(8), force=True)
    assert len(bus.sent) == 1
    bus.queue.append(message(0x100, is_error_frame=True))
    transport.drain()
    assert transport.send(1, bytes(8))


def test_the_listener_gets_what_no_route_takes(transport, bus):
    heard = []
    transport.listener = lambda arbitration_id, data: heard.append((arbitration_id, data))
    transport.routes[route_key(0x11, 1)] = lambda data, stamp: data[0] >> 4 == 1
    bus.queue.extend([message(0x11, b"\x11" + bytes(7)), message(0x11, b"\x21" + bytes(7)), message(0x12)])
    transport.drain()
    assert heard == [(0x11, b"\x21" + bytes(7)), (0x12, bytes(8))]


def test_kernel_stamps_date_a_frame_back_on_our_clock(bus):
    clock = VirtualClock(10_000_000_000)
    transport = Transport(Channel(bus, fd=True), clock)
    stamps = []
    transport.routes[route_key(0x11, 0)] = lambda data, stamp: bool(stamps.append(stamp)) or True
    now = time.time()
    for timestamp in (now - 0.005, 0.0, now + 100.0, now - 100.0):
        bus.queue.append(can.Message(timestamp, 0x11, False, data=bytes(8)))
    transport.drain()
    assert clock.now_ns() - stamps[0] == pytest.approx(5e6, abs=3e6)
    assert stamps[1:] == [clock.now_ns()] * 3


def test_wait_ends_with_the_time(transport, clock):
    assert not transport.wait(lambda: False, 0.01)
    assert clock.now_ns() == 1_000_000 + 10_000_000
    assert transport.wait(lambda: True, 0.01)


def test_load_is_measured(transport, bus, clock):
    for _ in range(600):
        transport.send_all([(1, bytes(8))] * 8)
        bus.queue.extend(message(0x11) for _ in range(8))
        clock.sleep_until(clock.now_ns() + 2_000_000)
        transport.drain()
    assert transport.statistics()["load"] == pytest.approx(0.52, abs=0.01)


def test_round_trip_percentiles(transport):
    assert transport.round_trip().max == 0.0
    transport.trips.extend(range(0, 101_000, 1000))
    assert transport.round_trip() == (50.0, 99.0, 100.0)


def test_close_is_idempotent_even_when_the_interface_is_gone(transport, bus):
    bus.broken_shutdown = True
    transport.close()
    transport.close()
    with pytest.raises(BusError, match="closed"):
        transport.drain()
    assert transport.statistics()["sent"] == 0


@pytest.mark.realtime
def test_a_virtual_bus_with_a_peer_in_a_thread():
    ours = can.Bus(interface="virtual", channel="transport-test")
    theirs = can.Bus(interface="virtual", channel="transport-test")
    transport = Transport(Channel(ours, fd=True), MonotonicClock())
    seen = itertools.count()
    count = [0]
    transport.routes[route_key(0x11, 0)] = lambda data, stamp: bool(count.append(next(seen))) or True

    def echo():
        for _ in range(50):
            if theirs.recv(1.0) is not None:
                theirs.send(can.Message(arbitration_id=0x11, is_extended_id=False, data=bytes(8)))

    peer = threading.Thread(target=echo)
    peer.start()
    for n in range(50):
        transport.send(1, bytes(8))
        assert transport.wait(lambda n=n: len(count) > n + 1, 1.0)
    peer.join()
    transport.close()
    theirs.shutdown()
    assert transport.received == 50
