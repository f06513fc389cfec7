"""An arm of CiA 402 drives, in step with SYNC; its gripper may be a DAMIAO drive on the same bus.

In every cycle two PDOs go to each drive, then SYNC makes all of them act at once, and two PDOs come back from each.
The drives close their loops themselves, in cyclic synchronous modes:

    TRACK   position (CSP): target position, velocity offset, torque offset
    DAMP    velocity (CSV): target velocity 0, torque offset
    EFFORT  torque (CST):   target torque 0, torque offset

So what a drive does between two cycles, and when the host falls silent, is what its mode says: it holds a position or
stands still; only in torque mode, which leaves no other choice, a torque goes on until the heartbeat is missed.
"""

from collections.abc import Iterator, Sequence

from robotctl.hal.can.arm import CanArm
from robotctl.hal.can.cia402.codec import SYNC_ID, Mode, Nmt
from robotctl.hal.can.cia402.drive import Drive
from robotctl.hal.can.cia402.machine import Goal, State, controlword
from robotctl.hal.can.cia402.network import HostNetwork
from robotctl.hal.can.cia402.power import CYCLE_S, clear_faults, not_ready, switch_off, switch_on
from robotctl.hal.can.cia402.replay import describe
from robotctl.hal.can.cia402.verification import Expected, Identity, verify_drive
from robotctl.hal.can.damiao.gripper import DamiaoGripper
from robotctl.hal.can.damiao.passenger import Passenger
from robotctl.hal.can.problems import raise_problems
from robotctl.hal.can.transport import Transport
from robotctl.hal.clock import Clock
from robotctl.hal.errors import DriveError, HardwareError
from robotctl.hal.profile import Cia402Drive, DamiaoDrive
from robotctl.hal.robot import Robot
from robotctl.hal.types import Command, CommandMode, Fault, Sample, Sent

_SYNC = (SYNC_ID, b"")
_MODES = {CommandMode.TRACK: Mode.POSITION, CommandMode.DAMP: Mode.VELOCITY, CommandMode.EFFORT: Mode.TORQUE}
_ENABLED_WORD = 0x27
_POLL_PERIOD_NS = 9_500_000
"""Between two SYNCs while the drives are off."""


class Cia402Arm(CanArm):
    """Fulfils `Arm` on a CAN channel. `identities` holds what the drives said of themselves, by joint."""

    def __init__(self, robot: Robot, clock: Clock, channel: str) -> None:
        """Prepare. Opens and sends nothing.

        Raises:
            ConfigError: if the profile has no CAN drives.
        """
        super().__init__(robot, clock, channel)
        profile = robot.profile
        self.identities: dict[str, Identity] = {}
        self._specs = [(joint.name, joint.drive) for joint in profile.joints if isinstance(joint.drive, Cia402Drive)]
        self._expected = [Expected.of(robot, joint) for joint in profile.joints]
        gripper = profile.gripper
        self._passenger = (
            Passenger(gripper, gripper.drive, profile.safety.drive_timeout_s, clock)
            if gripper and isinstance(gripper.drive, DamiaoDrive)
            else None
        )
        self.gripper: DamiaoGripper | None = self._passenger.gripper if self._passenger else None
        self._drives: list[Drive] = []
        self._joints: list[Drive] = self._drives
        self._network: HostNetwork | None = None

    # --- life -------------------------------------------------------------------------------------------------------

    def _attach(self, transport: Transport) -> None:
        self._network = HostNetwork(transport, self._clock)
        self._drives = self._joints = [Drive(name, wiring, self._network) for name, wiring in self._specs]
        if self._passenger:
            self._passenger.attach(transport)

    def verify(self) -> None:
        """Read back from every drive what it is, refuse what the profile does not say, and set its PDOs up in RAM.

        Enables nothing. On return every drive is in NMT state OPERATIONAL, and heard.

        Raises:
            DriveError: if one drive is not as it should be.
            DrivesError: if several are, or one in several ways; it holds them all.
            BusError: if the bus is gone, nobody is on it, or old frames were sent.
        """
        network = self._require_network()
        self._verified = False
        self.warnings.clear()
        self.identities.clear()
        commands = {identifier for drive in self._drives for identifier in drive.commands}
        if self._passenger:
            commands |= self._passenger.commands
        network.prove_empty(max(drive.id for drive in self._drives), commands)
        problems: list[DriveError] = []
        for drive, expected in zip(self._drives, self._expected, strict=True):
            identity, found = verify_drive(drive, expected, self.warnings)
            problems += found
            if identity is not None:
                self.identities[drive.name] = identity
        if self._passenger:
            problems += self._passenger.verify(self.warnings)
        raise_problems(problems)
        for drive in self._drives:
            drive.start(self._clock.now_ns())
        raise_problems(not_ready(self._drives, self._expected, network))
        self._verified = True
        if self._tap is not None:
            self._tap.describe(describe(self._drives))

    def enable(self) -> None:
        """Enable every drive that is not, each holding the pose measured at that moment.

        Raises:
            HardwareError: if the arm is not verified, or a drive is silent, faulty, elsewhere than it can be, or does
                not come on. All drives are then off.
            BusError: if the bus is gone.
        """
        network = self._require_network()
        if not self._verified:
            raise HardwareError("the drives are not verified", "call verify() first")
        for drive in self._drives:
            if drive.nmt == Nmt.PRE_OPERATIONAL and not drive.restarted:
                # It missed the host's heartbeat while it was off, and has kept its PDOs.
                drive.start(self._clock.now_ns())
        problems = not_ready(self._drives, self._expected, network)
        if self._passenger:
            problems += self._passenger.not_ready()
        raise_problems(problems)
        on = all(drive.state is State.ENABLED for drive in self._drives)
        if self._enabled and on and (self._passenger is None or self._passenger.is_on):
            return
        try:
            # What is held must not follow the fall of a drive that comes on later.
            counts = [drive.counts for drive in self._drives]
            switch_on(self._drives, network, lambda: list(self._holding(counts)))
            if self._passenger:
                self._passenger.enable()
        except HardwareError:
            self.disable()
            raise
        self._enabled = True

    def _holding(self, counts: Sequence[int]) -> Iterator[tuple[int, bytes]]:
        efforts = self._feed_forward.tolist()
        for drive, where, effort in zip(self._drives, counts, efforts, strict=True):
            yield from drive.encode(controlword(drive.statusword, Goal.ON), Mode.POSITION, where, 0.0, effort)

    def _take_over(self, command: Command) -> None:
        """Return once every drive has answered, or after 10 ms. The gripper holds its opening, if it has answered."""
        network = self._require_network()
        now = self._clock.now_ns()
        for drive, angle in zip(self._drives, command.position.tolist(), strict=True):
            drive.configured, drive.nmt, drive.beat_ns = True, Nmt.OPERATIONAL, now
            drive.statusword, drive.state = _ENABLED_WORD, State.ENABLED
            drive.position, drive.counts = angle, drive.counts_of(angle)
            drive.beat_period_ns = 1 << 40  # unknown: nothing was read
        self.write(command)
        if self._passenger:
            self._passenger.poll()
        network.wait(lambda: all(drive.heard for drive in self._drives), CYCLE_S)
        if self._passenger:
            self._passenger.take_over()

    def read(self) -> Sample:
        """Return the latest sample; angles are NaN, with stamp 0, until a joint is first heard of.

        While the drives are verified and off they are kept talking by SYNC, and by the host's heartbeat.
        """
        transport = self._require_open()
        transport.drain()
        now = self._clock.now_ns()
        if self._verified and not self._enabled and now - self._polled_ns >= _POLL_PERIOD_NS and not transport.waiting:
            self._poll(transport, now)  # one round may wait for an arm without power, not one after the other
        drives = self._drives
        faults: tuple[Fault, ...] = ()
        for drive in drives:
            fault = drive.fault(now)
            if fault is not None:
                faults += (fault,)
        if self._passenger:
            faults += self._passenger.faults()
        return self._sample(now, faults, None, enabled=all(drive.state is State.ENABLED for drive in drives))

    def write(self, command: Command) -> Sent:
        """Send one cycle. Says in the result what was clipped by the wire's range or kept back.

        A drive that went off by itself is not led back on. While all are off nothing is sent, but the effort is
        remembered: `enable` holds with it.
        """
        transport, network = self._require_open(), self._require_network()
        self._feed_forward = command.effort
        if not self._enabled:
            return Sent(command, "drives are off")
        drives = self._drives
        mode, position, velocity, effort = command
        tracking = mode == CommandMode.TRACK
        frames = network.beat()
        try:
            targets = position.tolist()
            speeds = velocity.tolist() if tracking else self._still
            for drive, q, dq, torque in zip(drives, targets, speeds, effort.tolist(), strict=True):
                word = controlword(drive.statusword, Goal.STAY)
                frames += drive.encode(word, _MODES[mode], drive.counts_of(q) if tracking else drive.counts, dq, torque)
        except (ValueError, OverflowError):
            text = "not sent: a value is not finite, or there are not as many as joints"
            return Sent(command, text, delivered=False)
        frames.append(_SYNC)
        now = self._clock.now_ns()
        count = transport.send_all(frames)
        if transport.refusal:
            return Sent(command, f"not sent: {transport.refusal}", delivered=False)
        if count < len(frames):
            # Without a SYNC none of what did leave takes effect.
            return Sent(command, f"{len(frames) - count} frames were not sent: the transmit queue is full", False)
        for drive in drives:
            drive.expect_reply(now)
        if transport.simulated:
            # The replies are there already: stamp them now, not one tick later.
            transport.drain()
        for drive in drives:
            if drive.saturated or drive.state is not State.ENABLED:
                return self._altered(command)
        return Sent(command)

    def clear_faults(self) -> None:
        """Clear the fault of every drive that reports one. Enables nothing.

        Raises:
            DriveError: if one drive is silent or keeps its fault; DrivesError if several do.
            BusError: if the bus is gone.
        """
        self._require_open()
        clear_faults(self._drives)
        if self._passenger:
            self._passenger.clear()

    # --- about ------------------------------------------------------------------------------------------------------

    def bus_statistics(self) -> dict[str, object] | None:
        passengers = [self._passenger.drive] if self._passenger and self._passenger.drive else []
        return self._count([*self._drives, *passengers])

    # --- parts ------------------------------------------------------------------------------------------------------

    def _switch_off(self) -> None:
        try:
            switch_off(self._drives, self._require_network())
        finally:
            if self._passenger:
                self._passenger.disable()

    def _require_network(self) -> HostNetwork:
        self._require_open()
        assert self._network is not None
        return self._network

    def _poll(self, transport: Transport, now: int) -> None:
        self._polled_ns = now
        frames = self._require_network().beat()
        if transport.send_all([*frames, _SYNC]):
            for drive in self._drives:
                drive.expect_reply(now)
        if self._passenger:
            self._passenger.poll()
        if transport.simulated:
            transport.drain()

    def _altered(self, command: Command) -> Sent:
        """Return why a cycle asked for something else than the command."""
        reasons = []
        clipped = [drive for drive in self._drives if drive.saturated]
        if clipped:
            reasons.append(f"clipped to the wire's range: {', '.join(drive.name for drive in clipped)}")
            for drive in clipped:
                drive.saturated = False
        off = [f"{drive.name} ({drive.state})" for drive in self._drives if drive.state is not State.ENABLED]
        if off:
            reasons.append(f"drives are off: {', '.join(off)}")
        return Sent(command, "; ".join(reasons))
