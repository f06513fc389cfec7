"""What safety owes every robot on every backend. Inherit `SafetyContract` and give it a `backend`."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest

from robotctl.control.operator import Verb
from robotctl.control.session import LockstepSession, Stopped
from robotctl.hal.robot import Robot
from robotctl.hal.types import Command, CommandMode, Vector
from robotctl.learning.policies import make_policy
from robotctl.learning.policy import Observation
from robotctl.safety.deadman import Grip
from robotctl.safety.machine import State
from robotctl.safety.target import JointTorque, JointVelocity, Target

DEADLINE_NS = 100_000_000


class Arm:
    """A session in lockstep that has gone home, and a policy's side of it."""

    def __init__(self, session: LockstepSession) -> None:
        self.session = session
        self.robot = session.robot
        self.seq = 0

    @property
    def state(self) -> State:
        return self.session.state

    @property
    def truth(self) -> Vector:
        return self.session.latest()["true_position"]

    def tick(self, count: int = 1) -> None:
        self.session.advance(count * self.robot.period_ns * 1e-9)

    def put(self, target: type[Target], values: Vector, **fields: int) -> None:
        self.seq += 1
        epoch = int(self.session.latest()["epoch"])
        given = {"epoch": epoch, "seq": self.seq, "deadline_ns": self.session.clock.now_ns() + DEADLINE_NS} | fields
        self.session.link.mailbox.put(target(np.asarray(values), **given))

    def lead(self, share: float, seconds: float = 0.3) -> None:
        """Let all joints go at a share of their caps."""
        for _ in range(round(seconds * 20)):
            self.put(JointVelocity, share * self.robot.limits.velocity)
            self.session.advance(0.05)

    def rest(self) -> None:
        """Wait for the published stopping time, and see that the arm stands."""
        self.session.advance(self.robot.stopping_time_s + 0.02)
        assert np.abs(self.session.latest()["true_velocity"]).max() < self.robot.profile.safety.standstill

    def stays(self, seconds: float = 1.0) -> None:
        """See that nothing moves, whatever the policy says."""
        before = self.truth.copy()
        self.lead(1.0, seconds)
        # Gravity and dry friction settle by little; a policy at full speed would go 1 rad.
        assert np.abs(self.truth - before).max() < 0.03


def shift(command: Command, **fields: Vector) -> Command:
    return command._replace(**{key: getattr(command, key) + value for key, value in fields.items()})


class SafetyContract:
    """Every case, for one robot on one backend."""

    backend: str

    @contextmanager
    def running(self, robot: Robot) -> Iterator[Arm]:
        at_home = robot.profile.model_copy(update={"rest": robot.profile.home})
        with LockstepSession(replace(robot, profile=at_home), self.backend) as session:
            session.request(Verb.ARM)
            session.begin()
            yield Arm(session)

    @pytest.fixture
    def arm(self, robot: Robot) -> Iterator[Arm]:
        with self.running(robot) as arm:
            yield arm

    @pytest.mark.parametrize("name", ["random", "outward"])
    def test_hostile_policies_break_nothing(self, arm: Arm, name: str) -> None:
        policy = make_policy(name, arm.robot, arm.session.loop.kinematics, 1)
        for step in range(60):
            record = arm.session.latest()
            seen = Observation(record["position"], record["velocity"], record["tool"], record["tool"], step)
            arm.put(JointVelocity, policy.act(seen))
            arm.session.advance(0.05)
        assert arm.state is State.RUN
        assert arm.session.trips == []
        assert sum(arm.session.judge.violations.values()) == 0

    def test_an_emergency_stop_brakes_and_latches(self, arm: Arm) -> None:
        arm.lead(0.5)
        arm.session.emergency_stop()
        arm.rest()
        assert arm.session.trips[0]["protection"] == "P23"
        assert arm.state in (State.FAULT, State.DISABLED)
        arm.stays()
        with pytest.raises(Stopped, match="refused"):
            arm.session.request(Verb.START)

    @pytest.mark.parametrize("broken", ["nan", "shape", "empty"])
    def test_a_malformed_target_stops_in_the_same_tick(self, arm: Arm, broken: str) -> None:
        arm.lead(0.5)
        values = {"nan": np.full(arm.robot.dof, np.nan), "shape": np.zeros(arm.robot.dof + 1), "empty": np.zeros(0)}
        arm.put(JointVelocity, values[broken])
        arm.tick()
        assert arm.state is State.STOPPING
        assert [trip["protection"] for trip in arm.session.trips] == ["P9"]
        arm.rest()
        arm.stays(0.5)

    def test_a_policy_that_falls_silent_is_braked_and_may_come_back(self, arm: Arm) -> None:
        arm.lead(0.3)
        arm.session.advance(0.2)
        assert arm.session.trips[0]["protection"] == "P10"
        assert arm.state in (State.STOPPING, State.HOLD)
        arm.put(JointVelocity, np.zeros(arm.robot.dof))
        arm.tick(2)
        assert arm.state is State.RUN
        arm.session.advance(1.0)
        assert arm.state is State.HOLD
        arm.stays(0.5)
        arm.session.request(Verb.START)
        assert arm.state is State.RUN

    def test_targets_of_before_a_stop_do_not_run_after_it(self, arm: Arm) -> None:
        epoch = int(arm.session.latest()["epoch"])
        arm.session.request(Verb.STOP)
        arm.rest()
        arm.session.request(Verb.ACK)
        arm.session.request(Verb.START)
        before = arm.truth.copy()
        for _ in range(10):
            arm.put(JointVelocity, arm.robot.limits.velocity, epoch=epoch)
            arm.tick(2)
        assert np.abs(arm.truth - before).max() < 2e-3

    def test_without_its_deadmans_switch_the_arm_brakes_within_one_tick(self, arm: Arm) -> None:
        desk = arm.session.link.desk
        desk.hold(Grip.HELD)
        arm.lead(0.5)
        desk.hold(Grip.RELEASED)
        arm.tick()
        assert arm.state is State.STOPPING
        assert arm.session.trips[-1]["protection"] == "P22"
        arm.rest()
        arm.stays(0.3)
        desk.hold(Grip.HELD)
        arm.lead(0.1)
        assert arm.state is State.RUN
        desk.hold(Grip.SQUEEZED)
        arm.tick()
        assert arm.session.trips[-1]["stop_category"] == 1

    BUGS: ClassVar[dict[str, tuple[str, Callable[[Robot, Command], Command]]]] = {
        "velocity": ("P1", lambda robot, command: command._replace(velocity=1.05 * robot.limits.velocity)),
        "limits": ("P2", lambda robot, command: shift(command, position=robot.limits.upper - command.position + 0.01)),
        "acceleration": (
            "P6",
            lambda robot, command: shift(command, velocity=5e-9 * robot.period_ns * robot.limits.acceleration),
        ),
        "torque": ("P7", lambda robot, command: command._replace(effort=1.01 * robot.limits.torque)),
        "jump": ("P1", lambda robot, command: shift(command, position=0.05 * robot.limits.velocity)),
        "mode": ("P7", lambda robot, command: Command(CommandMode.EFFORT, *command[1:3], 0.2 * robot.limits.torque)),
    }
    """What a broken shaper might send, and who has to refuse it."""

    @pytest.mark.parametrize("name", BUGS)
    def test_a_bug_in_the_shaper_is_caught_within_one_tick(self, arm: Arm, name: str) -> None:
        protection, broken = self.BUGS[name]
        arm.lead(0.2)
        motion = arm.session.loop._motion
        track, seen = motion.track, []

        def bug(wanted: Vector, sample: object, *, brake: bool, periods: int = 1) -> Command:
            command = track(wanted, sample, brake=brake, periods=periods)
            seen.append(brake)
            return broken(arm.robot, command) if len(seen) == 1 else command

        motion.track = bug
        arm.tick()
        found = arm.session.trips
        assert len(found) == 1
        # A jump past a limit passes several limits at once; whichever the guard looks at first.
        assert found[0]["protection"] in ((protection,) if name != "limits" else ("P1", "P2"))
        assert found[0]["stop_category"] == 1
        assert seen == [False, True]  # refused, and braked in the same tick
        assert arm.state is State.STOPPING
        arm.rest()
        assert arm.session.judge.violations["position"] == arm.session.judge.violations["velocity"] == 0

    def test_a_bug_that_persists_costs_the_torque(self, arm: Arm) -> None:
        arm.lead(0.2)
        motion = arm.session.loop._motion
        track = motion.track
        motion.track = lambda *args, **options: track(*args, **options)._replace(
            velocity=9.0 * arm.robot.limits.velocity
        )
        arm.tick()
        assert [trip["stop_category"] for trip in arm.session.trips] == [1, 0]
        assert arm.state in (State.DISABLED, State.FAULT)

    def test_after_the_guard_only_a_power_cycle_helps(self, arm: Arm) -> None:
        motion = arm.session.loop._motion
        track = motion.track
        motion.track = lambda *args, **options: track(*args, **options)._replace(
            velocity=9.0 * arm.robot.limits.velocity
        )
        arm.tick()
        motion.track = track
        arm.session.advance(1.0)
        if arm.robot.profile.category0 == "damp":
            with pytest.raises(Stopped, match="lowered first"):
                arm.session.request(Verb.ACK)
            arm.session.advance(2.5)
        with pytest.raises(Stopped, match="power of the drives off and on"):
            arm.session.request(Verb.ACK)

    def test_torque_targets_keep_to_the_torque_rate(self, arm: Arm) -> None:
        """The guard compares every message with the last one; none of these may be refused."""
        for step in range(20):
            arm.put(JointTorque, (1.0 if step % 2 else -1.0) * arm.robot.limits.torque)
            arm.session.advance(0.02)
        assert {trip["protection"] for trip in arm.session.trips} <= {"P8", "P10"}
