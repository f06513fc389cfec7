"""Scenes: what stands around the arm touches the tool alone, and leaves the arm itself as it was."""

import mujoco
import numpy as np
import pytest

from robotctl.hal.robot import Robot, load_robot
from robotctl.sim.plant import Plant
from robotctl.sim.scene import Block, Door

PADS = {"panda_leftfinger": (0.0, 0.004, 0.045), "panda_rightfinger": (0.0, -0.004, 0.045)}
DOOR = Door(hinge=(0.65, -0.25, 0.449), opening=0.5)
BLOCK = Block(at=(0.5, 0.1, 0.3), pads=PADS)


def mass_matrix(plant: Plant) -> np.ndarray:
    full = np.zeros((plant.model.nv, plant.model.nv))
    mujoco.mj_fullM(plant.model, plant.data, full)
    return full[: plant.dof, : plant.dof]


def test_without_a_scene_nothing_can_touch(robot: Robot) -> None:
    assert Plant(robot).model.ngeom == 0


@pytest.mark.parametrize("scene", [DOOR, BLOCK], ids=["door", "block"])
def test_the_arm_has_the_same_inertia_and_weight(panda: Robot, scene) -> None:
    bare, furnished = Plant(panda), Plant(panda, scene=scene)
    assert mass_matrix(furnished) == pytest.approx(mass_matrix(bare))
    assert furnished.data.qfrc_bias[:7] == pytest.approx(bare.data.qfrc_bias[:7])


@pytest.mark.parametrize("scene", [DOOR, BLOCK], ids=["door", "block"])
def test_at_rest_nothing_moves(panda: Robot, scene) -> None:
    plant = Plant(panda, scene=scene)
    before = plant.data.qpos[9:].copy()
    plant.advance(1_000_000_000)
    assert plant.data.qpos[9:] == pytest.approx(before, abs=1e-3)
    assert plant.truth().position == pytest.approx(np.array(panda.profile.home), abs=1e-3)


def test_a_door_stands_open_and_shuts_at_zero(panda: Robot) -> None:
    plant = Plant(panda, scene=DOOR)
    assert plant.data.joint("door").qpos[0] == pytest.approx(0.5)
    assert plant.data.body("door").xmat.reshape(3, 3)[:, 1] == pytest.approx([-np.sin(0.5), np.cos(0.5), 0.0])
    plant.data.joint("door").qvel[0] = -3.0
    plant.advance(2_000_000_000)
    assert plant.data.joint("door").qpos[0] >= -0.02


def test_only_the_tool_touches_the_door() -> None:
    reaching = "twin.start=[0.0, -0.1, 0.0, -2.0, 0.0, 1.9, 0.785]"
    plant = Plant(load_robot("panda", [reaching]), scene=DOOR)
    assert plant.data.ncon > 0
    bodies = {int(plant.model.geom_bodyid[geom]) for contact in plant.data.contact for geom in contact.geom}
    assert bodies == {plant.model.body("door").id, int(plant.model.site_bodyid[plant.model.site("robotctl_tool").id])}
    plant.advance(300_000_000)
    assert abs(plant.data.joint("door").qpos[0] - DOOR.opening) > 0.05
