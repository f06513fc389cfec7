"""The shaper: one step, boundary grids, and long hostile runs on the reference."""

import numpy as np
import pytest

from robotctl.control.kinematics import Kinematics
from robotctl.control.limiter import VelocityLimiter
from robotctl.hal.robot import Robot, load_robot
from robotctl.safety.shaper import Clip, Shaper

STATES = 2000


def near_the_surface(robot: Robot, kinematics: Kinematics, count: int) -> list[np.ndarray]:
    """Random poses whose tool lies within 2 cm of the sphere's surface, inside."""
    rng = np.random.default_rng(3)
    centre, radius = np.array(robot.profile.sphere.centre), robot.profile.sphere.radius
    margin = robot.profile.safety.sphere_margin
    poses: list[np.ndarray] = []
    while len(poses) < count:
        pose = rng.uniform(robot.limits.lower + 0.1, robot.limits.upper - 0.1)
        if 0.0 < radius - margin - np.linalg.norm(kinematics.tool(pose) - centre) < 0.02:
            poses.append(pose)
    return poses


def test_random_states_at_the_surface_and_twice_the_cap(panda: Robot) -> None:
    """Projecting and clamping one after the other lets a quarter of these through; the QP none."""
    kinematics = Kinematics(panda)
    shaper = Shaper(panda, kinematics)
    # Without acceleration caps in the way, the step has to reach its answer at once.
    shaper._change = np.full(panda.dof, 1e9)
    rng = np.random.default_rng(4)
    centre = np.array(panda.profile.sphere.centre)
    for pose in near_the_surface(panda, kinematics, STATES):
        tool, jacobian = kinematics.tool_and_jacobian(pose)
        wanted = rng.uniform(-2.0, 2.0, panda.dof) * panda.limits.velocity
        rest = np.zeros(panda.dof)
        lower, upper = shaper._box(pose, rest)
        row = shaper.sphere.row(tool, jacobian)
        assert row is not None
        best = np.minimum(np.maximum(wanted, lower), upper)
        if row.normal @ best > row.bound:
            best = shaper._into_sphere(best, wanted, lower, upper, row, tool, jacobian)
        assert (np.abs(best) <= panda.limits.velocity).all()
        normal = (tool - centre) / np.linalg.norm(tool - centre)
        assert normal @ jacobian @ best <= row.bound + 1e-6
        # No other velocity that keeps the limits is closer: scaling the clipped one, the named fallback, is not.
        clipped = np.minimum(np.maximum(wanted, lower), upper)
        outward = float(row.normal @ clipped)
        scaled = clipped * (1.0 if outward <= row.bound else row.bound / outward)
        assert np.linalg.norm(best - wanted) <= np.linalg.norm(scaled - wanted) + 1e-6


def test_the_projection_rule_is_wrong_where_it_is_said_to_be(panda: Robot) -> None:
    """The alternative `projection` stays in the box but lets some velocities out; the predicted stop catches those."""
    projecting = load_robot("panda", ["safety.sphere=projection"])
    kinematics = Kinematics(projecting)
    shaper = Shaper(projecting, kinematics)
    rng = np.random.default_rng(5)
    for pose in near_the_surface(projecting, kinematics, 300):
        tool, jacobian = kinematics.tool_and_jacobian(pose)
        wanted = rng.uniform(-2.0, 2.0, 7) * panda.limits.velocity
        shaped = shaper.step(pose, np.zeros(7), wanted, tool, jacobian)
        assert (np.abs(shaped.velocity) <= panda.limits.velocity).all()


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("joint", range(7))
def test_grid_around_each_soft_limit(panda: Robot, joint: int, side: float) -> None:
    """From any state that could still brake, one step later it still can."""
    kinematics = Kinematics(panda)
    shaper = Shaper(panda, kinematics)
    shaper.sphere.radius = 1e3
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


@pytest.mark.parametrize("policy", ["random", "outward", "bang"])
@pytest.mark.parametrize("sphere", ["qp", "projection"])
def test_hostile_wishes_keep_every_invariant(robot: Robot, policy: str, sphere: str) -> None:
    robot = load_robot(robot.profile.name, [f"safety.sphere={sphere}"])
    kinematics = Kinematics(robot)
    limiter, shaper, limits = VelocityLimiter(robot), Shaper(robot, kinematics), robot.limits
    rng = np.random.default_rng(11)
    centre, radius, dt = np.array(robot.profile.sphere.centre), robot.profile.sphere.radius, robot.period_ns * 1e-9
    position, velocity, acceleration = np.array(robot.profile.home), np.zeros(robot.dof), np.zeros(robot.dof)
    wish = np.zeros(robot.dof)
    clipped = Clip.NONE
    for tick in range(8000):
        tool, jacobian = kinematics.tool_and_jacobian(position)
        if tick % (25 if policy != "bang" else 250) == 0:
            if policy == "random":
                wish = rng.uniform(-2.0, 2.0, robot.dof) * limits.velocity
            elif policy == "bang":
                wish = rng.choice([-10.0, 0.0, 10.0], robot.dof) * limits.velocity
            else:
                push = jacobian.T @ (tool - centre)
                wish = 2.0 * np.where(np.abs(push) > 0.01, np.sign(push), 1.0) * limits.velocity
        limited = limiter.step(wish, velocity, acceleration)
        following, clip = shaper.step(position, velocity, limited, tool, jacobian)
        clipped |= clip
        acceleration = (following - velocity) / dt
        position = position + 0.5 * dt * (velocity + following)
        velocity = following
        assert (position <= limits.upper).all()
        assert (position >= limits.lower).all()
        assert (np.abs(velocity) <= limits.velocity).all()
        assert (np.abs(acceleration) <= limits.acceleration).all()
        assert np.linalg.norm(kinematics.tool(position) - centre) <= radius
    assert Clip.SPHERE in clipped  # else nothing was tested


def test_a_tool_outside_is_led_back(panda: Robot) -> None:
    kinematics = Kinematics(panda)
    shaper = Shaper(panda, kinematics)
    home = np.array(panda.profile.home)
    shaper.sphere.centre = kinematics.tool(home) - np.array([0.0, 0.0, shaper.sphere.radius + 0.02])
    position, velocity, dt = home.copy(), np.zeros(7), panda.period_ns * 1e-9
    rooms = []
    for _ in range(500):
        tool, jacobian = kinematics.tool_and_jacobian(position)
        following = shaper.step(position, velocity, np.zeros(7), tool, jacobian).velocity
        position, velocity = position + 0.5 * dt * (velocity + following), following
        rooms.append(shaper.sphere.room(tool))
    assert rooms[0] < -0.019
    assert rooms[-1] > -0.005
    assert min(np.diff(rooms)) > -1e-6
