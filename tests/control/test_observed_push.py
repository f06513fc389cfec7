"""The momentum observer against the twin, whose pushes are known: on both backends, at rest, in motion and loaded."""

import numpy as np
import pytest

from robotctl.control.operator import Verb
from robotctl.control.session import LockstepSession
from robotctl.hal.robot import load_robot
from robotctl.safety.target import JointVelocity
from robotctl.sim.plant import Plant

RIGS = [("kinova", "sim"), ("xarm7", "sim"), ("panda", "sim"), ("panda", "can"), ("openarm", "sim"), ("openarm", "can")]


def plant_of(session: LockstepSession) -> Plant:
    arm = session._rig.arm
    return arm._plant if hasattr(arm, "_plant") else arm._channel.bus.bench.plant


@pytest.fixture
def holding(request: pytest.FixtureRequest):
    name, backend, *overrides = request.param
    robot = load_robot(name, ["safety.contact=1.0", *overrides])
    with LockstepSession(robot, backend) as session:
        session.request(Verb.ARM)
        session.advance(0.3)
        yield session


def found(session: LockstepSession) -> np.ndarray:
    return session.loop._motion.observer.external.copy()


@pytest.mark.parametrize("holding", RIGS, indirect=True)
def test_a_push_on_an_arm_at_rest_is_found_within_20_ms(holding: LockstepSession) -> None:
    """To a tenth, and the rounding of what the drives measure; the dry friction of a joint may hide as much of it."""
    robot = holding.robot
    friction = holding.loop.kinematics.friction
    for joint in range(robot.dof):
        push = np.zeros(robot.dof)
        push[joint] = 0.1 * robot.limits.torque[joint]
        before = found(holding)
        plant_of(holding).push(push)
        holding.advance(0.02)
        error = np.abs(found(holding) - before - push)
        assert (error <= 0.1 * push + 0.02 * robot.limits.torque + 2.0 * friction).all(), (joint, error)
        plant_of(holding).push(0.0 * push)
        holding.advance(0.2)


@pytest.mark.parametrize("holding", [("panda", "can", "payload=2.0", "twin.payload=-1.0")], indirect=True)
def test_a_payload_that_the_model_has_wrong_is_found_as_the_torque_it_is(holding: LockstepSession) -> None:
    kinematics = holding.loop.kinematics
    holding.advance(6.0)  # it sprang up, and comes to rest
    _, jacobian = kinematics.tool_and_jacobian(holding.latest()["true_position"])
    mean = np.zeros(7)
    for _ in range(100):  # where a measured velocity is rounded up or down in turn, it shows for a moment
        holding.advance(2e-3)
        mean += found(holding) / 100
    assert mean == pytest.approx(9.81 * jacobian[2], abs=0.3)  # a kilogram less pulls down


@pytest.mark.parametrize("holding", RIGS, indirect=True)
def test_in_free_motion_little_is_found(holding: LockstepSession) -> None:
    """What lasts for 20 ms stays far below the threshold of contact: under 2 % of the torque cap, and dry friction."""
    robot, rng = holding.robot, np.random.default_rng(3)
    holding.begin()
    residuals = []
    for step in range(40):
        velocity = rng.uniform(-1.5, 1.5, robot.dof) * robot.limits.velocity
        head = int(holding.latest()["epoch"]), step, holding.clock.now_ns() + 10**8
        holding.link.mailbox.put(JointVelocity(velocity, *head))
        for _ in range(25):
            holding.advance(robot.period_ns * 1e-9)
            residuals.append(found(holding))
    magnitudes = np.abs(np.array(residuals))
    lasting = np.lib.stride_tricks.sliding_window_view(magnitudes, 10, axis=0).min(axis=-1).max(axis=0)
    assert (lasting <= 0.02 * robot.limits.torque + 1.1 * holding.loop.kinematics.friction).all(), lasting
