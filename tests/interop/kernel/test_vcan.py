"""Our driver and our emulated drives over the kernel's own SocketCAN. Good for behaviour, not for timing."""

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import can
import numpy as np
import pytest

from robotctl.control.kinematics import Kinematics
from robotctl.hal.backend import open_backend
from robotctl.hal.can.channel import open_channel
from robotctl.hal.clock import MonotonicClock
from robotctl.hal.errors import BusError
from robotctl.hal.robot import load_robot
from robotctl.hal.types import Command, CommandMode

if not Path("/sys/class/net/vcan0").exists():
    pytest.skip("needs a vcan0 interface; tests/interop/test_kernel_can.py boots one", allow_module_level=True)

CHANNEL = "socketcan:vcan0"
ROBOTCTL = [sys.executable, "-m", "robotctl.cli.main"]
SLOW = ["servo_hz=50"]


@pytest.fixture
def emulator(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[subprocess.Popen[bytes]]:
    announcement = tmp_path / "emulate.json"
    options = getattr(request, "param", [])
    process = subprocess.Popen([*ROBOTCTL, "emulate", "--channel", CHANNEL, "--json", str(announcement), *options])
    deadline = time.monotonic() + 60
    while not announcement.exists():
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.1)
    yield process
    process.kill()
    process.wait()


def test_frames_of_both_kinds_cross_the_kernel() -> None:
    robot, clock = load_robot("openarm"), MonotonicClock()
    first, second = open_channel(CHANNEL, robot, clock), open_channel(CHANNEL, robot, clock)
    try:
        for fd in (False, True):
            first.bus.send(
                can.Message(arbitration_id=0x123, data=b"12345678", is_extended_id=False, is_fd=fd, bitrate_switch=fd)
            )
            received = second.bus.recv(2.0)
            assert received is not None
            assert (received.arbitration_id, bytes(received.data), received.is_fd) == (0x123, b"12345678", fd)
    finally:
        first.bus.shutdown()
        second.bus.shutdown()


def test_an_interface_that_does_not_exist_is_named() -> None:
    with pytest.raises(BusError, match="can9"):
        open_channel("socketcan:can9", load_robot("openarm"), MonotonicClock())


def test_a_silent_bus_names_every_joint_and_what_to_check() -> None:
    rig = open_backend("can", load_robot("openarm"), MonotonicClock(), CHANNEL)
    with rig.arm, pytest.raises(Exception, match="openarm_right_joint1") as caught:
        rig.arm.verify()
    text = str(caught.value)
    assert "0x07" in text
    assert "power" in text


def test_scan_finds_every_motor(emulator: subprocess.Popen[bytes], tmp_path: Path) -> None:
    report = tmp_path / "scan.json"
    command = [*ROBOTCTL, "scan", "--channel", CHANNEL, "--robot", "openarm", "--json", str(report)]
    subprocess.run(command, check=True, timeout=100)
    motors = json.loads(report.read_text())["motors"]
    assert [motor["id"] for motor in motors] == list(range(1, 9))


@pytest.mark.parametrize("emulator", [["--register", "all:TIMEOUT=10000"]], ids=["half a second"], indirect=True)
def test_the_arm_comes_up_follows_and_is_let_go_by_its_own_watchdog(emulator: subprocess.Popen[bytes]) -> None:
    """A guest of one core stands still for longer than the usual 80 ms now and then."""
    robot, clock = load_robot("openarm", [*SLOW, "safety.drive_timeout_s=0.5"]), MonotonicClock()
    rig = open_backend("can", robot, clock, CHANNEL)
    with rig.arm as arm:
        arm.verify()
        assert not arm.read().enabled
        arm.enable()
        for _ in range(25):
            arm.hold()
            clock.sleep_until(clock.now_ns() + 20_000_000)
            sample = arm.read()
        assert sample.enabled
        assert not sample.faults
        time.sleep(1.0)  # nobody speaks to the drives: each one's own watchdog has to act
        arm.hold()
        time.sleep(0.1)
        lost = arm.read()
        assert not lost.enabled
        assert {fault.name for fault in lost.faults} == {"COMMUNICATION_LOST"}
        arm.disable()


@pytest.mark.parametrize("emulator", [["--register", "all:TIMEOUT=40000"]], ids=["patient"], indirect=True)
def test_drives_that_another_enabled_are_taken_over_through_a_second_socket(emulator: subprocess.Popen[bytes]) -> None:
    robot, clock = load_robot("openarm", [*SLOW, "safety.drive_timeout_s=2"]), MonotonicClock()
    with open_backend("can", robot, clock, CHANNEL).arm as first:
        first.verify()
        first.enable()
        first.hold()
        pose = first.read().position
        second = open_backend("can", robot, clock, CHANNEL).arm
        damping = Command(CommandMode.DAMP, pose, np.zeros(7), Kinematics(robot).gravity(pose))
        second.take_over(damping)
        for _ in range(25):
            second.write(damping)
            clock.sleep_until(clock.now_ns() + 20_000_000)
        sample = second.read()
        assert sample.enabled
        assert sample.position == pytest.approx(pose, abs=0.1)
        second.disable()
        assert not second.read().enabled
        second.close()
