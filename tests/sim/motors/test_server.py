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
from robotctl.hal.clock import Clock, MonotonicClock, VirtualClock
from robotctl.hal.errors import BusError, ConfigError
from robotctl.hal.robot import Robot, load_robot
from robotctl.sim.motors.bench import Bench
from robotctl.sim.motors.orders import give_orders
from robotctl.sim.motors.ports import open_port, open_ports
from robotctl.sim.motors.server import BusPort, Pace, Port, Server, serve
from robotctl.sim.motors.shared_plant import SharedPlant
from robotctl.sim.motors.terminal import SlcanPort
from robotctl.sim.motors.trouble import PowerCut

MS = 1_000_000


@pytest.fixture(scope="module")
def bimanual() -> Robot:
    return load_robot("openarm_bimanual")


def paced(bench: Bench, clock: Clock) -> Pace:
    return Pace(clock, bench.advance, bench.now_ns)


@contextmanager
def serving(robot: Robot, port: Port, fd: bool) -> Iterator[Server]:
    clock = MonotonicClock()
    bench = Bench(robot, clock.now_ns(), fd)
    pace = paced(bench, clock)
    server = Server(bench, port, pace)
    over = threading.Event()
    thread = threading.Thread(target=serve, args=([server], pace, over.is_set))
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
    clock, port, bench = VirtualClock(), Stub(), Bench(panda)
    server = Server(bench, port, paced(bench, clock))
    port.incoming = [frame(1, encode_special(Special.ENABLE))]
    server.step()
    clock.sleep_until(10_000 * MS)
    # The frame that feeds the watchdog has been waiting all the time.
    port.incoming = [frame(1)]
    server.step()
    assert [reply.data[0] >> 4 for reply in port.outgoing] == [Status.ENABLED] * 2


def test_whoever_listens_hears_both_directions_in_the_drives_own_time(panda: Robot) -> None:
    clock, port, bench = VirtualClock(), Stub(), Bench(panda, fd=False)
    server = Server(bench, port, paced(bench, clock))
    heard: list[tuple[float, int]] = []
    server.on_frame = lambda seen: heard.append((seen.timestamp, seen.arbitration_id))
    clock.sleep_until(5 * MS)
    port.incoming = [frame(1)]
    server.step()
    assert heard == [(0.005, 1), (0.005, 0x11)]


def test_fd_replies_are_lost_on_a_classic_port(panda: Robot) -> None:
    port, bench = Stub(fd=False), Bench(panda, fd=True)
    server = Server(bench, port, paced(bench, VirtualClock()))
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
    Server(bench, port, paced(bench, VirtualClock())).step()
    told = [(message.arbitration_id, message.is_error_frame) for message in port.outgoing]
    assert told == ([(UNACKNOWLEDGED.error_class, True)] if carries else [])


def test_drives_hear_the_bit_rate_of_the_host_alone(panda: Robot) -> None:
    port, bench = Stub(), Bench(panda, fd=False)
    server = Server(bench, port, paced(bench, VirtualClock()))
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


def test_time_passes_for_the_drives_of_two_buses_together(bimanual: Robot) -> None:
    clock, ports, plant = VirtualClock(), [Stub(), Stub()], SharedPlant(bimanual, fd=False)
    pace = Pace(clock, plant.advance, 0)
    servers = [Server(bench, port, pace) for bench, port in zip(plant.benches, ports, strict=True)]
    for _ in range(3):
        clock.sleep_until(clock.now_ns() + 5 * MS)
        for server in servers:
            server.step()
    assert [bench.now_ns for bench in plant.benches] == [15 * MS] * 2
    ports[1].incoming = [frame(1)]
    for server in servers:
        server.step()
    assert [[reply.arbitration_id for reply in port.outgoing] for port in ports] == [[], [0x11]]


def test_every_bus_of_a_robot_has_a_port(bimanual: Robot) -> None:
    ports = open_ports("virtual:port-a,virtual:port-b", bimanual)
    assert [port.name for port in ports] == ["virtual:port-a", "virtual:port-b"]
    for port in ports:
        port.close()
    with pytest.raises(ConfigError, match=r"(?s)on 2 buses, and --channel 'virtual:port-a' names 1.*with commas"):
        open_ports("virtual:port-a", bimanual)


def test_orders_go_to_the_buses_that_have_the_motor(bimanual: Robot) -> None:
    plant = SharedPlant(bimanual, fd=False)
    give_orders(plant.benches, ["all:TIMEOUT=200", "openarm_left_joint3:TIMEOUT=300"], ["powercut:gripper"])
    right, left = ([drive.memory[Register.TIMEOUT] for drive in bench.drives] for bench in plant.benches)
    assert (right, left) == ([200] * 8, [200, 200, 300, 200, 200, 200, 200])
    plant.advance(MS)
    assert [drive.name for bench in plant.benches for drive in bench.drives if not drive.powered] == ["gripper"]
    with pytest.raises(ConfigError, match="no motor 'elbow'"):
        give_orders(plant.benches, ["elbow:TIMEOUT=200"], [])
