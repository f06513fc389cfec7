"""Both engines are fed one description, and agree on it."""

from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from robotctl.control.kinematics import Kinematics
from robotctl.hal.description import load_description, locate
from robotctl.hal.errors import ConfigError
from robotctl.hal.robot import Robot
from robotctl.sim.plant import Plant

STATES = 1000


def test_pinocchio_and_mujoco_agree_on_random_states(robot: Robot) -> None:
    kinematics, plant = Kinematics(robot), Plant(robot)
    for axis in range(plant.axes):
        plant.drive(axis, 0.0, 0.0, 0.0, 0.0, 0.0)  # brakes open: a braked joint is made heavier
    model, data, n = plant.model, plant.data, robot.dof
    fingers = robot.profile.gripper.fingers if robot.profile.gripper else []
    tool = model.site("robotctl_tool").id
    rng = np.random.default_rng(7)
    worst = dict.fromkeys(("tool", "jacobian", "gravity", "mass"), 0.0)
    linear, angular, mass = np.zeros((3, model.nv)), np.zeros((3, model.nv)), np.zeros((model.nv, model.nv))
    for _ in range(STATES):
        q = rng.uniform(robot.limits.lower, robot.limits.upper)
        data.qpos[:n] = q
        for finger in fingers:
            data.qpos[model.joint(finger.name).qposadr[0]] = 0.5 * (finger.closed + finger.open)
        data.qvel[:] = 0.0
        mujoco.mj_forward(model, data)
        pose, jacobian = kinematics.pose_and_jacobian(q)
        mujoco.mj_jacSite(model, data, linear, angular, tool)
        mujoco.mj_fullM(model, data, mass)
        worst["tool"] = max(worst["tool"], np.abs(pose.translation - data.site_xpos[tool]).max())
        stacked = np.vstack([linear[:, :n], angular[:, :n]])
        worst["jacobian"] = max(worst["jacobian"], np.abs(jacobian - stacked).max())
        worst["gravity"] = max(worst["gravity"], np.abs(kinematics.gravity(q) - data.qfrc_bias[:n]).max())
        ours = kinematics.mass_matrix(q)
        worst["mass"] = max(worst["mass"], np.abs(ours - mass[:n, :n]).max() / np.abs(ours).max())
    assert worst["tool"] < 1e-9, worst
    assert worst["jacobian"] < 1e-8, worst
    assert worst["gravity"] < 1e-8, worst
    assert worst["mass"] < 1e-8, worst


def test_reach_bounds_every_jacobian(robot: Robot) -> None:
    kinematics = Kinematics(robot)
    rng = np.random.default_rng(1)
    for _ in range(300):
        _, jacobian = kinematics.tool_and_jacobian(rng.uniform(robot.limits.lower, robot.limits.upper))
        assert (np.linalg.norm(jacobian, axis=0) <= kinematics.reach + 1e-12).all()


def test_a_body_alone_under_the_world_keeps_its_place() -> None:
    """Pinocchio's MJCF reader drops its offset, unless it stands inside a root."""
    path = locate("openarm_mujoco", "openarm_mujoco/v2/openarm_bimanual.xml")
    left = load_description(path, "openarm_left_base_link")
    right = load_description(path, "openarm_right_base_link")
    assert "openarm_right_joint1" in right.limits
    assert "openarm_left_joint1" not in right.limits
    assert "openarm_left_joint7" in left.limits


def test_a_continuous_joint_is_one_coordinate(tmp_path: Path) -> None:
    path = tmp_path / "wheel.urdf"
    path.write_text(
        """<robot name="wheel"><link name="a"/><link name="b"><inertial><mass value="1"/>
        <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
        <joint name="j" type="continuous"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>
        <limit effort="5" velocity="2"/></joint></robot>"""
    )
    description = load_description(path)
    assert pin.buildModelFromXML(description.xml).nq == 1
    assert description.limits["j"].velocity == 2.0


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("<robot><link", "not well-formed"),
        ("<sdf/>", "neither a URDF nor an MJCF"),
        ("<mujoco><worldbody><body name='x'/></worldbody></mujoco>", "no body None under worldbody"),
    ],
)
def test_bad_models_are_refused(tmp_path: Path, text: str, complaint: str) -> None:
    path = tmp_path / "model.xml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=complaint):
        load_description(path)


def test_a_missing_package_or_file_says_what_to_do() -> None:
    with pytest.raises(ConfigError, match="pip install no-such-robots"):
        locate("no-such-robots", "x.urdf")
    with pytest.raises(ConfigError, match="0 files"):
        locate("example-robot-data", "no_such_description/x.urdf")
    with pytest.raises(ConfigError, match="does not exist"):
        locate("", "/nowhere/x.urdf")
