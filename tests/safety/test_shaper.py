"""The shaper, step by step and on boundary grids; tests/control/test_shaped_reference.py has the long hostile runs."""

import numpy as np
import pytest

from robotctl.control.kinematics import Kinematics
from robotctl.hal.robot import Robot, load_robot
from robotctl.safety.region import Row, regions
from robotctl.safety.shaper import Clip, Shaper

STATES = 100


def without_acceleration_caps(robot: Robot) -> list[str]:
    """Settings with which one step has to reach its answer at once."""
    return [f"joints.{joint}.acceleration=1e9" for joint in range(robot.dof)]


def near_the_surface(robot: Robot, kinematics: Kinematics, count: int) -> list[np.ndarray]:
    """Random poses whose tool lies within 2 cm of the sphere's surface, inside."""
    rng = np.random.default_rng(3)
    sphere = regions(robot.profile, robot.profile.safety.sphere_margin)[0]
    poses: list[np.ndarray] = []
    while len(poses) < count:
        pose = rng.uniform(robot.limits.lower + 0.1, robot.limits.upper - 0.1)
        if 0.0 < sphere.room(kinematics.tool(pose)) < 0.02:
            poses.append(pose)
    return poses


def closest(wanted: np.ndarray, lower: np.ndarray, upper: np.ndarray, rows: list[Row]) -> np.ndarray:
    """The same QP by other means: at its optimum v = clip(wanted - sum of price * normal), price >= 0, one per row.

    Each price in turn is found by bisection, until none changes any more (coordinate ascent on the dual).
    """
    prices = np.zeros(len(rows))
    normals = np.array([row.normal for row in rows])
    for _ in range(200):
        before = prices.copy()
        for index, row in enumerate(rows):

            def outward(price: float, index: int = index, row: Row = row) -> float:
                prices[index] = price
                return float(row.normal @ np.clip(wanted - prices @ normals, lower, upper)) - row.bound

            low, high = 0.0, 1.0
            while outward(high) > 0.0 and high < 1e9:
                high *= 2.0
            for _ in range(100):
                middle = 0.5 * (low + high)
                low, high = (middle, high) if outward(middle) > 0.0 else (low, middle)
            prices[index] = 0.0 if outward(0.0) <= 0.0 else high
        if np.abs(prices - before).max() < 1e-9 * max(1.0, prices.max()):
            break
    return np.clip(wanted - prices @ normals, lower, upper)


def test_random_states_at_the_surface_and_twice_the_cap(robot: Robot) -> None:
    """Projecting and clamping one after the other lets a quarter of these through; the QP none, and nearest of all."""
    robot = load_robot(robot.profile.name, without_acceleration_caps(robot))
    kinematics = Kinematics(robot)
    shaper = Shaper(robot, kinematics)
    sphere = shaper.regions[0]
    rng, rest = np.random.default_rng(4), np.zeros(robot.dof)
    bound, braked = 0, 0
    for pose in near_the_surface(robot, kinematics, STATES):
        tool, jacobian = kinematics.tool_and_jacobian(pose)
        wanted = rng.uniform(-2.0, 2.0, robot.dof) * robot.limits.velocity
        best, clip = shaper.step(pose, rest, wanted, tool, jacobian)
        row = sphere.row(tool, jacobian)
        assert (np.abs(best) <= robot.limits.velocity).all()
        assert row.normal @ best <= row.bound + 1e-7
        if clip & Clip.PREDICTED_STOP:  # a step along the surface would leave it: some micrometres of room
            braked += 1
            assert sphere.room(tool) < 1e-5
            continue
        reference = closest(wanted, *shaper._box.bounds(pose, rest), [row])
        assert np.linalg.norm(best - wanted) <= np.linalg.norm(reference - wanted) + 1e-6
        bound += bool(clip & Clip.SPHERE)
    assert bound > 0.2 * STATES
    assert braked < 0.01 * STATES


def test_random_states_between_a_table_and_a_box(robot: Robot, keep_outs) -> None:
    """Several rows at once: the nearest velocity that keeps all of them."""
    robot = load_robot(robot.profile.name, [keep_outs(robot), *without_acceleration_caps(robot)])
    kinematics = Kinematics(robot)
    shaper = Shaper(robot, kinematics)
    rng, rest, home = np.random.default_rng(6), np.zeros(robot.dof), np.array(robot.profile.home)
    states = several = 0
    while states < 40:
        pose = np.clip(home + rng.uniform(-0.8, 0.8, robot.dof), robot.limits.lower + 0.1, robot.limits.upper - 0.1)
        tool, jacobian = kinematics.tool_and_jacobian(pose)
        rooms = sorted(region.room(tool) for region in shaper.regions)
        if rooms[0] < 1e-3 or rooms[1] > 0.05:  # near two of them, inside all
            continue
        states += 1
        wanted = rng.uniform(-2.0, 2.0, robot.dof) * robot.limits.velocity
        best, clip = shaper.step(pose, rest, wanted, tool, jacobian)
        assert not clip & Clip.PREDICTED_STOP
        rows = [region.row(tool, jacobian) for region in shaper.regions]
        reference = closest(wanted, *shaper._box.bounds(pose, rest), rows)
        assert all(row.normal @ best <= row.bound + 1e-7 for row in rows)
        assert best == pytest.approx(reference, abs=1e-5)
        several += sum(row.normal @ best > row.bound - 1e-7 for row in rows) > 1
        assert bool(clip & Clip.KEEP_OUT) is any(
            row.normal @ np.clip(wanted, *shaper._box.bounds(pose, rest)) > row.bound for row in rows[1:]
        )
    assert several > 1


@pytest.mark.parametrize("seed", range(3))
def test_the_projection_rule_scales_all_joints_alike_where_one_would_be_too_fast(panda: Robot, seed: int) -> None:
    """Some 0.2 mm inside the surface, with a wish that leads out."""
    rng = np.random.default_rng(seed)
    kinematics = Kinematics(panda)
    pose = rng.uniform(0.7 * panda.limits.lower + 0.3 * panda.limits.upper, panda.limits.upper - 0.3)
    tool, jacobian = kinematics.tool_and_jacobian(pose)
    radius = float(np.linalg.norm(tool - panda.profile.sphere.centre)) + panda.profile.safety.sphere_margin + 2e-4
    settings = [f"sphere.radius={radius!r}", "safety.sphere=projection", *without_acceleration_caps(panda)]
    robot = load_robot("panda", settings)
    shaper, cap = Shaper(robot, kinematics), (1.0 - robot.profile.safety.cap_margin) * robot.limits.velocity
    wanted = np.sign(jacobian.T @ (tool - robot.profile.sphere.centre)) * rng.uniform(0.5, 2.0, 7) * cap
    projected = shaper.regions[0].project(np.clip(wanted, -cap, cap), tool, jacobian, robot.period_ns * 1e-9)
    shaped = shaper.step(pose, np.zeros(7), wanted, tool, jacobian)
    assert shaped.velocity == pytest.approx(projected / max(1.0, (np.abs(projected) / cap).max()))
    assert shaped.clip == Clip.VELOCITY | Clip.SPHERE


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("joint", range(7))
def test_grid_around_each_soft_limit(panda: Robot, joint: int, side: float) -> None:
    """From any state that could still brake, one step later it still can."""
    kinematics = Kinematics(panda)
    shaper = Shaper(panda, kinematics)
    shaper.regions[0].radius = 1e3
    cap, brake = shaper.velocity_cap[joint], shaper.acceleration_cap[joint]
    margin, dt = panda.profile.safety.position_margin, panda.period_ns * 1e-9
    edge = (panda.limits.upper if side > 0 else -panda.limits.lower)[joint] - margin
    for distance in [0.0, 1e-9, 1e-6, 1e-4, 1e-3, 0.01, 0.05, 0.2]:
        fastest = min(cap, np.sqrt(2.0 * brake * distance))
        for speed in np.linspace(-cap, fastest, 9):
            position, velocity = np.array(panda.profile.home), np.zeros(7)
            position[joint], velocity[joint] = side * (edge - distance), side * speed
            tool, jacobian = kinematics.tool_and_jacobian(position)
            wanted = np.zeros(7)
            wanted[joint] = side * 2.0 * cap
            following = shaper.step(position, velocity, wanted, tool, jacobian).velocity
            reached = side * (position + 0.5 * dt * (velocity + following))[joint]
            ahead = max(0.0, side * following[joint])
            assert reached + ahead**2 / (2.0 * brake) <= edge + 1e-5
            assert abs(following[joint] - velocity[joint]) <= brake * dt * (1 + 1e-6)


def test_a_wish_inside_all_limits_is_granted_untouched(panda: Robot) -> None:
    kinematics = Kinematics(panda)
    shaper = Shaper(panda, kinematics)
    home, wanted = np.array(panda.profile.home), np.full(7, 1e-3)
    shaped = shaper.step(home, np.zeros(7), wanted, *kinematics.tool_and_jacobian(home))
    assert shaped.clip is Clip.NONE
    assert shaped.velocity is wanted


@pytest.mark.parametrize("kind", ["sphere", "plane", "box"])
def test_a_tool_outside_is_led_back(panda: Robot, kind: str) -> None:
    home = np.array(panda.profile.home)
    x, y, z = Kinematics(panda).tool(home)
    wall = x - 0.02 + panda.profile.safety.sphere_margin  # home lies 2 cm behind it
    setting = {
        "sphere": f"sphere.centre=[{x}, {y}, {z - panda.profile.sphere.radius - 0.018}]",
        "plane": f"keep_out=[{{kind: plane, name: a, point: [{wall}, 0, 0], normal: [-1, 0, 0]}}]",
        "box": f"keep_out=[{{kind: box, name: a, centre: [{wall + 0.1}, {y}, {z}], half: [0.1, 0.3, 0.3]}}]",
    }[kind]
    robot = load_robot("panda", [setting])
    kinematics = Kinematics(robot)
    shaper = Shaper(robot, kinematics)
    region = shaper.regions[-1]
    position, velocity, dt = home.copy(), np.zeros(7), robot.period_ns * 1e-9
    rooms = []
    for _ in range(500):
        tool, jacobian = kinematics.tool_and_jacobian(position)
        following = shaper.step(position, velocity, np.zeros(7), tool, jacobian).velocity
        position, velocity = position + 0.5 * dt * (velocity + following), following
        rooms.append(region.room(tool))
    assert rooms[0] == pytest.approx(-0.02)
    assert rooms[-1] > -0.005
    assert min(np.diff(rooms)) > -1e-6
