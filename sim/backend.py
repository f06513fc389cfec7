"""The MuJoCo backend: commands reach the plant's drives directly, without a bus."""

import math
from collections import deque

import numpy as np

from robotctl.hal.arm import Arm, Gripper, Inspector
from robotctl.hal.backend import Rig
from robotctl.hal.clock import Clock
from robotctl.hal.errors import ConfigError, HardwareError
from robotctl.hal.profile import GripperProfile
from robotctl.hal.robot import Robot
from robotctl.hal.types import Command, CommandMode, GripperSample, Sample, Sent, Truth
from robotctl.sim.plant import Plant


def open_sim(robot: Robot, clock: Clock, channel: str = "") -> Rig:
    """Return the twin of a robot. Entry point `sim` of the group `robotctl.backends`."""
    if channel:
        raise ConfigError(f"the sim backend has no channel, got {channel!r}", "use --backend can, or drop --channel")
    plant = Plant(robot, clock.now_ns())
    arm = SimArm(robot, plant, clock)
    gripper = SimGripper(robot.profile.gripper, plant, clock, arm) if robot.profile.gripper else None
    return Rig(arm, gripper)


class SimArm(Arm):
    """An arm in MuJoCo, with the lag, delay, noise and payload of the profile's `twin`."""

    def __init__(self, robot: Robot, plant: Plant, clock: Clock, seed: int = 0) -> None:
        self._plant = plant
        self._clock = clock
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

    @property
    def enabled(self) -> bool:
        """Whether its drives are on."""
        return self._enabled

    def inspect_with(self, inspector: Inspector) -> None:
        self._inspector = inspector

    def connect(self) -> None:
        self._connected = True

    def verify(self) -> None:
        self._require_connected()

    def enable(self) -> None:
        self._require_connected()
        if not self._enabled:
            refusal = self._inspector.enabling() if self._inspector else ""
            if refusal:
                raise HardwareError(f"the drives were not enabled: {refusal}")
            self._plant.advance(self._clock.now_ns())
            self._enabled = True
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
        position, velocity = truth.position, truth.velocity
        if self._noisy:
            position = position + self._rng.normal(0.0, self._twin.noise_position, position.shape)
            velocity = velocity + self._rng.normal(0.0, self._twin.noise_velocity, velocity.shape)
        return Sample(now, position, velocity, truth.effort, self._ones * now, (), self._enabled)

    def write(self, command: Command) -> Sent:
        if not self._enabled:
            return Sent(command, "drives are off")
        if not self._is_sound(command):
            return Sent(command, "not sent: a value is not finite, or there are not as many as joints", delivered=False)
        refusal = self._inspector.command(command) if self._inspector else ""
        if refusal:
            return Sent(command, f"not sent: {refusal}", delivered=False)
        if self._delay_ns:
            self._waiting.append((self._clock.now_ns() + self._delay_ns, command))
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
        self._plant.drive_arm(kp, kd, command.position, velocity, command.effort)

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
