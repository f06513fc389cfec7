"""From what is wanted to the command for the drives: limit, shape, lead the reference, feed forward.

Holds everything that has a memory between two ticks of motion, and nothing that decides whether to move.
"""

import numpy as np

from robotctl.control.collision import CollisionModel
from robotctl.control.kinematics import Kinematics
from robotctl.control.limiter import VelocityLimiter
from robotctl.control.lowering import damp
from robotctl.control.reference import Reference
from robotctl.hal.errors import ConfigError
from robotctl.hal.robot import Robot
from robotctl.hal.types import Command, CommandMode, Sample, Vector
from robotctl.safety.observer import MomentumObserver
from robotctl.safety.region import regions
from robotctl.safety.shaper import Clip, Shaper
from robotctl.safety.stoppable import StoppableMotion
from robotctl.safety.torque import ArmState, TorqueShaper
from robotctl.safety.trip import Trip

_AT_REST = 1e-3
"""Reference speed at which an arm that was stopped may begin to give way, rad/s."""


class Motion:
    """Makes one command per tick. `wanted`, `clip` and `command` tell of the last one."""

    def __init__(self, robot: Robot, kinematics: Kinematics) -> None:
        """Build everything that a motion needs.

        Raises:
            ConfigError: if the profile leads tool or links to where they may not be.
        """
        self.rest = np.zeros(robot.dof)
        """What is wanted of an arm that is to brake and stay."""
        self.reference = Reference(robot, kinematics)
        self._before = self.reference.mark()
        self.wanted: Vector = self.rest
        self.clip = Clip.NONE
        self.command = Command(CommandMode.TRACK, self.rest, self.rest, self.rest)
        self._kinematics = kinematics
        self._limiter = VelocityLimiter(robot)
        self.scene = CollisionModel(robot, kinematics) if robot.profile.collision else None
        self._shaper = Shaper(robot, kinematics, self.scene)
        self.observer = MomentumObserver(robot.dof, kinematics)
        self._torque_shaper = TorqueShaper(robot, kinematics, self.scene)
        self._stoppable = StoppableMotion(robot, kinematics)
        self._torque: Vector | None = None
        self._limits = robot.limits
        self._yielding = robot.profile.safety.reset_scale * robot.limits.velocity * robot.period_ns * 1e-9
        """Way of a servo period in which an arm gives way (n,), rad."""
        self._stale_ns = round(robot.profile.safety.feedback_stop_s * 1e9)
        self._refuse_forbidden_poses(robot)

    def begin(self, position: Vector) -> Command:
        """Return the command that holds a measured pose, and lead on from there."""
        self._torque = None
        self.reference.resync(position, self.rest)
        self.reference.effort = self._kinematics.gravity(position)
        return Command(CommandMode.TRACK, position, self.rest, self.reference.effort)

    def track(self, wanted: Vector, sample: Sample, *, brake: bool, periods: int = 1) -> Command:
        """Return the command for joint velocities (n,), rad/s; with `brake`, for stopping as fast as the caps allow.

        After a late tick `periods` says how many servo periods have passed since the last one: the drives went on
        with the velocity they were given, and the reference has to go with them, proved step by step.
        """
        reference = self.reference
        if self._torque is not None:
            self._torque = None
            reference.resync(sample.position, sample.velocity)
        self.wanted, self.clip = wanted, Clip.NONE
        self._before = reference.mark()
        # What is no longer heard of is taken to be where it was led: an old error must not drive the integrator.
        stale = sample.stamp_ns - int(sample.joint_stamp_ns.min()) > self._stale_ns
        for _ in range(periods):
            velocity = self._shape(wanted, brake)
            self.command = reference.step(velocity, reference.position if stale else sample.position)
        return self.command

    def give_way(self, sample: Sample) -> None:
        """Lead the arm slowly towards where it is pushed, so that its gains do not press against what it touches.

        Not past its limits: there it holds against whatever pushes it.
        """
        reference, most, limits = self.reference, self._yielding, self._limits
        if np.abs(reference.velocity).max() > _AT_REST:
            return  # it brakes first
        way = np.minimum(np.maximum(sample.position - reference.position, -most), most)
        least, farthest = np.minimum(limits.lower, reference.position), np.maximum(limits.upper, reference.position)
        reference.resync(np.minimum(np.maximum(reference.position + way, least), farthest), self.rest)

    def take_back(self) -> None:
        """Go back to before the last command of `track`: it did not leave."""
        self.reference.restore(self._before)

    def _shape(self, wanted: Vector, brake: bool) -> Vector:
        reference = self.reference
        if wanted is self.rest and not reference.velocity.any():
            return self.rest  # at rest, to stay so: outside the limits, too
        if brake:
            limited = self._shaper.brake(reference.velocity)
        else:
            limited = self._limiter.step(wanted, reference.velocity, reference.acceleration)
        tool, jacobian = self._kinematics.tool_and_jacobian(reference.position)
        velocity, clip = self._shaper.step(reference.position, reference.velocity, limited, tool, jacobian)
        self.clip |= clip
        return velocity

    def push(self, torque: Vector, sample: Sample) -> Command | Trip:
        """Return the command for torques (n,), Nm, on top of gravity compensation.

        Or a trip, if braking from the measured motion would end outside a limit: then nothing but `track` may follow.
        """
        effort = self.reference.effort
        position, velocity = self.observer.present(sample, effort)
        trip = self._stoppable.check(position, velocity, sample.stamp_ns)
        if trip is not None:
            return trip
        state = ArmState(position, velocity, effort, self.observer.external)
        self._torque, self.clip = self._torque_shaper.push(state, self._kinematics.gravity(position) + torque)
        self.wanted = torque
        self.reference.effort = self._torque
        self.reference.resync(position, velocity)
        self.command = Command(CommandMode.EFFORT, sample.position, self.rest, self._torque)
        return self.command

    def damp(self, position: Vector, share: float) -> Command:
        """Return the command that damps the joints with a share of their gravity compensated."""
        self.wanted, self.clip = self.rest, Clip.NONE
        self.command = damp(self._kinematics, position, share)
        return self.command

    def _refuse_forbidden_poses(self, robot: Robot) -> None:
        safety, remedy = robot.profile.safety, "change the pose, or what stands in its way"
        for key, values in robot.profile.poses.items():
            pose = np.array(values)
            tool = self._kinematics.tool(pose)
            for region in regions(robot.profile, safety.sphere_margin):
                room = region.room(tool)
                if room < 0.0:
                    what = f"{key}: the tool would be {-1e3 * room:.0f} mm past the bound of {region.name!r}"
                    raise ConfigError(f"{robot.source}: {what}", remedy)
            if self.scene is None:
                continue
            for (one, other), clearance in zip(self.scene.pairs, self.scene.clearances(pose), strict=True):
                if clearance < safety.proximity_stop + safety.proximity_margin:
                    what = f"{key}: {one} and {other} would be {1e3 * clearance:.0f} mm apart"
                    raise ConfigError(f"{robot.source}: {what}", f"{remedy}; or list them in collision.ignore")
