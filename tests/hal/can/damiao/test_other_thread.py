"""The same life on a bus that delivers when it likes: drives in another thread behind python-can's virtual bus."""

import threading

import can
import numpy as np
import pytest

from robotctl.hal.can.channel import Channel
from robotctl.hal.can.damiao.arm import DamiaoArm
from robotctl.hal.clock import MonotonicClock
from robotctl.hal.types import Command, CommandMode

pytestmark = pytest.mark.realtime


@pytest.fixture
def served(bench, monkeypatch):
    theirs = can.Bus(interface="virtual", channel="drives")
    stop = threading.Event()

    def serve():
        while not stop.is_set():
            request = theirs.recv(0.02)
            for motor in bench.bus.motors if request else ():
                reply = motor.on_frame(request.arbitration_id, bytes(request.data))
                if reply is not None:
                    theirs.send(can.Message(arbitration_id=motor.reply_id, is_extended_id=False, data=reply))

    def open_virtual(name, robot, clock):
        return Channel(can.Bus(interface="virtual", channel="drives"), fd=True)

    monkeypatch.setattr("robotctl.hal.can.arm.open_channel", open_virtual)
    thread = threading.Thread(target=serve)
    thread.start()
    yield bench
    stop.set()
    thread.join()
    theirs.shutdown()


def test_a_life_in_real_time(served):
    clock = MonotonicClock()
    with DamiaoArm(served.robot, clock, "virtual:drives") as arm:
        arm.verify()
        arm.enable()
        home = arm.read().position
        for tick in range(100):
            arm.write(Command(CommandMode.TRACK, home, np.zeros(7), np.zeros(7)))
            clock.sleep_until(clock.now_ns() + 5_000_000)
            sample = arm.read()
            if tick > 10:
                assert (sample.stamp_ns - sample.joint_stamp_ns).max() < 100_000_000
        assert sample.enabled
        statistics = arm.bus_statistics()
        assert statistics["sent"] > 700
        assert 0.0 < statistics["round_trip_us"]["p50"] < 100_000.0
        arm.disable()
        assert all(motor.status == 0 for motor in served.bus.motors)
