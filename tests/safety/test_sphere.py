"""The sphere's row, and the projection rule."""

import numpy as np
import pytest

from robotctl.control.kinematics import Kinematics
from robotctl.hal.robot import Robot
from robotctl.safety.sphere import BoundingSphere


@pytest.fixture
def poses(robot: Robot) -> list[np.ndarray]:
    rng = np.random.default_rng(1)
    return [rng.uniform(robot.limits.lower, robot.limits.upper) for _ in range(50)]


@pytest.fixture
def kinematics(robot: Robot) -> Kinematics:
    return Kinematics(robot)


def test_the_radius_is_the_profiles_less_the_margin(robot: Robot):
    sphere = BoundingSphere(robot.profile)
    assert sphere.radius == robot.profile.sphere.radius - robot.profile.safety.sphere_margin
    assert sphere.room(sphere.centre) == sphere.radius
    assert sphere.room(sphere.centre + np.array([0.0, sphere.radius + 0.03, 0.0])) == pytest.approx(-0.03)


def test_the_row_is_the_derivative_of_the_distance(robot: Robot, kinematics: Kinematics, poses):
    sphere = BoundingSphere(robot.profile)
    step = 1e-6
    for pose in poses:
        row = sphere.row(*kinematics.tool_and_jacobian(pose))
        for joint in range(robot.dof):
            ahead, behind = pose.copy(), pose.copy()
            ahead[joint] += step
            behind[joint] -= step
            slope = (sphere.room(kinematics.tool(behind)) - sphere.room(kinematics.tool(ahead))) / (2 * step)
            assert row.normal[joint] == pytest.approx(slope, abs=1e-6)


@pytest.mark.parametrize("distance", [-0.3, -0.02, -0.01 - 1e-9, -0.009, -1e-6, 0.0, 1e-6, 0.01, 0.1, 0.3])
def test_the_bound_is_proportional_to_the_room_and_the_correction_is_capped(panda: Robot, distance):
    sphere = BoundingSphere(panda.profile)
    tool = sphere.centre + np.array([sphere.radius - distance, 0.0, 0.0])
    row = sphere.row(tool, np.eye(3, 7))
    assert row.bound == pytest.approx(max(sphere.gain * distance, -0.05), abs=1e-12)
    assert row.normal == pytest.approx([1, 0, 0, 0, 0, 0, 0])


def test_at_the_centre_there_is_no_row_and_nothing_to_divide_by(panda: Robot):
    sphere = BoundingSphere(panda.profile)
    jacobian = np.ones((3, 7))
    with np.errstate(all="raise"):
        assert sphere.row(sphere.centre.copy(), jacobian) is None
        assert sphere.row(sphere.centre + np.array([0.9e-3, 0.0, 0.0]), jacobian) is None
        assert sphere.project(np.ones(7), sphere.centre.copy(), jacobian, 1e6) is not None
    assert sphere.row(sphere.centre + np.array([1.1e-3, 0.0, 0.0]), jacobian) is not None


def test_a_singular_row_asks_for_nothing(panda: Robot):
    """A Jacobian that cannot move the tool along the normal leaves 0 <= k h."""
    sphere = BoundingSphere(panda.profile)
    jacobian = np.zeros((3, 7))
    jacobian[1, 0] = 1.0
    row = sphere.row(sphere.centre + np.array([sphere.radius - 0.01, 0.0, 0.0]), jacobian)
    assert not row.normal.any()
    assert row.bound > 0.0


def test_projection_leaves_alone_what_stays_inside(robot: Robot, kinematics: Kinematics, poses):
    sphere = BoundingSphere(robot.profile)
    rng = np.random.default_rng(2)
    untouched = 0
    for pose in poses:
        tool, jacobian = kinematics.tool_and_jacobian(pose)
        velocity = rng.uniform(-1.0, 1.0, robot.dof)
        if sphere.room(tool + 0.002 * jacobian @ velocity) > 0.0:
            assert sphere.project(velocity, tool, jacobian, 0.002) is velocity
            untouched += 1
    assert untouched > 0


def test_projection_takes_the_outward_part_away_and_adds_the_correction(robot: Robot, kinematics: Kinematics, poses):
    sphere = BoundingSphere(robot.profile)
    rng = np.random.default_rng(3)
    projected = 0
    for pose in poses:
        tool, jacobian = kinematics.tool_and_jacobian(pose)
        if np.linalg.svd(jacobian, compute_uv=False)[-1] < 0.05:
            continue
        for depth in (0.0, 0.02):  # on the surface, and outside
            sphere.radius = float(np.linalg.norm(tool - sphere.centre)) - depth
            sphere._square = sphere.radius**2
            normal = (tool - sphere.centre) / np.linalg.norm(tool - sphere.centre)
            velocity = rng.uniform(-1.0, 1.0, robot.dof)
            if normal @ jacobian @ velocity < 0.0:
                velocity = -velocity
            before = jacobian @ velocity
            after = jacobian @ sphere.project(velocity, tool, jacobian, 0.002)
            assert normal @ after == pytest.approx(-sphere.gain * depth, abs=2e-3)
            tangent = np.eye(3) - np.outer(normal, normal)
            assert tangent @ after == pytest.approx(tangent @ before, abs=2e-3)
            projected += 1
    assert projected > 10


def test_projection_outside_keeps_an_inward_velocity_and_adds_to_it(panda: Robot):
    sphere = BoundingSphere(panda.profile)
    tool = sphere.centre + np.array([sphere.radius + 0.02, 0.0, 0.0])
    velocity = np.array([-0.1, 0.3, 0.0, 0.0, 0.0, 0.0, 0.0])
    shaped = sphere.project(velocity, tool, np.eye(3, 7), 0.002)
    assert shaped[:2] == pytest.approx([-0.1 - sphere.gain * 0.02, 0.3], abs=1e-5)
