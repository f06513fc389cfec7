"""What a motion refuses to be built on, and how an arm gives way."""

import numpy as np
import pytest

from robotctl.control.kinematics import Kinematics
from robotctl.control.motion import Motion
from robotctl.hal.errors import ConfigError
from robotctl.hal.robot import Robot, load_robot
from robotctl.hal.types import Sample

LOWER = "[0.0, -0.4, 0.0, -2.3, 0.0, 1.9, 0.785]"
"""Panda's home and rest, whose tool is 449 mm high, with the elbow bent more."""
TABLE = "keep_out=[{kind: plane, name: table, point: [0, 0, 0.4], normal: [0, 0, 1], clearance: 0.03}]"
POST = "keep_out=[{kind: box, name: post, centre: [-0.04, 0.17, 0.6], half: [0.03, %s, 0.03]}]"


def build(*settings: str) -> None:
    robot = load_robot("panda", settings)
    Motion(robot, Kinematics(robot))


@pytest.mark.parametrize("key", ["home", "rest"])
def test_home_and_rest_have_to_be_where_the_tool_may_be(key: str) -> None:
    build(TABLE, "collision=null")
    with pytest.raises(ConfigError, match=rf"panda.yaml: {key}: the tool would be \d+ mm past the bound of 'table'"):
        build(TABLE, "collision=null", f"{key}={LOWER}")


@pytest.mark.parametrize(("half", "settings"), [(0.06, ()), (0.05, ("safety.proximity_margin=0.011",))])
def test_home_has_to_be_where_the_links_may_be(half: float, settings: tuple[str, ...]) -> None:
    """A post beside the elbow, 33, 14 or 5 mm away; 8 mm are kept by default, 16 mm with that margin."""
    build(POST % 0.03, *settings)
    with pytest.raises(
        ConfigError, match=r"panda.yaml: home: panda_link3 and post would be \d+ mm apart\n  try: change"
    ):
        build(POST % half, *settings)
    build(POST % half, *settings, "collision=null")
    build(POST % half, *settings, "collision.ignore=[[panda_link3, post]]")


def test_an_arm_that_is_pushed_past_a_limit_does_not_give_way_any_further(panda: Robot) -> None:
    motion = Motion(panda, Kinematics(panda))
    at_limit = np.array(panda.profile.home)
    at_limit[0], at_limit[1] = panda.limits.upper[0] - 1e-5, panda.limits.lower[1] + 1e-5
    motion.begin(at_limit)
    pushed = at_limit + np.array([0.05, -0.05, 0.05, 0.0, 0.0, 0.0, 0.0])
    for _ in range(500):
        motion.give_way(Sample(0, pushed, 0.0 * pushed, 0.0 * pushed, np.zeros(7, np.int64), enabled=True))
    led = motion.reference.position
    assert led == pytest.approx([panda.limits.upper[0], panda.limits.lower[1], *pushed[2:]])
