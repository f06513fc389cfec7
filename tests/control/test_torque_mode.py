"""Hostile torque policies, judged on the plant's true state in every tick: P8 keeps what velocity targets keep."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from robotctl.control.operator import Verb
from robotctl.control.session import LockstepSession
from robotctl.hal.robot import Robot, load_robot
from robotctl.hal.types import Vector
from robotctl.safety.machine import State
from robotctl.safety.target import FreeDrive, JointTorque

POLICY_S = 0.05
ACCELERATION_TOLERANCE = 1.0
"""Share of its cap by which a true joint acceleration, over a servo period, may exceed it ..."""
WITH_WRONG_PAYLOAD = 2.0
"""... and with a payload that is wrong by half."""

Policy = Callable[[np.void], Vector]


class Torques:
    """Torque policies, as shares of the torque caps on top of gravity."""

    def __init__(self, robot: Robot, kinematics) -> None:
        self.rng = np.random.default_rng(5)
        self.n = robot.dof
        self.centre = np.array(robot.profile.sphere.centre)
        self.kinematics = kinematics
        self.side = self.rng.choice([-1.0, 1.0], self.n)

    def random(self, record: np.void) -> Vector:
        return self.rng.uniform(-1.0, 1.0, self.n)

    def bang_bang(self, record: np.void) -> Vector:
        return self.rng.choice([-1.0, 1.0], self.n)

    def outward(self, record: np.void) -> Vector:
        """Push the tool out of its sphere, and the joints that have no part in it against their limits."""
        tool, jacobian = self.kinematics.tool_and_jacobian(record["position"])
        push = jacobian.T @ (tool - self.centre)
        return np.where(np.abs(push) > 0.05 * np.abs(push).max(), np.sign(push), self.side)

    def constant(self, record: np.void) -> Vector:
        return 0.5 * self.side

    def faster(self, record: np.void) -> Vector:
        return np.where(record["velocity"] < 0.0, -1.0, 1.0)


class Judged:
    """A session whose every tick is judged."""

    def __init__(self, robot: Robot, backend: str) -> None:
        self.robot = replace(robot, profile=robot.profile.model_copy(update={"rest": robot.profile.home}))
        self.session = LockstepSession(self.robot, backend)
        self.seq = 0
        self.worst = dict.fromkeys(("position", "velocity", "acceleration", "sphere", "rate"), -np.inf)

    def __enter__(self) -> "Judged":
        self.session.__enter__()
        self.session.request(Verb.ARM)
        self.session.advance(0.1)  # what the model does not know of is found meanwhile
        self.session.begin()
        return self

    def __exit__(self, *error) -> None:
        self.session.__exit__(*error)

    def run(self, policy: Policy | None, seconds: float) -> None:
        """Give the arm to a torque policy; without one, let it be led by hand."""
        cap, ticks_per_target = self.robot.limits.torque, round(POLICY_S * self.robot.profile.servo_hz)
        for tick in range(round(seconds * self.robot.profile.servo_hz)):
            if tick % ticks_per_target == 0:
                record = self.session.latest()
                self.seq += 1
                head = int(record["epoch"]), self.seq, self.session.clock.now_ns() + 10**8
                target = FreeDrive(*head) if policy is None else JointTorque(cap * policy(record), *head)
                self.session.link.mailbox.put(target)
            self.tick()

    def tick(self) -> None:
        before = self.session.latest()
        self.session.advance(self.robot.period_ns * 1e-9)
        after, limits, dt = self.session.latest(), self.robot.limits, self.robot.period_ns * 1e-9
        position, velocity = after["true_position"], after["true_velocity"]
        acceleration = np.abs(velocity - before["true_velocity"]) / dt
        rate = np.abs(after["command_effort"] - before["command_effort"]) / dt
        sphere = self.robot.profile.sphere
        self._note("position", np.maximum(position - limits.upper, limits.lower - position))
        self._note("velocity", np.abs(velocity) - limits.velocity)
        self._note("acceleration", acceleration / limits.acceleration - 1.0)
        self._note("sphere", np.linalg.norm(after["true_tool"] - np.array(sphere.centre)) - sphere.radius)
        self._note("rate", rate / limits.torque_rate - 1.0)

    def _note(self, key: str, excess: Vector) -> None:
        self.worst[key] = max(self.worst[key], float(np.max(excess)))

    def check(self, acceleration: float = ACCELERATION_TOLERANCE) -> None:
        worst = self.worst
        assert self.session.trips == []
        assert self.session.state is State.RUN
        assert worst["position"] <= 0.5e-3, worst
        assert worst["velocity"] <= self.robot.profile.safety.velocity_tolerance, worst
        assert worst["sphere"] <= 2e-3, worst
        assert worst["acceleration"] <= acceleration, worst
        assert worst["rate"] <= 1e-6, worst


def hostile(judged: Judged, seconds: float = 1.5) -> None:
    torques = Torques(judged.robot, judged.session.loop.kinematics)
    for policy in (torques.random, torques.bang_bang, torques.outward, torques.constant, torques.faster):
        judged.run(policy, seconds)


@pytest.mark.parametrize(
    ("name", "backend"),
    [("kinova", "sim"), ("openarm", "sim"), ("panda", "sim"), ("xarm7", "sim"), ("openarm", "can"), ("panda", "can")],
)
def test_hostile_torques_keep_every_invariant(name: str, backend: str) -> None:
    with Judged(load_robot(name), backend) as judged:
        hostile(judged)
        judged.check()
        # They did try: joints came to their caps, and the tool to its sphere or joints to their limits.
        assert judged.worst["velocity"] > -0.1
        assert max(judged.worst["sphere"], judged.worst["position"]) > -0.01


@pytest.mark.parametrize("share", [-0.5, 0.5])
@pytest.mark.parametrize(("name", "payload"), [("panda", 2.0), ("openarm", 1.0)])
def test_a_payload_that_is_wrong_by_half_breaks_nothing(name: str, payload: float, share: float) -> None:
    robot = load_robot(name, [f"payload={payload}", f"twin.payload={share * payload}"])
    with Judged(robot, "can") as judged:
        hostile(judged, 1.0)
        judged.check(WITH_WRONG_PAYLOAD)


def test_light_joints_keep_their_caps_while_nothing_else_is_pushed(panda: Robot) -> None:
    with Judged(panda, "can") as judged:
        torques, wrist = Torques(panda, judged.session.loop.kinematics), np.array([0, 0, 0, 0, 1, 1, 1])
        judged.run(lambda record: wrist * torques.bang_bang(record), 2.0)
        judged.check()
        assert judged.worst["velocity"] > -0.1


@pytest.mark.parametrize("push", [3.0, 8.0])
def test_led_by_hand_an_arm_gives_way_as_fast_as_its_caps_allow(panda: Robot, push: float) -> None:
    with Judged(panda, "sim") as judged:
        plant = judged.session._rig.arm._plant
        before = judged.session.latest()["true_position"]
        plant.push(np.array([push, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
        judged.run(None, 1.0)
        assert judged.session.latest()["true_position"][0] > before[0] + 0.3
        plant.push(np.zeros(7))
        judged.run(None, 0.5)
        judged.check(np.inf)  # a light joint is jerked along before anything can be done about it
