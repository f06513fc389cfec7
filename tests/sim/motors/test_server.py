"""Drives served to others in real time, on python-can's virtual bus and on pseudo-terminals."""

import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import can
import pytest

from robotctl.hal.can.damiao.codec import (
    BROADCAST_ID,
    RegisterCommand,
    Special,
    Status,
    encode_register,
    encode_special,
)
from robotctl.hal.can.damiao.registers import Register
from robotctl.hal.can.error_frames import UNACKNOWLEDGED
from robotctl.hal.clock import MonotonicClock, VirtualClock
from robotctl.hal.errors import BusError, ConfigError
from robotctl.hal.robot import Robot
from robotctl.sim.motors.bench import Bench
from robotctl.sim.motors.ports import open_port
from robotctl.sim.motors.server import BusPort, Port, Server
from robotctl.sim.motors.terminal import SlcanPort
from robotctl.sim.motors.trouble import PowerCut

MS = 1_000_000


@contextmanager
def serving(robot: Robot, port: Port, fd: bool) -> Iterator[Server]:
    clock = MonotonicClock()
    server = Server(Bench(robot, clock.now_ns(), fd), port, clock)
    over = threading.Event()
    thread = threading.Thread(target=server.serve, args=(over.is_set,))
    thread.start()
    try:
        yield server
    finally:
        over.set()
        thread.join()
        port.close()


def frame(identifier: int, data: bytes = bytes(8), **options) -> can.Message:
    return can.Message(arbitration_id=identifier, data=data, is_extended_id=False, **options)


def virtual(name: str, protocol=can.CanProtocol.CAN_FD) -> can.BusABC:
    return can.Bus(interface="virtual", channel=name, protocol=protocol)


@pytest.mark.realtime
def test_several_clients_of_a_virtual_bus(panda: Robot) -> None:
    with (
        serving(panda, open_port("virtual:server-a", panda), fd=True),
        virtual("server-a") as one,
        virtual("server-a") as two,
    ):
        one.send(frame(1))
        assert one.recv(1.0).arbitration_id == 0x11
        assert [two.recv(1.0).arbitration_id for _ in range(2)] == [1, 0x11]
        two.send(frame(2))
        assert two.recv(1.0).is_fd


@pytest.mark.realtime
def test_watchdog_in_real_time(panda: Robot) -> None:
    with serving(panda, open_port("virtual:server-b", panda), fd=True), virtual("server-b") as bus:
        bus.send(frame(1, encode_special(Special.ENABLE)))
        assert bus.recv(1.0).data[0] >> 4 == Status.ENABLED
        time.sleep(0.2)
        bus.send(frame(BROADCAST_ID, encode_register(1, RegisterCommand.REFRESH)))
        assert bus.recv(1.0).data[0] >> 4 == Status.COMMUNICATION_LOST


@pytest.mark.realtime
def test_garbage_changes_nothing(panda: Robot) -> None:
    with serving(panda, open_port("virtual:server-c", panda), fd=True), virtual("server-c") as bus:
        for identifier in (0, 1, 0x101, 0x7FE, BROADCAST_ID):
            for length in (0, 1, 7, 12, 64):
                bus.send(frame(identifier, os.urandom(length), is_fd=length > 8))
        bus.send(frame(1, is_error_frame=True))
        bus.send(frame(1, is_remote_frame=True, dlc=8))
        bus.send(can.Message(arbitration_id=0x1FFFFFFF, data=bytes(8), is_extended_id=True))
        while bus.recv(0.1) is not None:
            pass
        bus.send(frame(3))
        assert bus.recv(1.0).arbitration_id == 0x13


class Stub:
    """A port that hands out what a test puts in."""

    name = "stub"
    garbage = 0
    bitrate = None
    carries_errors = False

    def __init__(self, fd: bool = True) -> None:
        self.fd = fd
        self.incoming: list[can.Message] = []
        self.outgoing: list[can.Message] = []

    def receive(self, timeout_s: float) -> list[can.Message]:
        frames, self.incoming = self.incoming, []
        return frames

    def send(self, reply: can.Message) -> bool:
        self.outgoing.append(reply)
        return True

    def close(self) -> None:
        pass


def test_drives_stand_still_while_the_server_does_not_run(panda: Robot) -> None:
    clock, port = VirtualClock(), Stub()
    server = Server(Bench(panda), port, clock)
    port.incoming = [frame(1, encode_special(Special.ENABLE))]
    server.step()
    clock.sleep_until(10_000 * MS)
    # The frame that feeds the watchdog has been waiting all the time.
    port.incoming = [frame(1)]
    server.step()
    assert [reply.data[0] >> 4 for reply in port.outgoing] == [Status.ENABLED] * 2


def test_whoever_listens_hears_both_directions_in_the_drives_own_time(panda: Robot) -> None:
    clock, port = VirtualClock(), Stub()
    server = Server(Bench(panda, fd=False), port, clock)
    heard: list[tuple[float, int]] = []
    server.on_frame = lambda seen: heard.append((seen.timestamp, seen.arbitration_id))
    clock.sleep_until(5 * MS)
    port.incoming = [frame(1)]
    server.step()
    assert heard == [(0.005, 1), (0.005, 0x11)]


def test_fd_replies_are_lost_on_a_classic_port(panda: Robot) -> None:
    port = Stub(fd=False)
    server = Server(Bench(panda, fd=True), port, VirtualClock())
    port.incoming = [frame(1)]
    server.step()
    assert port.outgoing == []
    assert (server.received, server.answered, server.lost) == (1, 0, 1)


@pytest.mark.parametrize("carries", [True, False])
def test_hosts_are_told_what_their_controller_would_have_seen_where_that_can_be(panda: Robot, carries: bool) -> None:
    port, bench = Stub(), Bench(panda, fd=True)
    port.carries_errors = carries
    bench.trouble.add(PowerCut())
    port.incoming = [frame(1)]
    Server(bench, port, VirtualClock()).step()
    told = [(message.arbitration_id, message.is_error_frame) for message in port.outgoing]
    assert told == ([(UNACKNOWLEDGED.error_class, True)] if carries else [])


def test_drives_hear_the_bit_rate_of_the_host_alone(panda: Robot) -> None:
    port, bench = Stub(), Bench(panda, fd=False)
    server = Server(bench, port, VirtualClock())
    bench.drive(1).preset(Register.CAN_BR, 3)
    for bitrate, answers in ((500_000, [0x11]), (1_000_000, []), (250_000, [])):
        port.bitrate, port.incoming, port.outgoing = bitrate, [frame(1)], []
        server.step()
        assert [message.arbitration_id for message in port.outgoing] == answers


def test_a_port_survives_trouble_and_gives_up_on_a_broken_bus() -> None:
    class Broken:
        broken = 1

        def recv(self, timeout):
            if self.broken:
                self.broken -= 1
                raise ValueError("not a frame")

        def send(self, message, timeout):
            raise can.CanOperationError("full")

    bus = Broken()
    port = BusPort("x:y", bus, fd=True)
    assert port.receive(0.0) == []
    assert port.garbage == 1
    assert not port.send(frame(1))
    bus.broken = 10**6
    received = (port.receive(0.0) for _ in range(1000))
    with pytest.raises(BusError, match="lost x:y"):
        list(received)


def test_ports_that_do_not_exist(panda: Robot) -> None:
    for name in ("", "nonsense", "slcan:", "nonsense:1"):
        with pytest.raises(ConfigError):
            open_port(name, panda)
    with pytest.raises(BusError):
        open_port("socketcan:robotctl9", panda)


@pytest.mark.realtime
def test_a_host_that_does_not_read_loses_frames_and_nothing_else() -> None:
    port = SlcanPort()
    try:
        descriptor = os.open(port.paths[0], os.O_RDWR | os.O_NOCTTY)
        os.write(descriptor, b"O\r")
        port.receive(0.1)
        taken = [port.send(frame(0x11)) for _ in range(20_000)]
        assert taken[0]
        assert not taken[-1]
        os.close(descriptor)
        port.receive(0.001)
        assert port.send(frame(0x11))
    finally:
        port.close()
