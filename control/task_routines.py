"""Routines that set a task's scene right again (R3): the tool led along a line, pushing, gripping."""

import numpy as np

from robotctl.control.kinematics import Kinematics
from robotctl.hal.arm import Gripper
from robotctl.hal.robot import Robot
from robotctl.hal.types import Sample, Vector
from robotctl.safety.routines import Goto, Routine

_GAIN = 3.0
"""Approach speed per metre left, 1/s."""
_ARRIVED = 2e-3
"""m"""
_DAMPING = 0.02
_PUSHING_SPEED = 0.05
"""m/s"""
_PRESSED_NS = 100_000_000
"""Time for which a force has to last: speeding up takes torque for a moment, too."""
_SLOW = 0.02
"""Speed below which dry friction fades, rad/s."""
_GRIPPED_NS = 300_000_000
_STANDS = 1e-3
"""m"""
_WIDTH_TOLERANCE = 4e-3
"""m"""


class ToolTo(Routine):
    """The tool straight to a point, by damped least squares: dq = J^T (J J^T + d^2 I)^-1 v (Wampler 1986)."""

    timeout_s = 20.0

    def __init__(self, robot: Robot, kinematics: Kinematics, point: Vector, name: str) -> None:
        safety = robot.profile.safety
        self.name = name
        self._robot = robot
        self._kinematics = kinematics
        self._point = point
        self._cap = safety.reset_scale * robot.limits.velocity
        self._speed = safety.reset_tool_speed

    def velocity(self, sample: Sample, position: Vector) -> Vector | None:
        tool, jacobian = self._kinematics.tool_and_jacobian(position)
        way = self._point - tool
        distance = float(np.linalg.norm(way))
        if distance < _ARRIVED:
            return None
        motion = way * min(_GAIN, self._speed / distance)
        wanted = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + _DAMPING**2 * np.eye(3), motion)
        return np.asarray(wanted / max(1.0, float((np.abs(wanted) / self._cap).max())))


class Push(ToolTo):
    """Slowly towards a point, until it is reached or the tool presses with a force; then the force is let go."""

    def __init__(self, robot: Robot, kinematics: Kinematics, point: Vector, force: float, name: str) -> None:
        super().__init__(robot, kinematics, point, name)
        self._speed = min(self._speed, _PUSHING_SPEED)
        self._force = force
        self._since_ns: int | None = None
        self._letting_go: Goto | None = None

    def velocity(self, sample: Sample, position: Vector) -> Vector | None:
        if self._letting_go is None and self._has_pressed(sample):
            self._letting_go = Goto(self._robot, sample.position, self.name, self._kinematics)
        if self._letting_go is not None:
            return self._letting_go.velocity(sample, position)
        return super().velocity(sample, position)

    def pressing(self, sample: Sample) -> float:
        """Return the force of the tool towards its point, N, from the torques that the arm itself does not explain.

        At rest J^T f = t - g(q), so f = (J J^T)^-1 J (t - g) in the sense of least squares.
        """
        kinematics, position, velocity = self._kinematics, sample.position, sample.velocity
        tool, jacobian = kinematics.tool_and_jacobian(position)
        rubbing = kinematics.damping * velocity + kinematics.friction * np.tanh(velocity / _SLOW)
        unexplained = sample.effort - kinematics.gravity(position) - rubbing
        force = np.linalg.solve(jacobian @ jacobian.T + _DAMPING**2 * np.eye(3), jacobian @ unexplained)
        way = self._point - tool
        return float(force @ way) / max(float(np.linalg.norm(way)), _ARRIVED)

    def _has_pressed(self, sample: Sample) -> bool:
        if self.pressing(sample) < self._force:
            self._since_ns = None
            return False
        if self._since_ns is None:
            self._since_ns = sample.stamp_ns
        return sample.stamp_ns - self._since_ns >= _PRESSED_NS


class Grip(Routine):
    """The gripper to a width, until it stands still there, or around something on the way."""

    timeout_s = 4.0

    def __init__(self, robot: Robot, gripper: Gripper, width: float, force: float, name: str) -> None:
        self.name = name
        self._rest = np.zeros(robot.dof)
        self._gripper = gripper
        self._width = width
        self._force = force
        self._since: tuple[int, float] | None = None
        """Since when the fingers have stood at which width."""

    def velocity(self, sample: Sample, position: Vector) -> Vector | None:
        self._gripper.command(self._width, self._force)
        width = self._gripper.read().width
        is_opening = width < self._width - _WIDTH_TOLERANCE
        if self._since is None or is_opening or abs(width - self._since[1]) > _STANDS:
            self._since = (sample.stamp_ns, width)
        return None if sample.stamp_ns - self._since[0] >= _GRIPPED_NS else self._rest
