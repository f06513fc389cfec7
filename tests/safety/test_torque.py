"""P8: the torque shaper, one call at a time."""

import daqp
import numpy as np
import pytest

from robotctl.control.kinematics import Kinematics
from robotctl.hal.robot import load_robot
from robotctl.safety.box import JointBox
from robotctl.safety.lookahead import Lookahead
from robotctl.safety.shaper import Clip
from robotctl.safety.torque import ArmState, TorqueShaper

REST = np.zeros(7)
REACTION = 0.02


PANDA = load_robot("panda")


@pytest.fixture(scope="module")
def kinematics() -> Kinematics:
    return Kinematics(PANDA)


@pytest.fixture(scope="module")
def shaper(kinematics: Kinematics) -> TorqueShaper:
    return TorqueShaper(PANDA, kinematics)


def state(kinematics, position, velocity=REST, effort=None, external=REST):
    gravity = kinematics.gravity(position)
    return ArmState(np.asarray(position), velocity, gravity if effort is None else effort, external)


def acceleration(kinematics, moving, torque):
    bias = kinematics.bias(moving.position, moving.velocity) + kinematics.damping * moving.velocity
    return np.linalg.solve(kinematics.mass_matrix(moving.position), torque + moving.external - bias)


def middle(robot):
    return np.array(robot.profile.home)


def test_where_nothing_binds_the_wanted_torque_is_returned(shaper, kinematics, panda):
    moving = state(kinematics, middle(panda))
    wanted = moving.effort + 0.01
    torque, clip = shaper.push(moving, wanted)
    assert torque is wanted
    assert clip is Clip.NONE


@pytest.mark.parametrize("joint", range(7))
@pytest.mark.parametrize("side", [-1, 1])
def test_torque_changes_no_faster_than_its_rate_and_stays_under_its_cap(shaper, kinematics, panda, joint, side):
    moving = state(kinematics, middle(panda))
    wanted = moving.effort.copy()
    wanted[joint] += side * 500.0
    torque, clip = shaper.push(moving, wanted)
    assert (np.abs(torque - moving.effort) <= panda.limits.torque_rate * 2e-3 + 1e-9).all()
    assert clip & Clip.TORQUE
    full = state(kinematics, middle(panda), effort=side * panda.limits.torque)
    torque, _ = shaper.push(full, 2.0 * full.effort)
    assert (np.abs(torque) <= panda.limits.torque + 1e-9).all()


@pytest.mark.parametrize("joint", [4, 5, 6])
@pytest.mark.parametrize("side", [-1, 1])
def test_light_joints_keep_their_acceleration_caps(shaper, kinematics, panda, joint, side):
    moving = state(kinematics, middle(panda))
    wanted = moving.effort.copy()
    wanted[joint] += side * 1.5
    torque, clip = shaper.push(moving, wanted)
    assert clip & Clip.ACCELERATION
    assert (np.abs(acceleration(kinematics, moving, torque)) <= panda.limits.acceleration + 1e-3).all()


@pytest.mark.parametrize("joint", range(7))
@pytest.mark.parametrize("side", [-1, 1])
def test_at_its_velocity_cap_a_joint_gets_no_faster(shaper, kinematics, panda, joint, side):
    velocity = REST.copy()
    velocity[joint] = side * (1.0 - panda.profile.safety.cap_margin) * panda.limits.velocity[joint]
    moving = state(kinematics, middle(panda), velocity)
    wanted = moving.effort.copy()
    wanted[joint] += side * 1.0
    torque, clip = shaper.push(moving, wanted)
    assert clip & (Clip.VELOCITY | Clip.POSITION | Clip.SPHERE)
    assert side * acceleration(kinematics, moving, torque)[joint] < 0.1


@pytest.mark.parametrize("joint", range(7))
@pytest.mark.parametrize("side", [-1, 1])
def test_before_a_soft_limit_a_joint_brakes(shaper, kinematics, panda, joint, side):
    limit = (panda.limits.upper if side > 0 else panda.limits.lower)[joint]
    position, velocity = middle(panda), REST.copy()
    speed = 0.6
    position[joint] = limit - side * (REACTION * speed + speed**2 / (2.0 * 0.5 * panda.limits.acceleration[joint]))
    velocity[joint] = side * speed
    moving = state(kinematics, position, velocity)
    torque, clip = shaper.push(moving, moving.effort)
    assert clip
    assert side * acceleration(kinematics, moving, torque)[joint] < 0.0


def test_a_load_that_was_observed_is_reckoned_with(shaper, kinematics, panda):
    """The same torque, with an unknown 10 Nm in the shoulder that helps it: the cap on acceleration binds earlier."""
    external = REST.copy()
    external[0] = 10.0
    moving = state(kinematics, middle(panda), external=external)
    torque, clip = shaper.push(moving, moving.effort)
    assert clip & Clip.ACCELERATION
    assert torque[0] < moving.effort[0]


def test_the_sphere_is_approached_no_faster_than_room_allows(kinematics, panda):
    home = middle(panda)
    x, y, z = (float(value) for value in kinematics.tool(home))
    robot = load_robot("panda", [f"sphere.centre=[{x - 0.1}, {y}, {z}]", "sphere.radius=0.103"])
    shaper = TorqueShaper(robot, kinematics)
    _, jacobian = kinematics.tool_and_jacobian(home)
    velocity = jacobian.T @ np.array([0.5, 0.0, 0.0])
    moving = state(kinematics, home, velocity)
    torque, clip = shaper.push(moving, moving.effort)
    assert clip & Clip.SPHERE
    assert (jacobian @ acceleration(kinematics, moving, torque))[0] < 0.0


@pytest.mark.parametrize("seed", range(20))
def test_the_answer_is_no_further_from_the_wanted_torque_than_any_other_that_keeps_the_box(
    shaper, kinematics, panda, seed
):
    """Compared, in the metric of M^-1, with random torques that keep torque, rate and acceleration."""
    rng = np.random.default_rng(seed)
    moving = state(kinematics, middle(panda), rng.uniform(-0.2, 0.2, 7))
    wanted = moving.effort + rng.uniform(-2.0, 2.0, 7)
    torque, _ = shaper.push(moving, wanted)
    mobility = np.linalg.inv(kinematics.mass_matrix(moving.position))
    distance = (torque - wanted) @ mobility @ (torque - wanted)
    usable = (1.0 - panda.profile.safety.cap_margin) * panda.limits.acceleration
    for _ in range(200):
        other = torque + rng.normal(0.0, 0.2, 7)
        fits = (np.abs(acceleration(kinematics, moving, other)) <= usable - 1e-2).all()
        fits &= bool((np.abs(other - moving.effort) <= panda.limits.torque_rate * 2e-3).all())
        if fits:
            assert (other - wanted) @ mobility @ (other - wanted) >= distance - 1e-3


def test_where_the_solver_fails_the_arm_brakes(shaper, kinematics, panda, monkeypatch):
    velocity = np.full(7, 0.3)
    moving = state(kinematics, middle(panda), velocity)
    monkeypatch.setattr(daqp, "solve", lambda *_: (None, 0.0, -1, {}))
    torque, _ = shaper.push(moving, moving.effort + 50.0)
    assert (acceleration(kinematics, moving, torque)[:4] < 0.0).all()
    assert (np.abs(torque - moving.effort) <= panda.limits.torque_rate * 2e-3 + 1e-9).all()


def test_at_the_centre_of_its_sphere_a_tool_is_free(kinematics):
    """There is no direction outward there, so no row."""
    home = middle(PANDA)
    x, y, z = (float(value) for value in kinematics.tool(home))
    robot = load_robot("panda", [f"sphere.centre=[{x}, {y}, {z}]"])
    moving = state(kinematics, home)
    torque, clip = TorqueShaper(robot, kinematics).push(moving, moving.effort)
    assert torque is moving.effort
    assert clip is Clip.NONE


# -- joints that know nothing of each other ------------------------------------------------------------------------


class Loose:
    """Joints without coupling; the tool goes along x with the first one, at half its angle."""

    damping = np.linspace(0.2, 2.0, 7)
    reach = np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])

    def mass(self, position):
        return 0.1 + 0.05 * np.sin(20.0 * position) ** 2

    def mass_matrix(self, position):
        return np.diag(self.mass(position))

    def bias(self, position, velocity):
        return 3.0 * position + 0.3 * velocity**2

    def tool(self, position):
        return np.array([0.5 * position[0], 0.0, 0.5])

    def tool_and_jacobian(self, position):
        jacobian = np.zeros((3, 7))
        jacobian[0, 0] = 0.5
        return self.tool(position), jacobian


LAG, DELAY = 0.013, 0.004
LOOSE = Loose()


def loose_robot(*settings):
    return load_robot("panda", [f"twin.lag_s={LAG}", f"twin.delay_s={DELAY}", *settings])


def by_hand(robot, moving, wanted):
    """Torque (n,) and clip, a joint at a time: as close to the wanted one as acceleration and then torque allow."""
    reaction, usable = 0.02 + LAG + DELAY, 1.0 - robot.profile.safety.cap_margin
    position, velocity, effort, external = moving
    middle = position + 1e-3 * velocity
    mass = LOOSE.mass(middle) + 2e-3 * LOOSE.damping
    load = LOOSE.bias(middle, velocity) + LOOSE.damping * velocity - external
    box = JointBox(robot, reaction, usable, brake_share=0.5, pull=0.25 / reaction)
    slowest, fastest = box.bounds(position, velocity)
    most_torque = np.minimum(robot.limits.torque, effort + 2e-3 * robot.limits.torque_rate)
    least_torque = np.maximum(-robot.limits.torque, effort - 2e-3 * robot.limits.torque_rate)
    torque = np.clip(
        wanted, load + mass * (slowest - velocity) / reaction, load + mass * (fastest - velocity) / reaction
    )
    clip = Clip.NONE
    for joint in range(7):
        following = velocity[joint] + reaction * (wanted[joint] - load[joint]) / mass[joint]
        cap, step = usable * robot.limits.velocity[joint], usable * robot.limits.acceleration[joint] * reaction
        if not least_torque[joint] <= wanted[joint] <= most_torque[joint]:
            clip |= Clip.TORQUE
        if abs(following) > cap:
            clip |= Clip.VELOCITY
        if abs(following - velocity[joint]) > step:
            clip |= Clip.ACCELERATION
        for side, bound in ((1.0, fastest[joint]), (-1.0, -slowest[joint])):
            if side * following > bound and bound < min(cap, side * velocity[joint] + step):
                clip |= Clip.POSITION
    return np.clip(torque, least_torque, most_torque), clip


def loose_motion(rng, robot, near):
    limits = robot.limits
    position = rng.uniform(-0.5, 0.5, 7)
    if near:
        side = rng.random(7) < 0.5
        position = np.where(side, limits.upper, limits.lower) + rng.uniform(-0.05, 0.05, 7)
    velocity = rng.uniform(-0.99, 0.99, 7) * limits.velocity
    load = LOOSE.bias(position, velocity) + LOOSE.damping * velocity
    effort = np.clip(load + rng.uniform(-4.0, 4.0, 7), -limits.torque, limits.torque)
    return ArmState(position, velocity, effort, rng.uniform(-1.0, 1.0, 7))


@pytest.mark.parametrize("seed", range(40))
@pytest.mark.parametrize("near", [False, True])
@pytest.mark.parametrize("spread", [0.3, 5.0])
def test_without_coupling_each_joint_gets_what_is_right_for_it(seed, near, spread):
    robot = loose_robot("sphere.centre=[0.0, 0.0, 0.0]", "sphere.radius=20.0")
    rng = np.random.default_rng(seed)
    moving = loose_motion(rng, robot, near)
    wanted = moving.effort + rng.uniform(-spread, spread, 7)
    torque, clip = TorqueShaper(robot, LOOSE).push(moving, wanted)
    expected, why = by_hand(robot, moving, wanted)
    assert torque == pytest.approx(expected, abs=1e-6)
    assert clip == why


@pytest.mark.parametrize("joint", range(7))
@pytest.mark.parametrize("case", ["free", "torque", "velocity", "acceleration", "position"])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_clip_tells_which_limit_one_joint_would_have_passed(joint, case, side):
    robot = loose_robot("sphere.centre=[0.0, 0.0, 0.0]", "sphere.radius=20.0")
    position, velocity, wanted = middle(PANDA), np.zeros(7), np.zeros(7)
    match case:
        case "torque":
            wanted[joint] = side * (2e-3 * robot.limits.torque_rate[joint] + 1e-3)
        case "velocity":
            velocity[joint] = side * robot.limits.velocity[joint] * 0.99
        case "acceleration":
            wanted[joint] = side * 0.15 * robot.limits.acceleration[joint]
        case "position":
            velocity[joint] = side * 0.3
            position[joint] = (robot.limits.upper if side > 0 else robot.limits.lower)[joint] - side * 0.02
    load = LOOSE.bias(position, velocity) + LOOSE.damping * velocity
    moving = ArmState(position, velocity, load, np.zeros(7))
    torque, clip = TorqueShaper(robot, LOOSE).push(moving, load + wanted)
    expected, why = by_hand(robot, moving, load + wanted)
    assert torque == pytest.approx(expected, abs=1e-6)
    assert clip == why
    if case != "free":
        assert Clip[case.upper()] in clip


@pytest.mark.parametrize("room", [0.0, 1e-3, 4e-3, 8e-3])
def test_a_tool_is_braked_by_just_what_its_sphere_demands(room):
    robot = loose_robot("sphere.centre=[-1.0, 0.0, 0.5]", f"sphere.radius={1.05 + 5e-3 + room}")
    velocity = np.array([0.05, *REST[1:]])
    moving = ArmState(np.array([0.1, *REST[1:]]), velocity, np.array([0.3, *REST[1:]]), REST)
    middle = moving.position + 1e-3 * velocity
    mass = LOOSE.mass(middle)[0] + 2e-3 * LOOSE.damping[0]
    load = LOOSE.bias(middle, velocity)[0] + LOOSE.damping[0] * velocity[0]
    ahead = Lookahead(robot, LOOSE, 0.02 + LAG + DELAY, None).rows(moving.position, velocity)
    most = min(bound / normal[0] for normal, bound in zip(ahead.normals, ahead.bounds, strict=True))
    torque, clip = TorqueShaper(robot, LOOSE).push(moving, moving.effort + np.array([1.9, *REST[1:]]))
    assert Clip.SPHERE in clip
    assert torque[0] == pytest.approx(load + mass * most, abs=1e-6)
