"""A bus with scripted drives: small enough to break in every way that the driver has to notice."""

from collections import deque

import can
import pytest

from robotctl.hal.can.channel import Channel
from robotctl.hal.can.damiao.codec import (
    Feedback,
    RegisterCommand,
    Special,
    decode_mit,
    decode_pos_force,
    encode_feedback,
    encode_register,
)
from robotctl.hal.can.damiao.motors import MOTORS, Ranges
from robotctl.hal.can.damiao.registers import REGISTERS, Register, decode_value, encode_value
from robotctl.hal.clock import VirtualClock
from robotctl.hal.robot import load_robot

QUIET = {Special.ENABLE, Special.DISABLE, Special.CLEAR_ERROR, Special.SET_ZERO}


class ScriptedMotor:
    """Answers as a drive does; every attribute may be changed by a test."""

    def __init__(self, motor_id: int, reply_id: int, ranges: Ranges, position: float = 0.0) -> None:
        self.id, self.reply_id, self.ranges, self.position = motor_id, reply_id, ranges, position
        self.status = 0
        self.temperature = 28
        self.mute = False
        self.drop_next = 0
        self.copies = 1
        self.stubborn = False
        self.refuses_enable = False
        self.sticky_fault = False
        self.commands = []
        self.written = []
        self.registers = dict.fromkeys(REGISTERS, 0.0) | {
            Register.MST_ID: reply_id,
            Register.ESC_ID: motor_id,
            Register.TIMEOUT: 2000,
            Register.CTRL_MODE: 1,
            Register.SW_VER: 5013,
            Register.SN: 1000 + motor_id,
            Register.PMAX: ranges.pmax,
            Register.VMAX: ranges.vmax,
            Register.TMAX: ranges.tmax,
            Register.CAN_BR: 9,
            Register.UV_VALUE: 15.0,
            Register.VBUS: 24.0,
        }

    def feedback(self) -> bytes:
        return encode_feedback(
            Feedback(self.id, self.status, self.position, 0.0, 0.0, 31, self.temperature), self.ranges
        )

    def on_frame(self, arbitration_id: int, data: bytes) -> bytes | None:
        if self.mute:
            return None
        if arbitration_id == 0x7FF and data[0] | data[1] << 8 == self.id:
            return self._register(data)
        if arbitration_id == self.id and data[:7] == b"\xff" * 7 and data[7] in QUIET:
            self._special(data[7])
            return self.feedback()
        if arbitration_id == self.id:
            self.commands.append(decode_mit(data, self.ranges))
            return self.feedback()
        if arbitration_id == 0x300 + self.id:
            self.commands.append(decode_pos_force(data))
            return self.feedback()
        return None

    def _special(self, command: int) -> None:
        if command == Special.ENABLE and self.status == 0 and not self.refuses_enable:
            self.status = 1
        elif command == Special.DISABLE and self.status == 1 and not self.stubborn:
            self.status = 0
        if command == Special.CLEAR_ERROR and self.status > 1 and not self.sticky_fault:
            self.status = 0

    def _register(self, data: bytes) -> bytes:
        command, register = data[2], data[3]
        if command == RegisterCommand.REFRESH:
            return self.feedback()
        if command == RegisterCommand.WRITE:
            self.written.append((register, decode_value(register, data[4:8])))
            if not (self.stubborn or self.status == 1):
                self.registers[register] = decode_value(register, data[4:8])
        return encode_register(
            self.id, RegisterCommand(command), register, encode_value(register, self.registers[register])
        )


class ScriptedBus(can.BusABC):
    """Delivers in the caller, like the emulated bus. `sent` records every frame that was sent."""

    def __init__(self, motors: list[ScriptedMotor]) -> None:
        self.motors = motors
        self.sent = []
        self.queue = deque()
        self.send_error = None
        self.shutdowns = 0
        self.channel_info = "scripted"
        super().__init__("scripted")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        assert timeout is not None, "an unbounded send"
        if self.send_error is not None:
            raise self.send_error
        self.sent.append(msg)
        for motor in self.motors:
            reply = motor.on_frame(msg.arbitration_id, bytes(msg.data))
            if reply is None:
                continue
            if motor.drop_next:
                motor.drop_next -= 1
                continue
            for _ in range(motor.copies):
                self.inject(motor.reply_id, reply)

    def inject(self, arbitration_id: int, data: bytes, **flags: bool) -> None:
        self.queue.append(can.Message(arbitration_id=arbitration_id, is_extended_id=False, data=data, **flags))

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        return (self.queue.popleft() if self.queue else None), True

    def shutdown(self) -> None:
        self.shutdowns += 1
        super().shutdown()


class Bench:
    """A Panda's drives on a scripted bus, and an arm that opens it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        from robotctl.hal.can.damiao.arm import DamiaoArm

        self.robot = load_robot("panda")
        self.clock = VirtualClock(1_000_000_000)
        profile = self.robot.profile
        self.motors = []
        for joint, q in zip(profile.joints, profile.home, strict=True):
            drive = joint.drive
            angle = drive.sign * drive.gear * (q - drive.offset)
            self.motors.append(ScriptedMotor(drive.id, drive.reply_id, MOTORS[drive.motor], angle))
        grip = profile.gripper.drive
        self.gripper = ScriptedMotor(grip.id, grip.reply_id, MOTORS[grip.motor], 2.0)
        self.gripper.registers[Register.CTRL_MODE] = 4
        self.bus = ScriptedBus([*self.motors, self.gripper])
        self.channel = Channel(self.bus, fd=True, simulated=True)
        monkeypatch.setattr("robotctl.hal.can.arm.open_channel", lambda name, robot, clock: self.channel)
        self.arm = DamiaoArm(self.robot, self.clock, "scripted")

    def ready(self) -> None:
        self.arm.connect()
        self.arm.verify()

    def running(self) -> None:
        self.ready()
        self.arm.enable()

    def ids_sent(self) -> list[int]:
        return [message.arbitration_id for message in self.bus.sent]

    def specials(self) -> list[int]:
        return [m.data[7] for m in self.bus.sent if m.data[:7] == b"\xff" * 7]


@pytest.fixture
def bench(monkeypatch):
    made = Bench(monkeypatch)
    yield made
    made.arm.close()
    made.bus.shutdown()


@pytest.fixture
def scripted_motor():
    return ScriptedMotor


@pytest.fixture
def scripted_bus():
    return ScriptedBus
