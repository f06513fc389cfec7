"""One emulated DAMIAO drive: what it does with a frame, with time, and with its shaft.

A drive knows no bus and no clock: it is handed the data of a frame with the time, and returns the data of its reply.
Behaviour follows the vendor's manual and what openarm_can, axol, i2rt and python-damiao-driver rely on; where those
leave a question open, the least forgiving answer was taken.
"""

from collections.abc import Callable, Mapping
from functools import partial
from math import isfinite, pi
from random import Random

from robotctl.hal.can.damiao.codec import (
    KD_MAX,
    KP_MAX,
    Feedback,
    Offset,
    RegisterCommand,
    RegisterFrame,
    Special,
    Status,
    decode_feedback,
    decode_pos_force,
    decode_pos_vel,
    decode_vel,
    encode_feedback,
    encode_register,
    is_feedback,
)
from robotctl.hal.can.damiao.faults import status_name
from robotctl.hal.can.damiao.motors import Ranges
from robotctl.hal.can.damiao.registers import (
    CAN_BITRATES,
    TIMEOUT_UNIT_S,
    ControlMode,
    Register,
    decode_value,
    encode_value,
)
from robotctl.sim.motors.drive import FOREVER, Defer, Handler, Reply
from robotctl.sim.motors.memory import Memory, accepts
from robotctl.sim.motors.servo import Servo
from robotctl.sim.motors.shaft import Shaft
from robotctl.sim.motors.thermal import Thermal

_TIMEOUT_UNIT_NS = 50_000
_FD_NOMINAL = 1_000_000
"""Arbitration rate of a drive that is set to CAN FD, bit/s: the faster one is its data phase's."""
_U16 = 0xFFFF
_U12 = 0xFFF
_SPECIAL = 0xFFFFFFFF_FFFFFF00


class DamiaoDrive:
    """A drive with power. Positions and torques are the motor's own."""

    def __init__(
        self,
        name: str,
        model: str,
        memory: Memory,
        shaft: Shaft,
        changed: Callable[[], None],
        defer: Defer,
        delay_ns: int = 0,
        noise: tuple[float, float] = (0.0, 0.0),
        seed: int = 0,
    ) -> None:
        """Build a drive and power it up.

        Args:
            name: the joint's.
            model: e.g. DM8009.
            memory: its registers.
            shaft: what it turns.
            changed: called after everything that is more than a command in the present mode: ids, modes, status.
            defer: calls back at a later time.
            delay_ns: dead time until a motion command acts.
            noise: standard deviations of the reported position (rad) and speed (rad/s).
            seed: of the noise.
        """
        self.name = name
        self.model = model
        self.memory = memory
        self.shaft = shaft
        self.powered = False
        self.status = int(Status.DISABLED)
        self.fed_ns = 0
        """When a frame last reached it."""
        self.thermal = Thermal()
        self._changed = changed
        self._defer = defer
        self._delay_ns = delay_ns
        self._noise = noise if noise != (0.0, 0.0) else None
        self._random = Random(seed)
        self._zero = 0.0
        """Shaft angle at the zero that is stored in flash."""
        self._turns = 0.0
        self._epoch = 0
        self._servo: Servo | None = None
        self.power_up()

    # --- what others may ask ----------------------------------------------------------------------------------------

    @property
    def enabled(self) -> bool:
        return self.status == Status.ENABLED

    @property
    def angle(self) -> float:
        """Its angle as it would report it without noise, rad."""
        return self.shaft.state()[0] - self._zero + self._turns

    @property
    def ranges(self) -> Ranges:
        """Its present full scale, registers 21 to 23."""
        return Ranges(self.memory[Register.PMAX], self.memory[Register.VMAX], self.memory[Register.TMAX])

    @property
    def _starved(self) -> bool:
        return self.memory[Register.VBUS] < self.memory[Register.UV_VALUE]

    @property
    def is_servoing(self) -> bool:
        """Whether `step` has to be called as time passes: a position or speed loop of the drive's own is at work."""
        return self._servo is not None

    @property
    def deadline_ns(self) -> int:
        """When its watchdog will bite unless it is fed before."""
        timeout = self.memory[Register.TIMEOUT]
        return self.fed_ns + int(timeout) * _TIMEOUT_UNIT_NS if timeout and self.enabled else FOREVER

    @property
    def is_faulty(self) -> bool:
        return self.status > Status.ENABLED

    @property
    def cycles(self) -> int:
        return self.memory.cycles

    def told(self, status: object) -> str:
        assert isinstance(status, int)
        return status_name(status)

    def routes(self, bitrate: int) -> Mapping[int, Handler]:
        """Return what it does with commands in each mode; nothing without power, or at another bit rate."""
        if not self.powered or bitrate != (_FD_NOMINAL if self.fd else self.bitrate):
            return {}
        return {
            self.id + Offset.MIT: self.on_mit,
            self.id + Offset.POS_VEL: self.on_pos_vel,
            self.id + Offset.VEL: self.on_vel,
            self.id + Offset.POS_FORCE: self.on_pos_force,
        }

    # --- power, faults and time -------------------------------------------------------------------------------------

    def power_up(self) -> None:
        """Start from flash, disabled. The encoder knows one turn only: the angle wakes within half a turn of zero."""
        self.memory.power_up()
        self.powered = True
        angle = self.shaft.state()[0] - self._zero
        self._turns = -2.0 * pi * ((angle + pi) // (2.0 * pi))
        self._leave(Status.DISABLED)
        self._adopt()

    def power_down(self) -> None:
        """Lose the supply: no torque, no answers, and nothing kept that is not in flash."""
        self.powered = False
        self._leave(Status.DISABLED)

    def preset(self, register: int, value: float) -> None:
        """Set any register, in flash and in RAM, as if the drive had come that way."""
        self.memory.preset(register, value)
        self._adopt()

    def set_watchdog(self, seconds: float) -> None:
        self.preset(Register.TIMEOUT, round(seconds / TIMEOUT_UNIT_S))

    def fail(self, code: int | None = None) -> None:
        """Report a status from now on, over-current if none is given; the drive is off until it is cleared."""
        self._leave(Status.OVER_CURRENT if code is None else code)

    def supply(self, voltage: float) -> None:
        """Measure this at the supply, V; below register 0 it switches itself off, and cannot be cleared."""
        self.memory.write(Register.VBUS, voltage)
        if self._starved:
            self.fail(Status.UNDER_VOLTAGE)

    def shift_zero(self, offset: float) -> None:
        """Report angles that are larger by `offset`, rad, as if its zero had been set elsewhere."""
        self._zero -= offset
        self._adopt()

    def expire(self) -> None:
        """Let the watchdog bite."""
        self._leave(Status.COMMUNICATION_LOST)

    def warm(self, seconds: float) -> None:
        """Let `seconds` of the present torque heat the drive, and switch it off when it is too hot."""
        load = self.shaft.state()[2] / self.memory[Register.TMAX] if self.enabled else 0.0
        self.thermal.step(load, seconds)
        if self.enabled:
            fault = self.thermal.fault(self.memory[2])
            if fault is not None:
                self.fail(fault)

    def step(self, seconds: float) -> None:
        """Run the drive's own loop, if one is at work."""
        if self._servo is not None:
            self._servo.step(seconds)

    # --- frames -----------------------------------------------------------------------------------------------------

    def on_mit(self, data: bytes, now_ns: int) -> bytes | None:
        """Take a frame sent to the drive's id; return the feedback it is answered with."""
        if len(data) != 8:
            return None
        self.fed_ns = now_ns
        word = int.from_bytes(data, "big")
        if word >= _SPECIAL and self._special(word & 0xFF):
            return self.feedback()
        if self.status == 1 and self._mode == 1:
            slope, intercept = self._p
            position = (word >> 48) * slope + intercept
            slope, intercept = self._v
            velocity = (word >> 36 & _U12) * slope + intercept
            slope, intercept = self._t
            effort = (word & _U12) * slope + intercept
            kp = (word >> 24 & _U12) * (KP_MAX / _U12)
            kd = (word >> 12 & _U12) * (KD_MAX / _U12)
            if self._delay_ns:
                law = partial(self._obey, self._epoch, kp, kd, position, velocity, effort)
                self._defer(now_ns + self._delay_ns, law)
            else:
                self.shaft.drive(kp, kd, position, velocity, effort)
        return self.feedback()

    def on_pos_vel(self, data: bytes, now_ns: int) -> bytes | None:
        """Take a frame sent to the drive's id + 0x100."""
        if len(data) != 8:
            return None
        if not self._is_special(data, now_ns) and self.enabled and self._mode == ControlMode.POS_VEL:
            position, speed = decode_pos_vel(data)
            self._aim(now_ns, position, abs(speed), None)
        return self.feedback()

    def on_vel(self, data: bytes, now_ns: int) -> bytes | None:
        """Take a frame sent to the drive's id + 0x200; hosts send 4 bytes, or 8."""
        if len(data) not in (4, 8):
            return None
        if not self._is_special(data, now_ns) and self.enabled and self._mode == ControlMode.VEL:
            self._aim(now_ns, None, decode_vel(data), None)
        return self.feedback()

    def on_pos_force(self, data: bytes, now_ns: int) -> bytes | None:
        """Take a frame sent to the drive's id + 0x300."""
        if len(data) != 8:
            return None
        if not self._is_special(data, now_ns) and self.enabled and self._mode == ControlMode.POS_FORCE:
            position, speed, current = decode_pos_force(data)
            # Torque is taken as proportional to current, with TMAX at the largest current.
            self._aim(now_ns, position, speed, min(current, 1.0) * self.memory[Register.TMAX])
        return self.feedback()

    def on_register(self, frame: RegisterFrame, now_ns: int) -> bytes | None:
        """Take a register frame that names this drive; return the reply, feedback for a refresh."""
        self.fed_ns = now_ns
        motor = frame.motor
        match frame.command:
            case RegisterCommand.REFRESH:
                return self.feedback()
            case RegisterCommand.READ:
                if frame.register not in self.memory:
                    return None
                value = encode_value(frame.register, self._read(frame.register))
                return encode_register(motor, RegisterCommand.READ, frame.register, value)
            case RegisterCommand.WRITE:
                if frame.register not in self.memory:
                    return None
                kept = self._write(frame.register, frame.raw)
                return encode_register(motor, RegisterCommand.WRITE, frame.register, kept)
            case _:
                if self.enabled:
                    return None
                self.memory.save()
                return encode_register(motor, RegisterCommand.SAVE, frame.register)

    def feedback(self) -> bytes:
        """Return the 8 bytes of a feedback frame: `codec.encode_feedback` with its factors worked out beforehand."""
        position, velocity, effort = self.shaft.state()
        if self._noise is not None:
            position += self._random.gauss(0.0, self._noise[0])
            velocity += self._random.gauss(0.0, self._noise[1])
        slope, intercept = self._to_p
        p = int(position * slope + intercept)
        slope, intercept = self._to_v
        v = int(velocity * slope + intercept)
        slope, intercept = self._to_t
        t = int(effort * slope + intercept)
        if not (0 <= p <= _U16 and 0 <= v <= _U12 and 0 <= t <= _U12):
            p = min(max(p, 0), _U16)
            v = min(max(v, 0), _U12)
            t = min(max(t, 0), _U12)
        return (self.status << 60 | p << 40 | v << 28 | t << 16 | self._tail | self.thermal.word).to_bytes(8, "big")

    def shifted(self, reply: Reply, angle: float) -> Reply:
        return self._retold(reply, lambda said: said._replace(position=said.position + angle))

    def frozen(self, reply: Reply, angle: float) -> Reply:
        return self._retold(reply, lambda said: said._replace(position=angle, velocity=0.0))

    def _retold(self, reply: Reply, change: Callable[[Feedback], Feedback]) -> Reply:
        if not is_feedback(reply.data, self.id):
            return reply
        return reply._replace(data=encode_feedback(change(decode_feedback(reply.data, self.ranges)), self.ranges))

    # --- inside -----------------------------------------------------------------------------------------------------

    def _is_special(self, data: bytes, now_ns: int) -> bool:
        self.fed_ns = now_ns
        word = int.from_bytes(data, "big")
        return len(data) == 8 and word >= _SPECIAL and self._special(word & 0xFF)

    def _special(self, code: int) -> bool:
        match code:
            case Special.ENABLE:
                if self.status == Status.DISABLED:
                    self._leave(Status.ENABLED)
                    self.shaft.drive(0.0, 0.0, 0.0, 0.0, 0.0)
            case Special.DISABLE:
                if self.enabled:
                    self._leave(Status.DISABLED)
            case Special.CLEAR_ERROR:
                if not self.enabled:
                    self._leave(Status.UNDER_VOLTAGE if self._starved else Status.DISABLED)
            case Special.SET_ZERO:
                self._zero = self.shaft.state()[0]
                self._turns = 0.0
                self.memory.cycles += 1
                self._forget()
                self._adopt()
            case _:
                return False
        return True

    def _leave(self, status: int) -> None:
        """Change the status, with all command values cleared and the shaft released."""
        self.status = int(status)
        self._forget()
        if status != Status.ENABLED:
            self.shaft.release()
        self._changed()

    def _forget(self) -> None:
        self._epoch += 1
        self._servo = None
        self.shaft.limit(None)
        if self.enabled:
            self.shaft.drive(0.0, 0.0, 0.0, 0.0, 0.0)

    def _obey(self, epoch: int, kp: float, kd: float, position: float, velocity: float, effort: float) -> None:
        # What was on its way when the drive was stopped must not act after the next start.
        if epoch == self._epoch:
            self.shaft.drive(kp, kd, position, velocity, effort)

    def _aim(self, now_ns: int, target: float | None, speed: float, bound: float | None) -> None:
        if not isfinite(speed) or not (target is None or isfinite(target)):
            return
        aim = partial(self._aim_now, self._epoch, target, speed, bound)
        if self._delay_ns:
            self._defer(now_ns + self._delay_ns, aim)
        else:
            aim()

    def _aim_now(self, epoch: int, target: float | None, speed: float, bound: float | None) -> None:
        if epoch != self._epoch:
            return
        starting = self._servo is None
        if self._servo is None:
            self._servo = Servo(self.shaft)
        fastest = self.memory[Register.VMAX]
        angle = None if target is None else target + self._zero - self._turns
        self._servo.aim(
            angle, min(max(speed, -fastest), fastest), self.memory[Register.TMAX] if bound is None else bound
        )
        self.shaft.limit(bound)
        if starting:
            self._changed()

    def _read(self, register: int) -> float:
        match register:
            case Register.P_M | Register.XOUT:
                return self.angle
            case 61:
                return self.thermal.mosfet
            case 62:
                return self.thermal.rotor
            case _:
                return self.memory[register]

    def _write(self, register: int, raw: bytes) -> bytes:
        """Write what can be written; return the value bytes of the acknowledgement."""
        value = decode_value(register, raw)
        if not accepts(register, value):
            return encode_value(register, self._read(register))
        if register == Register.CTRL_MODE and self.enabled:
            # The write is lost without a word, so the acknowledgement looks like any other.
            return raw
        self.memory.write(register, value)
        if register == Register.CTRL_MODE:
            self._forget()
        self._adopt()
        return raw

    def _adopt(self) -> None:
        """Work out from the registers what frames need."""
        memory = self.memory
        pmax, vmax, tmax = self.ranges
        self.id = int(memory[Register.ESC_ID])
        self.reply_id = int(memory[Register.MST_ID])
        self._mode = int(memory[Register.CTRL_MODE])
        code = int(memory[Register.CAN_BR])
        self.bitrate = CAN_BITRATES[code] if code < len(CAN_BITRATES) else CAN_BITRATES[-1]
        self.fd = self.bitrate > 1_000_000
        """Whether it answers in CAN FD."""
        origin = self._zero - self._turns
        self._p = (2.0 * pmax / _U16, origin - pmax)
        self._v = (2.0 * vmax / _U12, -vmax)
        self._t = (2.0 * tmax / _U12, -tmax)
        # The half turns int() into rounding.
        self._to_p = (_U16 / (2.0 * pmax), (pmax - origin) * _U16 / (2.0 * pmax) + 0.5)
        self._to_v = (_U12 / (2.0 * vmax), _U12 / 2.0 + 0.5)
        self._to_t = (_U12 / (2.0 * tmax), _U12 / 2.0 + 0.5)
        self._tail = (self.id & 0xF) << 56
        self._changed()
