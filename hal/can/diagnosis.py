"""Does a profile fit the wire, and do the drives on the wire fit the profile? Findings for people; changes nothing."""

from collections.abc import Iterator, Mapping, Sequence
from math import pi

from robotctl.hal.can.bandwidth import cycle_s
from robotctl.hal.can.channel import channel_names, open_channel
from robotctl.hal.can.cia402.scan import examine_drives
from robotctl.hal.can.damiao.codec import Status
from robotctl.hal.can.damiao.faults import status_name
from robotctl.hal.can.damiao.motors import MOTORS
from robotctl.hal.can.damiao.registers import ControlMode, Register
from robotctl.hal.can.damiao.verification import plausible_turns
from robotctl.hal.can.found import FoundMotor
from robotctl.hal.can.interface import interface_findings
from robotctl.hal.can.scan import LAST_ID, sweep
from robotctl.hal.can.ways import Way, own_way, rate_text
from robotctl.hal.clock import Clock
from robotctl.hal.errors import BusError, ConfigError
from robotctl.hal.host import Finding, Level
from robotctl.hal.profile import CLASSIC_HZ, Cia402Drive, DamiaoDrive
from robotctl.hal.robot import Robot

_TAKE_OVER_S = 0.02
"""What the watchman needs to notice, to open a channel and to send."""
_AT_REST = 0.5
"""How far from its rest pose a joint of an arm without brakes may hang, rad; beyond, its zero is in doubt."""
_WARM = 10.0
"""K below the temperature that stops the arm from which a drive is warned of, as the supervisor does."""
_NOWHERE: Mapping[int, Way] = {}
_FASTEST_CLASSIC = 1_000_000
_COMFORTABLE_LOAD = 0.75
"""Bus load above which retransmissions and register traffic find no room."""


def drives_of(robot: Robot) -> list[tuple[str, DamiaoDrive, ControlMode]]:
    """Return name, drive and needed control mode of every DAMIAO drive in a profile, the gripper's last."""
    joints = robot.profile.joints
    drives = [(joint.name, joint.drive, ControlMode.MIT) for joint in joints if isinstance(joint.drive, DamiaoDrive)]
    gripper = robot.profile.gripper
    if gripper and isinstance(gripper.drive, DamiaoDrive):
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
    wire = profile.can
    return [*findings, load_finding(robot, Way(wire.bitrate, wire.fd), "profile"), _watchman_finding(robot)]


def channel_findings(robot: Robot, clock: Clock, name: str) -> list[Finding]:
    """Scan a channel (or one per bus), and compare what answers with the profile. Enables, clears and writes nothing.

    Raises:
        ConfigError: if there are not as many channels as buses.
    """
    if robot.profile.can is None:
        return []
    if robot.profile.buses == 1:
        return _bus_findings(robot, clock, name)
    names = channel_names(name, robot)
    if len(set(names)) < len(names):
        raise ConfigError(f"{name!r} opens all buses of {robot.profile.name} at once", "name a channel for each bus")
    return [found for bus, one in enumerate(names) for found in _bus_findings(robot.on_bus(bus), clock, one)]


def _bus_findings(robot: Robot, clock: Clock, name: str) -> list[Finding]:
    assert robot.profile.can is not None
    ids = {drive.id for _, drive, _ in drives_of(robot)}
    nodes = {joint.drive.id for joint in robot.profile.joints if isinstance(joint.drive, Cia402Drive)}
    way = own_way(name, robot.profile.can)
    try:
        found = sweep(name, robot, clock, max(LAST_ID, *ids, *nodes), ids | nodes)
    except BusError as error:
        return [Finding("bus", name, Level.FAIL, error.what, error.remedy)]
    findings = [finding for finding in found.findings if not finding.name.startswith("0x")]
    if name.startswith("socketcan:"):
        findings += interface_findings(name.removeprefix("socketcan:"), robot.profile.can)
    trips = found.attempts[0].round_trip
    if trips:
        findings.append(_finding("bus", "round trip", Level.OK, f"p50 {trips.p50:.0f} us, p99 {trips.p99:.0f} us"))
    if way.fd != robot.profile.can.fd:
        findings.append(load_finding(robot, way))
    elsewhere = {motor.id: attempt.way for attempt in found.attempts[1:] for motor in attempt.motors}
    findings += node_findings(robot, clock, name)
    return [*findings, *drive_findings(robot, found.motors, way, elsewhere)]


def load_finding(robot: Robot, way: Way, area: str = "bus") -> Finding:
    """Return how much of the bus the drives of a robot take, and the highest tick rate that it allows."""
    profile = robot.profile
    assert profile.can is not None
    wiring = profile.can.model_copy(update={"bitrate": way.bitrate})
    buses = [[drive for drive in profile.drives if drive.bus == bus] for bus in range(profile.buses)]
    cycle, count = max((cycle_s(drives, wiring, way.fd), len(drives)) for drives in buses)
    hz = profile.servo_hz if way.fd else min(profile.servo_hz, CLASSIC_HZ)
    load = cycle * hz
    level = Level.OK if load <= _COMFORTABLE_LOAD else Level.WARN if load < 1.0 else Level.FAIL
    highest = int(_COMFORTABLE_LOAD / cycle)
    text = f"{count} drives at {hz} Hz on {way} load the bus by {load * 100:.0f} %; it allows up to {highest} Hz"
    return _finding(area, "bus load", level, text, f"servo_hz of at most {highest}, or a second bus")


def _watchman_finding(robot: Robot) -> Finding:
    safety = robot.profile.safety
    in_time = safety.watchman_s + _TAKE_OVER_S <= safety.drive_timeout_s
    text = (
        f"takes the drives {safety.watchman_s * 1e3:g} ms after the loop's last tick; they may go off by themselves "
        f"after {safety.drive_timeout_s * 1e3:g} ms"
    )
    remedy = f"safety.watchman_s of at most {safety.drive_timeout_s - _TAKE_OVER_S:g}, or the arm falls before"
    return _finding("profile", "watchman", Level.OK if in_time else Level.WARN, text, remedy)


def drive_findings(
    robot: Robot, found: Sequence[FoundMotor], way: Way | None = None, elsewhere: Mapping[int, Way] = _NOWHERE
) -> list[Finding]:
    """Compare the drives that answered with the profile.

    Args:
        robot: whose profile.
        found: who answered.
        way: how they were asked; None for the profile's.
        elsewhere: who answered in another way, by id.
    """
    motors = {motor.id: motor for motor in found}
    wiring = robot.profile.can
    fd = way.fd if way is not None else wiring is not None and wiring.fd
    findings: list[Finding] = []
    wanted = {drive.id: (name, drive) for name, drive, _ in drives_of(robot)}
    for name, drive, mode in drives_of(robot):
        motor = motors.get(drive.id)
        who = f"{name} (0x{drive.id:02X})"
        if motor is None:
            if drive.id in elsewhere:
                text = f"answers only on {elsewhere[drive.id]}"
                findings.append(_finding("drives", who, Level.FAIL, text, "see the bus above"))
                continue
            others = "the others do: " if motors else ""
            remedy = f"{others}check its power, cable and id" + ("" if motors else ", termination, bit rate and CAN FD")
            findings.append(_finding("drives", who, Level.FAIL, "does not answer", remedy))
            continue
        problems = list(_problems(robot, drive, mode, motor, who))
        problems += _mistaken(drive, motor, who, wanted, motors)
        problems += _condition(robot, motor, who, fd)
        problems += _zero(robot, name, drive, motor, who)
        findings += problems or [_finding("drives", who, Level.OK, _healthy(motor))]
    for stranger in sorted(set(motors) - set(wanted)):
        text = "answers, but the profile does not know it"
        findings.append(
            _finding("drives", f"0x{stranger:02X}", Level.WARN, text, "is this the right robot and channel?")
        )
    return [*findings, *_firmware(found)]


def node_findings(robot: Robot, clock: Clock, channel: str) -> list[Finding]:
    """Read the CiA 402 drives of a profile back, and compare. Writes nothing.

    Raises:
        BusError: if the channel cannot be opened, or the bus is gone.
    """
    findings: list[Finding] = []
    if robot.profile.protocol != "cia402":
        return findings
    opened = open_channel(channel, robot, clock)
    try:
        examined = list(examine_drives(robot, opened, clock))
    finally:
        opened.close()
    for name, node, identity, problems, warnings in examined:
        who = f"{name} (node {node})"
        findings += [_finding("drives", who, Level.FAIL, problem.what, problem.remedy) for problem in problems]
        findings += [_finding("drives", who, Level.WARN, warning) for warning in warnings]
        if identity is not None and not problems:
            watchdog = f"watchdog {identity.timeout_s * 1e3:g} ms"
            text = f"vendor 0x{identity.vendor:X}, product 0x{identity.product:X}, {watchdog}"
            findings.append(_finding("drives", who, Level.OK, text))
    return findings


def _problems(robot: Robot, drive: DamiaoDrive, mode: ControlMode, motor: FoundMotor, who: str) -> Iterator[Finding]:
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
    longest = robot.profile.safety.drive_timeout_s
    if not 0.0 < identity.timeout_s <= longest * (1.0 + 1e-9):
        text = f"watchdog {identity.timeout_s * 1e3:g} ms" if identity.timeout_s else "no watchdog"
        remedy = f"set register {Register.TIMEOUT} (TIMEOUT, 50 us a count) to {round(longest / 50e-6)} and save it"
        yield _finding("drives", who, Level.FAIL, text, remedy)
    elif identity.timeout_s < robot.profile.safety.watchman_s + _TAKE_OVER_S:
        text = f"watchdog {identity.timeout_s * 1e3:g} ms: it goes off before the watchman can take it"
        yield _finding("drives", who, Level.WARN, text, "raise its register TIMEOUT, or lower safety.watchman_s")
    if identity.mode != mode:
        text = f"control mode {identity.mode} instead of {mode} ({mode.name})"
        yield _finding("drives", who, Level.WARN, text, "bring-up sets it in RAM; save it to be rid of this")


def _mistaken(
    drive: DamiaoDrive,
    motor: FoundMotor,
    who: str,
    wanted: Mapping[int, tuple[str, DamiaoDrive]],
    motors: Mapping[int, FoundMotor],
) -> Iterator[Finding]:
    """Look whether this is another motor than the profile says, and whether it has changed places with one."""
    if motor.identity is None or drive.motor in motor.models:
        return
    table = MOTORS[drive.motor]
    text = f"its ranges {_triple(motor.identity.ranges)} are not those of a {drive.motor}, {_triple(table)}"
    remedy = "correct the model in the profile, or registers 21 to 23"
    for other, (name, its) in wanted.items():
        there = motors.get(other)
        if there and its.motor in motor.models and drive.motor in there.models and its.motor not in there.models:
            text += f"; it looks swapped with {name} (0x{other:02X})"
            remedy = "give both their own ids (`robotctl motor set-id`), or exchange their plugs"
    yield _finding("drives", who, Level.FAIL, text, remedy)


def _condition(robot: Robot, motor: FoundMotor, who: str, fd: bool) -> Iterator[Finding]:
    """Look at faults, supply, temperature, and how it answers."""
    if motor.identity is None:
        return
    volts, least = motor.voltage, motor.least_voltage
    starved = volts is not None and least is not None and volts < least
    supply = f", its supply is {volts:.1f} V, it needs {least:.1f}" if starved and volts and least else ""
    if motor.status not in (status_name(Status.DISABLED), status_name(Status.ENABLED)):
        remedy = "look at the supply, its fuse and its cable" if starved else "remove the cause, then clear the fault"
        yield _finding("drives", who, Level.FAIL, f"reports {motor.status}{supply}", remedy)
    elif starved:
        yield _finding(
            "drives", who, Level.FAIL, f"under-voltage{supply}", "look at the supply, its fuse and its cable"
        )
    hottest, limit = max(motor.mosfet_temperature, motor.rotor_temperature), robot.profile.safety.temperature
    if hottest > limit - _WARM:
        level = Level.FAIL if hottest > limit else Level.WARN
        yield _finding("drives", who, level, f"{hottest} °C; the arm is stopped at {limit:g}", "let it cool")
    if fd and 0 < motor.bitrate <= _FASTEST_CLASSIC:
        text = f"is set to {rate_text(motor.bitrate)}, classic CAN; the profile says CAN FD"
        yield _finding(
            "drives",
            who,
            Level.FAIL,
            text,
            "set its register 35 (can_br) to 9 for 5 Mbit/s with the vendor's tool, or `fd: false` in the profile",
        )


def _zero(robot: Robot, name: str, drive: DamiaoDrive, motor: FoundMotor, who: str) -> Iterator[Finding]:
    """Look whether the measured angle can be, and whether it is where an arm without brakes hangs."""
    joints = {joint.name: index for index, joint in enumerate(robot.profile.joints)}
    if name not in joints or motor.identity is None or drive.motor not in motor.models:
        return
    model, turn = robot.description.limits[name], 2.0 * pi / drive.gear
    angle = drive.offset + motor.position / (drive.sign * drive.gear)
    turns = plausible_turns(angle, (model.lower, model.upper), turn)
    remedy = (
        "bring the joint to its zero by hand and `robotctl motor set-zero`; or its ids are swapped, its sign is wrong"
    )
    if not turns:
        text = f"measures {angle:.3f} rad, its range is {model.lower:.3f} to {model.upper:.3f}: its zero is wrong"
        yield _finding("drives", who, Level.FAIL, text, remedy)
        return
    rest = robot.profile.rest[joints[name]]
    away = min(abs(angle - turn * count - rest) for count in turns)
    if not robot.profile.brakes and away > _AT_REST:
        text = (
            f"measures {angle:.3f} rad, {away:.2f} rad from its rest pose: if the arm hangs at rest, its zero is wrong"
        )
        yield _finding("drives", who, Level.WARN, text, remedy)


def _firmware(found: Sequence[FoundMotor]) -> list[Finding]:
    """Look whether drives of one model run one firmware."""
    versions: dict[tuple[str, ...], dict[int, list[int]]] = {}
    for motor in found:
        if motor.identity is not None:
            versions.setdefault(motor.models, {}).setdefault(motor.identity.software, []).append(motor.id)
    mixed = [each for each in versions.values() if len(each) > 1]
    return [
        _finding(
            "drives",
            "firmware",
            Level.WARN,
            "not the same: " + ", ".join(f"{version} on {_ids(ids)}" for version, ids in sorted(each.items())),
            "bring drives of one model to one version; scales and fault codes changed between them",
        )
        for each in mixed
    ]


def _ids(ids: Sequence[int]) -> str:
    return " ".join(f"0x{motor:02X}" for motor in ids)


def _healthy(motor: FoundMotor) -> str:
    assert motor.identity is not None
    watchdog = f"watchdog {motor.identity.timeout_s * 1e3:g} ms"
    supply = f", {motor.voltage:.1f} V" if motor.voltage is not None else ""
    return (
        f"{' or '.join(motor.models)}, firmware {motor.identity.software}, {watchdog}, "
        f"{motor.mosfet_temperature}/{motor.rotor_temperature} °C{supply}, {motor.status}"
    )


def _finding(area: str, name: str, level: Level, text: str, remedy: str = "") -> Finding:
    return Finding(area, name, level, text, "" if level is Level.OK else remedy)


def _triple(values: tuple[float, ...]) -> str:
    return " / ".join(f"{value:g}" for value in values)
