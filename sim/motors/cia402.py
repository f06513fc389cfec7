"""One emulated CiA 402 drive: a CANopen node with its dictionary, its state machine, and its loops on a shaft.

It knows no bus and no clock: it is handed the data of a frame with the time, and says what it has to say by `say`.
Behaviour follows CiA 301 and IEC 61800-7-201; where those leave it to the maker, the least forgiving answer was taken:
a drive that misses its host's heartbeat leaves OPERATIONAL, and after a restart nothing is left of its PDO mapping.
"""

from collections.abc import Callable, Mapping
from functools import partial
from math import pi
from random import Random

from robotctl.hal.can.cia402 import objects as od
from robotctl.hal.can.cia402.codec import (
    HOST_ID,
    MOTION,
    NMT_ID,
    STATUS,
    SYNC_ID,
    Emergency,
    Mode,
    Nmt,
    NmtCommand,
    Service,
    encode_emergency,
    encode_heartbeat,
)
from robotctl.hal.can.cia402.faults import HOST_LOST, fault_of
from robotctl.hal.can.cia402.machine import State
from robotctl.hal.can.cia402.objects import Entry
from robotctl.hal.profile import Cia402Drive as Wiring
from robotctl.sim.motors.commissioned import BEAT_NS, DISABLE_VOLTAGE, FAULT_SIGNAL, QUICK_STOP, commissioned
from robotctl.sim.motors.cyclic import Loops
from robotctl.sim.motors.dictionary import OUT_OF_RANGE, Abort, Dictionary, serve
from robotctl.sim.motors.drive import FOREVER, Defer, Handler, Reply
from robotctl.sim.motors.pdo import COUNT, RECORDS, Pdo, check_write
from robotctl.sim.motors.shaft import Shaft
from robotctl.sim.motors.thermal import ROTOR_LIMIT, Thermal

QUICK_STOP_DECELERATION = 30.0
"""Of a joint, rad/s^2."""
FOLLOWING_WINDOW = 0.5
"""Of a joint, rad (object 0x6065 of a drive that has it)."""

_OVER_CURRENT, _UNDER_VOLTAGE, _TOO_HOT, _FOLLOWING = 0x2310, 0x3220, 0x4310, 0x8611
_LEAST_VOLTAGE = 18.0
_COMMUNICATION_ERROR, _GENERIC_ERROR = 0x10, 0x01
_BITS = {
    State.NOT_READY: 0x0200,
    State.OFF: 0x0250,
    State.READY: 0x0231,
    State.SWITCHED_ON: 0x0233,
    State.ENABLED: 0x0237,
    State.QUICK_STOP: 0x0217,
    State.FAULT_REACTION: 0x021F,
    State.FAULT: 0x0218,
}
_FOLLOWS = 0x1000
"""Bit 12 of the statusword in the cyclic modes."""
_TORQUE = (State.ENABLED, State.QUICK_STOP, State.FAULT_REACTION)
_STAY = 5
"""Least quick stop option (0x605A) with which a drive stays in QUICK STOP ACTIVE."""

Say = Callable[[int, bytes], None]
"""Takes id and data of a frame that goes out now."""


class Cia402Drive:
    """A drive with power. Positions and torques are the motor's own."""

    fd = False

    def __init__(
        self,
        name: str,
        wiring: Wiring,
        shaft: Shaft,
        gains: tuple[float, float],
        peak: float,
        watchdog_s: float,
        changed: Callable[[], None],
        say: Say,
        defer: Defer,
        now_ns: int,
        delay_ns: int = 0,
        noise: tuple[float, float] = (0.0, 0.0),
        seed: int = 0,
    ) -> None:
        """Build a drive as an integrator leaves it, and power it up.

        Args:
            name: the joint's.
            wiring: node id, resolution and rated torque.
            shaft: what it turns.
            gains: of its position loop, Nm/rad and Nms/rad of the motor.
            peak: largest torque of the motor, Nm.
            watchdog_s: time it waits for the host's heartbeat.
            changed: called when what it hears or what it has to be called for may be another.
            say: takes what it says.
            defer: calls back at a later time.
            now_ns: the present time.
            delay_ns: dead time until a setpoint acts.
            noise: standard deviations of the reported position (rad) and speed (rad/s).
            seed: of the noise.
        """
        self.name = name
        self.id = wiring.id
        self.reply_id = Service.TPDO1 + wiring.id
        self.model = "CiA 402"
        self.shaft = shaft
        self.thermal = Thermal()
        self.powered = False
        self.fed_ns = 0
        self.state = State.OFF
        self.nmt = Nmt.PRE_OPERATIONAL
        self.error = 0
        """Object 0x603F: the code of what is wrong at present."""
        self._wiring = wiring
        self._loops = Loops(shaft, *gains)
        self._changed, self._say, self._defer = changed, say, defer
        self._delay_ns = delay_ns
        self._noise = noise if noise != (0.0, 0.0) else None
        self._random = Random(seed)
        self._radian = wiring.resolution / (2.0 * pi)
        self._permille = 1000.0 / wiring.rated_torque
        self._zero = 0.0
        """Shaft angle at the encoder's zero."""
        self._epoch = 0
        self._mode = Mode.NONE
        self._word = 0
        self._listens = False
        """Whether a heartbeat of the host has come, so that the next one is waited for."""
        self._host_lost = False
        self.dictionary = commissioned(wiring, watchdog_s, peak)
        self._bind(self.dictionary)
        self._pdos = [Pdo(self.dictionary, *record) for record in RECORDS]
        self._waiting: dict[int, bytes] = {}
        """Frames of synchronous RPDOs until SYNC, by index of the PDO."""
        self._boot()
        self._beat(now_ns + BEAT_NS + self.id * 1_000_000)

    # --- what others may ask ----------------------------------------------------------------------------------------

    @property
    def enabled(self) -> bool:
        return self.state is State.ENABLED

    @property
    def is_faulty(self) -> bool:
        return self.state in (State.FAULT, State.FAULT_REACTION)

    @property
    def status(self) -> object:
        """State and error code, or that of a host which is not heard of."""
        return self.state, HOST_LOST if self._host_lost else self.error

    def told(self, status: object) -> str:
        assert isinstance(status, tuple)
        state, error = status
        return f"{state} ({fault_of('', error).name})" if error else str(state)

    @property
    def angle(self) -> float:
        return self.shaft.state()[0] - self._zero

    @property
    def is_servoing(self) -> bool:
        return self.powered and self.state in _TORQUE

    @property
    def deadline_ns(self) -> int:
        timeout = self.dictionary.values[0x1016, 1]
        waits = self.powered and self._listens and not self._host_lost
        return self.fed_ns + (timeout & 0xFFFF) * 1_000_000 if waits and timeout & 0xFFFF else FOREVER

    @property
    def cycles(self) -> int:
        return self.dictionary.cycles

    def routes(self, bitrate: int) -> Mapping[int, Handler]:
        """Return what it listens to in its present NMT state. It has the bus's bit rate, whatever that is."""
        if not self.powered:
            return {}
        found: dict[int, Handler] = {NMT_ID: self.on_nmt}
        host = self.dictionary.values[0x1016, 1] >> 16 & 0x7F
        if host:
            found[Service.HEARTBEAT + host] = self.on_heartbeat
        if self.nmt is not Nmt.STOPPED:
            found[Service.SDO + self.id] = self.on_sdo
        if self.nmt is Nmt.OPERATIONAL:
            found[SYNC_ID] = self.on_sync
            for index, pdo in enumerate(self._pdos[:COUNT]):
                if pdo.is_valid:
                    found[pdo.cob_id] = partial(self.on_rpdo, index)
        return found

    # --- power, faults and time -------------------------------------------------------------------------------------

    def power_up(self) -> None:
        """Start from what is stored, without torque, and say that it has booted."""
        self.dictionary.power_up()
        self._boot()
        self._say(Service.HEARTBEAT + self.id, encode_heartbeat(Nmt.BOOT_UP))

    def power_down(self) -> None:
        """Lose the supply: no torque, no answers, and nothing kept that is not stored."""
        self.powered = False
        self._go(State.OFF)
        self._changed()

    def preset(self, entry: Entry, value: int) -> None:
        """Set an entry, in store and in RAM, as if the drive had come that way."""
        self.dictionary.preset((entry.index, entry.sub), value)
        self._adopt()

    def supply(self, voltage: float) -> None:
        if voltage < _LEAST_VOLTAGE:
            self.fail(_UNDER_VOLTAGE)

    def shift_zero(self, offset: float) -> None:
        self._zero -= offset

    def set_watchdog(self, seconds: float) -> None:
        self.preset(od.HEARTBEAT_CONSUMER, HOST_ID << 16 | round(seconds * 1e3))

    def fail(self, code: int | None = None) -> None:
        """Report an error code, over-current if there is none, and go off; it stays until it is reset."""
        self.error = _OVER_CURRENT if code is None else code
        self._say_emergency(self.error, _GENERIC_ERROR)
        self._go(State.FAULT)

    def expire(self) -> None:
        """Miss the host's heartbeat: say so, leave OPERATIONAL, and do what object 0x6007 says."""
        self._host_lost = True
        self._say_emergency(HOST_LOST, _COMMUNICATION_ERROR)
        if self.nmt is Nmt.OPERATIONAL:
            self.nmt = Nmt.PRE_OPERATIONAL
        self._abort_connection()
        self._changed()

    def warm(self, seconds: float) -> None:
        load = self.shaft.state()[2] * self._permille / max(self.dictionary[od.MAX_TORQUE], 1) if self.enabled else 0.0
        self.thermal.step(load, seconds)
        if self.enabled and self.thermal.rotor >= ROTOR_LIMIT:
            self.fail(_TOO_HOT)

    def step(self, seconds: float) -> None:
        """Run its loops."""
        loops = self._loops
        loops.step(seconds)
        if self.state is State.ENABLED:
            if abs(loops.error) > FOLLOWING_WINDOW * self._wiring.gear:
                self.fail(_FOLLOWING)
        elif loops.stands:
            if self.state is State.FAULT_REACTION:
                self._go(State.FAULT)
            elif self.dictionary[od.QUICK_STOP_OPTION] < _STAY:
                self._go(State.OFF)

    # --- frames -----------------------------------------------------------------------------------------------------

    def on_nmt(self, data: bytes, now_ns: int) -> None:
        """Take a network management command."""
        if len(data) != 2 or data[1] not in (0, self.id):
            return
        match data[0]:
            case NmtCommand.START:
                self.nmt = Nmt.OPERATIONAL
            case NmtCommand.STOP:
                self.nmt = Nmt.STOPPED
                self._abort_connection()
            case NmtCommand.ENTER_PRE_OPERATIONAL:
                self.nmt = Nmt.PRE_OPERATIONAL
            case NmtCommand.RESET_NODE | NmtCommand.RESET_COMMUNICATION:
                self.power_up()
        self._waiting.clear()
        self._changed()

    def on_heartbeat(self, data: bytes, now_ns: int) -> None:
        """Take the host's heartbeat."""
        self.fed_ns = now_ns
        self._listens = True
        if self._host_lost:
            self._host_lost = False
            self._say_emergency(self.error, 0)
            self._changed()

    def on_sdo(self, data: bytes, now_ns: int) -> None:
        """Take an SDO request, and answer it."""
        answer = serve(self.dictionary, bytes(data))
        if answer is not None:
            self._say(Service.SDO_REPLY + self.id, answer)

    def on_rpdo(self, index: int, data: bytes, now_ns: int) -> None:
        """Take the frame of an RPDO; one that is synchronous waits for SYNC."""
        if len(data) < self._pdos[index].form.size:
            self._say_emergency(0x8210, _COMMUNICATION_ERROR)
        elif self._pdos[index].is_synchronous:
            self._waiting[index] = bytes(data)
        else:
            self._set(self._pdos[index].unpack(data))
            self._obey(now_ns)

    def on_sync(self, data: bytes, now_ns: int) -> None:
        """Act on what came before, and tell what is measured now."""
        if self._waiting:
            for index, frame in self._waiting.items():
                self._set(self._pdos[index].unpack(frame))
            self._waiting.clear()
            self._obey(now_ns)
        for pdo in self._pdos[COUNT:]:
            if pdo.is_valid and pdo.is_synchronous:
                self._say(pdo.cob_id, pdo.pack())

    def shifted(self, reply: Reply, angle: float) -> Reply:
        return self._retold(reply, lambda counts: counts + round(angle * self._radian))

    def frozen(self, reply: Reply, angle: float) -> Reply:
        if reply.arbitration_id == Service.TPDO2 + self.id and len(reply.data) == MOTION.size:
            return reply._replace(data=MOTION.pack(0, MOTION.unpack(reply.data)[1]))
        return self._retold(reply, lambda _: round(angle * self._radian))

    def _retold(self, reply: Reply, change: Callable[[int], int]) -> Reply:
        if reply.arbitration_id != self.reply_id or len(reply.data) != STATUS.size:
            return reply
        statusword, counts, torque = STATUS.unpack(reply.data)
        return reply._replace(data=STATUS.pack(statusword, change(counts), torque))

    # --- the state machine ------------------------------------------------------------------------------------------

    def _obey(self, now_ns: int) -> None:
        """Act on the controlword and the setpoints that are in the dictionary now."""
        word, before = self.dictionary[od.CONTROLWORD], self._word
        self._word = word
        self._command(word, rising=bool(word & ~before & 0x80))
        wanted = self.dictionary[od.MODE]
        if wanted in tuple(Mode) and (not wanted or self.dictionary[od.SUPPORTED_MODES] >> (wanted - 1) & 1):
            self._mode = Mode(wanted)
        if not self.enabled or self._mode is Mode.NONE:
            return
        values = self.dictionary.values
        velocity = values[0x60B1, 0] + (values[0x60FF, 0] if self._mode is Mode.VELOCITY else 0)
        torque = values[0x60B2, 0] + (values[0x6071, 0] if self._mode is Mode.TORQUE else 0)
        most = values[0x6072, 0]
        setpoint = (
            self._mode,
            values[0x607A, 0] / self._radian + self._zero,
            velocity / self._radian,
            min(max(torque, -most), most) / self._permille,
            max(values[0x60C2, 1] * 10.0 ** values[0x60C2, 2], 1e-3),
        )
        if self._delay_ns:
            self._defer(now_ns + self._delay_ns, partial(self._follow, self._epoch, setpoint))
        else:
            self._loops.follow(*setpoint)

    def _follow(self, epoch: int, setpoint: tuple[Mode, float, float, float, float]) -> None:
        # What was on its way when the drive was stopped must not act after the next start.
        if epoch == self._epoch:
            self._loops.follow(*setpoint)

    def _command(self, word: int, *, rising: bool) -> None:
        state = self.state
        if state is State.FAULT:
            if rising:
                self.error = HOST_LOST if self._host_lost else 0
                self._say_emergency(self.error, 0)
                self._go(State.OFF)
        elif state in (State.NOT_READY, State.FAULT_REACTION):
            return
        elif not word & 0x02:
            self._go(State.OFF)
        elif not word & 0x04:
            if state is State.ENABLED:
                self._quick_stop(State.QUICK_STOP)
            elif state is not State.QUICK_STOP:
                self._go(State.OFF)
        elif word & 0x0F == 0x0F:
            if state in (State.READY, State.SWITCHED_ON):
                self._go(State.ENABLED)
        elif word & 0x07 == 0x07:
            if state in (State.READY, State.ENABLED):
                self._go(State.SWITCHED_ON)
        elif state is not State.QUICK_STOP:
            self._go(State.READY)

    def _go(self, state: State) -> None:
        if state is self.state:
            return
        had_torque = self.state in _TORQUE
        self.state = state
        self._epoch += not (state in _TORQUE and had_torque)
        if state is State.ENABLED:
            self._loops.start()
        elif had_torque and state not in _TORQUE:
            self.shaft.release()
        self._changed()
        for pdo in self._pdos[COUNT:]:
            # Event-driven ones say what has changed.
            if self.nmt is Nmt.OPERATIONAL and self.powered and pdo.is_valid and not pdo.is_synchronous:
                self._say(pdo.cob_id, pdo.pack())

    def _quick_stop(self, state: State) -> None:
        self._loops.quick_stop(QUICK_STOP_DECELERATION * self._wiring.gear)
        self._go(state)

    def _abort_connection(self) -> None:
        """Do what object 0x6007 says of an enabled drive that is left alone."""
        option = self.dictionary[od.ABORT_OPTION]
        if self.state is not State.ENABLED:
            return
        if option == FAULT_SIGNAL:
            self.error = HOST_LOST
            self._quick_stop(State.FAULT_REACTION)
        elif option == DISABLE_VOLTAGE:
            self._go(State.OFF)
        elif option == QUICK_STOP:
            self._quick_stop(State.QUICK_STOP)

    # --- inside -----------------------------------------------------------------------------------------------------

    def _set(self, values: list[tuple[tuple[int, int], int]]) -> None:
        self.dictionary.values.update(values)

    def _boot(self) -> None:
        self.powered = True
        self.nmt = Nmt.PRE_OPERATIONAL
        self.error = self._word = 0
        self._mode = Mode.NONE
        self._listens = self._host_lost = False
        self._waiting.clear()
        self._go(State.OFF)
        self._adopt()

    def _adopt(self) -> None:
        for pdo in self._pdos:
            pdo.adopt()
        self._changed()

    def _written(self, entry: Entry) -> None:
        if entry in (od.CONTROLWORD, od.MODE):
            self._obey(self.fed_ns)
        else:
            self._adopt()

    def _check(self, entry: Entry, value: int) -> None:
        check_write(self.dictionary, entry, value, operational=self.nmt is Nmt.OPERATIONAL)
        if entry == od.MODE and value and not self.dictionary[od.SUPPORTED_MODES] >> (value - 1) & 1:
            raise Abort(OUT_OF_RANGE)

    def _say_emergency(self, code: int, register: int) -> None:
        if self.powered:
            register |= _GENERIC_ERROR if code else 0
            self._say(Service.EMCY + self.id, encode_emergency(Emergency(code, register, bytes(5))))

    def _beat(self, due_ns: int) -> None:
        """Say its heartbeat, again and again, from `due_ns` on."""

        def due() -> None:
            period = self.dictionary[od.HEARTBEAT_PRODUCER] * 1_000_000
            if self.powered and period:
                self._say(Service.HEARTBEAT + self.id, encode_heartbeat(self.nmt))
            self._beat(due_ns + (period or BEAT_NS))

        self._defer(due_ns, due)

    def _measured(self) -> int:
        position = self.shaft.state()[0] - self._zero
        if self._noise is not None:
            position += self._random.gauss(0.0, self._noise[0])
        return round(position * self._radian)

    def _speed(self) -> int:
        velocity = self.shaft.state()[1]
        if self._noise is not None:
            velocity += self._random.gauss(0.0, self._noise[1])
        return round(velocity * self._radian)

    def _torque(self) -> int:
        return min(max(round(self.shaft.state()[2] * self._permille), -0x8000), 0x7FFF)

    def _statusword(self) -> int:
        return _BITS[self.state] | (_FOLLOWS if self.enabled and self._mode is not Mode.NONE else 0)

    def _bind(self, dictionary: Dictionary) -> None:
        """Have the dictionary show what is measured, and ask before and tell after a write."""
        dictionary.live = {
            (0x603F, 0): lambda: self.error,
            (0x1001, 0): lambda: _GENERIC_ERROR if self.error else 0,
            (0x6041, 0): self._statusword,
            (0x6061, 0): lambda: int(self._mode),
            (0x6064, 0): self._measured,
            (0x606C, 0): self._speed,
            (0x6077, 0): self._torque,
        }
        dictionary.before_write, dictionary.after_write = self._check, self._written
