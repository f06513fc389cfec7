"""A DAMIAO drive at the service desk: its registers, and what is done once when an arm is built.

Replies are told by the id in their payload and not by where they come from, since reply ids are among what is set
here. Special frames and storing: DAMIAO's manual for the DM-J4340, sections on CAN commands and parameter registers.
"""

from collections.abc import Mapping
from typing import NamedTuple

from robotctl.hal.can.damiao.codec import (
    BROADCAST_ID,
    RegisterCommand,
    Special,
    Status,
    decode_feedback,
    decode_register,
    encode_register,
    encode_special,
    is_feedback,
)
from robotctl.hal.can.damiao.drive import REPLY_TIMEOUT_S, TRIES
from robotctl.hal.can.damiao.faults import status_name
from robotctl.hal.can.damiao.motors import MOTORS, Ranges
from robotctl.hal.can.damiao.registers import (
    CAN_BITRATES,
    REGISTERS,
    TIMEOUT_UNIT_S,
    ControlMode,
    Register,
    decode_value,
    encode_value,
)
from robotctl.hal.can.service import Difference, Motor, Parameters
from robotctl.hal.can.transport import Transport
from robotctl.hal.clock import Clock
from robotctl.hal.errors import ConfigError, DriveError
from robotctl.hal.profile import DamiaoDrive
from robotctl.hal.robot import Robot

_STORE_TIMEOUT_S = 0.2
"""For an answer to storing, which takes up to 30 ms."""
_STORE_TRIES = 3
_SECOND_VOICE_S = 0.01
"""How long to listen for a second drive that answers to the same id."""
_LONGEST_WATCHDOG_S = 10.0
_AT_ZERO = 0.02
"""How far from zero a drive may say that it is after its zero was set, rad."""
_BY_NAME = {info.name: register for register, info in REGISTERS.items()}
_CUTS_CONNECTION = frozenset({Register.MST_ID, Register.ESC_ID, Register.CAN_BR})
_FIRST_FD_CODE = CAN_BITRATES.index(1_000_000) + 1


class _Reply(NamedTuple):
    arbitration_id: int
    data: bytes


class DamiaoMotor(Motor):
    """One drive. Takes over the transport's listener while it asks."""

    protocol = "damiao"
    restorable = frozenset(
        info.name for register, info in REGISTERS.items() if info.writable and register not in _CUTS_CONNECTION
    )

    def __init__(self, transport: Transport, clock: Clock, motor_id: int, name: str) -> None:
        self.id = motor_id
        self.name = name
        self._transport = transport
        self._clock = clock
        self.flash_writes = 0
        self._serial: int | None = None
        self._replies: list[_Reply] = []

    def serial(self) -> int:
        if self._serial is None:
            self._serial = int(self._read(Register.SN))
        return self._serial

    def status(self) -> str:
        return status_name(self._feedback()[0])

    def read(self) -> Parameters:
        self._read(Register.SN)  # one that is not there is told of once, and not for every register
        found = {}
        for register, info in REGISTERS.items():
            # Two tries: a reply is rarely lost, and firmware that lacks a register never answers.
            value = self._try_to_read(register, tries=2)
            if value is not None:
                found[info.name] = value
        return found

    def write(self, parameters: Mapping[str, float]) -> None:
        self._refuse_impossible(parameters)
        self._require_service()
        for name, value in parameters.items():
            self._write(_BY_NAME[name], value)
        self._store([(_BY_NAME[name], value) for name, value in parameters.items()])

    def set_id(self, new_id: int, reply_id: int) -> None:
        if not (1 <= new_id <= 0x7F and 1 <= reply_id <= 0x7FF and reply_id != new_id):
            raise ConfigError(
                f"ids 0x{new_id:X} and 0x{reply_id:X} (reply) cannot be", "1 to 0x7F, and another one up to 0x7FF"
            )
        self._require_service()
        if new_id != self.id and DamiaoMotor(self._transport, self._clock, new_id, "")._voices():
            raise self._error(f"id 0x{new_id:02X} is taken: a drive answers to it", "give that one another id first")
        self._write(Register.MST_ID, reply_id)
        old = self.id
        self._send(RegisterCommand.WRITE, Register.ESC_ID, encode_value(Register.ESC_ID, new_id))
        self._transport.wait(lambda: bool(self._replies), REPLY_TIMEOUT_S)
        self.id = new_id
        if self._try_to_read(Register.ESC_ID) != new_id:
            self.id = old
            raise self._error(f"did not take the id 0x{new_id:02X}", "power-cycle it, and look with `robotctl scan`")
        self._store([(Register.ESC_ID, new_id), (Register.MST_ID, reply_id)])

    def set_zero(self) -> float:
        self._require_service()
        status, _ = self._feedback()
        if status != Status.DISABLED:
            raise self._error(f"reports {status_name(status)}", "remove the cause and power-cycle it first")
        self.flash_writes += 1
        self._transport.send(self.id, encode_special(Special.SET_ZERO))
        self._transport.wait(lambda: False, _STORE_TIMEOUT_S)
        _, angle = self._feedback()
        if abs(angle) > _AT_ZERO:
            raise self._error(f"measures {angle:.3f} rad after its zero was set", "hold the joint still and try again")
        return angle

    def set_watchdog(self, seconds: float) -> None:
        if not 0.5 * TIMEOUT_UNIT_S < seconds <= _LONGEST_WATCHDOG_S:
            raise ConfigError(
                f"a watchdog of {seconds * 1e3:g} ms cannot be set",
                f"more than 0, at most {_LONGEST_WATCHDOG_S * 1e3:g} ms; robotctl drives no arm without one",
            )
        self.write({REGISTERS[Register.TIMEOUT].name: round(seconds / TIMEOUT_UNIT_S)})

    def differences(self, wanted: Mapping[str, float], found: Mapping[str, float]) -> list[Difference]:
        different = []
        for register, info in REGISTERS.items():
            theirs, ours = wanted.get(info.name), found.get(info.name)
            if info.writable and theirs is not None and not _same(register, theirs, ours):
                different.append(Difference(info.name, theirs, ours))
        return different

    def departures(self, robot: Robot, drive: DamiaoDrive, mode: int, found: Mapping[str, float]) -> list[Difference]:
        assert robot.profile.can is not None
        counts = round(robot.profile.safety.drive_timeout_s / TIMEOUT_UNIT_S)
        pmax, vmax, tmax = MOTORS[drive.motor]
        wanted: dict[Register, float] = {
            Register.MST_ID: drive.reply_id,
            Register.ESC_ID: drive.id,
            Register.CTRL_MODE: mode,
            Register.PMAX: pmax,
            Register.VMAX: vmax,
            Register.TMAX: tmax,
        }
        timeout = found.get(REGISTERS[Register.TIMEOUT].name)
        if timeout is None or not 0 < timeout <= counts:
            wanted[Register.TIMEOUT] = counts
        if robot.profile.can.fd and found.get(REGISTERS[Register.CAN_BR].name, 0) < _FIRST_FD_CODE:
            wanted[Register.CAN_BR] = CAN_BITRATES.index(robot.profile.can.data_bitrate)
        return self.differences({REGISTERS[register].name: value for register, value in wanted.items()}, found)

    # --- inside -----------------------------------------------------------------------------------------------------

    def _refuse_impossible(self, parameters: Mapping[str, float]) -> None:
        for name, value in parameters.items():
            if name not in self.restorable:
                raise ConfigError(f"{self.name}: {name} cannot be written here", f"one of {', '.join(self.restorable)}")
            register = _BY_NAME[name]
            if register == Register.CTRL_MODE and value not in tuple(ControlMode):
                raise ConfigError(f"{self.name}: there is no control mode {value:g}", "1 to 4")

    def _require_service(self) -> None:
        """Refuse a drive that is enabled, or one of several.

        Raises:
            DriveError: with what to do.
        """
        voices = self._voices()
        if voices == 0:
            raise self._silent()
        if voices > 1:
            raise self._error(f"{voices} drives answer to this id", "unplug all but one: each would take the order")
        status, _ = self._feedback()
        self.serial()  # known from here on, so that writes can be counted even if it falls silent
        if status == Status.ENABLED:
            raise self._error("is enabled", "end what drives it; nothing is written to a drive that may move")

    def _voices(self) -> int:
        """Return how many drives answer to this id: the middle of three counts, so that an echo is no second drive."""
        counts = []
        for _ in range(3):
            self._send(RegisterCommand.READ, Register.SN)
            if self._transport.wait(lambda: bool(self._replies), REPLY_TIMEOUT_S):
                self._transport.wait(lambda: False, _SECOND_VOICE_S)
            counts.append(len(self._replies))
        return sorted(counts)[1]

    def _read(self, register: int) -> float:
        value = self._try_to_read(register)
        if value is None:
            raise self._silent()
        return value

    def _try_to_read(self, register: int, tries: int = TRIES) -> float | None:
        for _ in range(tries):
            self._send(RegisterCommand.READ, register)
            if self._transport.wait(lambda: bool(self._replies), REPLY_TIMEOUT_S):
                return decode_value(register, self._replies[0].data[4:8])
        return None

    def _write(self, register: int, value: float) -> None:
        """Write to RAM and read back: an acknowledgement proves nothing."""
        raw = encode_value(register, value)
        kept: float | None = None
        for _ in range(TRIES):
            self._send(RegisterCommand.WRITE, register, raw)
            self._transport.wait(lambda: bool(self._replies), REPLY_TIMEOUT_S)
            kept = self._try_to_read(register)
            if kept == decode_value(register, raw):
                return
        found = "is not told" if kept is None else f"stays at {kept:g}"
        raise self._error(f"{REGISTERS[register].name} {found}, {value:g} was written", "is the value in its range?")

    def _store(self, expected: list[tuple[int, float]]) -> None:
        """Copy RAM to flash until that is confirmed, seldom, since it wears; then read back what should be there."""
        for _ in range(_STORE_TRIES):
            self.flash_writes += 1
            self._send(RegisterCommand.SAVE, 0x01)
            if self._transport.wait(lambda: bool(self._replies), _STORE_TIMEOUT_S):
                break
        else:
            raise self._error(
                "did not confirm that it stored its registers", "power-cycle it, then look with `robotctl motor info`"
            )
        for register, value in expected:
            if not _same(register, value, self._read(register)):
                raise self._error(f"lost {REGISTERS[register].name} while storing", "try again")

    def _feedback(self) -> tuple[int, float]:
        """Return status and angle, rad."""
        reply_id = int(self._read(Register.MST_ID))
        ranges = Ranges(self._read(Register.PMAX), self._read(Register.VMAX), self._read(Register.TMAX))
        for _ in range(TRIES):
            self._send(RegisterCommand.REFRESH, 0)
            heard: list[bytes] = []

            def is_answered(heard: list[bytes] = heard) -> bool:
                heard[:] = [data for sender, data in self._replies if sender == reply_id and is_feedback(data, self.id)]
                return bool(heard)

            if self._transport.wait(is_answered, REPLY_TIMEOUT_S):
                feedback = decode_feedback(heard[-1], ranges)
                return feedback.status, feedback.position
        raise self._silent()

    def _send(self, command: RegisterCommand, register: int, raw: bytes = b"\0\0\0\0") -> None:
        """Send one request, and collect from now on what may be its answer."""
        self._replies = replies = []

        def listen(arbitration_id: int, data: bytes) -> None:
            if arbitration_id == BROADCAST_ID or len(data) != 8:
                return
            frame = decode_register(data, self.id)
            if command is RegisterCommand.REFRESH:
                wanted = frame is None
            elif command is RegisterCommand.SAVE:
                wanted = frame is not None and frame.command == command
            else:
                wanted = frame is not None and (frame.command, frame.register) == (command, register)
            if wanted:
                replies.append(_Reply(arbitration_id, data))

        self._transport.listener = listen
        self._transport.send(BROADCAST_ID, encode_register(self.id, command, register, raw))

    def _error(self, what: str, remedy: str = "") -> DriveError:
        return DriveError(self.name or "motor", self.id, what, remedy)

    def _silent(self) -> DriveError:
        return self._error("does not answer", "`robotctl scan` shows who does, and why nobody may")


def _same(register: int, one: float, other: float | None) -> bool:
    return other is not None and encode_value(register, one) == encode_value(register, other)
