"""The reach task: goals that can be reached, the same for the same seed."""

from pathlib import Path

import numpy as np
import pytest

from robotctl.control.kinematics import Kinematics
from robotctl.hal.errors import ConfigError
from robotctl.hal.robot import CONFIGS, Robot, load_robot
from robotctl.learning.task import load_task


def test_the_shipped_task():
    task = load_task("reach")
    assert (task.name, task.steps, task.policy_hz) == ("reach", 150, 20)
    assert (task.cube, task.success) == (0.2, 0.05)
    assert load_task(str(CONFIGS / "tasks" / "reach.yaml")) == task


def test_goals_lie_in_the_cube_and_in_the_sphere(robot: Robot):
    task, kinematics = load_task("reach"), Kinematics(robot)
    home = kinematics.tool(np.array(robot.profile.home))
    sphere = robot.profile.sphere
    goals = np.array([task.goal(robot, kinematics, seed, episode) for seed in range(20) for episode in range(10)])
    assert (np.abs(goals - home) <= 0.5 * task.cube).all()
    assert (np.linalg.norm(goals - sphere.centre, axis=1) < sphere.radius - task.success).all()
    assert (np.ptp(goals, axis=0) > 0.5 * task.cube).all()  # they fill it
    assert len(np.unique(goals, axis=0)) == len(goals)


def test_goals_follow_seed_and_episode(panda: Robot):
    task, kinematics = load_task("reach"), Kinematics(panda)
    assert np.array_equal(task.goal(panda, kinematics, 3, 4), task.goal(panda, Kinematics(panda), 3, 4))
    assert not np.array_equal(task.goal(panda, kinematics, 3, 4), task.goal(panda, kinematics, 4, 3))


def test_a_sphere_without_room_is_refused():
    robot = load_robot("panda", ["sphere.centre=[2.0, 0.0, 0.5]"])
    with pytest.raises(ConfigError, match="no room for the targets of task 'reach'"):
        load_task("reach").goal(robot, Kinematics(robot), 0, 0)


def test_an_unknown_task_names_those_there_are():
    with pytest.raises(ConfigError, match=r"unknown task 'dance'\n  try: use one of .*reach"):
        load_task("dance")


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("cube: -0.2", "cube"),
        ("cube: .nan", "cube"),
        ("policy_hz: 0", "policy_hz"),
        ("steps: 0", "steps"),
        ("success: .inf", "success"),
        ("colour: red", "colour"),
    ],
)
def test_a_malformed_task_is_refused_with_its_key(tmp_path: Path, line: str, complaint: str):
    key = line.split(":")[0]
    shipped = (CONFIGS / "tasks" / "reach.yaml").read_text().splitlines()
    path = tmp_path / "task.yaml"
    path.write_text("\n".join([old for old in shipped if not old.startswith(f"{key}:")] + [line]))
    with pytest.raises(ConfigError, match=complaint):
        load_task(str(path))


def test_a_task_file_of_ones_own(tmp_path: Path):
    path = tmp_path / "near.yaml"
    path.write_text((CONFIGS / "tasks" / "reach.yaml").read_text().replace("cube: 0.2", "cube: 0.1"))
    assert load_task(str(path)).cube == 0.1
