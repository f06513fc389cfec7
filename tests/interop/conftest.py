"""Our emulated drives, in real time, on a bus of python-can's that others reach."""

import itertools
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import can

from robotctl.hal.clock import MonotonicClock
from robotctl.hal.robot import Robot
from robotctl.sim.motors.bench import Bench
from robotctl.sim.motors.server import BusPort, Pace, Server, serve

_numbers = itertools.count()


@contextmanager
def served(robot: Robot) -> Iterator[tuple[str, Bench]]:
    """Serve a robot's drives, on classic CAN, and return the name of their `virtual` channel."""
    name = f"served{next(_numbers)}"
    clock = MonotonicClock()
    bench = Bench(robot, clock.now_ns(), fd=False)
    bus = can.Bus(interface="virtual", channel=name)
    over = threading.Event()
    pace = Pace(clock, bench.advance, bench.now_ns)
    server = Server(bench, BusPort(name, bus, fd=False), pace)
    thread = threading.Thread(target=serve, args=([server], pace, over.is_set))
    thread.start()
    yield name, bench
    over.set()
    thread.join()
    bus.shutdown()
