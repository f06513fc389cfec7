"""python-can's own slcan client, and plain pyserial, on the emulator's pseudo-terminal, in a process of its own."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import can
import pytest
import serial

from robotctl.hal.can.damiao.codec import (
    BROADCAST_ID,
    MitCommand,
    RegisterCommand,
    Special,
    Status,
    decode_feedback,
    decode_register,
    encode_mit,
    encode_register,
    encode_special,
)
from robotctl.hal.can.damiao.motors import MOTORS
from robotctl.hal.can.damiao.registers import Register, decode_value

pytestmark = pytest.mark.realtime

EMULATE = """
import sys, typer
from robotctl.cli.emulate import emulate
app = typer.Typer()
app.command()(emulate)
app()
"""
START_S = 60.0
TIMEOUT_S = 2.0


class Emulator:
    def __init__(self, folder: Path, *options: str) -> None:
        self.report = folder / "emulate.json"
        self.process = subprocess.Popen(
            [sys.executable, "-c", EMULATE, "--json", str(self.report), *options], stdout=subprocess.PIPE, text=True
        )
        deadline = time.monotonic() + START_S
        while not self.report.exists():
            assert self.process.poll() is None, "the emulator ended before it served"
            assert time.monotonic() < deadline
            time.sleep(0.05)
        self.devices = [part.removeprefix("slcan:") for part in self.read()["channel"].split(", ")]

    def read(self) -> dict:
        return json.loads(self.report.read_text())

    def open(self, index: int = 0, bitrate: int = 1_000_000) -> can.BusABC:
        return can.Bus(interface="slcan", channel=self.devices[index], bitrate=bitrate, sleep_after_open=0.05)

    def interrupt(self) -> int:
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(20)


@pytest.fixture(scope="module")
def emulator(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Emulator]:
    emulator = Emulator(tmp_path_factory.mktemp("emulate"), "--adapters", "2", "--register", "5:TIMEOUT=0")
    yield emulator
    emulator.process.kill()
    emulator.process.wait()


def ask(bus: can.BusABC, identifier: int, data: bytes) -> can.Message:
    bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
    reply = bus.recv(TIMEOUT_S)
    assert reply is not None
    return reply


def test_registers_and_feedback(emulator: Emulator) -> None:
    with emulator.open() as bus:
        for motor, model in enumerate(
            ("DM8009", "DM8009", "DM4340", "DM4340", "DM4310", "DM4310", "DM4310", "DM4310"), 1
        ):
            for register, value in zip((Register.PMAX, Register.VMAX, Register.TMAX), MOTORS[model], strict=True):
                reply = ask(bus, BROADCAST_ID, encode_register(motor, RegisterCommand.READ, register))
                assert reply.arbitration_id == 0x10 + motor
                assert not reply.is_fd
                assert decode_value(register, decode_register(bytes(reply.data), motor).raw) == pytest.approx(value)
            reply = ask(bus, BROADCAST_ID, encode_register(motor, RegisterCommand.REFRESH))
            assert decode_feedback(reply.data, MOTORS[model]).status == Status.DISABLED


def test_moving_a_joint(emulator: Emulator) -> None:
    ranges = MOTORS["DM4310"]
    with emulator.open() as bus:
        feedback = decode_feedback(ask(bus, 5, encode_special(Special.ENABLE)).data, ranges)
        assert feedback.status == Status.ENABLED
        goal = feedback.position + 0.3
        deadline = time.monotonic() + 10.0
        while abs(feedback.position - goal) > 0.05:
            assert time.monotonic() < deadline
            feedback = decode_feedback(ask(bus, 5, encode_mit(MitCommand(goal, 0, 30, 1, 0), ranges)).data, ranges)
        assert decode_feedback(ask(bus, 5, encode_special(Special.DISABLE)).data, ranges).status == Status.DISABLED


def test_two_hosts_hear_each_other(emulator: Emulator) -> None:
    with emulator.open(0) as one, emulator.open(1) as two:
        # The second adapter's channel must be open before the first one sends.
        ask(two, 1, bytes(8))
        while one.recv(0.1) is not None:
            pass
        ask(one, 2, bytes(8))
        assert [two.recv(TIMEOUT_S).arbitration_id for _ in range(2)] == [2, 0x12]


def test_the_wrong_bit_rate_is_silence(emulator: Emulator) -> None:
    with emulator.open(bitrate=500_000) as bus:
        bus.send(can.Message(arbitration_id=1, data=bytes(8), is_extended_id=False))
        assert bus.recv(0.3) is None
    with emulator.open() as bus:
        ask(bus, 1, bytes(8))


def test_adapter_identifies_itself(emulator: Emulator) -> None:
    with emulator.open() as bus:
        assert bus.get_version(TIMEOUT_S) == (10, 13)
        assert bus.get_serial_number(TIMEOUT_S) == "ROBO"


def test_plain_serial_and_garbage(emulator: Emulator) -> None:
    with serial.Serial(emulator.devices[0], timeout=TIMEOUT_S) as port:
        port.write(b"\r\xff\x00garbage\rt12")
        time.sleep(0.05)
        port.write(b"\r\rC\r")
        time.sleep(0.1)
        port.reset_input_buffer()
        port.write(b"S8\r")
        assert port.read_until(b"\r") == b"\r"
        port.write(b"O\r")
        assert port.read_until(b"\r") == b"\r"
        port.write(b"t7FF80300330900000000\r")
        assert port.read_until(b"\r") == b"z\r"
        assert port.read_until(b"\r") == b"t01380300330940060000\r"


def test_a_host_that_vanished_leaves_a_usable_adapter(emulator: Emulator) -> None:
    with serial.Serial(emulator.devices[0], timeout=TIMEOUT_S) as port:
        port.write(b"S8\rO\rt0018")
        port.flush()
    time.sleep(0.2)
    with emulator.open() as bus:
        ask(bus, 1, bytes(8))


def test_fd_with_an_adapter_that_can(emulator: Emulator) -> None:
    timing = can.BitTimingFd.from_sample_point(80_000_000, 1_000_000, 75.0, 5_000_000, 75.0)
    with can.Bus(interface="slcan", channel=emulator.devices[0], timing=timing, sleep_after_open=0.05) as bus:
        request = encode_register(6, RegisterCommand.WRITE, Register.CAN_BR, (9).to_bytes(4, "little"))
        assert not ask(bus, BROADCAST_ID, request).is_fd
        assert ask(bus, 6, bytes(8)).is_fd
        request = encode_register(6, RegisterCommand.WRITE, Register.CAN_BR, (4).to_bytes(4, "little"))
        assert ask(bus, BROADCAST_ID, request).is_fd
        assert not ask(bus, 6, bytes(8)).is_fd


def test_trouble_and_exit_statuses(tmp_path: Path) -> None:
    emulator = Emulator(tmp_path, "--robot", "panda", "--trouble", "mute:3", "--trouble", "fault:4:0xC")
    try:
        with emulator.open() as bus:
            bus.send(can.Message(arbitration_id=3, data=bytes(8), is_extended_id=False))
            assert bus.recv(0.3) is None
            assert ask(bus, 4, bytes(8)).data[0] == 0xC4
    finally:
        assert emulator.interrupt() == 130
    report = emulator.read()
    assert report["motors"][3]["status"] == 0xC
    assert report["received"] == 2
    assert report["answered"] == 1
    assert emulator.devices[0] in emulator.process.stdout.read()
