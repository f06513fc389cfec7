"""P8: motion under torque control has to be stoppable inside all limits."""

import numpy as np
import pytest

from robotctl.control.kinematics import Kinematics
from robotctl.hal.robot import Robot, load_robot
from robotctl.safety.stoppable import StoppableMotion
from robotctl.safety.trip import Category, Protection


class AtCentre:
    """An arm whose tool is always in the middle of its sphere, so that only the joints count."""

    reach = 1.0

    def __init__(self, robot: Robot) -> None:
        self._centre = np.array(robot.profile.sphere.centre)

    def tool(self, position):
        return self._centre


BREACH = 2e-3


def judge(check, position, velocity):
    return check.check(position, velocity, 5)


def stopping_distance(robot: Robot, joint: int, speed: float) -> float:
    """At the usable part of the acceleration cap, after 10 ms of reaction."""
    usable = (1.0 - robot.profile.safety.cap_margin) * robot.limits.acceleration[joint]
    return 0.01 * speed + speed**2 / (2.0 * usable)


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 1.0])
def test_joint_limits(robot: Robot, side, share):
    check = StoppableMotion(robot, AtCentre(robot))
    for joint in range(robot.dof):
        speed = share * robot.limits.velocity[joint]
        limit = (robot.limits.upper if side > 0 else robot.limits.lower)[joint]
        for step, trips in ((-1e-6, False), (1e-6, True)):
            position, velocity = np.array(robot.profile.home), np.zeros(robot.dof)
            position[joint] = limit + side * (BREACH + step - stopping_distance(robot, joint, speed))
            velocity[joint] = side * speed
            trip = judge(check, position, velocity)
            assert (trip is not None) is trips
            if trip is not None:
                assert (trip.protection, trip.category) == (Protection.TORQUE_STATE, Category.BRAKE_HOLD)
                assert f"{robot.profile.joints[joint].name} would stop" in trip.cause
                assert trip.onset_ns == 5


@pytest.mark.parametrize("side", [-1, 1])
def test_velocity_caps(robot: Robot, side):
    check = StoppableMotion(robot, AtCentre(robot))
    middle = 0.5 * (robot.limits.lower + robot.limits.upper)
    for joint in range(robot.dof):
        for step, trips in ((-1e-9, False), (1e-9, True)):
            velocity = np.zeros(robot.dof)
            velocity[joint] = side * (robot.limits.velocity[joint] + robot.profile.safety.velocity_tolerance + step)
            trip = judge(check, middle, velocity)
            assert (trip is not None) is trips
            if trip is not None:
                assert "over its cap" in trip.cause


def test_moving_away_from_a_limit_is_free(panda: Robot):
    check = StoppableMotion(panda, AtCentre(panda))
    position = np.array(panda.profile.home)
    position[0] = panda.limits.upper[0] - 1e-6
    velocity = np.zeros(7)
    velocity[0] = -panda.limits.velocity[0]
    assert judge(check, position, velocity) is None
    velocity[0] = 0.1
    assert judge(check, position, velocity) is not None


def test_the_predicted_stop_of_the_tool_counts(panda: Robot):
    """The sphere is laid so that the tool stops a millimetre inside it, or outside."""
    kinematics = Kinematics(panda)
    home, velocity = np.array(panda.profile.home), np.zeros(7)
    velocity[1] = 0.8
    stop = home.copy()
    stop[1] += stopping_distance(panda, 1, 0.8)
    start, end = kinematics.tool(home), kinematics.tool(stop)
    assert np.linalg.norm(end - start) > 0.03
    x, y, z = (float(value) for value in start)
    for step, trips in ((1e-3, False), (-1e-3, True)):
        radius = float(np.linalg.norm(end - start)) - BREACH + step
        robot = load_robot("panda", [f"sphere.centre=[{x}, {y}, {z}]", f"sphere.radius={radius}"])
        check = StoppableMotion(robot, Kinematics(robot))
        assert judge(check, home, np.zeros(7)) is None
        trip = judge(check, home, velocity)
        assert (trip is not None) is trips
        if trip is not None:
            assert "tool would stop past the bound of 'sphere'" in trip.cause


def test_each_joint_is_judged_by_its_own_cap(panda: Robot):
    velocity = np.zeros(7)
    velocity[0] = panda.limits.velocity[0] + panda.profile.safety.velocity_tolerance + 0.01
    velocity[6] = panda.limits.velocity[6]  # faster, but it may be
    trip = StoppableMotion(panda, AtCentre(panda)).check(np.array(panda.profile.home), velocity, 0)
    assert "panda_joint1 moves at 1.06 rad/s" in trip.cause
