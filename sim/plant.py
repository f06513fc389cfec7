"""The MuJoCo plant: an arm whose joints follow the drive law of MIT mode, as real drives do.

Every joint is moved by `torque = kp (p - q) + kd (v - dq) + t`, clipped to its largest torque. MuJoCo evaluates the
law inside its own step, so a drive's feedback loop runs at the physics rate whatever the rate of the commands.
The sim backend and the emulated motors stand in front of the same plant; they differ in how a command reaches it.
"""

from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from robotctl.hal.errors import ConfigError
from robotctl.hal.profile import PAYLOAD_GYRATION, GripperProfile, RobotProfile
from robotctl.hal.robot import Robot
from robotctl.hal.types import Truth, Vector
from robotctl.sim.scene import Scene

PHYSICS_STEP_NS = 1_000_000
WATCHDOG_SHARE = 0.8
"""Watchdog timeout of simulated drives, as a fraction of the longest that the profile allows."""
_BRAKE_TORQUE = 500.0
"""Nm of dry friction that a closed brake adds."""
_BRAKE_ARMATURE = 0.1
"""Least inertia of a joint whose brake is closed, kg m^2."""
_BRAKE_SOLIMP = (0.9999, 0.9999, 0.001, 0.5, 2.0)
"""Impedance of that friction; see MuJoCo's solver parameters."""


class AxisState(NamedTuple):
    """True state of one drive axis, in joint coordinates."""

    position: float
    velocity: float
    effort: float


class Plant:
    """A robot in MuJoCo. Axes 0..n-1 are the arm's joints; axis n, where there is a gripper, its first finger.

    Time moves by `advance`; between two calls the latest drive commands act. Nothing here reads a clock.
    """

    def __init__(self, robot: Robot, start_ns: int = 0, scene: Scene | None = None) -> None:
        """Build the plant at rest where the profile says, all drives off, with a scene around it if there is one."""
        profile = robot.profile
        self.time_ns = start_ns
        self.dof = robot.dof
        self.model, actuators = _build(robot, scene)
        self.data = mujoco.MjData(self.model)
        joints = [joint.name for joint in profile.joints]
        self.axes = robot.dof + (1 if profile.gripper else 0)
        if profile.gripper:
            joints.append(profile.gripper.fingers[0].name)
        ids = [self.model.joint(name).id for name in joints]
        self._qpos = np.array([self.model.jnt_qposadr[i] for i in ids])
        self._dofs = np.array([self.model.jnt_dofadr[i] for i in ids])
        # The arm comes first in every model this package builds, so that its state is a slice.
        if list(self._qpos[: self.dof]) != list(range(self.dof)):
            raise ConfigError(f"{robot.source}: the arm's joints must be the first of the model")
        self._tool_site = self.model.site("robotctl_tool").id
        self._friction = self.model.dof_frictionloss.copy()
        self._solimp = self.model.dof_solimp.copy()
        self._armature = self.model.dof_armature.copy()
        self._weight = self.model.dof_invweight0.copy()
        self._jammed = [False] * self.axes
        # Until its drives come on, an arm lies in its cradle.
        self._braked = [axis < self.dof for axis in range(self.axes)]
        self._largest = self.model.actuator_forcerange[:, 1].copy()
        # Views of MuJoCo's own memory: an item of a memoryview costs a tenth of an item of its arrays, and emulated
        # drives set and read one axis at a time, thousands of times a second.
        self._bias_rows = [_view(self.model.actuator_biasprm[actuator]) for actuator in actuators]
        self._ctrl_view = _view(self.data.ctrl)
        self._force_view = _view(self.data.actuator_force)
        self._qpos_view = _view(self.data.qpos)
        self._qvel_view = _view(self.data.qvel)
        self._addresses = [(int(self._qpos[axis]), int(self._dofs[axis]), actuators[axis]) for axis in range(self.axes)]
        self._lagged = self.model.na > 0
        self._brakes = profile.brakes
        for axis in range(self.axes):
            self.release(axis)
            self._hold(axis)
        self.place(np.array(profile.twin.start or profile.rest))

    def place(self, position: Vector) -> None:
        """Put the arm at rest at `position`, rad. For starts and tests; a real arm has no such thing."""
        self.data.qpos[self._qpos[: self.dof]] = position
        self.data.qvel[:] = 0.0
        mujoco.mj_forward(self.model, self.data)

    def advance(self, to_ns: int) -> None:
        """Step the physics up to the last whole step at or before `to_ns`."""
        steps = (to_ns - self.time_ns) // PHYSICS_STEP_NS
        if steps > 0:
            mujoco.mj_step(self.model, self.data, steps)
            self.time_ns += steps * PHYSICS_STEP_NS

    def drive(self, axis: int, kp: float, kd: float, position: float, velocity: float, effort: float) -> None:
        """Set the law that an enabled drive follows from now on (joint coordinates, SI)."""
        actuator = self._addresses[axis][2]
        bias = self._bias_rows[axis]
        if self._lagged and axis < self.dof:
            self._keep_torque(axis, kp + bias[1], kd + bias[2])
        bias[1] = -kp
        bias[2] = -kd
        if self._braked[axis]:
            self._braked[axis] = False
            self._hold(axis)
        self._ctrl_view[actuator] = kp * position + kd * velocity + effort

    def drive_arm(self, kp: Vector, kd: Vector, position: Vector, velocity: Vector, effort: Vector) -> None:
        """Set the law of all arm joints at once; arrays are (n,)."""
        n = self.dof
        bias = self.model.actuator_biasprm
        if self._lagged:
            self._keep_torque(slice(n), kp + bias[:n, 1], kd + bias[:n, 2])
        bias[:n, 1] = -kp
        bias[:n, 2] = -kd
        self.data.ctrl[:n] = kp * position + kd * velocity + effort

    def _keep_torque(self, axes: int | slice, more_kp: Any, more_kd: Any) -> None:
        """Let the torque go on from where it is when gains change: what lags is the command, not the new gains."""
        data = self.data
        data.act[axes] += more_kp * data.qpos[axes] + more_kd * data.qvel[axes]

    def settle_lag(self, axis: int) -> None:
        """Let the lag of an axis start from its present command, as a drive does that was just enabled."""
        if self._lagged and axis < self.dof:
            self.data.act[axis] = self.data.ctrl[axis]

    def release(self, axis: int) -> None:
        """Switch the drive of an axis off: no torque; the brake, where there is one, closes."""
        bias = self._bias_rows[axis]
        bias[1] = bias[2] = 0.0
        self._ctrl_view[self._addresses[axis][2]] = 0.0
        self.settle_lag(axis)
        if self._brakes and axis < self.dof:
            self._braked[axis] = True
            self._hold(axis)

    def axis(self, axis: int) -> AxisState:
        """Return the true state of one axis."""
        qpos, dof, actuator = self._addresses[axis]
        return AxisState(self._qpos_view[qpos], self._qvel_view[dof], self._force_view[actuator])

    def limit(self, axis: int, effort: float | None) -> None:
        """Bound the drive of an axis to +-`effort`, Nm or N, never above its largest; None takes the bound away."""
        largest = float(self._largest[axis])
        bound = largest if effort is None else min(effort, largest)
        self.model.actuator_forcerange[self._addresses[axis][2]] = (-bound, bound)

    def inertia(self, axis: int) -> float:
        """Return the inertia that an axis feels in the model's zero pose, kg m^2 or kg."""
        return float(self.model.dof_M0[self._dofs[axis]])

    def jam(self, axis: int, jammed: bool) -> None:
        """Let an axis seize up, or run freely again, whatever its drive does."""
        self._jammed[axis] = jammed
        self._hold(axis)

    def truth(self) -> Truth:
        """Return the arm's true state, as copies."""
        n = self.dof
        return Truth(
            self.data.qpos[:n].copy(),
            self.data.qvel[:n].copy(),
            self.data.actuator_force[:n].copy(),
            self.data.site_xpos[self._tool_site].copy(),
        )

    def push(self, effort: Vector) -> None:
        """Apply external torques (n,) to the joints, Nm, until the next call: a person, a wall, a collision."""
        self.data.qfrc_applied[self._dofs[: self.dof]] = effort

    def _hold(self, axis: int) -> None:
        dof = self._dofs[axis]
        held = self._braked[axis] or self._jammed[axis]
        self.model.dof_frictionloss[dof] = _BRAKE_TORQUE if held else self._friction[dof]
        # MuJoCo's dry friction creeps: as it comes, a braked joint slides at 1 mrad/s per rad/s^2 that it keeps back.
        self.model.dof_solimp[dof] = _BRAKE_SOLIMP if held else self._solimp[dof]
        # Nor does it hold a joint that weighs next to nothing, as the last ones of an arm may.
        armature, weight = self._armature[dof], self._weight[dof]
        self.model.dof_armature[dof] = max(armature, _BRAKE_ARMATURE) if held else armature
        self.model.dof_invweight0[dof] = min(weight, 1.0 / _BRAKE_ARMATURE) if held else weight


def _build(robot: Robot, scene: Scene | None) -> tuple[mujoco.MjModel, list[int]]:
    profile = robot.profile
    spec = mujoco.MjSpec.from_string(robot.description.xml)
    spec.option.timestep = PHYSICS_STEP_NS * 1e-9
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    _mark_tool(spec, profile)
    moved = {joint.name for joint in profile.joints}
    moved |= {finger.name for finger in profile.gripper.fingers} if profile.gripper else set()
    for other in [joint for joint in spec.joints if joint.name not in moved]:
        spec.delete(other)  # as in Pinocchio's model: what the profile does not move stays where it is
    for joint in profile.joints:
        spec.joint(joint.name).armature += joint.armature
        _add_drive(spec, joint.name, joint.torque, profile.twin.lag_s)
    if profile.gripper:
        _couple_fingers(spec, profile.gripper)
        _add_drive(spec, profile.gripper.fingers[0].name, profile.gripper.force, 0.0)
    if scene is not None:
        scene.add(spec)
    model = spec.compile()
    return model, list(range(model.nu))


def _view(array: NDArray[np.float64]) -> "memoryview[float]":
    return array.data.cast("B").cast("d")


def _add_drive(spec: mujoco.MjSpec, joint: str, torque: float, lag_s: float) -> None:
    actuator = spec.add_actuator(name=f"drive_{joint}", target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    actuator.gaintype = mujoco.mjtGain.mjGAIN_FIXED
    actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
    actuator.gainprm[0] = 1.0
    actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
    actuator.forcerange = [-torque, torque]
    actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
    if lag_s > 0.0:
        actuator.dyntype = mujoco.mjtDyn.mjDYN_FILTEREXACT
        actuator.dynprm[0] = lag_s


def _mark_tool(spec: mujoco.MjSpec, profile: RobotProfile) -> None:
    body = spec.body(profile.tool_frame)
    position = np.array(profile.tool_offset)
    if body is None:
        site = spec.site(profile.tool_frame)
        body, position = site.parent, site.pos + position
    payload = profile.payload + profile.twin.payload
    body.add_site(name="robotctl_tool", pos=position)
    if payload > 0.0:
        load = body.add_body(name="robotctl_payload", pos=position)
        load.mass = payload
        load.ipos = [0.0, 0.0, 0.0]  # MuJoCo's own default is the body's place in its parent
        load.inertia = [payload * PAYLOAD_GYRATION] * 3
        load.explicitinertial = True


def _couple_fingers(spec: mujoco.MjSpec, gripper: GripperProfile) -> None:
    first = gripper.fingers[0]
    for other in gripper.fingers[1:]:
        ratio = (other.open - other.closed) / (first.open - first.closed)
        coupling = spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, objtype=mujoco.mjtObj.mjOBJ_JOINT)
        coupling.name1, coupling.name2 = other.name, first.name
        coupling.data[:5] = [other.closed - ratio * first.closed, ratio, 0.0, 0.0, 0.0]
