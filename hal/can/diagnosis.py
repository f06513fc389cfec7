"""Does a profile fit the wire, and do the drives on the wire fit the profile? Findings for people; changes nothing."""

from collections.abc import Iterator

from robotctl.hal.can.damiao.faults import status_name
from robotctl.hal.can.damiao.motors import MOTORS
from robotctl.hal.can.damiao.registers import ControlMode, Register
from robotctl.hal.can.scan import FoundMotor, Scan
from robotctl.hal.can.transport import frame_time_ns
from robotctl.hal.host import Finding, Level
from robotctl.hal.profile import Drive
from robotctl.hal.robot import Robot

_TAKE_OVER_S = 0.02
"""What the watchman needs to notice, to open a channel and to send."""
_COMFORTABLE_LOAD = 0.75
"""Bus load above which retransmissions and register traffic find no room."""


def drives_of(robot: Robot) -> list[tuple[str, Drive, ControlMode]]:
    """Return name, drive and needed control mode of every drive in a profile, the gripper's last."""
    drives = [(joint.name, joint.drive, ControlMode.MIT) for joint in robot.profile.joints if joint.drive]
    gripper = robot.profile.gripper
    if gripper and gripper.drive:
        drives.append(("gripper", gripper.drive, ControlMode.POS_FORCE))
    return drives


def profile_findings(robot: Robot) -> list[Finding]:
    """Look at what a profile asks of the wire and of its actuators."""
    profile = robot.profile
    findings = [_finding("profile", "limits", Level.OK, f"{robot.source}: inside its model's and its motors' limits")]
    lag = profile.twin.lag_s + profile.twin.delay_s
    if lag > 0.0 and profile.safety.sphere_gain > 1.0 / (4.0 * lag):
        text = (
            f"{profile.safety.sphere_gain:g} 1/s is too high for {lag * 1e3:g} ms of lag and delay: the tool overshoots"
        )
        findings.append(_finding("profile", "sphere_gain", Level.WARN, text, f"at most {1.0 / (4.0 * lag):.2f}"))
    if profile.can is None:
        return [*findings, _finding("profile", "can", Level.WARN, "no CAN drives: runs in simulation only")]
    wire, count = profile.can, len(drives_of(robot))
    cycle_s = 2e-9 * count * frame_time_ns(wire.fd, wire.bitrate, wire.data_bitrate)
    load = cycle_s * profile.servo_hz
    level = Level.OK if load <= _COMFORTABLE_LOAD else Level.WARN if load < 1.0 else Level.FAIL
    kind = "CAN FD" if wire.fd else "classic CAN"
    text = f"{count} drives at {profile.servo_hz} Hz on {kind} load the bus by {load * 100:.0f} %"
    remedy = f"servo_hz of at most {int(_COMFORTABLE_LOAD / cycle_s)}, or a second bus"
    findings.append(_finding("profile", "bus load", level, text, remedy))
    return [*findings, _watchman_finding(robot)]


def _watchman_finding(robot: Robot) -> Finding:
    safety = robot.profile.safety
    in_time = safety.watchman_s + _TAKE_OVER_S <= safety.drive_timeout_s
    text = (
        f"takes the drives {safety.watchman_s * 1e3:g} ms after the loop's last tick; they may go off by themselves "
        f"after {safety.drive_timeout_s * 1e3:g} ms"
    )
    remedy = f"safety.watchman_s of at most {safety.drive_timeout_s - _TAKE_OVER_S:g}, or the arm falls before"
    return _finding("profile", "watchman", Level.OK if in_time else Level.WARN, text, remedy)


def drive_findings(robot: Robot, found: Scan) -> list[Finding]:
    """Compare what a scan found with the profile."""
    motors = {motor.id: motor for motor in found.motors}
    findings: list[Finding] = []
    wanted = set()
    for name, drive, mode in drives_of(robot):
        wanted.add(drive.id)
        motor = motors.get(drive.id)
        who = f"{name} (0x{drive.id:02X})"
        if motor is None:
            remedy = "check its power, cable, termination and id, and that bit rate and CAN FD fit"
            findings.append(_finding("drives", who, Level.FAIL, "does not answer", remedy))
            continue
        problems = list(_problems(robot, drive, mode, motor, who))
        findings += problems or [_finding("drives", who, Level.OK, _healthy(motor))]
    for stranger in sorted(set(motors) - wanted):
        text = "answers, but the profile does not know it"
        findings.append(
            _finding("drives", f"0x{stranger:02X}", Level.WARN, text, "is this the right robot and channel?")
        )
    return findings


def _problems(robot: Robot, drive: Drive, mode: ControlMode, motor: FoundMotor, who: str) -> Iterator[Finding]:
    if len(motor.reply_ids) > 1:
        text = f"{len(motor.reply_ids)} motors share this id"
        yield _finding("drives", who, Level.FAIL, text, "unplug all but one, and give each an id of its own")
    elif motor.reply_ids[0] != drive.reply_id:
        text = f"answers on 0x{motor.reply_ids[0]:02X}, the profile says 0x{drive.reply_id:02X}"
        yield _finding("drives", who, Level.FAIL, text, f"set register {Register.MST_ID} (MST_ID), or the profile")
    identity = motor.identity
    if identity is None:
        yield _finding("drives", who, Level.FAIL, "answered once and then no more", "look for a loose contact")
        return
    table = MOTORS[drive.motor]
    if drive.motor not in motor.models:
        text = f"its ranges {_triple(identity.ranges)} are not those of a {drive.motor}, {_triple(table)}"
        yield _finding("drives", who, Level.FAIL, text, "correct the model in the profile, or registers 21 to 23")
    longest = robot.profile.safety.drive_timeout_s
    if not 0.0 < identity.timeout_s <= longest * (1.0 + 1e-9):
        text = f"watchdog {identity.timeout_s * 1e3:g} ms" if identity.timeout_s else "no watchdog"
        remedy = f"set register {Register.TIMEOUT} (TIMEOUT, 50 us a count) to {round(longest / 50e-6)} and save it"
        yield _finding("drives", who, Level.FAIL, text, remedy)
    elif identity.timeout_s < robot.profile.safety.watchman_s + _TAKE_OVER_S:
        text = f"watchdog {identity.timeout_s * 1e3:g} ms: it goes off before the watchman can take it"
        yield _finding("drives", who, Level.WARN, text, "raise its register TIMEOUT, or lower safety.watchman_s")
    if motor.status not in (status_name(0), status_name(1)):
        yield _finding("drives", who, Level.FAIL, f"reports {motor.status}", "remove the cause, then clear the fault")
    if identity.mode != mode:
        text = f"control mode {identity.mode} instead of {mode} ({mode.name})"
        yield _finding("drives", who, Level.WARN, text, "bring-up sets it in RAM; save it to be rid of this")


def _healthy(motor: FoundMotor) -> str:
    assert motor.identity is not None
    watchdog = f"watchdog {motor.identity.timeout_s * 1e3:g} ms"
    return (
        f"{' or '.join(motor.models)}, firmware {motor.identity.software}, {watchdog}, "
        f"{motor.mosfet_temperature}/{motor.rotor_temperature} °C, {motor.status}"
    )


def _finding(area: str, name: str, level: Level, text: str, remedy: str = "") -> Finding:
    return Finding(area, name, level, text, "" if level is Level.OK else remedy)


def _triple(values: tuple[float, ...]) -> str:
    return " / ".join(f"{value:g}" for value in values)
