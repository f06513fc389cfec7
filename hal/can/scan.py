"""Who is on the bus? Register reads and feedback requests only: nothing is enabled, cleared or written.

A drive is asked by its id and answers on whatever reply id it has, so every answer is looked at, wherever it comes.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from robotctl.hal.can.channel import Channel
from robotctl.hal.can.damiao.codec import BROADCAST_ID, RegisterCommand, decode_register, encode_register
from robotctl.hal.can.damiao.drive import Drive, Identity
from robotctl.hal.can.damiao.faults import status_name
from robotctl.hal.can.damiao.motors import MOTORS, Ranges
from robotctl.hal.can.damiao.registers import CAN_BITRATES, ControlMode, Register
from robotctl.hal.can.transport import Transport
from robotctl.hal.clock import Clock
from robotctl.hal.errors import DriveError

LAST_ID = 32

_ROUNDS = 3
"""Each id is asked this often; single replies get lost."""
_BATCH = 4
"""Requests in flight, fewer than the 10 frames of the kernel's default transmit queue."""
_BATCH_WAIT_S = 0.005
_NOMINAL = Ranges(12.5, 45.0, 54.0)
"""Only until the drive's own are read."""


@dataclass(frozen=True, slots=True)
class FoundMotor:
    """A drive that answered."""

    id: int
    reply_ids: tuple[int, ...]
    """More than one: several motors share the id."""
    identity: Identity | None = None
    """None if it answered once and then no more."""
    bitrate: int = 0
    """bit/s, 0 if unknown. Above 1 Mbit/s it answers in CAN FD."""
    position: float = float("nan")
    """Motor angle, rad."""
    mosfet_temperature: int = 0
    """degrees Celsius"""
    rotor_temperature: int = 0
    """degrees Celsius"""
    status: str = ""

    @property
    def models(self) -> tuple[str, ...]:
        """Motors of the table with these ranges: a guess, since the drive does not tell."""
        return guess_models(self.identity.ranges) if self.identity else ()


@dataclass(frozen=True, slots=True)
class Scan:
    """What a scan found, and what to try where it found too little."""

    motors: tuple[FoundMotor, ...]
    hints: tuple[str, ...] = ()
    statistics: dict[str, object] = field(default_factory=dict)


def scan(channel: Channel, clock: Clock, last_id: int = LAST_ID) -> Scan:
    """Ask the ids 1 to `last_id` who they are. Takes about 0.2 s, and 0.1 s more for every drive that drops out.

    The channel stays open.

    Raises:
        BusError: if the bus is gone.
    """
    transport = Transport(channel, clock)
    answers = _probe(transport, range(1, last_id + 1))
    motors = tuple(_examine(transport, clock, motor, replies) for motor, replies in sorted(answers.items()))
    return Scan(motors, _hints(motors, transport, last_id), transport.statistics())


def guess_models(ranges: Ranges) -> tuple[str, ...]:
    """Return the models whose full-scale ranges are these."""
    return tuple(
        name
        for name, table in MOTORS.items()
        if all(abs(a - b) <= 1e-3 * b for a, b in zip(ranges, table, strict=True))
    )


def _probe(transport: Transport, ids: Sequence[int]) -> dict[int, Counter[int]]:
    """Return how often each motor id answered on which reply id."""
    answers: dict[int, Counter[int]] = {}

    def listen(arbitration_id: int, data: bytes) -> None:
        # Our own requests, looped back, come on the broadcast id.
        if arbitration_id == BROADCAST_ID or len(data) != 8:
            return
        motor = data[0] | data[1] << 8
        frame = decode_register(data, motor)
        if motor in ids and frame and (frame.command, frame.register) == (RegisterCommand.READ, Register.SN):
            answers.setdefault(motor, Counter())[arbitration_id] += 1

    transport.listener = listen
    for _ in range(_ROUNDS):
        for start in range(0, len(ids), _BATCH):
            for motor in ids[start : start + _BATCH]:
                transport.send(BROADCAST_ID, encode_register(motor, RegisterCommand.READ, Register.SN))
            transport.wait(lambda: False, _BATCH_WAIT_S)
    transport.listener = None
    return answers


def _examine(transport: Transport, clock: Clock, motor: int, replies: Counter[int]) -> FoundMotor:
    reply_ids = tuple(sorted(replies))
    if max(replies.values()) > _ROUNDS:
        reply_ids = tuple(sorted(replies.elements()))[::_ROUNDS]
    drive = Drive(f"motor {motor}", motor, reply_ids[0], _NOMINAL, transport, clock)
    try:
        identity = drive.identify()
        code = int(drive.read_register(Register.CAN_BR))
        drive.adopt(identity.ranges)
        drive.refresh()
    except DriveError:
        return FoundMotor(motor, reply_ids)
    return FoundMotor(
        motor,
        reply_ids,
        identity,
        CAN_BITRATES[code] if code < len(CAN_BITRATES) else 0,
        drive.position,
        drive.mosfet_temperature,
        drive.rotor_temperature,
        status_name(drive.status),
    )


def _hints(motors: Sequence[FoundMotor], transport: Transport, last_id: int) -> tuple[str, ...]:
    hints = []
    if not motors:
        wire = "CAN FD" if transport.fd else "classic CAN"
        hints += [
            f"nothing answered on the ids 1 to {last_id}: are the drives powered, and is the e-stop released?",
            "termination: 60 Ohm between CAN_H and CAN_L with the power off, 120 Ohm at each end; common ground",
            f"bit rates: the host speaks {wire}; a drive set above 1 Mbit/s answers in CAN FD only, one at or below "
            "1 Mbit/s in classic CAN",
        ]
        if transport.error_frames:
            hints.append(f"{transport.error_frames} error frames: most likely a wrong bit rate, or nobody acknowledges")
        if transport.send_failures:
            hints.append(f"{transport.send_failures} frames could not be sent: nobody acknowledges them")
    for motor in motors:
        who = f"id 0x{motor.id:02X}"
        if len(motor.reply_ids) > 1:
            listed = ", ".join(f"0x{reply:02X}" for reply in motor.reply_ids)
            hints.append(f"{who}: {len(motor.reply_ids)} motors share it (replies on {listed}); unplug all but one")
        if motor.identity is None:
            hints.append(f"{who}: answered once and then no more; a loose contact, or a second motor with its id")
        elif motor.identity.timeout_s == 0.0:
            hints.append(f"{who}: its watchdog is off; set register 9 (TIMEOUT, 50 us a count), e.g. 2000 for 100 ms")
        if motor.identity and motor.identity.mode not in ControlMode._value2member_map_:
            hints.append(f"{who}: unknown control mode {motor.identity.mode}")
    return tuple(hints)
