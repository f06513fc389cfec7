"""Which DAMIAO drives are on a bus? Register reads and feedback requests only: nothing is enabled, cleared or written.

A drive is asked by its id and answers on whatever reply id it has, so every answer is looked at, wherever it comes.
"""

from collections import Counter
from collections.abc import Sequence

from robotctl.hal.can.damiao.codec import BROADCAST_ID, RegisterCommand, decode_register, encode_register
from robotctl.hal.can.damiao.drive import REPLY_TIMEOUT_S, Drive
from robotctl.hal.can.damiao.faults import status_name
from robotctl.hal.can.damiao.motors import MOTORS, Ranges
from robotctl.hal.can.damiao.registers import CAN_BITRATES, Register
from robotctl.hal.can.found import FoundMotor
from robotctl.hal.can.transport import Transport
from robotctl.hal.clock import Clock
from robotctl.hal.errors import DriveError

_ROUNDS = 3
"""Each id is asked this often; single replies get lost."""
_MORE_ROUNDS = 9
"""The same where replies do get lost: drives that were silent so far may be there all the same."""
_BATCH = 4
"""Requests in flight, fewer than the 10 frames of the kernel's default transmit queue."""
_BATCH_WAIT_S = 0.005
_POLLS = 12
"""Feedback requests per drive, to see whether replies get lost."""
_OPTIONAL_TRIES = 2
"""For registers that older firmware does not have."""
_NOMINAL = Ranges(12.5, 45.0, 54.0)
"""Only until the drive's own are read."""


def probe(transport: Transport, clock: Clock, last_id: int) -> tuple[FoundMotor, ...]:
    """Ask the ids 1 to `last_id` who they are. Takes about 0.2 s, and 0.1 s more for every drive that drops out.

    Raises:
        BusError: if the bus is gone.
    """
    ids = range(1, last_id + 1)
    answers: dict[int, Counter[int]] = {}
    _ask(transport, ids, answers, _ROUNDS)
    rounds = _ROUNDS
    if any(replies.total() < _ROUNDS for replies in answers.values()):
        _ask(transport, ids, answers, _MORE_ROUNDS)
        rounds += _MORE_ROUNDS
    return tuple(_examine(transport, clock, motor, replies, rounds) for motor, replies in sorted(answers.items()))


def guess_models(ranges: Ranges) -> tuple[str, ...]:
    """Return the models whose full-scale ranges are these: a guess, since a drive does not tell its model."""
    return tuple(
        name
        for name, table in MOTORS.items()
        if all(abs(a - b) <= 1e-3 * b for a, b in zip(ranges, table, strict=True))
    )


def _ask(transport: Transport, ids: Sequence[int], answers: dict[int, Counter[int]], rounds: int) -> None:
    """Add to `answers` how often each motor id answers on which reply id."""

    def listen(arbitration_id: int, data: bytes) -> None:
        # Our own requests, looped back, come on the broadcast id.
        if arbitration_id == BROADCAST_ID or len(data) != 8:
            return
        motor = data[0] | data[1] << 8
        frame = decode_register(data, motor)
        if motor in ids and frame and (frame.command, frame.register) == (RegisterCommand.READ, Register.SN):
            answers.setdefault(motor, Counter())[arbitration_id] += 1

    transport.listener = listen
    for _ in range(rounds):
        for start in range(0, len(ids), _BATCH):
            for motor in ids[start : start + _BATCH]:
                transport.send(BROADCAST_ID, encode_register(motor, RegisterCommand.READ, Register.SN))
            transport.wait(lambda: False, _BATCH_WAIT_S)
    transport.listener = None


def _examine(transport: Transport, clock: Clock, motor: int, replies: Counter[int], rounds: int) -> FoundMotor:
    reply_ids = tuple(sorted(replies))
    if max(replies.values()) > rounds:
        reply_ids = tuple(sorted(replies.elements()))[::rounds]
    drive = Drive(f"motor {motor}", motor, reply_ids[0], _NOMINAL, transport, clock)
    heard = _poll(drive, transport, clock)
    try:
        identity = drive.identify()
        code = int(drive.read_register(Register.CAN_BR))
        drive.adopt(identity.ranges)
        drive.refresh()
    except DriveError:
        return FoundMotor(motor, reply_ids, asked=_POLLS, heard=heard)
    return FoundMotor(
        motor,
        reply_ids,
        identity,
        CAN_BITRATES[code] if code < len(CAN_BITRATES) else 0,
        drive.position,
        drive.mosfet_temperature,
        drive.rotor_temperature,
        status_name(drive.status),
        guess_models(identity.ranges),
        _optional(drive, Register.VBUS),
        _optional(drive, Register.UV_VALUE),
        _POLLS,
        heard,
    )


def _poll(drive: Drive, transport: Transport, clock: Clock) -> int:
    """Ask for feedback `_POLLS` times, and return how often it came. One that is late is not lost."""
    for asked in range(1, _POLLS + 1):
        drive.expect_reply(clock.now_ns())
        drive.poll()
        transport.wait(lambda asked=asked: drive.heard >= asked, REPLY_TIMEOUT_S)  # type: ignore[misc]
    return drive.heard


def _optional(drive: Drive, register: Register) -> float | None:
    try:
        return drive.read_register(register, _OPTIONAL_TRIES)
    except DriveError:
        return None
