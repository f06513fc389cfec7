"""The plant: the drive law, brakes, payload and external torques, against closed forms where there are any."""

import numpy as np
import pytest

from robotctl.control.kinematics import Kinematics
from robotctl.hal.robot import Robot, load_robot
from robotctl.sim.plant import PHYSICS_STEP_NS, Plant

MS = 1_000_000


def held(robot: Robot) -> Plant:
    """A plant whose drives hold the home pose with gravity compensated."""
    plant = Plant(robot)
    home = np.array(robot.profile.home)
    plant.place(home)
    gravity = Kinematics(robot).gravity(home)
    for axis, joint in enumerate(robot.profile.joints):
        plant.drive(axis, joint.gains.kp, joint.gains.kd, home[axis], 0.0, gravity[axis])
        plant.settle_lag(axis)
    return plant


def test_time_moves_in_whole_steps(panda: Robot) -> None:
    plant = Plant(panda, start_ns=5)
    plant.advance(5 + PHYSICS_STEP_NS - 1)
    assert plant.time_ns == 5
    plant.advance(5 + 3 * PHYSICS_STEP_NS + 1)
    assert plant.time_ns == 5 + 3 * PHYSICS_STEP_NS
    plant.advance(0)
    assert plant.time_ns == 5 + 3 * PHYSICS_STEP_NS


def test_a_held_arm_stays(robot: Robot) -> None:
    plant = held(robot)
    plant.advance(1000 * MS)
    assert np.abs(plant.truth().position - robot.profile.home).max() < 2e-3


def test_an_arm_lies_in_its_cradle_until_its_drives_come_on(robot: Robot) -> None:
    plant = Plant(robot)
    plant.advance(2000 * MS)
    assert np.abs(plant.truth().position - robot.profile.rest).max() < 1e-2


@pytest.mark.parametrize(("name", "falls"), [("panda", False), ("openarm", True)])
def test_without_torque_brakes_hold_and_others_fall(name: str, falls: bool) -> None:
    robot = load_robot(name)
    plant = held(robot)
    plant.advance(10 * MS)
    for axis in range(robot.dof):
        plant.release(axis)
    plant.advance(1000 * MS)
    moved = np.abs(plant.truth().position - robot.profile.home).max()
    assert bool(moved > 0.2) is falls


def test_the_drive_law_is_kp_kd_and_feed_forward(panda: Robot) -> None:
    plant = held(panda)
    plant.drive(0, 10.0, 2.0, 0.3, 0.5, 1.5)
    plant.advance(PHYSICS_STEP_NS)
    state = plant.axis(0)
    expected = 10.0 * (0.3 - state.position) + 2.0 * (0.5 - state.velocity) + 1.5
    assert state.effort == pytest.approx(expected, rel=0.05)


def test_torque_is_clipped_to_the_profile(panda: Robot) -> None:
    plant = held(panda)
    plant.drive(0, 0.0, 0.0, 0.0, 0.0, 500.0)
    plant.advance(PHYSICS_STEP_NS)
    assert plant.axis(0).effort == panda.limits.torque[0]


def test_a_payload_weighs_on_the_drives() -> None:
    light, heavy = load_robot("panda"), load_robot("panda", ["twin.payload=1.0"])
    plants = [held(robot) for robot in (light, heavy)]
    for plant in plants:
        plant.advance(3000 * MS)
    sag = plants[0].truth().tool[2] - plants[1].truth().tool[2]
    assert sag > 0.01
    jacobian = Kinematics(light).tool_and_jacobian(plants[1].truth().position)[1]
    load = plants[1].truth().effort - Kinematics(light).gravity(plants[1].truth().position)
    np.testing.assert_allclose(load, -jacobian.T @ [0.0, 0.0, -9.81], atol=0.3)


def test_a_push_moves_the_arm_and_ends(panda: Robot) -> None:
    plant = held(panda)
    effort = np.zeros(7)
    effort[0] = 20.0
    plant.push(effort)
    plant.advance(300 * MS)
    pushed = plant.truth().position[0]
    assert pushed > 0.05
    plant.push(np.zeros(7))
    plant.advance(3000 * MS)
    assert plant.truth().position[0] < 0.5 * pushed


def test_a_jammed_joint_stands_however_light_it_is() -> None:
    robot = load_robot("xarm7")
    plant = Plant(robot)
    for axis in range(7):
        plant.drive(axis, 100.0, 2.0, plant.axis(axis).position, 0.0, 0.0)
    plant.data.qvel[6] = 1.5
    where = plant.axis(6).position
    plant.jam(6, jammed=True)
    plant.drive(6, 40.0, 0.5, where + 0.4, 1.0, 0.0)
    plant.advance(500_000_000)
    assert plant.axis(6).position == pytest.approx(where, abs=0.02)
    plant.jam(6, jammed=False)
    plant.advance(2_000_000_000)
    assert plant.axis(6).position == pytest.approx(where + 0.4, abs=0.02)


def test_the_known_payload_hangs_at_the_tool_point_as_the_model_has_it(robot: Robot) -> None:
    loaded = load_robot(robot.profile.name, ["payload=2.0"])
    plant, kinematics, home = Plant(loaded), Kinematics(loaded), np.array(loaded.profile.home)
    plant.place(home)
    load = kinematics.gravity(home) - Kinematics(robot).gravity(home)
    _, jacobian = kinematics.tool_and_jacobian(home)
    assert load == pytest.approx(2.0 * 9.81 * jacobian[2], abs=1e-9)
    assert plant.data.qfrc_bias[: loaded.dof] == pytest.approx(kinematics.gravity(home), abs=0.01)


@pytest.mark.parametrize("error", [-1.0, 0.5])
def test_the_twins_payload_is_what_the_controller_is_not_told(error: float) -> None:
    told = Plant(load_robot("panda", [f"payload={1.0 + error}"]))
    untold = Plant(load_robot("panda", ["payload=1.0", f"twin.payload={error}"]))
    assert untold.model.body_mass.sum() == pytest.approx(told.model.body_mass.sum())
