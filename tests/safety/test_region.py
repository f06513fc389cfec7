"""Regions by themselves: room, outward, bend and row against finite differences, and the projection rule."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robotctl.control.kinematics import Kinematics
from robotctl.hal.robot import Robot, load_robot
from robotctl.safety.region import Box, Plane, Region, Sphere, regions, rotation

GAIN = 5.0
TURN = rotation(0.4, -0.3, 1.1)
HALF = np.array([0.1, 0.2, 0.3])
REGIONS: dict[str, Region] = {
    "sphere": Sphere("sphere", GAIN, np.array([0.1, -0.2, 0.3]), 0.4),
    "plane": Plane("plane", GAIN, np.array([0.0, 0.1, 0.2]), np.array([1.0, -2.0, 2.0]), 0.03),
    "box": Box("box", GAIN, np.array([0.05, 0.0, -0.1]), HALF, TURN, 0.02),
}
POINT = np.array([0.05, 0.0, -0.1]) + TURN @ [0.25, 0.05, 0.1]
"""Before a face of the box."""
near = st.floats(-0.8, 0.8)
points = st.tuples(near, near, near).map(np.array)
each_region = pytest.mark.parametrize("name", REGIONS)


@pytest.fixture
def poses(robot: Robot) -> list[np.ndarray]:
    rng = np.random.default_rng(1)
    return [rng.uniform(robot.limits.lower, robot.limits.upper) for _ in range(50)]


@pytest.fixture
def kinematics(robot: Robot) -> Kinematics:
    return Kinematics(robot)


def signed_distance_to_box(local: np.ndarray) -> float:
    """By brute force: the nearest point of the box, or the nearest face from inside."""
    nearest = np.clip(local, -HALF, HALF)
    if (nearest != local).any():
        return float(np.linalg.norm(local - nearest))
    return -min(float(side) for side in np.concatenate([HALF - local, HALF + local]))


# -- all regions ----------------------------------------------------------------------------------------------------


@each_region
@given(point=points)
def test_outward_is_the_way_that_room_shrinks_fastest(name: str, point: np.ndarray) -> None:
    region, step = REGIONS[name], 1e-6
    outward = region.outward(point)
    assert outward is not None
    assert np.linalg.norm(outward) == pytest.approx(1.0)
    # Along a small step outward the room shrinks by that step, and by no step does it shrink faster.
    assert region.room(point) - region.room(point + step * outward) == pytest.approx(step, rel=1e-3)
    for other in np.vstack([np.eye(3), -np.eye(3)]):
        assert region.room(point) - region.room(point + step * other) <= step * (1 + 1e-6)


@each_region
@given(point=points, velocity=points)
def test_room_bends_no_faster_than_told(name: str, point: np.ndarray, velocity: np.ndarray) -> None:
    """Along a straight line room'' >= -bend; for the sphere, exactly so."""
    region, step = REGIONS[name], 1e-3
    if name == "sphere" and np.linalg.norm(point - region.centre) < 0.05:
        return
    ahead, here, behind = (region.room(point + side * step * velocity) for side in (1, 0, -1))
    second = (ahead - 2.0 * here + behind) / step**2
    assert second >= -region.bend(point, velocity) - 1e-2
    if name == "sphere":
        assert second == pytest.approx(-region.bend(point, velocity), rel=0.01, abs=1e-3)
    else:
        assert region.bend(point, velocity) == 0.0


@each_region
@given(start=points, middle=points, end=points)
def test_along_a_path_there_is_at_least_the_room_told(name, start, middle, end) -> None:
    region, path = REGIONS[name], np.array([start, middle, end])
    least = region.along(path)
    share = np.linspace(0.0, 1.0, 21)[:, None]
    on_the_way = np.vstack([start + share * (middle - start), middle + share * (end - middle)])
    rooms = [region.room(point) for point in on_the_way]
    assert least <= min(rooms) + 1e-12
    if name != "box":
        assert least == pytest.approx(min(rooms), abs=1e-12)


@each_region
@pytest.mark.parametrize("room", [-0.05, -0.01 - 1e-9, -0.009, -1e-6, 0.0, 1e-6, 0.01, 0.1])
def test_the_bound_is_proportional_to_the_room_and_the_correction_is_capped(name: str, room: float) -> None:
    region = REGIONS[name]
    point = POINT + (region.room(POINT) - room) * region.outward(POINT)
    assert region.room(point) == pytest.approx(room, abs=1e-12)
    row = region.row(point, np.eye(3, 7))
    assert row.bound == pytest.approx(max(GAIN * room, -0.05), abs=1e-12)
    assert row.normal == pytest.approx([*region.outward(point), 0, 0, 0, 0])


@each_region
def test_the_row_is_the_derivative_of_the_room(name: str, robot: Robot, kinematics: Kinematics, poses) -> None:
    region, step = REGIONS[name], 1e-6
    for pose in poses:
        row = region.row(*kinematics.tool_and_jacobian(pose))
        for joint in range(robot.dof):
            ahead, behind = pose.copy(), pose.copy()
            ahead[joint] += step
            behind[joint] -= step
            slope = (region.room(kinematics.tool(behind)) - region.room(kinematics.tool(ahead))) / (2 * step)
            assert row.normal[joint] == pytest.approx(slope, abs=1e-5)


@each_region
def test_a_singular_row_asks_for_nothing(name: str) -> None:
    """A Jacobian that cannot move the tool along the normal leaves 0 <= k h."""
    region = REGIONS[name]
    across = np.cross(region.outward(POINT), [0.0, 0.0, 1.0])
    row = region.row(POINT, np.outer(across, np.ones(7)))
    assert row.normal == pytest.approx(np.zeros(7), abs=1e-12)


def test_the_profile_lists_the_sphere_first_and_each_region_keeps_the_margin() -> None:
    table = "{kind: plane, name: table, point: [0, 0, -0.3], normal: [0, 0, 2], clearance: 0.01}"
    shelf = "{kind: box, name: shelf, centre: [0.7, 0, 0], half: [0.1, 0.2, 0.3], rpy: [0, 0, 1.5708], clearance: 0.04}"
    robot = load_robot("panda", [f"keep_out=[{table}, {shelf}]", "safety.sphere_gain=3"])
    wide, narrow = regions(robot.profile), regions(robot.profile, 0.002)
    assert [region.name for region in wide] == ["sphere", "table", "shelf"]
    assert {region.gain for region in wide} == {3.0}
    point = np.array([0.4, 0.1, -0.2])
    assert wide[0].room(point) == 0.42 - math.dist(point, robot.profile.sphere.centre)
    assert wide[1].room(point) == pytest.approx(0.1 - 0.01)
    assert wide[2].room(point) == pytest.approx(0.7 - 0.2 - 0.4 - 0.04, abs=1e-5)
    for without, kept in zip(wide, narrow, strict=True):
        assert without.room(point) - kept.room(point) == pytest.approx(0.002)


# -- box ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("x", [-0.3, -0.1 - 1e-9, -0.1, -0.1 + 1e-9, 0.0, 0.05, 0.1, 0.25])
@pytest.mark.parametrize("y", [-0.4, -0.2, 0.0, 0.2 - 1e-9, 0.2, 0.2 + 1e-9])
@pytest.mark.parametrize("z", [-0.3, -0.29, 0.01, 0.3, 0.5])
def test_boxes_faces_edges_and_corners(x: float, y: float, z: float) -> None:
    local = np.array([x, y, z])
    box = REGIONS["box"]
    point = np.array([0.05, 0.0, -0.1]) + TURN @ local
    distance = signed_distance_to_box(local)
    assert box.room(point) == pytest.approx(distance - 0.02, abs=1e-12)
    # Following the way out for the distance that is left ends on the surface, from inside, too.
    assert box.room(point + distance * box.outward(point)) == pytest.approx(-0.02, abs=1e-9)


def test_a_thin_wall_cannot_be_stepped_over() -> None:
    wall = Box("wall", GAIN, np.zeros(3), np.array([0.001, 1.0, 1.0]), np.eye(3), 0.0)
    before, behind = np.array([-0.1, 0.0, 0.0]), np.array([0.1, 0.0, 0.0])
    assert min(wall.room(before), wall.room(behind)) == pytest.approx(0.099)
    assert wall.along(np.array([before, behind])) == pytest.approx(0.099 - 0.2)
    assert wall.along(np.array([before, before + np.array([0.05, 0.2, 0.0])])) == pytest.approx(0.049)


def test_rotations_are_about_the_fixed_axes_in_the_order_x_y_z() -> None:
    quarter = math.pi / 2
    assert rotation(quarter, 0, 0) @ [0, 1, 0] == pytest.approx([0, 0, 1])
    assert rotation(0, quarter, 0) @ [0, 0, 1] == pytest.approx([1, 0, 0])
    assert rotation(0, 0, quarter) @ [1, 0, 0] == pytest.approx([0, 1, 0])
    assert rotation(quarter, 0, 0) @ [0, 0, 1] == pytest.approx([0, -1, 0])
    assert rotation(0, quarter, 0) @ [1, 0, 0] == pytest.approx([0, 0, -1])
    assert rotation(0, 0, quarter) @ [0, 1, 0] == pytest.approx([-1, 0, 0])
    assert rotation(quarter, quarter, 0) @ [0, 1, 0] == pytest.approx([1, 0, 0])
    assert rotation(quarter, 0, quarter) @ [0, 1, 0] == pytest.approx([0, 0, 1])


# -- sphere ---------------------------------------------------------------------------------------------------------


def test_at_the_centre_there_is_no_row_and_nothing_to_divide_by() -> None:
    sphere = Sphere("sphere", GAIN, np.array([0.1, -0.2, 0.3]), 0.4)
    jacobian = np.ones((3, 7))
    with np.errstate(all="raise"):
        assert sphere.row(sphere.centre.copy(), jacobian) is None
        assert sphere.row(sphere.centre + np.array([0.9e-3, 0.0, 0.0]), jacobian) is None
        assert sphere.bend(sphere.centre.copy(), np.ones(3)) == 0.0
        assert sphere.project(np.ones(7), sphere.centre.copy(), jacobian, 1e6) is not None
    assert sphere.row(sphere.centre + np.array([1.1e-3, 0.0, 0.0]), jacobian) is not None


def test_projection_leaves_alone_what_stays_inside(robot: Robot, kinematics: Kinematics, poses):
    sphere = regions(robot.profile)[0]
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
    sphere = regions(robot.profile)[0]
    rng = np.random.default_rng(3)
    projected = 0
    for pose in poses:
        tool, jacobian = kinematics.tool_and_jacobian(pose)
        if np.linalg.svd(jacobian, compute_uv=False)[-1] < 0.05:
            continue
        for depth in (0.0, 0.02):  # on the surface, and outside
            sphere.radius = float(np.linalg.norm(tool - sphere.centre)) - depth
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


def test_projection_outside_keeps_an_inward_velocity_and_adds_to_it() -> None:
    sphere = REGIONS["sphere"]
    tool = sphere.centre + np.array([sphere.radius + 0.02, 0.0, 0.0])
    velocity = np.array([-0.1, 0.3, 0.0, 0.0, 0.0, 0.0, 0.0])
    shaped = sphere.project(velocity, tool, np.eye(3, 7), 0.002)
    assert shaped[:2] == pytest.approx([-0.1 - GAIN * 0.02, 0.3], abs=1e-5)


def test_the_projections_inverse_is_damped_by_a_millionth() -> None:
    sphere, outwards = REGIONS["sphere"], np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    tool = sphere.centre + np.array([sphere.radius, 0.0, 0.0])
    shaped = sphere.project(outwards, tool, np.eye(3, 7), 0.002)
    assert shaped == pytest.approx(1e-6 * outwards, rel=1e-5)
