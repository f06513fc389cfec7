"""The MuJoCo backend: commands reach the plant's drives directly, without a bus."""

import math
from collections import deque
from collections.abc import Iterable

import numpy as np

from robotctl.hal.arm import Arm, Gripper, Inspector
from robotctl.hal.backend import Rig
from robotctl.hal.clock import Clock
from robotctl.hal.errors import ConfigError, HardwareError
from robotctl.hal.profile import GripperProfile
from robotctl.hal.robot import Robot
from robotctl.hal.types import Command, CommandMode, Fault, GripperSample, Sample, Sent, Truth, Vector, frozen
from robotctl.sim.motors.thermal import AMBIENT, Thermal
from robotctl.sim.plant import WATCHDOG_SHARE, Plant
from robotctl.sim.scene import Scene

_WARM_NS = 100_000_000
"""Step of the thermal models."""
_COMMUNICATION_LOST = 0xD


def open_sim(robot: Robot, clock: Clock, channel: str = "", scene: Scene | None = None) -> Rig:
    """Return the twin of a robot. Entry point `sim` of the group `robotctl.backends`."""
    if channel:
        raise ConfigError(f"the sim backend has no channel, got {channel!r}", "use --backend can, or drop --channel")
    plant = Plant(robot, clock.now_ns(), scene)
    arm = SimArm(robot, plant, clock)
    gripper = SimGripper(robot.profile.gripper, plant, clock, arm) if robot.profile.gripper else None
    return Rig(arm, gripper)


class SimArm(Arm):
    """An arm in MuJoCo, with the lag, delay, noise and payload of the profile's `twin`.

    Its drives have what real ones have: a watchdog, which switches them off when no command comes, faults, which stay
    until they are cleared, and a temperature.
    """

    def __init__(self, robot: Robot, plant: Plant, clock: Clock, seed: int = 0) -> None:
        self._plant = plant
        self._clock = clock
        self._names = [joint.name for joint in robot.profile.joints]
        self._twin = robot.profile.twin
        self._rng = np.random.default_rng(seed)
        gains = [joint.gains for joint in robot.profile.joints]
        self._kp = np.array([gain.kp for gain in gains])
        self._kd = np.array([gain.kd for gain in gains])
        self._none = np.zeros(robot.dof)
        self._ones = np.ones(robot.dof, dtype=np.int64)
        self._truth = plant.truth()
        self._delay_ns = round(self._twin.delay_s * 1e9)
        self._noisy = self._twin.noise_position > 0.0 or self._twin.noise_velocity > 0.0
        self._waiting: deque[tuple[int, Command]] = deque()
        self._connected = False
        self._enabled = False
        self._inspector: Inspector | None = None
        self.blocked = ""
        """Why no command reaches the drives at present."""
        self._timeout_ns = round(WATCHDOG_SHARE * robot.profile.safety.drive_timeout_s * 1e9)
        self._fed_ns = 0
        self._faults: tuple[Fault, ...] = ()
        self._unpowered: set[int] = set()
        self._off: set[int] = set()
        """Drives that went off by themselves since they were enabled."""
        self._largest = robot.limits.torque
        self._thermals = [Thermal() for _ in self._names]
        self._temperature: Vector = frozen([AMBIENT] * robot.dof)
        self._warm_ns = clock.now_ns() + _WARM_NS

    @property
    def plant(self) -> Plant:
        """What it stands in front of."""
        return self._plant

    @property
    def enabled(self) -> bool:
        """Whether its drives are on."""
        return self._enabled

    @property
    def gains(self) -> tuple[Vector, Vector]:
        """Stiffness (n,), Nm/rad, and damping (n,), Nms/rad, that its drives track with."""
        return self._kp, self._kd

    def fail(self, axes: Iterable[int], code: int, name: str, hint: str) -> None:
        """Let the drives of some joints go off by themselves, with a fault that stays until it is cleared."""
        self._faults += tuple(Fault(self._names[axis], code, name, hint) for axis in axes)
        self._switch_off(axes)

    def power_down(self, axes: Iterable[int]) -> None:
        """Take the supply from some drives: no torque, and nothing kept of their faults."""
        self._unpowered.update(axes)
        names = {self._names[axis] for axis in axes}
        self._faults = tuple(fault for fault in self._faults if fault.joint not in names)
        self._switch_off(axes)

    def power_up(self, axes: Iterable[int]) -> None:
        """Give the supply back; the drives stay off."""
        self._unpowered.difference_update(axes)

    def inspect_with(self, inspector: Inspector) -> None:
        self._inspector = inspector

    def connect(self) -> None:
        self._connected = True

    def verify(self) -> None:
        self._require_connected()
        self._require_healthy()

    def enable(self) -> None:
        self._require_connected()
        self._require_healthy()
        if not self._enabled or self._off:
            refusal = self._inspector.enabling() if self._inspector else ""
            if refusal:
                raise HardwareError(f"the drives were not enabled: {refusal}")
            self._fed_ns = self._clock.now_ns()
            self._plant.advance(self._fed_ns)
            self._enabled = True
            self._off.clear()
            holding = self._holding()
            for axis in range(self._plant.dof):
                self._plant.drive(
                    axis, self._kp[axis], self._kd[axis], holding.position[axis], 0.0, holding.effort[axis]
                )
                self._plant.settle_lag(axis)

    def read(self) -> Sample:
        self._require_connected()
        now = self._clock.now_ns()
        self._deliver(now)
        truth = self._truth = self._plant.truth()
        if now >= self._warm_ns:
            self._warm(truth.effort, now)
        position, velocity = truth.position, truth.velocity
        if self._noisy:
            position = position + self._rng.normal(0.0, self._twin.noise_position, position.shape)
            velocity = velocity + self._rng.normal(0.0, self._twin.noise_velocity, velocity.shape)
        # A drive without power says nothing, so that nothing tells it from one that is on.
        stamps, on = self._ones * now, self._enabled and not self._off - self._unpowered
        return Sample(now, position, velocity, truth.effort, stamps, self._faults, on, self._temperature)

    def write(self, command: Command) -> Sent:
        if not self._enabled:
            return Sent(command, "drives are off")
        if not self._is_sound(command):
            return Sent(command, "not sent: a value is not finite, or there are not as many as joints", delivered=False)
        refusal = self._inspector.command(command) if self._inspector else ""
        if refusal:
            return Sent(command, f"not sent: {refusal}", delivered=False)
        if self.blocked:
            return Sent(command, f"not sent: {self.blocked}", delivered=False)
        self._fed_ns = self._clock.now_ns()
        if self._delay_ns:
            self._waiting.append((self._fed_ns + self._delay_ns, command))
        else:
            self._apply(command)
        return Sent(command)

    def hold(self) -> Sent:
        return self.write(self._holding())

    def disable(self) -> None:
        self._waiting.clear()
        if not self._enabled:
            return
        self._enabled = False
        self._plant.advance(self._clock.now_ns())
        for axis in range(self._plant.axes):
            self._plant.release(axis)

    def clear_faults(self) -> None:
        self._require_connected()
        self._faults = ()

    def close(self) -> None:
        self._connected = False

    def truth(self) -> Truth:
        """Return the true state at the last `read`."""
        return self._truth

    def _holding(self) -> Command:
        position = self._plant.truth().position
        # An ideal drive's own integrator would find this effort; here the plant knows it.
        gravity = self._plant.data.qfrc_bias[: self._plant.dof].copy()
        return Command(CommandMode.TRACK, position, self._none, gravity)

    def _is_sound(self, command: Command) -> bool:
        """Return whether the plant can take a command: MuJoCo would start anew after one that is not finite."""
        _, position, velocity, effort = command
        if not len(position) == len(velocity) == len(effort) == self._plant.dof:
            return False
        # Whatever is not finite stays so in a product with itself: cheaper than asking every value.
        return math.isfinite(position @ position + velocity @ velocity + effort @ effort)

    def _deliver(self, now: int) -> None:
        """Let time pass until `now`; what falls due on the way happens at its own time."""
        bites = self._fed_ns + self._timeout_ns
        if self._enabled and now >= bites and len(self._off) < self._plant.dof:
            self._pass(bites)
            hint = "no command came within the drive's watchdog; find why the loop fell silent"
            axes = set(range(self._plant.dof)) - self._off
            self.fail(sorted(axes), _COMMUNICATION_LOST, "COMMUNICATION_LOST", hint)
        self._pass(now)

    def _switch_off(self, axes: Iterable[int]) -> None:
        self._off.update(axes)
        for axis in axes:
            self._plant.release(axis)

    def _pass(self, now: int) -> None:
        while self._waiting and self._waiting[0][0] <= now:
            due, command = self._waiting.popleft()
            self._plant.advance(due)
            self._apply(command)
        self._plant.advance(now)

    def _apply(self, command: Command) -> None:
        match command.mode:
            case CommandMode.TRACK:
                kp, kd = self._kp, self._kd
            case CommandMode.EFFORT:
                kp, kd = self._none, self._none
            case CommandMode.DAMP:
                kp, kd = self._none, self._kd
        velocity = command.velocity if command.mode is CommandMode.TRACK else self._none
        effort = command.effort
        if self._off:
            alive = np.array([axis not in self._off for axis in range(self._plant.dof)], dtype=np.float64)
            kp, kd, effort = alive * kp, alive * kd, alive * effort
        self._plant.drive_arm(kp, kd, command.position, velocity, effort)

    def _warm(self, effort: Vector, now: int) -> None:
        self._warm_ns = now + _WARM_NS
        for thermal, load in zip(self._thermals, (effort / self._largest).tolist(), strict=True):
            thermal.step(load, _WARM_NS * 1e-9)
        self._temperature = frozen([max(thermal.mosfet, thermal.rotor) for thermal in self._thermals])

    def _require_healthy(self) -> None:
        if self._unpowered:
            silent = ", ".join(self._names[axis] for axis in sorted(self._unpowered))
            raise HardwareError(f"no answer from {silent}", "check the supply of the drives")
        if self._faults:
            faults = ", ".join(f"{fault.joint} reports {fault.name}" for fault in self._faults)
            raise HardwareError(faults, f"{self._faults[0].hint}; then clear the fault")

    def _require_connected(self) -> None:
        if not self._connected:
            raise HardwareError("the arm is not connected", "call connect() first")


class SimGripper(Gripper):
    """A gripper in MuJoCo: its fingers go to the commanded width at the profile's speed.

    Its drive goes on and off with the arm's; what was commanded before is forgotten when it does.
    """

    def __init__(self, profile: GripperProfile, plant: Plant, clock: Clock, arm: SimArm) -> None:
        self._profile = profile
        self._plant = plant
        self._clock = clock
        self._arm = arm
        self._axis = plant.dof
        self._target: float | None = None
        self._reference = 0.0
        self._stepped_ns = 0

    def command(self, width: float, force: float) -> None:
        check_grip(self._profile, width, force)
        if not self._arm.enabled:
            return
        self._plant.limit(self._axis, force)
        if self._target is None:
            self._reference = self.read().width
            self._stepped_ns = self._clock.now_ns()
        self._target = width

    def read(self) -> GripperSample:
        finger = self._profile.fingers[0]
        state = self._plant.axis(self._axis)
        width = self._profile.width * (state.position - finger.closed) / (finger.open - finger.closed)
        return GripperSample(self._clock.now_ns(), width, abs(state.effort))

    def step(self) -> None:
        if not self._arm.enabled:
            self._target = None
        if self._target is None:
            return
        now = self._clock.now_ns()
        reach = self._profile.speed * (now - self._stepped_ns) * 1e-9
        self._stepped_ns = now
        self._reference += max(-reach, min(reach, self._target - self._reference))
        finger = self._profile.fingers[0]
        position = finger.closed + (finger.open - finger.closed) * self._reference / self._profile.width
        gains = self._profile.gains
        self._plant.drive(self._axis, gains.kp, gains.kd, position, 0.0, 0.0)


def check_grip(profile: GripperProfile, width: float, force: float) -> None:
    """Refuse what the gripper cannot do.

    Raises:
        ValueError: if a value is not finite or out of the profile's range.
    """
    if not 0.0 <= width <= profile.width:
        raise ValueError(f"gripper width {width} m is outside 0..{profile.width}")
    if not 0.0 < force <= profile.force:
        raise ValueError(f"grip force {force} N is outside 0..{profile.force}")
