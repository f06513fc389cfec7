"""What a motion refuses to be built on."""

import pytest

from robotctl.control.kinematics import Kinematics
from robotctl.control.motion import Motion
from robotctl.hal.errors import ConfigError
from robotctl.hal.robot import load_robot

TABLE = "keep_out=[{kind: plane, name: table, point: [0, 0, %s], normal: [0, 0, 1], clearance: 0.03}]"


@pytest.mark.parametrize("key", ["home", "rest"])
def test_home_and_rest_have_to_be_where_the_tool_may_be(key: str) -> None:
    """Panda's tool is 449 mm high in both, and lower with the elbow bent more."""
    lower = f"{key}=[0.0, -0.4, 0.0, -2.3, 0.0, 1.9, 0.785]"
    robot = load_robot("panda", [TABLE % 0.40])
    Motion(robot, Kinematics(robot))
    robot = load_robot("panda", [TABLE % 0.40, lower])
    with pytest.raises(ConfigError, match=rf"panda.yaml: {key}: the tool would be \d+ mm past the bound of 'table'"):
        Motion(robot, Kinematics(robot))
