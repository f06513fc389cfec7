"""Pinocchio kinematics and dynamics of an arm, without allocation where the tick uses it."""

import tempfile
from pathlib import Path

import numpy as np
import pinocchio as pin

from robotctl.hal.errors import ConfigError
from robotctl.hal.profile import PAYLOAD_GYRATION
from robotctl.hal.robot import Robot
from robotctl.hal.types import Vector, frozen


class Kinematics:
    """The arm's model with the gripper's joints locked half open. All vectors in the order of the profile's joints.

    Frames: positions and Jacobians are of the tool point, in the base frame.
    """

    def __init__(self, robot: Robot) -> None:
        """Build the model.

        Raises:
            ConfigError: if the model's joints or frames are not those of the profile.
        """
        profile = robot.profile
        full = build_model(robot)
        names = [joint.name for joint in profile.joints]
        self.model = pin.buildReducedModel(full, *locked(robot, full, opening=0.5))
        if [name for name in self.model.names if name != "universe"] != names:
            raise ConfigError(
                f"{robot.source}: joints must be listed in the model's order: {list(self.model.names)[1:]}"
            )
        if not self.model.existFrame(profile.tool_frame):
            raise ConfigError(f"{robot.source}: tool_frame {profile.tool_frame!r} is not in the model")
        carrier = self.model.frames[self.model.getFrameId(profile.tool_frame)]
        placement = carrier.placement * pin.SE3(np.eye(3), np.array(profile.tool_offset))
        tool = pin.Frame("robotctl_tool", carrier.parentJoint, carrier.parentFrame, placement, pin.FrameType.OP_FRAME)
        self._tool = self.model.addFrame(tool)
        load = pin.Inertia(profile.payload, np.zeros(3), PAYLOAD_GYRATION * profile.payload * np.eye(3))
        self.model.appendBodyToJoint(carrier.parentJoint, load, placement)
        self.model.armature = self.model.armature + np.array([joint.armature for joint in profile.joints])
        self._data = self.model.createData()
        self._aligned = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        self._still = np.zeros(self.model.nv)
        self.reach = frozen(_reach(self.model, carrier.parentJoint, placement))
        """Length of the chain from each joint to the tool point (n,), m: no joint is further from it. 0 for those that
        do not move it."""
        self.damping = np.array(self.model.damping)
        """Viscous friction of each joint, Nms/rad."""
        self.friction = np.array(self.model.friction)
        """Dry friction of each joint, Nm."""

    def tool(self, position: Vector) -> Vector:
        """Return the tool point (3,), m."""
        pin.forwardKinematics(self.model, self._data, position)
        return np.array(pin.updateFramePlacement(self.model, self._data, self._tool).translation)

    def tool_and_jacobian(self, position: Vector) -> tuple[Vector, Vector]:
        """Return the tool point (3,) and its translational Jacobian (3, n), m/rad."""
        jacobian = pin.computeFrameJacobian(self.model, self._data, position, self._tool, self._aligned)
        return np.array(self._data.oMf[self._tool].translation), jacobian[:3]

    def pose_and_jacobian(self, position: Vector) -> tuple[pin.SE3, Vector]:
        """Return the tool's pose and its Jacobian (6, n): linear rows first."""
        jacobian = pin.computeFrameJacobian(self.model, self._data, position, self._tool, self._aligned)
        return pin.SE3(self._data.oMf[self._tool]), jacobian

    def inverse_dynamics(self, position: Vector, velocity: Vector, acceleration: Vector) -> Vector:
        """Return the torques (n,) of a motion, Nm, without friction."""
        return np.array(pin.rnea(self.model, self._data, position, velocity, acceleration))

    def gravity(self, position: Vector) -> Vector:
        """Return the torques (n,) that hold the arm still, Nm."""
        return np.array(pin.computeGeneralizedGravity(self.model, self._data, position))

    def mass_matrix(self, position: Vector) -> Vector:
        """Return the joint-space inertia (n, n), kg m^2."""
        return np.array(pin.crba(self.model, self._data, position))

    def bias(self, position: Vector, velocity: Vector) -> Vector:
        """Return the torques (n,) that keep the velocities constant, Nm: Coriolis, centrifugal and gravity."""
        return np.array(pin.nonLinearEffects(self.model, self._data, position, velocity))

    def coriolis(self, position: Vector, velocity: Vector) -> Vector:
        """Return C (n, n) with C v the Coriolis and centrifugal torques, such that dM/dt = C + C^T."""
        return np.array(pin.computeCoriolisMatrix(self.model, self._data, position, velocity))

    def tool_drift(self, position: Vector, velocity: Vector) -> Vector:
        """Return dJ/dt v (3,), m/s^2: how the tool point accelerates while the joint velocities stay constant."""
        pin.forwardKinematics(self.model, self._data, position, velocity, self._still)
        return np.array(pin.getFrameClassicalAcceleration(self.model, self._data, self._tool, self._aligned).linear)


def _reach(model: pin.Model, joint: int, tool: pin.SE3) -> Vector:
    reach, far = np.zeros(model.nv), float(np.linalg.norm(tool.translation))
    while joint > 0:
        reach[model.idx_vs[joint]] = far
        far += float(np.linalg.norm(model.jointPlacements[joint].translation))
        joint = model.parents[joint]
    return reach


def locked(robot: Robot, full: pin.Model, opening: float) -> tuple[list[int], Vector]:
    """Return the joints of the whole model that the profile does not move, and where they are locked.

    Args:
        opening: of the gripper, from 0 (closed) to 1.
    """
    names = {joint.name for joint in robot.profile.joints}
    others = [full.getJointId(name) for name in full.names if name != "universe" and name not in names]
    configuration = pin.neutral(full)
    for finger in robot.profile.gripper.fingers if robot.profile.gripper else ():
        if not full.existJointName(finger.name):
            raise ConfigError(f"{robot.source}: gripper: finger {finger.name!r} is not in the model")
        coordinate = full.joints[full.getJointId(finger.name)].idx_q
        configuration[coordinate] = finger.closed + opening * (finger.open - finger.closed)
    return others, configuration


def build_model(robot: Robot) -> pin.Model:
    """Return Pinocchio's model of the whole description, gripper included."""
    description = robot.description
    if description.format == "urdf":
        return pin.buildModelFromXML(description.xml)
    with tempfile.TemporaryDirectory() as folder:  # Pinocchio's MJCF reader takes files only
        path = Path(folder) / "model.xml"
        path.write_text(description.xml)
        return pin.buildModelFromMJCF(str(path))
