"""An arm of DAMIAO drives in MIT mode, with the gripper on the same bus.

What matters is what a drive was told last, so every way into motion ends at the measured pose, and every way out is
confirmed by the drives. A cycle is one frame per joint and one reply each: the reply to the command of this tick is
the sample of the next one, stamped with the time it arrived.
"""

from collections.abc import Sequence

import numpy as np

from robotctl.hal.can.arm import CanArm
from robotctl.hal.can.damiao.codec import KD_MAX, KP_MAX, Special, Status
from robotctl.hal.can.damiao.drive import CONFIRM_TIMEOUT_S, TRIES, Drive, Identity
from robotctl.hal.can.damiao.faults import fault_of, status_name
from robotctl.hal.can.damiao.gripper import DamiaoGripper
from robotctl.hal.can.damiao.motors import MOTORS
from robotctl.hal.can.damiao.power import clear_faults, not_ready, switch_off
from robotctl.hal.can.damiao.registers import ControlMode
from robotctl.hal.can.damiao.replay import describe
from robotctl.hal.can.damiao.verification import Eavesdropper, Expected, verify_drive
from robotctl.hal.can.problems import raise_problems
from robotctl.hal.can.transport import Transport, route_key
from robotctl.hal.clock import Clock
from robotctl.hal.errors import ConfigError, DriveError, HardwareError
from robotctl.hal.profile import DamiaoDrive as DriveProfile
from robotctl.hal.robot import Robot
from robotctl.hal.types import Command, CommandMode, Fault, Sample, Sent, Vector

_POLL_PERIOD_NS = 3_500_000
"""Between two requests for feedback while the drives are off; every second tick at 500 Hz, 40 % load on FD."""

_LEAST_DAMPING = 0.5
"""Nms/rad of the motor in DAMP, where a profile's kd is smaller: damping has to stop an arm without brakes."""


class DamiaoArm(CanArm):
    """Fulfils `Arm` on a CAN channel. `identities` holds what the drives said of themselves, by joint."""

    def __init__(self, robot: Robot, clock: Clock, channel: str) -> None:
        """Prepare. Opens and sends nothing.

        Raises:
            ConfigError: if the profile has no CAN drives, or asks for what the wire cannot carry.
        """
        super().__init__(robot, clock, channel)
        profile = robot.profile
        self.identities: dict[str, Identity] = {}
        self.gripper: DamiaoGripper | None = None
        self._specs = [(joint.name, joint.drive) for joint in profile.joints if isinstance(joint.drive, DriveProfile)]
        self._expected = [
            self._expect(joint.name, joint.drive) for joint in profile.joints if isinstance(joint.drive, DriveProfile)
        ]
        if profile.gripper and isinstance(profile.gripper.drive, DriveProfile):
            self.gripper = DamiaoGripper(profile.gripper, clock)
            drive = profile.gripper.drive
            # The gripper's angle is mapped by motor_open, so its drive stays in the motor's own radians.
            self._specs.append(("gripper", drive.model_copy(update={"sign": 1, "gear": 1.0, "offset": 0.0})))
            self._expected.append(
                Expected(drive.motor, ControlMode.POS_FORCE, profile.safety.drive_timeout_s, None, 2.0 * np.pi)
            )
        _check(robot, self._specs)
        self._drives: list[Drive] = []
        self._joints: list[Drive] = []
        self._gains: dict[CommandMode, list[int]] = {}

    # --- life -------------------------------------------------------------------------------------------------------

    def _attach(self, transport: Transport) -> None:
        self._drives = [
            Drive(
                name,
                spec.id,
                spec.reply_id,
                MOTORS[spec.motor],
                transport,
                self._clock,
                spec.sign * spec.gear,
                spec.offset,
            )
            for name, spec in self._specs
        ]
        self._joints = self._drives[: self._robot.dof]
        gains = [joint.gains for joint in self._robot.profile.joints]
        pairs = list(zip(self._joints, gains, strict=True))
        self._gains = {
            CommandMode.TRACK: [drive.gains(gain.kp, gain.kd) for drive, gain in pairs],
            CommandMode.EFFORT: [drive.gains(0.0, 0.0) for drive in self._joints],
            CommandMode.DAMP: [
                drive.gains(0.0, max(gain.kd, _LEAST_DAMPING * drive.scale**2)) for drive, gain in pairs
            ],
        }
        if self.gripper:
            self.gripper.attach(self._drives[-1], transport)

    def verify(self) -> None:
        """Read back from every drive what it is, and refuse what the profile does not say. Enables nothing.

        Raises:
            DriveError: if one drive is not as it should be.
            DrivesError: if several are, or one in several ways; it holds them all.
            BusError: if the bus is gone, nobody is on it, or old frames were sent.
        """
        transport = self._require_open()
        self._verified = False
        self.warnings.clear()
        self.identities.clear()
        commands = {identifier for drive in self._drives for identifier in drive.commands}
        transport.prove_empty(self._drives[0].question, commands)
        others = Eavesdropper()
        transport.listener = others
        problems: list[DriveError] = []
        try:
            for drive, expected in zip(self._drives, self._expected, strict=True):
                identity, found = verify_drive(drive, expected, others, self.warnings)
                problems += found
                if identity is not None:
                    self.identities[drive.name] = identity
                if drive.status == Status.ENABLED:
                    self.warnings.append(f"{drive.name}: was already enabled")
        finally:
            transport.listener = None
        raise_problems(problems)
        self._verified = True
        if self._tap is not None:
            self._tap.describe(describe(self._drives, self._robot.dof))

    def enable(self) -> None:
        """Enable every drive that is not, each holding the pose measured at that moment.

        Raises:
            HardwareError: if the arm is not verified, or a drive is silent, faulty, elsewhere than when it was
                verified, or does not enable. All drives are then disabled again.
            BusError: if the bus is gone.
        """
        transport = self._require_open()
        if not self._verified:
            raise HardwareError("the drives are not verified", "call verify() first")
        raise_problems(not_ready(self._drives, self._expected))
        if self._enabled and all(drive.status == Status.ENABLED for drive in self._drives):
            return
        try:
            self._enable_all(transport)
        except HardwareError:
            self.disable()
            raise
        self._enabled = True

    def _take_over(self, command: Command) -> None:
        """Return once every drive has answered, or after 20 ms. Their ranges are taken to be the profile's motors'.

        The gripper, if it has answered, holds its opening.
        """
        transport, drives, angles = self._require_open(), self._drives, command.position.tolist()
        for drive, angle in zip(self._joints, angles, strict=True):
            drive.position = angle
        self.write(command)
        if self.gripper:
            drives[-1].poll()
        transport.wait(lambda: all(drive.heard for drive in drives), CONFIRM_TIMEOUT_S)
        for drive, expected, angle in zip(self._joints, self._expected, angles, strict=False):
            drive.fold_near(angle, expected.turn)
        if self.gripper and drives[-1].heard:
            self.gripper.engage()

    def read(self) -> Sample:
        """Return the latest sample; angles are NaN, with stamp 0, until a joint is first heard of.

        While the drives are verified and off it asks them for feedback.
        """
        transport = self._require_open()
        transport.drain()
        now = self._clock.now_ns()
        if self._verified and not self._enabled and now - self._polled_ns >= _POLL_PERIOD_NS and not transport.waiting:
            self._poll(transport, now)  # one round may wait for an arm without power, not one after the other
        joints = self._joints
        enabled = True
        faults: tuple[Fault, ...] = ()
        for drive in joints:
            if drive.status != 1:
                enabled = False
        for drive in self._drives:
            if drive.status > 1:
                faults += (fault_of(drive.name, drive.status),)
        hottest = [float(max(drive.mosfet_temperature, drive.rotor_temperature)) for drive in joints]
        return self._sample(now, faults, np.array(hottest), enabled=enabled)

    def write(self, command: Command) -> Sent:
        """Send one MIT frame per joint. Says in the result what was clipped by the wire's range or kept back.

        While the drives are off nothing is sent, but the effort is remembered: `enable` holds with it.
        """
        self._require_open()
        self._feed_forward = command.effort
        if not self._enabled:
            return Sent(command, "drives are off")
        try:
            frames = self.encode(command)
        except (ValueError, OverflowError):
            text = "not sent: a value is not finite, or there are not as many as joints"
            return Sent(command, text, delivered=False)
        return self.send(command, frames)

    def encode(self, command: Command) -> list[tuple[int, bytes]]:
        """Return the frames (id, data) of a command, one per joint.

        Raises:
            ValueError, OverflowError: if a value is not finite, or there are not as many as joints.
        """
        joints = self._joints
        mode, position, velocity, effort = command
        if mode == CommandMode.TRACK:
            targets, speeds = position.tolist(), velocity.tolist()
        else:
            # kp is 0, so the angle has no effect; the measured one is what a reader of the log expects.
            targets, speeds = [drive.position for drive in joints], self._still
        return [
            (drive.id, drive.encode(q, dq, torque, gains))
            for drive, q, dq, torque, gains in zip(
                joints, targets, speeds, effort.tolist(), self._gains[mode], strict=True
            )
        ]

    def send(self, command: Command, frames: Sequence[tuple[int, bytes]]) -> Sent:
        """Send what `encode` made of a command to drives that are on; the rest of `write`."""
        transport, joints = self._require_open(), self._joints
        self._feed_forward = command.effort
        now = self._clock.now_ns()
        count = transport.send_all(frames)
        if transport.refusal:
            return Sent(command, f"not sent: {transport.refusal}", delivered=False)
        for drive in joints[:count]:
            if drive.reply_pending:
                drive.missed += 1
            drive.reply_pending = True
            drive.sent_ns = now
        if transport.simulated:
            # The replies are there already: stamp them now, not one tick later.
            transport.drain()
        if count < len(frames):
            text = f"{len(frames) - count} frames were not sent: nothing leaves, or the transmit queue is full"
            return Sent(command, text, delivered=False)
        for drive in joints:
            if drive.saturated or drive.status != 1:
                return self._altered(command, frames)
        return Sent(command)

    def clear_faults(self) -> None:
        """Clear the fault of every drive that reports one. Enables nothing.

        Raises:
            DriveError: if one drive is silent or keeps its fault; DrivesError if several do.
            BusError: if the bus is gone.
        """
        self._require_open()
        clear_faults(self._drives)

    # --- about ------------------------------------------------------------------------------------------------------

    def bus_statistics(self) -> dict[str, object] | None:
        """Return the counters since `connect`; they outlive `close`. `missed_by_joint` counts per drive."""
        return self._count(self._drives)

    # --- parts ------------------------------------------------------------------------------------------------------

    def _switch_off(self) -> None:
        switch_off(self._drives, self._require_open())

    def _expect(self, joint: str, drive: DriveProfile) -> Expected:
        model = self._robot.description.limits[joint]
        turn = 2.0 * np.pi / drive.gear
        timeout = self._robot.profile.safety.drive_timeout_s
        return Expected(drive.motor, ControlMode.MIT, timeout, (model.lower, model.upper), turn)

    def _poll(self, transport: Transport, now: int) -> None:
        self._polled_ns = now
        for drive in self._drives:
            drive.expect_reply(now)
            drive.reply_pending = drive.poll()
        if transport.simulated:
            transport.drain()

    def _enable_all(self, transport: Transport) -> None:
        holding: list[tuple[Drive, bytes]] = []
        for drive in self._drives:
            # The watchdogs of those that hold already run while this one is waited for.
            for _ in range(TRIES):
                if drive.answers(Special.ENABLE) and drive.status == Status.ENABLED:
                    break
                transport.send_all([(held.id, frame) for held, frame in holding])
            else:
                name = status_name(drive.status)
                raise drive.error(f"did not enable in {TRIES} tries, its status is {name}", "check its supply")
            if len(holding) < len(self._joints):
                index = len(holding)
                effort = float(self._feed_forward[index])
                frame = drive.encode(drive.position, 0.0, effort, self._gains[CommandMode.TRACK][index])
                holding.append((drive, frame))
                transport.send_all([(drive.id, frame)])
            elif self.gripper:
                self.gripper.engage()
        marks = [(drive, drive.heard) for drive, _ in holding]
        transport.send_all([(drive.id, frame) for drive, frame in holding])
        transport.wait(lambda: all(drive.heard > mark for drive, mark in marks), CONFIRM_TIMEOUT_S)
        raise_problems(
            [
                drive.error(f"did not stay enabled, its status is {status_name(drive.status)}", "check its supply")
                for drive in self._drives
                if drive.status != Status.ENABLED
            ]
        )

    def _altered(self, command: Command, frames: Sequence[tuple[int, bytes]]) -> Sent:
        """Return what a cycle really asked for, and why that is not the command."""
        reasons = []
        clipped = [drive for drive in self._joints if drive.saturated]
        if clipped:
            reasons.append(f"clipped to the wire's range: {', '.join(drive.name for drive in clipped)}")
            asked = (command.position.copy(), command.velocity.copy(), command.effort.copy())
            for index, drive in enumerate(self._joints):
                if drive.saturated:
                    drive.saturated = False
                    for array, value in zip(asked, drive.decode(frames[index][1]), strict=True):
                        array[index] = value
            command = Command(command.mode, *(_locked(array) for array in asked))
        off = [
            f"{drive.name} ({status_name(drive.status)})" for drive in self._joints if drive.status != Status.ENABLED
        ]
        if off:
            reasons.append(f"drives are off: {', '.join(off)}")
        return Sent(command, "; ".join(reasons))


def _locked(array: Vector) -> Vector:
    array.flags.writeable = False
    return array


def _check(robot: Robot, specs: Sequence[tuple[str, DriveProfile]]) -> None:
    """Refuse what the wire cannot carry.

    Raises:
        ConfigError: naming every joint concerned.
    """
    problems = []
    seen: dict[int, str] = {}
    for name, spec in specs:
        if spec.motor not in MOTORS:
            problems.append(f"{name}: unknown motor {spec.motor!r}; known are {', '.join(MOTORS)}")
        key = route_key(spec.reply_id, spec.id)
        if key in seen:
            problems.append(f"{name}: replies on 0x{spec.reply_id:02X} cannot be told from those of {seen[key]}")
        seen.setdefault(key, name)
    for joint in robot.profile.joints:
        square = joint.drive.gear**2 if joint.drive else 1.0
        if joint.gains.kp / square > KP_MAX or joint.gains.kd / square > KD_MAX:
            problems.append(
                f"{joint.name}: the drive takes kp up to {KP_MAX * square:g} and kd up to {KD_MAX * square:g}"
            )
    if problems:
        raise ConfigError("\n".join(f"{robot.source}: {problem}" for problem in problems), "correct the profile")
