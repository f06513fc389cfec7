"""DAMIAO frames in words, for a person who listens to a bus."""

from typing import NamedTuple

from robotctl.hal.can.damiao.codec import (
    BROADCAST_ID,
    Offset,
    RegisterCommand,
    RegisterFrame,
    Special,
    decode_feedback,
    decode_mit,
    decode_pos_force,
    decode_pos_vel,
    decode_register,
    decode_vel,
    encode_special,
    is_feedback,
)
from robotctl.hal.can.damiao.faults import status_name
from robotctl.hal.can.damiao.motors import MOTORS, Ranges
from robotctl.hal.can.damiao.registers import REGISTERS, decode_value
from robotctl.hal.can.diagnosis import drives_of
from robotctl.hal.robot import Robot

_SPECIALS = {encode_special(special): special.name.replace("_", " ") for special in Special}


class _Known(NamedTuple):
    name: str
    id: int
    ranges: Ranges


class DamiaoWords:
    """Decodes with the ids and motors of a robot's profile. What it does not know it says so of."""

    def __init__(self, robot: Robot) -> None:
        known = [
            (drive, _Known(name, drive.id, MOTORS[drive.motor]))
            for name, drive, _ in drives_of(robot)
            if drive.motor in MOTORS
        ]
        self._names = {drive.id: motor.name for drive, motor in known}
        self._commands = {drive.id + offset: (offset, motor) for drive, motor in known for offset in Offset}
        self._replies = {(drive.reply_id, drive.id & 0xF): motor for drive, motor in known}

    def __call__(self, arbitration_id: int, data: bytes) -> str:
        """Return what a frame says."""
        if arbitration_id == BROADCAST_ID and len(data) >= 4:
            asked = decode_register(data, data[0] | data[1] << 8)
            return self._register(asked, reply=False) if asked else "?"
        command = self._commands.get(arbitration_id)
        if command is not None:
            return f"to {command[1].name}: {_command(command[0], data, command[1].ranges)}"
        motor = self._replies.get((arbitration_id, data[0] & 0xF)) if len(data) == 8 else None
        if motor is None:
            return "?"
        if is_feedback(data, motor.id):
            feedback = decode_feedback(data, motor.ranges)
            how = status_name(feedback.status)
            return (
                f"{motor.name}: {how} {feedback.position:+.3f} rad {feedback.velocity:+.2f} rad/s "
                f"{feedback.effort:+.2f} Nm {feedback.mosfet_temperature}/{feedback.rotor_temperature} °C"
            )
        answer = decode_register(data, motor.id)
        return self._register(answer, reply=True) if answer else "?"

    def _register(self, frame: RegisterFrame, reply: bool) -> str:
        who = self._names.get(frame.motor, f"motor 0x{frame.motor:02X}")
        info = REGISTERS.get(frame.register)
        name = info.name if info else f"register {frame.register}"
        value = f"{name} = {decode_value(frame.register, frame.raw):g}"
        match frame.command:
            case RegisterCommand.READ:
                return f"{who}: {value}" if reply else f"to {who}: what is {name}?"
            case RegisterCommand.WRITE:
                return f"{who}: wrote {value}" if reply else f"to {who}: WRITE {value}"
            case RegisterCommand.SAVE:
                return f"{who}: stored" if reply else f"to {who}: STORE all registers"
            case _:
                return f"to {who}: how are you?"


def _command(offset: Offset, data: bytes, ranges: Ranges) -> str:
    if data in _SPECIALS:
        return _SPECIALS[data]
    if len(data) != 8 and not (offset is Offset.VEL and len(data) == 4):
        return f"{len(data)} bytes"
    match offset:
        case Offset.MIT:
            p, v, kp, kd, effort = decode_mit(data, ranges)
            return f"MIT {p:+.3f} rad {v:+.2f} rad/s kp {kp:.1f} kd {kd:.2f} {effort:+.2f} Nm"
        case Offset.POS_VEL:
            return "POS_VEL {:+.3f} rad up to {:.2f} rad/s".format(*decode_pos_vel(data))
        case Offset.VEL:
            return f"VEL {decode_vel(data):+.2f} rad/s"
        case _:
            return "POS_FORCE {:+.3f} rad up to {:.2f} rad/s, {:.0%} current".format(*decode_pos_force(data))
