"""The reset routines, led along an ideal reference and through the shaper."""

import numpy as np
import pytest

from robotctl.control.kinematics import Kinematics
from robotctl.control.limiter import VelocityLimiter
from robotctl.hal.errors import ConfigError
from robotctl.hal.robot import Robot, load_robot
from robotctl.hal.types import Sample
from robotctl.safety.region import regions
from robotctl.safety.routines import Goto, RandomStart, Retreat, Settle
from robotctl.safety.shaper import Shaper


def sample(position, velocity=None):
    velocity = np.zeros(len(position)) if velocity is None else velocity
    return Sample(0, position, velocity, velocity, np.zeros(len(position), np.int64), enabled=True)


def lead(robot, kinematics, routine, start):
    """Let a routine move the reference as the loop does; return positions, velocities and wishes until it is done."""
    limiter, shaper, dt = VelocityLimiter(robot), Shaper(robot, kinematics), robot.period_ns * 1e-9
    position, velocity, acceleration = np.array(start), np.zeros(robot.dof), np.zeros(robot.dof)
    positions, velocities, wishes = [position], [velocity], []
    for _ in range(round(routine.timeout_s / dt)):
        wanted = routine.velocity(sample(position, velocity), position)
        if wanted is None:
            return np.array(positions), np.array(velocities), np.array(wishes)
        limited = limiter.step(wanted, velocity, acceleration)
        tool, jacobian = kinematics.tool_and_jacobian(position)
        following = shaper.step(position, velocity, limited, tool, jacobian).velocity
        acceleration = (following - velocity) / dt
        position = position + 0.5 * dt * (velocity + following)
        velocity = following
        positions.append(position)
        velocities.append(velocity)
        wishes.append(wanted)
    pytest.fail(f"{routine.name} did not arrive within {routine.timeout_s} s")


def lead_ideally(robot, routine, start):
    dt = robot.period_ns * 1e-9
    position, positions, wishes = np.array(start), [np.array(start)], []
    for _ in range(round(routine.timeout_s / dt)):
        wanted = routine.velocity(sample(position), position)
        if wanted is None:
            return np.array(positions), np.array(wishes)
        position = position + dt * wanted
        positions.append(position)
        wishes.append(wanted)
    pytest.fail(f"{routine.name} did not arrive within {routine.timeout_s} s")


@pytest.fixture
def kinematics(robot: Robot) -> Kinematics:
    return Kinematics(robot)


def test_goto_arrives_within_its_caps(robot: Robot, kinematics: Kinematics):
    home = np.array(robot.profile.home)
    safety = robot.profile.safety
    start = home.copy()
    start[0] -= 0.5
    start[-1] += 0.4
    positions, _, wishes = lead(robot, kinematics, Goto(robot, home, "home", kinematics), start)
    assert positions[-1] == pytest.approx(home, abs=2e-3)
    assert (np.abs(wishes) <= safety.reset_scale * robot.limits.velocity * (1 + 1e-9)).all()
    speeds = [
        np.linalg.norm(kinematics.tool_and_jacobian(position)[1] @ wish)
        for position, wish in zip(positions, wishes, strict=False)
    ]
    assert max(speeds) <= 0.8 * safety.reset_tool_speed * (1 + 1e-9)
    # One of the two caps is in use somewhere, else neither was tested.
    scale = (np.abs(wishes) / (safety.reset_scale * robot.limits.velocity)).max()
    assert scale > 0.999 or max(speeds) > 0.799 * safety.reset_tool_speed


@pytest.mark.parametrize("tool_speed", [0.02, 0.1])
def test_goto_aims_at_four_fifths_of_the_tool_speed_where_that_is_the_tighter_cap(tool_speed):
    robot = load_robot("panda", [f"safety.reset_tool_speed={tool_speed}"])
    kinematics, home = Kinematics(robot), np.array(robot.profile.home)
    start = home + np.array([-0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    wish = Goto(robot, home, "home", kinematics).velocity(sample(start), start)
    assert np.linalg.norm(kinematics.tool_and_jacobian(start)[1] @ wish) == pytest.approx(0.8 * tool_speed)


def test_goto_leads_along_a_straight_line(panda: Robot):
    home = np.array(panda.profile.home)
    start = home + np.array([0.3, 0.0, 0.1, 0.0, 0.0, 0.0, -0.2])
    routine = Goto(panda, home, "home", Kinematics(panda))
    wanted = routine.velocity(sample(start), start)
    assert np.cross((home - start)[[0, 2, 6]], wanted[[0, 2, 6]]) == pytest.approx(np.zeros(3), abs=1e-12)
    assert wanted[0] < 0.0 < wanted[6]


def test_goto_slows_down_where_the_tool_gets_faster_than_it_was_to(panda: Robot):
    """The shaper may lead joints another way than they want, as along a sphere, and the tool with them."""
    kinematics, home = Kinematics(panda), np.array(panda.profile.home)
    start = home + np.array([-0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    routine = Goto(panda, home, "home", kinematics)
    full = routine.velocity(sample(start), start)
    _, jacobian = kinematics.tool_and_jacobian(start)
    turning = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    turning *= panda.profile.safety.reset_tool_speed / np.linalg.norm(jacobian @ turning)
    for share, pace in [(0.89, 1.0), (0.91, 0.8), (0.91, 0.64), (0.89, 0.645), (0.0, 0.65)]:
        assert routine.velocity(sample(start, share * turning), start) == pytest.approx(pace * full)
    for _ in range(100):
        wanted = routine.velocity(sample(start), start)
    assert wanted == pytest.approx(full)
    fast_already = Goto(panda, home, "home", kinematics).velocity(sample(start, 0.91 * turning), start)
    assert fast_already == pytest.approx(0.8 * full)


@pytest.mark.parametrize(("distance", "done"), [(1.9e-3, True), (2.1e-3, False)])
def test_goto_is_done_when_it_has_arrived(panda: Robot, distance, done):
    home = np.array(panda.profile.home)
    routine = Goto(panda, home, "home", Kinematics(panda))
    position = home.copy()
    position[4] += distance
    assert (routine.velocity(sample(position), position) is None) is done


def test_retreat_from_beyond_joint_limits(robot: Robot, kinematics: Kinematics):
    safety = robot.profile.safety
    for side, limit in ((1, robot.limits.upper), (-1, robot.limits.lower)):
        start = np.array(robot.profile.home)
        start[0] = limit[0] + side * 0.1
        start[-1] = limit[-1] + side * 0.05
        routine = Retreat(robot, kinematics)
        routine._regions[0].radius = 10.0  # the joints alone
        positions, wishes = lead_ideally(robot, routine, start)
        beyond = np.maximum(positions - robot.limits.upper, robot.limits.lower - positions).max(axis=1)
        assert beyond[0] > 0.0
        assert beyond[-1] < -safety.position_margin
        assert (np.diff(beyond) <= 1e-12).all()
        assert (np.abs(wishes) <= 0.1 * robot.limits.velocity * (1 + 1e-9)).all()


def test_retreat_from_outside_the_sphere(robot: Robot, kinematics: Kinematics):
    """Several starts up to 6 cm outside: always inwards, slowly, and to its end."""
    rng = np.random.default_rng(2)
    sphere = regions(robot.profile, robot.profile.safety.sphere_margin)[0]
    starts = []
    while len(starts) < 3:
        pose = rng.uniform(robot.limits.lower + 0.2, robot.limits.upper - 0.2)
        if -0.06 < sphere.room(kinematics.tool(pose)) < -0.02:
            starts.append(pose)
    for start in starts:
        positions, velocities, wishes = lead(robot, kinematics, Retreat(robot, kinematics), start)
        rooms = np.array([sphere.room(kinematics.tool(position)) for position in positions])
        assert rooms[-1] > 0.0
        assert (np.diff(rooms) >= -1e-6).all()
        assert (np.abs(wishes) <= 0.1 * robot.limits.velocity * (1 + 1e-9)).all()
        assert (positions >= robot.limits.lower).all()
        assert (positions <= robot.limits.upper).all()
        assert (np.abs(velocities) <= robot.limits.velocity).all()


@pytest.mark.parametrize("kind", ["plane", "box"])
def test_retreat_from_inside_a_keep_out(panda: Robot, kind: str):
    """Home lies 3 cm inside; the way out is the shortest, and at least 1 cm further."""
    home = np.array(panda.profile.home)
    x, y, z = Kinematics(panda).tool(home)
    item = {
        "plane": f"{{kind: plane, name: a, point: [{x - 0.03}, 0, 0], normal: [-1, 0, 0]}}",
        "box": f"{{kind: box, name: a, centre: [{x + 0.07}, {y}, {z}], half: [0.1, 0.3, 0.3]}}",
    }[kind]
    robot = load_robot("panda", [f"keep_out=[{item}]"])
    kinematics = Kinematics(robot)
    region = regions(robot.profile)[1]
    positions, _, wishes = lead(robot, kinematics, Retreat(robot, kinematics), home)
    rooms = np.array([region.room(kinematics.tool(position)) for position in positions])
    assert rooms[0] == pytest.approx(-0.03)
    assert rooms[-1] > 0.01
    assert (np.diff(rooms) >= -1e-6).all()
    assert kinematics.tool(positions[-1])[1:] == pytest.approx([y, z], abs=5e-3)
    assert (np.abs(wishes) <= 0.1 * robot.limits.velocity * (1 + 1e-9)).all()


def test_retreat_through_the_shaper_from_beyond_a_joint_limit(panda: Robot):
    """The shaper lets it in, although the start is outside what it allows."""
    kinematics = Kinematics(panda)
    start = np.array(panda.profile.home)
    start[4] = panda.limits.upper[4] + 0.05
    positions, _, _ = lead(panda, kinematics, Retreat(panda, kinematics), start)
    assert positions[-1][4] < panda.limits.upper[4]
    assert (np.diff(positions[:, 4]) <= 1e-12).all()


def test_retreat_has_nothing_to_do_inside(robot: Robot, kinematics: Kinematics):
    home = np.array(robot.profile.home)
    assert Retreat(robot, kinematics).velocity(sample(home), home) is None


class Slide:
    """The first joint slides the tool along x, a metre per radian, from `start`."""

    def __init__(self, start) -> None:
        self._start = np.array(start)

    def tool_and_jacobian(self, position):
        jacobian = np.zeros((3, len(position)))
        jacobian[0, 0] = 1.0
        return self._start + position[0] * jacobian[:, 0], jacobian


SPHERE = load_robot("panda").profile.sphere


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize(
    ("beyond", "speed"),  # past where the retreat ends, rad; and the speed of that, rad/s
    [(0.5, 0.1), (0.034, 0.1), (0.03, 0.09), (0.01, 0.03), (0.006, 0.02), (0.0021, 0.02), (0.0019, None)],
)
def test_a_joint_retreats_in_proportion_between_a_crawl_and_a_tenth_of_its_cap(panda: Robot, side, beyond, speed):
    end = (panda.limits.upper[1] if side > 0 else -panda.limits.lower[1]) - panda.profile.safety.position_margin - 0.01
    position = np.array(panda.profile.home)
    position[1] = side * (end + beyond)
    wanted = Retreat(panda, Slide(SPHERE.centre)).velocity(sample(position), position)
    if speed is None:
        assert wanted is None
    else:
        assert wanted == pytest.approx([0.0, -side * speed, 0.0, 0.0, 0.0, 0.0, 0.0], abs=1e-12)


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize(
    ("beyond", "speed"),  # past where the retreat ends, m
    [(0.5, 0.1), (0.03, 0.09 / 1.001), (0.01, 0.03 / 1.001), (0.006, 0.02), (0.0021, 0.02), (0.0019, None)],
)
def test_so_does_the_tool(panda: Robot, side, beyond, speed):
    """The damped inverse of a Jacobian of length 1 is 1/1.001 long."""
    position = np.array(panda.profile.home)
    out = SPHERE.radius - panda.profile.safety.sphere_margin - 0.01 + beyond
    slide = Slide(np.array(SPHERE.centre) + side * np.array([out, 0.0, 0.0]))
    wanted = Retreat(panda, slide).velocity(sample(position), position)
    if speed is None:
        assert wanted is None
    else:
        assert wanted == pytest.approx([-side * speed, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], abs=1e-12)


class Crowd:
    """Two pairs of links: the clearance of the second grows with the third joint, at half a metre per radian."""

    pairs = (("base", "post"), ("elbow", "table"))

    def measure(self, position, pairs):
        return np.array([1.0, 0.5 * position[2]])[list(pairs)]

    def approach(self, position, pairs):
        assert pairs in ([], [1])
        return [np.array([0.0, 0.0, -0.5, 0.0, 0.0, 0.0, 0.0]) for _ in pairs]


@pytest.mark.parametrize(
    ("short", "speed"),  # of the clearance at which the retreat ends, m; and the speed of the joint, rad/s
    [(0.1, 0.1), (0.01, 3.0 * 0.01 * 0.5 / 0.251), (0.001, 0.02), (1e-6, 0.02), (-1e-6, None)],
)
def test_links_that_are_too_near_are_led_apart(panda: Robot, short, speed):
    safety = panda.profile.safety
    position = np.array(panda.profile.home)
    position[2] = 2.0 * (safety.proximity_stop + safety.proximity_margin + 0.002 - short)
    wanted = Retreat(panda, Slide(SPHERE.centre), Crowd()).velocity(sample(position), position)
    if speed is None:
        assert wanted is None
    else:
        assert wanted == pytest.approx([0.0, 0.0, speed, 0.0, 0.0, 0.0, 0.0], abs=1e-12)


def test_a_retreat_that_knows_no_way_stays_where_it_is(panda: Robot):
    position = np.array(panda.profile.home)
    above = np.array(SPHERE.centre) + np.array([0.0, 0.0, 1.0])  # the slide moves the tool along x only
    assert not Retreat(panda, Slide(above)).velocity(sample(position), position).any()


def test_in_the_very_middle_of_a_tiny_sphere_every_way_leads_out():
    robot = load_robot("panda", ["sphere.radius=0.005"])
    position = np.array(robot.profile.home)
    assert not Retreat(robot, Slide(SPHERE.centre)).velocity(sample(position), position).any()


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize(("error", "speed"), [(0.01, 0.03), (0.5, 0.3)])
def test_goto_slows_down_in_proportion_and_keeps_to_its_share_of_the_caps(panda: Robot, side, error, speed):
    pose = np.array(panda.profile.home)
    position = pose.copy()
    position[1] -= side * error
    wanted = Goto(panda, pose, "home", Slide(SPHERE.centre)).velocity(sample(position), position)
    assert wanted == pytest.approx([0.0, side * speed, 0.0, 0.0, 0.0, 0.0, 0.0], abs=1e-12)


def test_names_and_times_after_which_a_routine_has_failed(panda: Robot):
    slide = Slide(SPHERE.centre)
    assert (Settle(panda).name, Settle(panda).timeout_s) == ("settle", 2.0 + panda.stopping_time_s)
    assert (Retreat(panda, slide).name, Retreat(panda, slide).timeout_s) == ("retreat", 30.0)
    goto = Goto(panda, np.array(panda.profile.home), "home", slide)
    assert (goto.name, goto.timeout_s) == ("home", 60.0)


@pytest.mark.parametrize("side", [-1, 1])
def test_settle_waits_for_every_measured_joint(robot: Robot, side):
    routine = Settle(robot)
    still = robot.profile.safety.standstill
    home = np.array(robot.profile.home)
    for joint in range(robot.dof):
        velocity = np.zeros(robot.dof)
        velocity[joint] = side * still
        assert not routine.velocity(sample(home, velocity), home).any()
        velocity[joint] = side * (still - 1e-9)
        assert routine.velocity(sample(home, velocity), home) is None
    assert routine.timeout_s > robot.stopping_time_s


def drawn(robot, seed, kinematics):
    return RandomStart(robot, seed, kinematics)._pose


def test_random_starts_follow_their_seed(robot: Robot, kinematics: Kinematics):
    assert np.array_equal(drawn(robot, 0, kinematics), drawn(robot, 0, Kinematics(robot)))
    assert not np.array_equal(drawn(robot, 0, kinematics), drawn(robot, 1, kinematics))
    assert RandomStart(robot, 7, kinematics).name == "random start 7"


def test_the_pose_of_a_seed_stays_the_same_in_later_versions(panda: Robot):
    first = panda.profile.home + np.random.default_rng(3).uniform(-0.2, 0.2, panda.dof)
    assert np.array_equal(drawn(panda, 3, Kinematics(panda)), first)


def test_random_starts_fill_the_box_around_home(panda: Robot):
    kinematics = Kinematics(panda)
    away = np.array([drawn(panda, seed, kinematics) for seed in range(200)]) - panda.profile.home
    assert (np.abs(away) <= 0.2).all()
    assert (away.min(axis=0) < -0.15).all()
    assert (away.max(axis=0) > 0.15).all()


@pytest.mark.parametrize("side", [-1, 1])
def test_random_starts_keep_the_soft_limits(side):
    robot = load_robot("panda", ["start_spread=0.1", "safety.position_margin=0.02"])
    edge = robot.limits.upper[6] if side > 0 else robot.limits.lower[6]
    home = [*robot.profile.home[:6], float(edge - side * 0.05)]
    robot = load_robot("panda", ["start_spread=0.1", "safety.position_margin=0.02", f"home={home}"])
    kinematics = Kinematics(robot)
    room = np.array([side * (edge - drawn(robot, seed, kinematics)[6]) for seed in range(200)])
    assert room.min() >= 0.02
    assert room.min() < 0.025
    assert room.max() > 0.14


def test_random_starts_stay_inside_every_region():
    wall = "keep_out=[{kind: plane, name: wall, point: [0.0, 0.1, 0.0], normal: [0.0, -1.0, 0.0]}]"
    robot = load_robot("panda", [wall, "start_spread=0.3"])
    kinematics = Kinematics(robot)
    tools = np.array([kinematics.tool(drawn(robot, seed, kinematics)) for seed in range(200)])
    allowed = 0.1 - 0.02 - robot.profile.safety.sphere_margin
    assert tools[:, 1].max() <= allowed
    assert tools[:, 1].max() > allowed - 0.01


def test_a_random_start_that_is_hardly_ever_inside_is_refused(panda: Robot):
    robot = load_robot("panda", ["sphere.radius=0.021"])
    with pytest.raises(ConfigError, match="no random start found in 100 draws"):
        RandomStart(robot, 0, Kinematics(robot))
    with pytest.raises(ConfigError, match="seed -1 is negative"):
        RandomStart(panda, -1, Kinematics(panda))


def test_a_random_start_is_led_to(panda: Robot):
    kinematics = Kinematics(panda)
    routine = RandomStart(panda, 5, kinematics)
    positions, _, _ = lead(panda, kinematics, routine, panda.profile.home)
    assert positions[-1] == pytest.approx(drawn(panda, 5, kinematics), abs=2e-3)


class Apart:
    """A scene with one pair, always as far apart."""

    pairs = (("link", "wall"),)

    def __init__(self, dof: int, clearance: float):
        self.reach = np.zeros((1, dof))
        self.clearance = clearance

    def measure(self, position, pairs):
        return np.full(len(pairs), self.clearance)


@pytest.mark.parametrize(("short", "good"), [(-1e-6, True), (1e-6, False)])
def test_random_starts_keep_links_apart(panda: Robot, short: float, good: bool):
    safety = panda.profile.safety
    scene = Apart(panda.dof, safety.proximity_stop + safety.proximity_margin + 2e-3 - short)
    if good:
        RandomStart(panda, 0, Kinematics(panda), scene)
    else:
        with pytest.raises(ConfigError, match="no random start"):
            RandomStart(panda, 0, Kinematics(panda), scene)
