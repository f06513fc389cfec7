"""P8: the torque shaper, one call at a time."""

import daqp
import numpy as np
import pytest

from robotctl.control.kinematics import Kinematics
from robotctl.hal.robot import load_robot
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
