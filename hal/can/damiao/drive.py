"""One DAMIAO drive, seen from the host: requests with retries, and the feedback it sends.

Positions, velocities and efforts are those of the joint; the map to the motor's own is
`motor angle = scale * (joint angle - zero - fold)`, with velocity likewise, and motor torque = joint torque / scale.
"""

from typing import NamedTuple

from robotctl.hal.can.damiao.codec import (
    BROADCAST_ID,
    KD_MAX,
    KP_MAX,
    Offset,
    RegisterCommand,
    Special,
    Status,
    decode_mit,
    encode_register,
    encode_special,
    quantise,
)
from robotctl.hal.can.damiao.motors import Ranges
from robotctl.hal.can.damiao.registers import TIMEOUT_UNIT_S, Register, decode_value, encode_value
from robotctl.hal.can.transport import Transport, route_key
from robotctl.hal.clock import Clock
from robotctl.hal.errors import DriveError

TRIES = 5
"""Requests before a drive counts as silent; single replies are often lost in a burst at bring-up (axol uses 5)."""

REPLY_TIMEOUT_S = 0.05
"""Time a drive has for its reply. A round trip takes about 0.3 ms on CAN FD, 1.6 ms in a user-mode kernel."""

CONFIRM_TIMEOUT_S = 0.02
"""The same where the request is resent anyway and other drives wait."""

_TWIN_TIMEOUT_S = 0.002
"""How long to listen for a second reply to one request."""

_REGISTER_COMMANDS = frozenset(int(command) for command in RegisterCommand)
_LAST_REGISTER = 81
_U16 = 0xFFFF
_U12 = 0xFFF


class Identity(NamedTuple):
    """What a drive says of itself."""

    motor_id: int
    reply_id: int
    hardware: int
    software: int
    sub_version: int
    serial: int
    mode: int
    """CTRL_MODE, see `ControlMode`."""
    timeout_s: float
    """The drive's own watchdog; 0 is off."""
    ranges: Ranges


class Drive:
    """A drive on a transport. The fields are what its latest feedback said; `stamp_ns` is 0 before the first.

    `reply_pending` is set by `expect_reply` and cleared by the reply.
    """

    __slots__ = (
        "_clock", "_from_wire", "_high", "_low", "_replies", "_reply_key", "_to_wire", "_transport", "_trips", "effort",
        "fold", "heard", "id", "missed", "mosfet_temperature", "name", "position", "ranges", "reply_id",
        "reply_pending", "rotor_temperature", "saturated", "scale", "sent_ns", "stamp_ns", "status", "velocity", "zero",
    )  # fmt: skip

    def __init__(
        self,
        name: str,
        motor_id: int,
        reply_id: int,
        ranges: Ranges,
        transport: Transport,
        clock: Clock,
        scale: float = 1.0,
        zero: float = 0.0,
    ) -> None:
        """Register with the transport. Sends nothing.

        `name` is the joint's, for messages; `scale` are motor radians per joint radian, signed; `zero` is the joint
        angle at the motor's zero, rad.
        """
        self.name = name
        self.id = motor_id
        self.reply_id = reply_id
        self.scale = scale
        self.zero = zero
        self.position = float("nan")
        self.velocity = float("nan")
        self.effort = float("nan")
        self.status = int(Status.DISABLED)
        self.mosfet_temperature = 0
        self.rotor_temperature = 0
        self.stamp_ns = 0
        self.heard = 0
        """Feedback frames so far."""
        self.missed = 0
        """Cyclic commands without a reply before the next one."""
        self.reply_pending = False
        self.sent_ns = 0
        self.saturated = False
        """Whether a value given to `encode` lay outside the wire's range; whoever looks resets it."""
        self._low = motor_id & 0xFF
        self._high = motor_id >> 8
        self._transport = transport
        self._trips = transport.trips
        self._clock = clock
        self._reply_key = -1
        self._replies: list[bytes] = []
        self.adopt(ranges)
        transport.routes[route_key(reply_id, motor_id)] = self.accept
        transport.reply_ids.add(reply_id)

    def adopt(self, ranges: Ranges, fold: float = 0.0) -> None:
        """Use these full-scale ranges, and add `fold` (rad) to every joint angle: a wake-up may be a turn off."""
        pmax, vmax, tmax = ranges
        scale = self.scale
        self.ranges = ranges
        self.fold = fold
        centre = self.zero + fold
        # Of position, velocity, effort: step = value * slope + intercept, with the half that turns int() into rounding
        self._to_wire = (
            *(scale * _U16 / (2.0 * pmax), (pmax - scale * centre) * _U16 / (2.0 * pmax) + 0.5),
            *(scale * _U12 / (2.0 * vmax), _U12 / 2.0 + 0.5),
            *(_U12 / (2.0 * tmax * scale), _U12 / 2.0 + 0.5),
        )
        self._from_wire = (
            *(2.0 * pmax / _U16 / scale, centre - pmax / scale),
            *(2.0 * vmax / _U12 / scale, -vmax / scale),
            *(2.0 * tmax / _U12 * scale, -tmax * scale),
        )

    def fold_near(self, angle: float, turn: float) -> None:
        """Fold by whole turns (rad of the joint), so that the measured angle is the one closest to `angle`."""
        fold = -turn * round((self.position - angle) / turn)
        self.adopt(self.ranges, self.fold + fold)
        self.position += fold

    # --- the fast path ----------------------------------------------------------------------------------------------

    def gains(self, kp: float, kd: float) -> int:
        """Return the bits of an MIT frame that hold the gains; kp in Nm/rad and kd in Nms/rad of the joint."""
        square = self.scale * self.scale
        return quantise(kp / square, 0.0, KP_MAX, _U12) << 24 | quantise(kd / square, 0.0, KD_MAX, _U12) << 12

    def encode(self, position: float, velocity: float, effort: float, gains: int) -> bytes:
        """Return the 8 bytes of an MIT command (rad, rad/s, Nm of the joint). Sets `saturated` where it must clip.

        The same as `codec.encode_mit`, with the factors worked out beforehand: 0.9 us instead of 2.4.
        """
        p_slope, p_zero, v_slope, v_zero, t_slope, t_zero = self._to_wire
        p = int(position * p_slope + p_zero)
        v = int(velocity * v_slope + v_zero)
        t = int(effort * t_slope + t_zero)
        if not (0 <= p <= _U16 and 0 <= v <= _U12 and 0 <= t <= _U12):
            self.saturated = True
            p = min(max(p, 0), _U16)
            v = min(max(v, 0), _U12)
            t = min(max(t, 0), _U12)
        return (p << 48 | v << 36 | gains | t).to_bytes(8, "big")

    def decode(self, data: bytes) -> tuple[float, float, float]:
        """Return position, velocity and effort of the joint that an MIT frame of `encode` asks for."""
        command = decode_mit(data, self.ranges)
        position = command.position / self.scale + self.zero + self.fold
        return position, command.velocity / self.scale, command.effort * self.scale

    def accept(self, data: bytearray, stamp_ns: int) -> bool:
        """Take 8 bytes that came on this drive's reply id with its low nibble; return whether they made sense.

        A register frame is told from feedback as `codec.is_feedback` does: an acknowledgement that is taken for
        feedback is a position of -12.47 rad.
        """
        if (
            data[0] == self._low
            and data[2] in _REGISTER_COMMANDS
            and data[1] == self._high
            and data[3] <= _LAST_REGISTER
        ):
            if data[2] << 8 | data[3] != self._reply_key:
                return False
            self._replies.append(bytes(data[4:]))
            return True
        word = int.from_bytes(data, "big")
        p_slope, p_zero, v_slope, v_zero, t_slope, t_zero = self._from_wire
        self.position = (word >> 40 & _U16) * p_slope + p_zero
        self.velocity = (word >> 28 & _U12) * v_slope + v_zero
        self.effort = (word >> 16 & _U12) * t_slope + t_zero
        self.status = word >> 60
        self.mosfet_temperature = word >> 8 & 0xFF
        self.rotor_temperature = word & 0xFF
        self.stamp_ns = stamp_ns
        self.heard += 1
        if self.reply_pending:
            self.reply_pending = False
            self._trips.append(max(stamp_ns - self.sent_ns, 0))
        return True

    def expect_reply(self, now_ns: int) -> None:
        """Note that a cyclic command goes out; one that is still unanswered counts as missed."""
        if self.reply_pending:
            self.missed += 1
        self.reply_pending = True
        self.sent_ns = now_ns

    # --- requests: bring-up and shutdown, not for the loop ----------------------------------------------------------

    def read_register(self, register: int, tries: int = TRIES) -> float:
        """Return a register's value.

        Raises:
            DriveError: if the drive does not answer, `tries` times in a row.
        """
        for _ in range(tries):
            replies = self._request(RegisterCommand.READ, register)
            if replies:
                return decode_value(register, replies[0])
        raise self.silent()

    def write_register(self, register: int, value: float) -> None:
        """Write a register in RAM (never to flash), and read it back.

        Raises:
            DriveError: if the drive does not answer, or does not keep the value.
        """
        raw = encode_value(register, value)
        kept = float("nan")
        for _ in range(TRIES):
            self._request(RegisterCommand.WRITE, register, raw)
            # A write is lost without a word while the drive is enabled, so its reply proves nothing.
            kept = self.read_register(register)
            if kept == decode_value(register, raw):
                return
        raise self.error(
            f"register {register} ({Register(register).name}) stays at {kept:g}, {value:g} was written",
            "disable the drive first; while it is enabled some writes are ignored",
        )

    def replies_to_one_request(self) -> int:
        """Return how often one request for the serial number is answered: more than once means two motors.

        The serial number is asked for since it differs: equal replies would merge into one on the wire.
        """
        for _ in range(TRIES):
            if self._request(RegisterCommand.READ, Register.SN):
                self._transport.wait(lambda: len(self._replies) > 1, _TWIN_TIMEOUT_S)
                return len(self._replies)
        return 0

    def identify(self) -> Identity:
        """Return what the drive says of itself.

        Raises:
            DriveError: if it does not answer.
        """
        read = self.read_register
        return Identity(
            motor_id=int(read(Register.ESC_ID)),
            reply_id=int(read(Register.MST_ID)),
            hardware=int(read(Register.HW_VER)),
            software=int(read(Register.SW_VER)),
            sub_version=int(read(Register.SUB_VER)),
            serial=int(read(Register.SN)),
            mode=int(read(Register.CTRL_MODE)),
            timeout_s=read(Register.TIMEOUT) * TIMEOUT_UNIT_S,
            ranges=Ranges(read(Register.PMAX), read(Register.VMAX), read(Register.TMAX)),
        )

    def refresh(self) -> None:
        """Ask for feedback and wait for it.

        Raises:
            DriveError: if the drive does not answer, five times in a row.
        """
        for _ in range(TRIES):
            before = self.heard
            self.poll()
            if self._transport.wait(lambda before=before: self.heard > before, REPLY_TIMEOUT_S):  # type: ignore[misc]
                return
        raise self.silent()

    @property
    def commands(self) -> set[int]:
        """The ids of frames that tell it to do something, as an arm's drive or a gripper's."""
        return {self.id, Offset.POS_FORCE + self.id}

    @property
    def question(self) -> tuple[int, bytes]:
        """The frame (id, data) that asks for feedback and changes nothing."""
        return BROADCAST_ID, encode_register(self.id, RegisterCommand.REFRESH)

    def poll(self) -> bool:
        """Ask for feedback without waiting; return whether the request left the host."""
        return self._transport.send(*self.question)

    def special(self, command: Special) -> bool:
        """Send enable, disable or clear-error, and return whether it left the host."""
        return self._transport.send(self.id, encode_special(command), force=command is Special.DISABLE)

    def answers(self, command: Special) -> bool:
        """Send a special frame once, and return whether feedback came back in time."""
        before = self.heard
        self.special(command)
        return self._transport.wait(lambda: self.heard > before, CONFIRM_TIMEOUT_S)

    def error(self, what: str, remedy: str = "") -> DriveError:
        """Return an error that names this drive's joint and id."""
        return DriveError(self.name, self.id, what, remedy)

    def silent(self) -> DriveError:
        """Return the error for a drive that does not answer."""
        wire = "CAN FD" if self._transport.fd else "classic CAN"
        return self.error(
            f"does not answer ({TRIES} requests)",
            f"check its power, the cable and the ground, termination (120 Ohm at both ends), that its id is "
            f"0x{self.id:02X} and its reply id 0x{self.reply_id:02X}, and the bit rates: the host speaks {wire}, and a "
            f"drive set above 1 Mbit/s answers in CAN FD only. `robotctl scan` shows who answers",
        )

    def _request(self, command: RegisterCommand, register: int, raw: bytes = b"\0\0\0\0") -> list[bytes]:
        self._reply_key = command << 8 | register
        self._replies.clear()
        self._transport.send(BROADCAST_ID, encode_register(self.id, command, register, raw))
        self._transport.wait(lambda: bool(self._replies), REPLY_TIMEOUT_S)
        return self._replies
