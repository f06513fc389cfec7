"""Bring-up of a CiA 402 drive: what it must say of itself before it is trusted, and how its PDOs are set up.

Everything is read first, on every drive, and all that is wrong is told at once. What is written then is in RAM: the
layout of the PDOs, the cycle time, and targets of 0 that the PDOs leave alone. What a drive does when the host dies is
never written: it has to be stored in the drive, where it outlives everybody.
"""

from typing import NamedTuple

from robotctl.hal.can.cia402.codec import HOST_ID, Mode, NmtCommand
from robotctl.hal.can.cia402.drive import Drive
from robotctl.hal.can.cia402.faults import fault_of
from robotctl.hal.can.cia402.machine import State, state_of
from robotctl.hal.can.cia402.objects import (
    ABORT_OPTION,
    CYCLE,
    CYCLE_EXPONENT,
    DEVICE_PROFILE,
    DEVICE_TYPE,
    ERROR_CODE,
    EVERY_SYNC,
    HEARTBEAT_CONSUMER,
    HEARTBEAT_PRODUCER,
    INCREMENTS,
    INCREMENTS_PER_SECOND,
    MAX_MOTOR_SPEED,
    MAX_TORQUE,
    POSITION,
    PRODUCT,
    RATED_TORQUE,
    REVISION,
    REVOLUTIONS,
    RPDOS,
    SERIAL,
    STATUSWORD,
    SUPPORTED_MODES,
    TARGET_TORQUE,
    TARGET_VELOCITY,
    TPDOS,
    VELOCITY_UNIT,
    VENDOR,
)
from robotctl.hal.errors import DriveError
from robotctl.hal.profile import Joint
from robotctl.hal.robot import Robot

ZERO_TOLERANCE = 0.1
"""How far past the model's limits a joint may be measured, rad: mechanical stops give, and zeros are set by hand."""

_RATED_TOLERANCE = 1e-3
_LONGEST_BEAT_MS = 500
"""Of the drive's own heartbeat: how late the host may learn that a drive has restarted."""
_MODES = (Mode.POSITION, Mode.VELOCITY, Mode.TORQUE)


class Expected(NamedTuple):
    """What the profile says of a drive."""

    timeout_s: float
    """Longest time without the host's heartbeat."""
    bounds: tuple[float, float]
    """Joint angles that can be, rad."""
    torque: float
    """Torque cap of the joint, Nm."""
    velocity: float
    """Velocity cap of the joint, rad/s."""
    cycle_s: float
    """Servo period."""

    @staticmethod
    def of(robot: Robot, joint: Joint) -> "Expected":
        model = robot.description.limits[joint.name]
        timeout_s = robot.profile.safety.drive_timeout_s
        bounds = (model.lower, model.upper)
        return Expected(timeout_s, bounds, joint.torque, joint.velocity, robot.period_ns * 1e-9)


class Identity(NamedTuple):
    """What a drive says of itself."""

    vendor: int
    product: int
    revision: int
    serial: int
    timeout_s: float
    """Consumer heartbeat time for the host."""
    resolution: float
    """Increments per motor turn."""
    rated_torque: float
    """Nm"""


def verify_drive(drive: Drive, expected: Expected, warnings: list[str]) -> tuple[Identity | None, list[DriveError]]:
    """Read a drive back and compare. Returns what it is, if it answers, and everything that is wrong with it.

    Only where nothing is wrong are its PDOs set up; `warnings` takes what it does not tell.
    """
    drive.configured = False
    identity, problems = examine_drive(drive, expected, warnings)
    if not problems:
        try:
            _set_up(drive, expected)
        except DriveError as problem:
            problems = [problem]
    return identity, problems


def examine_drive(drive: Drive, expected: Expected, warnings: list[str]) -> tuple[Identity | None, list[DriveError]]:
    """Do the reading part of `verify_drive`; writes nothing."""
    try:
        kind = drive.read(DEVICE_TYPE)
        if kind & 0xFFFF != DEVICE_PROFILE:
            what = f"is a device of profile {kind & 0xFFFF}, not {DEVICE_PROFILE}"
            return None, [drive.error(what, "correct its id in the profile, or the node's")]
        identity = _identify(drive)
        problems = _check_identity(drive, identity)
        problems += _check_watchdog(drive, expected)
        problems += _check_limits(drive, expected, identity, warnings)
        problems += _check_state(drive, expected)
    except DriveError as problem:
        return None, [problem]
    return identity, problems


def misplaced(drive: Drive, position: float, bounds: tuple[float, float]) -> list[DriveError]:
    """Return the problem of a joint that is measured where it cannot be, if it is."""
    lower, upper = bounds
    if lower - ZERO_TOLERANCE <= position <= upper + ZERO_TOLERANCE:
        return []
    return [
        drive.error(
            f"measures {position:.4f} rad, outside its joint's range {lower:.4f} to {upper:.4f}",
            "home the drive; check the sign, offset, gear and resolution of the profile",
        )
    ]


def _identify(drive: Drive) -> Identity:
    read = drive.read
    return Identity(
        read(VENDOR),
        drive.read_if_there(PRODUCT) or 0,
        drive.read_if_there(REVISION) or 0,
        drive.read_if_there(SERIAL) or 0,
        timeout_s=1e-3 * (read(HEARTBEAT_CONSUMER) & 0xFFFF),
        resolution=read(INCREMENTS) / max(read(REVOLUTIONS), 1),
        rated_torque=1e-3 * read(RATED_TORQUE),
    )


def _check_identity(drive: Drive, identity: Identity) -> list[DriveError]:
    wiring, problems = drive.wiring, []
    for what, found, wanted in (
        ("vendor id", identity.vendor, wiring.vendor),
        ("product code", identity.product, wiring.product),
    ):
        if wanted is not None and found != wanted:
            text = f"its {what} is 0x{found:08X}, the profile says 0x{wanted:08X}"
            problems.append(drive.error(text, "is it the right drive? Then correct the profile"))
    if identity.resolution != wiring.resolution:
        problems.append(
            drive.error(
                f"counts {identity.resolution:g} increments a turn, the profile says {wiring.resolution}",
                "correct the profile, or object 0x608F; with another resolution every angle is scaled wrongly",
            )
        )
    if abs(identity.rated_torque - wiring.rated_torque) > _RATED_TOLERANCE * wiring.rated_torque:
        problems.append(
            drive.error(
                f"its rated torque is {identity.rated_torque:g} Nm, the profile says {wiring.rated_torque:g}",
                "correct the profile, or object 0x6076; with another one every torque is scaled wrongly",
            )
        )
    return problems


def _check_watchdog(drive: Drive, expected: Expected) -> list[DriveError]:
    problems = []
    entry = drive.read(HEARTBEAT_CONSUMER)
    node, milliseconds = entry >> 16 & 0x7F, entry & 0xFFFF
    longest = round(expected.timeout_s * 1e3)
    how = f"write 0x{HOST_ID << 16 | longest:08X} ({longest} ms for node {HOST_ID}) to object 0x1016:1, and store it"
    if not milliseconds or node != HOST_ID:
        what = f"listens to the heartbeat of node {node}" if milliseconds and node else "has no watchdog"
        problems.append(drive.error(f"drive {what}: it would go on when the host dies (heartbeat consumer)", how))
    elif milliseconds > longest:
        problems.append(drive.error(f"its watchdog waits {milliseconds} ms, {longest} ms are allowed", how))
    if drive.read(ABORT_OPTION) == 0:
        text = "drive has no watchdog: it does nothing when the host's heartbeat is lost (abort connection option 0)"
        problems.append(drive.error(text, f"write 3 (quick stop) to object 0x{ABORT_OPTION.index:04X}, and store it"))
    beat = drive.read(HEARTBEAT_PRODUCER)
    if not 0 < beat <= _LONGEST_BEAT_MS:
        text = f"sends its heartbeat every {beat} ms" if beat else "sends no heartbeat"
        remedy = f"write 100 (ms) to object 0x{HEARTBEAT_PRODUCER.index:04X}, and store it"
        problems.append(drive.error(f"{text}; at most {_LONGEST_BEAT_MS} ms are allowed", remedy))
    drive.beat_period_ns = beat * 1_000_000
    return problems


def _check_limits(drive: Drive, expected: Expected, identity: Identity, warnings: list[str]) -> list[DriveError]:
    problems = []
    supported = drive.read(SUPPORTED_MODES)
    missing = [f"{mode} ({mode.name.lower()})" for mode in _MODES if not supported >> (mode - 1) & 1]
    if missing:
        text = f"lacks the cyclic synchronous modes {', '.join(missing)}"
        problems.append(drive.error(text, "another firmware or drive is needed"))
    needed = expected.torque * abs(drive.units.permille)
    most = drive.read(MAX_TORQUE)
    if most < needed * (1.0 - _RATED_TOLERANCE):
        text = f"gives at most {most / abs(drive.units.permille):.1f} Nm at the joint, its cap is {expected.torque:g}"
        problems.append(drive.error(text, "lower the profile's torque, or raise object 0x6072"))
    speed = drive.read_if_there(MAX_MOTOR_SPEED)
    turns = expected.velocity * abs(drive.units.counts) / identity.resolution * 60.0 if identity.resolution else 0.0
    if speed is not None and speed < turns:
        text = f"turns at most at {speed} /min, the joint's velocity cap takes {turns:.0f}"
        problems.append(drive.error(text, "lower the profile's velocity, or raise object 0x6080"))
    unit = drive.read_if_there(VELOCITY_UNIT)
    if unit is None:
        warnings.append(f"{drive.name}: does not tell its unit of velocity; increments/s are taken for granted")
    elif unit != INCREMENTS_PER_SECOND:
        text = f"its unit of velocity is 0x{unit:08X}, needed are increments/s (0x{INCREMENTS_PER_SECOND:08X})"
        problems.append(drive.error(text, "write that to object 0x60A9, and store it"))
    return problems


def _check_state(drive: Drive, expected: Expected) -> list[DriveError]:
    statusword = drive.read(STATUSWORD)
    state = state_of(statusword)
    if state in (State.FAULT, State.FAULT_REACTION):
        drive.emergency = drive.read(ERROR_CODE)
        fault = fault_of(drive.name, drive.emergency)
        return [drive.error(f"reports {fault.name}", f"{fault.hint}; then clear the fault")]
    if state is None or state in (State.ENABLED, State.QUICK_STOP):
        text = f"is in state {state or f'0x{statusword:04X}'}"
        return [drive.error(text, "another program may drive it: end that, or cycle the drive's power")]
    drive.emergency = 0
    per_radian, _, offset = drive.units
    return misplaced(drive, drive.read(POSITION) / per_radian + offset, expected.bounds)


def _set_up(drive: Drive, expected: Expected) -> None:
    """Map the PDOs, for which the node leaves OPERATIONAL."""
    drive.restarted = False
    drive.command(NmtCommand.ENTER_PRE_OPERATIONAL)
    # In CSV and CST the drive adds what its offsets say, which the PDOs carry, to these.
    drive.write(TARGET_VELOCITY, 0)
    drive.write(TARGET_TORQUE, 0)
    value, exponent = cycle_time(expected.cycle_s)
    drive.write(CYCLE, value)
    drive.write(CYCLE_EXPONENT, exponent)
    drive.map_pdos(RPDOS, TPDOS, EVERY_SYNC)


def cycle_time(seconds: float) -> tuple[int, int]:
    """Return value and exponent of object 0x60C2 for a period; the value is one byte, so it may be rounded."""
    exponent = -3
    while exponent > -6 and abs(seconds * 10.0**-exponent - round(seconds * 10.0**-exponent)) > 1e-6:
        exponent -= 1
    while round(seconds * 10.0**-exponent) > 0xFF:
        exponent += 1
    return round(seconds * 10.0**-exponent), exponent
