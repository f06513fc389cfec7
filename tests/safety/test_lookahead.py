"""Looking ahead on a slide: the first joint moves the tool along a line through the middle of the sphere, 1 m/rad."""

import numpy as np
import pytest

from robotctl.hal.robot import load_robot
from robotctl.safety.lookahead import Lookahead
from robotctl.safety.shaper import Clip

AXIS = np.array([0.6, 0.0, 0.8])
REACTION = 0.03
WALLS = ", ".join(f"{{kind: plane, name: {name}, point: [9, 0, 0], normal: [-1, 0, 0]}}" for name in "ab")
ROBOT = load_robot("panda", ["safety.cap_margin=0.1", "joints.0.acceleration=2.0", f"keep_out=[{WALLS}]"])
SAFETY, SPHERE = ROBOT.profile.safety, ROBOT.profile.sphere
BRAKE = 0.9 * 2.0
FIRST = np.eye(7)[0]


class Slide:
    reach = FIRST

    def tool_and_jacobian(self, position):
        return np.array(SPHERE.centre) + position[0] * AXIS, np.outer(AXIS, FIRST)


class Pair:
    """Two links whose clearance is that of the second joint to a quarter of a radian, a metre per radian."""

    pairs = (("link", "other"),)
    reach = np.eye(7)[1:2]

    def measure(self, position, pairs):
        return np.array([0.25 - position[1]])[list(pairs)]

    def approach(self, position, pairs):
        return [np.eye(7)[1] for _ in pairs]


def rows(position, velocity, scene=None):
    return Lookahead(ROBOT, Slide(), REACTION, scene).rows(position, velocity)


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("speed", [0.6, -0.6])
def test_three_poses_ahead_are_kept_inside(side, speed):
    """After the reaction, and where braking with 1.8 and with 0.9 rad/s^2 ends."""
    found = rows(side * 0.1 * FIRST, side * speed * FIRST)
    assert found.flags == 3 * [Clip.SPHERE, Clip.KEEP_OUT, Clip.KEEP_OUT]
    for number, rest in enumerate((0.0, abs(speed) / BRAKE, abs(speed) / (0.5 * BRAKE))):
        pose = 0.1 + speed * REACTION + 0.5 * speed * rest
        outward = side if pose > 0.0 else -side
        room = SPHERE.radius - SAFETY.sphere_margin - abs(pose)
        assert found.normals[3 * number] == pytest.approx(outward * (REACTION + rest) * FIRST)
        assert found.bounds[3 * number] == pytest.approx(SAFETY.sphere_gain * room - outward * side * speed)


@pytest.mark.parametrize("speed", [0.1, -0.1])
def test_so_are_the_clearances_of_links(speed):
    position = np.array([0.1, 0.238, 0.0, 0.0, 0.0, 0.0, 0.0])
    found = rows(position, speed * np.eye(7)[1], Pair())
    assert [flag for flag in found.flags if flag is Clip.PROXIMITY] == 3 * [Clip.PROXIMITY]
    brake = 0.9 * ROBOT.limits.acceleration[1]
    for number, rest in enumerate((0.0, abs(speed) / brake, abs(speed) / (0.5 * brake))):
        room = 0.012 - speed * (REACTION + 0.5 * rest) - SAFETY.proximity_stop - SAFETY.proximity_margin
        assert found.normals[4 * number + 3] == pytest.approx((REACTION + rest) * np.eye(7)[1])
        assert found.bounds[4 * number + 3] == pytest.approx(SAFETY.sphere_gain * room - speed)


def test_without_anything_near_there_may_be_no_row_at_all():
    robot = load_robot("panda")
    found = Lookahead(robot, Slide(), REACTION, None).rows(np.zeros(7), np.zeros(7))  # the very middle of the sphere
    assert found.normals.shape == (0, 7)
    assert len(found.bounds) == 0
