"""The reference: what it integrates, what it feeds forward, and what its slow integrator may do."""

import numpy as np
import pytest

from robotctl.control.kinematics import Kinematics
from robotctl.control.reference import Reference
from robotctl.hal.robot import Robot
from robotctl.hal.types import CommandMode


@pytest.fixture
def kinematics(robot: Robot) -> Kinematics:
    return Kinematics(robot)


@pytest.fixture
def reference(robot: Robot, kinematics: Kinematics) -> Reference:
    made = Reference(robot, kinematics)
    made.resync(np.array(robot.profile.home), np.zeros(robot.dof))
    return made


def test_it_integrates_by_the_trapezoid(robot: Robot, reference: Reference):
    dt, home = robot.period_ns * 1e-9, np.array(robot.profile.home)
    slope = 0.3 * robot.limits.acceleration
    for step in range(1, 51):
        command = reference.step(slope * step * dt, reference.position)
    time = 50 * dt
    assert command.mode is CommandMode.TRACK
    assert command.position == pytest.approx(home + 0.5 * slope * time**2, abs=1e-12)
    assert command.velocity == pytest.approx(slope * time)
    assert reference.acceleration == pytest.approx(slope)
    assert command.position is reference.position
    assert command.velocity is reference.velocity


def test_at_rest_the_effort_is_gravity(robot: Robot, reference: Reference, kinematics: Kinematics):
    home, rest = np.array(robot.profile.home), np.zeros(robot.dof)
    expected = np.clip(kinematics.gravity(home), -robot.limits.torque, robot.limits.torque)
    for _ in range(200):
        command = reference.step(rest, home)
    assert command.effort == pytest.approx(expected, abs=1e-9)  # no error, no bias
    assert np.abs(expected).max() > 0.5


def test_in_motion_the_effort_is_that_of_the_motion(robot: Robot, reference: Reference, kinematics: Kinematics):
    dt = robot.period_ns * 1e-9
    velocity = 0.3 * robot.limits.velocity
    reference.resync(reference.position, velocity - 0.01)
    command = reference.step(velocity, reference.position)
    expected = kinematics.inverse_dynamics(reference.position, velocity, np.full(robot.dof, 0.01 / dt))
    expected += kinematics.damping * velocity + kinematics.friction * np.tanh(velocity / 0.02)
    assert command.effort == pytest.approx(np.clip(expected, -robot.limits.torque, robot.limits.torque), abs=1e-9)


def test_a_lasting_error_at_rest_is_answered_by_a_growing_bounded_bias(robot: Robot, reference: Reference):
    home, rest = np.array(robot.profile.home), np.zeros(robot.dof)
    sag = home - 0.05  # the arm hangs below its reference
    before = reference.step(rest, home).effort
    efforts = [reference.step(rest, sag).effort - before for _ in range(1000)]
    assert (np.diff(efforts, axis=0) >= -1e-12).all()
    assert (efforts[-1] > 0.0).all()
    ki = np.array([joint.gains.ki for joint in robot.profile.joints])
    room = robot.limits.torque - before
    expected = np.minimum(np.minimum(ki * 0.05 * 1000 * robot.period_ns * 1e-9, 0.3 * robot.limits.torque), room)
    assert efforts[-1] == pytest.approx(expected, rel=0.01)
    for _ in range(20_000):
        effort = reference.step(rest, home - 5.0).effort
    assert (effort - before <= 0.3 * robot.limits.torque + 1e-9).all()
    assert (np.abs(effort) <= robot.limits.torque).all()


@pytest.mark.parametrize(("error", "works"), [(0.9e-3, False), (1.1e-3, True)])
def test_dry_friction_sized_errors_are_left_alone(robot: Robot, reference: Reference, error, works):
    home, rest = np.array(robot.profile.home), np.zeros(robot.dof)
    for _ in range(100):
        reference.step(rest, home - error)
    assert (np.abs(reference._bias) > 0.0).all() == works
    assert (np.abs(reference._bias) > 0.0).any() == works


def test_motion_does_not_wind_the_integrator_up(robot: Robot, reference: Reference):
    velocity = np.zeros(robot.dof)
    velocity[0] = 0.1
    reference.resync(reference.position, velocity)
    for _ in range(200):
        reference.step(velocity, reference.position - 0.05)
    assert not reference._bias.any()


def test_resync_starts_anew_and_caps_the_speed(robot: Robot, reference: Reference):
    reference.step(np.full(robot.dof, 0.01), reference.position)
    measured = np.array(robot.profile.rest)
    reference.resync(measured, 10.0 * robot.limits.velocity)
    assert reference.position == pytest.approx(measured)
    assert reference.velocity == pytest.approx(robot.limits.velocity)
    assert not reference.acceleration.any()
    measured[0] += 1.0  # a copy was taken
    assert reference.position[0] == pytest.approx(robot.profile.rest[0])


def test_efforts_never_exceed_the_joints_torque(robot: Robot, reference: Reference):
    rng = np.random.default_rng(4)
    for _ in range(200):
        velocity = rng.uniform(-1, 1, robot.dof) * robot.limits.velocity
        effort = reference.step(velocity, reference.position).effort
        assert (np.abs(effort) <= robot.limits.torque).all()


def test_a_measurement_that_is_no_number_leaves_no_trace(robot: Robot, reference: Reference):
    home, rest = np.array(robot.profile.home), np.zeros(robot.dof)
    expected = reference.step(rest, home).effort
    reference.step(rest, np.full(robot.dof, np.nan))
    assert reference.step(rest, home).effort == pytest.approx(expected)
