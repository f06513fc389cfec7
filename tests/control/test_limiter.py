"""Velocity, acceleration, jerk and torque rate under whatever is wished for."""

import numpy as np
import pytest

from robotctl.control.limiter import TorqueLimiter, VelocityLimiter
from robotctl.hal.robot import Robot

HAIR = 1.0 + 1e-9


def wishes(robot, kind, rng, count):
    cap = robot.limits.velocity
    wish = np.zeros(robot.dof)
    for tick in range(count):
        if kind == "restless" or (kind == "random" and tick % 25 == 0):
            wish = rng.uniform(-2.0, 2.0, robot.dof) * cap
        elif kind == "bang" and tick % 60 == 0:
            wish = rng.choice([-1e300, -10.0, 0.0, 10.0, 1e300], robot.dof)
        yield wish


@pytest.mark.parametrize("kind", ["random", "restless", "bang"])
def test_no_wish_exceeds_a_cap(robot: Robot, kind):
    limiter, dt = VelocityLimiter(robot), robot.period_ns * 1e-9
    velocity, acceleration = np.zeros(robot.dof), np.zeros(robot.dof)
    fastest = np.zeros(robot.dof)
    for wish in wishes(robot, kind, np.random.default_rng(1), 1500):
        following = limiter.step(wish, velocity, acceleration)
        now = (following - velocity) / dt
        assert (np.abs(following) <= limiter.cap * HAIR).all()
        assert (np.abs(now) <= robot.limits.acceleration).all()
        assert (np.abs(now - acceleration) <= robot.limits.jerk * dt * (1 + 1e-6)).all()
        velocity, acceleration = following, now
        fastest = np.maximum(fastest, np.abs(velocity))
    if kind != "restless":
        assert (fastest > 0.5 * limiter.cap).all()  # else nothing was tested


@pytest.mark.parametrize("kind", ["random", "bang"])
def test_caps_hold_when_somebody_else_changes_the_answer(robot: Robot, kind):
    """As the shaper does: every now and then the reference takes another velocity than the limiter answered."""
    limiter, dt = VelocityLimiter(robot), robot.period_ns * 1e-9
    rng = np.random.default_rng(2)
    velocity, acceleration = np.zeros(robot.dof), np.zeros(robot.dof)
    step = limiter._acceleration * dt
    altered = 0
    for tick, wish in enumerate(wishes(robot, kind, rng, 1500)):
        following = limiter.step(wish, velocity, acceleration)
        # From any velocity and acceleration within the caps the next step is within them, too.
        assert (np.abs(following) <= np.maximum(limiter.cap, np.abs(velocity) + step) * HAIR).all()
        assert (np.abs(following - velocity) <= robot.limits.acceleration * dt).all()
        if tick % 7 == 0 or rng.random() < 0.1:
            following = velocity - np.clip(velocity, -step, step)
            altered += 1
        acceleration = (following - velocity) / dt
        velocity = following
    assert altered > 200


def test_the_velocity_that_was_handed_in_is_where_it_goes_on_from(panda: Robot):
    """Twice the same limiter, once after another motion: the answers are the same."""
    used, fresh = VelocityLimiter(panda), VelocityLimiter(panda)
    velocity, zero = np.zeros(7), np.zeros(7)
    for _ in range(100):
        velocity = used.step(np.ones(7), velocity, zero)
    changed = np.full(7, 0.2)
    wish = np.full(7, -0.5)
    assert used.step(wish, changed, zero) == pytest.approx(fresh.step(wish, changed, zero), abs=1e-15)


def test_a_wish_is_reached_and_kept(robot: Robot):
    limiter = VelocityLimiter(robot)
    velocity, acceleration = np.zeros(robot.dof), np.zeros(robot.dof)
    wish = 0.4 * robot.limits.velocity
    dt = robot.period_ns * 1e-9
    for _ in range(round(1.0 / dt)):
        following = limiter.step(wish, velocity, acceleration)
        velocity, acceleration = following, (following - velocity) / dt
    assert velocity == pytest.approx(wish, abs=1e-9)


def test_a_wish_beyond_the_cap_is_clipped_to_it(robot: Robot):
    limiter = VelocityLimiter(robot)
    velocity, acceleration = np.zeros(robot.dof), np.zeros(robot.dof)
    wish, dt = 3.0 * robot.limits.velocity, robot.period_ns * 1e-9
    for _ in range(round(1.0 / dt)):
        following = limiter.step(wish, velocity, acceleration)
        velocity, acceleration = following, (following - velocity) / dt
    assert velocity == pytest.approx((1 - robot.profile.safety.cap_margin) * robot.limits.velocity, rel=1e-9)


def test_torques_and_their_rate_are_capped(robot: Robot):
    limiter, dt = TorqueLimiter(robot), robot.period_ns * 1e-9
    rng = np.random.default_rng(3)
    previous = np.zeros(robot.dof)
    largest = np.zeros(robot.dof)
    for _ in range(20):
        wish = rng.choice([-1e6, -1.0, 0.0, 1.0, 1e6], robot.dof)
        for _ in range(60):
            torque = limiter.step(wish, previous)
            assert (np.abs(torque) <= robot.limits.torque).all()
            assert (np.abs(torque - previous) <= robot.limits.torque_rate * dt * HAIR + 1e-12).all()
            previous = torque
            largest = np.maximum(largest, np.abs(torque))
    assert largest == pytest.approx(robot.limits.torque)


def test_a_torque_within_its_rate_is_granted(panda: Robot):
    wish = np.full(7, 0.5)
    assert TorqueLimiter(panda).step(wish, np.zeros(7)) == pytest.approx(wish)
