"""Bring-up: what a drive must say of itself before it is trusted. Reads only, except CTRL_MODE in RAM.

Every check is made on every drive, and all that is wrong is told at once: a person who fixes an arm fixes it once.
"""

import math
from typing import NamedTuple

from robotctl.hal.can.damiao.codec import BROADCAST_ID, Status
from robotctl.hal.can.damiao.drive import Drive, Identity
from robotctl.hal.can.damiao.faults import fault_of, is_fault, status_name
from robotctl.hal.can.damiao.motors import MOTORS, Ranges
from robotctl.hal.can.damiao.registers import TIMEOUT_UNIT_S, ControlMode, Register
from robotctl.hal.errors import DriveError

ZERO_TOLERANCE = 0.1
"""How far past the model's limits a joint may be measured, rad: mechanical stops give, and zeros are set by hand."""

_TURN = 2.0 * math.pi
_RANGE_TOLERANCE = 1e-4
"""Relative; the registers are float32 and profiles have few digits."""


class Expected(NamedTuple):
    """What the profile says of a drive."""

    motor: str
    mode: ControlMode
    timeout_s: float
    """Longest watchdog timeout."""
    bounds: tuple[float, float] | None
    """Joint angles that can be, rad; None where any can."""
    turn: float
    """A full turn of the motor's single-turn encoder, in joint radians."""


class Eavesdropper:
    """Remembers which ids register replies came on that no drive of the profile claimed."""

    def __init__(self) -> None:
        self.ids: dict[int, set[int]] = {}
        """Reply ids by motor id."""

    def __call__(self, arbitration_id: int, data: bytes) -> None:
        if arbitration_id != BROADCAST_ID and len(data) == 8 and data[2] in (0x33, 0x55, 0xAA):
            self.ids.setdefault(data[0] | data[1] << 8, set()).add(arbitration_id)

    def strangers(self, drive: Drive) -> list[str]:
        """Return the reply ids, as text, on which a motor with the drive's id answered, other than the drive's own."""
        return [f"0x{other:02X}" for other in sorted(self.ids.get(drive.id, set()) - {drive.reply_id})]


def verify_drive(
    drive: Drive, expected: Expected, others: Eavesdropper, warnings: list[str]
) -> tuple[Identity | None, list[DriveError]]:
    """Read a drive back and compare. Returns what it is, if it answers, and everything that is wrong with it.

    Folds the drive's angle by a full turn, or sets its control mode in RAM, where needed; each adds to `warnings`.
    """
    try:
        replies = _count_replies(drive)
        strangers = others.strangers(drive)
        if replies == 0:
            return None, [_elsewhere(drive, strangers) if strangers else drive.silent()]
        problems = []
        if replies > 1 or strangers:
            problems.append(_twins(drive, replies, strangers))
        identity = drive.identify()
        drive.refresh()
        problems += _check_identity(drive, expected, identity)
        problems += _check_mode(drive, expected, identity, warnings)
        if not _differ(identity.ranges, MOTORS[expected.motor]):
            problems += _check_position(drive, expected, warnings)
    except DriveError as silent:
        return None, [silent]
    return identity, problems


def plausible_turns(position: float, bounds: tuple[float, float], turn: float) -> list[int]:
    """Return which of -1, 0 and 1 full turns, subtracted from `position`, bring it inside `bounds`.

    A single-turn encoder that was parked more than half a turn from its zero wakes up a full turn off.
    """
    lower, upper = bounds[0] - ZERO_TOLERANCE, bounds[1] + ZERO_TOLERANCE
    return [turns for turns in (0, -1, 1) if lower <= position - turns * turn <= upper]


def _count_replies(drive: Drive) -> int:
    """Return how many motors answer: the middle of three counts, so that one frame sent twice is no second motor."""
    counts = [drive.replies_to_one_request()]
    if counts[0] > 1:
        counts += [drive.replies_to_one_request() for _ in range(2)]
    return sorted(counts)[len(counts) // 2]


def _elsewhere(drive: Drive, strangers: list[str]) -> DriveError:
    return drive.error(
        f"answers on id {' and '.join(strangers)}, the profile says 0x{drive.reply_id:02X}",
        f"set register {Register.MST_ID} (MST_ID) of the motor, or reply_id in the profile",
    )


def _twins(drive: Drive, replies: int, strangers: list[str]) -> DriveError:
    seen = f", also on id {' and '.join(strangers)}" if strangers else ""
    return drive.error(
        f"{max(replies, 2)} motors answer to id 0x{drive.id:02X}{seen}",
        f"unplug all but one, and give each an id of its own (register {Register.ESC_ID}, ESC_ID)",
    )


def _differ(found: Ranges, table: Ranges) -> bool:
    return any(abs(a - b) > _RANGE_TOLERANCE * b for a, b in zip(found, table, strict=True))


def _check_identity(drive: Drive, expected: Expected, identity: Identity) -> list[DriveError]:
    problems = []
    if (identity.motor_id, identity.reply_id) != (drive.id, drive.reply_id):
        problems.append(
            drive.error(
                f"says its ids are 0x{identity.motor_id:02X} and 0x{identity.reply_id:02X} (reply), "
                f"the profile says 0x{drive.id:02X} and 0x{drive.reply_id:02X}",
                "set registers 7 (MST_ID) and 8 (ESC_ID) of the motor, or the profile",
            )
        )
    table = MOTORS[expected.motor]
    if _differ(identity.ranges, table):
        problems.append(
            drive.error(
                f"has PMAX, VMAX, TMAX = {_triple(identity.ranges)}, a {expected.motor} has {_triple(table)}",
                "correct the motor's model in the profile, or registers 21 to 23 of the motor; with other ranges every "
                "value on the bus is scaled wrongly",
            )
        )
    counts = round(expected.timeout_s / TIMEOUT_UNIT_S)
    how = (
        f"set register {Register.TIMEOUT} (TIMEOUT, 50 us a count) of motor 0x{drive.id:02X} to at most {counts} "
        f"({expected.timeout_s * 1e3:g} ms), and save it while the drive is disabled"
    )
    if identity.timeout_s == 0.0:
        problems.append(drive.error("drive has no watchdog: it would go on when the host dies", how))
    elif identity.timeout_s > expected.timeout_s * (1.0 + 1e-9):
        problems.append(
            drive.error(
                f"its watchdog waits {identity.timeout_s * 1e3:g} ms, {expected.timeout_s * 1e3:g} ms are allowed", how
            )
        )
    if is_fault(drive.status):
        fault = fault_of(drive.name, drive.status)
        problems.append(drive.error(f"reports {fault.name}", f"{fault.hint}; then clear the fault"))
    return problems


def _check_mode(drive: Drive, expected: Expected, identity: Identity, warnings: list[str]) -> list[DriveError]:
    if identity.mode == expected.mode:
        return []
    if drive.status != Status.DISABLED:
        return [
            drive.error(
                f"control mode is {identity.mode}, needed is {expected.mode} ({expected.mode.name}), and the drive is "
                f"{status_name(drive.status)}",
                "disable it and clear its faults; a drive changes its mode only while disabled",
            )
        ]
    try:
        drive.write_register(Register.CTRL_MODE, expected.mode)
    except DriveError as refused:
        return [refused]
    warnings.append(f"{drive.name}: control mode was {identity.mode}, set to {expected.mode.name} in RAM")
    return []


def _check_position(drive: Drive, expected: Expected, warnings: list[str]) -> list[DriveError]:
    if expected.bounds is None:
        return []
    # An earlier verification may have folded: start from what the motor says.
    drive.adopt(drive.ranges)
    drive.refresh()
    measured = drive.position
    lower, upper = expected.bounds
    turns = plausible_turns(measured, expected.bounds, expected.turn)
    if len(turns) != 1:
        found = "no angle" if not turns else "more than one angle"
        return [
            drive.error(
                f"measures {measured:.4f} rad; {found} of q and q +- {expected.turn:.4f} fits the joint's range "
                f"{lower:.4f} to {upper:.4f}",
                "move the joint by hand into its range with the power off; check zero, sign and offset of the drive",
            )
        ]
    fold = -turns[0] * expected.turn
    reach = max(abs(drive.scale * (bound - drive.zero - fold)) for bound in expected.bounds)
    if fold and reach > drive.ranges.pmax:
        return [
            drive.error(
                f"woke up a full turn off ({measured:.4f} rad); from there {reach:.2f} rad are needed of its "
                f"{drive.ranges.pmax:.2f}",
                "move the joint by hand within half a turn of its zero, and power-cycle the drive",
            )
        ]
    drive.adopt(drive.ranges, fold)
    drive.refresh()
    if fold:
        warnings.append(
            f"{drive.name}: woke up a full turn off; {measured:.4f} rad is read as {drive.position:.4f} rad"
        )
    return []


def _triple(ranges: Ranges) -> str:
    return " / ".join(f"{value:g}" for value in ranges)
