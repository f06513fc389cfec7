"""What every arm and every gripper fulfils, whatever robot and backend. Inherit, say how to open one, change nothing.

All of it runs on a virtual clock, so the plant behind the arm has to follow that clock.
"""

from collections.abc import Callable

import numpy as np
import pytest

from robotctl.control.kinematics import Kinematics
from robotctl.hal.backend import Rig
from robotctl.hal.clock import VirtualClock
from robotctl.hal.errors import HardwareError, RobotctlError
from robotctl.hal.robot import Robot
from robotctl.hal.types import Command, CommandMode, GripperSample, Sample, Vector
from robotctl.sim.plant import Plant

BLIND_S = 0.06
"""Without a command: shorter than any drive's watchdog."""


class Bench:
    """A rig in its home pose, where gravity pulls, and the plant behind it."""

    def __init__(self, robot: Robot, rig: Rig, clock: VirtualClock, plant: Callable[[Rig], Plant]) -> None:
        self.robot, self.rig, self.arm, self.clock = robot, rig, rig.arm, clock
        self.gripper = rig.gripper
        self.kinematics = Kinematics(robot)
        self.home = np.array(robot.profile.home)
        self.rest = np.zeros(robot.dof)
        self._plant = plant

    @property
    def plant(self) -> Plant:
        return self._plant(self.rig)

    def connect(self) -> None:
        self.arm.connect()
        self.plant.place(self.home)

    def enable(self) -> Vector:
        """Bring the arm to where it holds its pose, and return that."""
        self.connect()
        self.arm.verify()
        return self.enable_again()

    def enable_again(self) -> Vector:
        sample = self.tick(3)
        self.arm.write(self.track(sample.position))
        self.arm.enable()
        return sample.position

    def track(self, position: Vector, velocity: Vector | None = None) -> Command:
        velocity = self.rest if velocity is None else velocity
        return Command(CommandMode.TRACK, position, velocity, self.kinematics.gravity(position))

    def tick(self, count: int = 1, command: Callable[[Sample], Command] | None = None) -> Sample:
        for _ in range(count):
            self.clock.sleep_until(self.clock.now_ns() + self.robot.period_ns)
            sample = self.arm.read()
            if command is not None:
                self.arm.write(command(sample))
            if self.gripper is not None:
                self.gripper.step()
        return sample

    def seconds(self, seconds: float) -> int:
        return round(seconds * self.robot.profile.servo_hz)

    @property
    def blind(self) -> int:
        """Ticks that may pass without a command."""
        return self.seconds(BLIND_S)

    def drift(self, pose: Vector) -> float:
        return float(np.abs(self.arm.truth().position - pose).max())

    def set_in_motion(self) -> float:
        """Let the first joint move, and return its speed."""
        velocity = self.rest.copy()
        velocity[0] = 0.4
        start, ticks = self.arm.read().position, iter(range(1, 10_000))
        dt = self.robot.period_ns * 1e-9
        self.tick(self.seconds(0.5), lambda _: self.track(start + next(ticks) * dt * velocity, velocity))
        speed = float(self.arm.truth().velocity[0])
        assert speed == pytest.approx(0.4, abs=0.1)
        return speed


class _Contract:
    verified_first = False
    """Whether `enable` demands a `verify` before."""

    def open(self, robot: Robot, clock: VirtualClock) -> Rig:
        raise NotImplementedError

    def plant(self, rig: Rig) -> Plant:
        raise NotImplementedError

    @pytest.fixture
    def bench(self, robot: Robot):
        clock = VirtualClock(1_000_000_000)
        made = Bench(robot, self.open(robot, clock), clock, self.plant)
        yield made
        made.arm.close()


class ArmContract(_Contract):
    # -- bring-up ---------------------------------------------------------------------------------------------------

    def test_connecting_sends_nothing(self, bench: Bench):
        bench.connect()
        statistics = bench.arm.bus_statistics()
        assert statistics is None or statistics["sent"] == 0
        assert not bench.plant.truth().effort.any()
        assert not bench.arm.read().enabled
        statistics = bench.arm.bus_statistics()
        assert statistics is None or statistics["sent"] == 0

    @pytest.mark.parametrize("call", ["verify", "enable", "read", "clear_faults"])
    def test_before_connecting_there_is_nothing_to_talk_to(self, bench: Bench, call: str):
        with pytest.raises(HardwareError, match="connect"):
            getattr(bench.arm, call)()

    def test_enabling_before_verifying(self, bench: Bench):
        bench.connect()
        if self.verified_first:
            with pytest.raises(RobotctlError, match="verif"):
                bench.arm.enable()
            assert not bench.arm.read().enabled
        else:
            bench.arm.enable()
            assert bench.arm.read().enabled

    def test_verifying_enables_and_moves_nothing(self, bench: Bench):
        bench.connect()
        bench.arm.verify()
        sample = bench.tick(5)
        assert not sample.enabled
        assert bench.drift(bench.home) < 1e-3

    def test_the_pose_is_known_before_the_torque_comes(self, bench: Bench):
        bench.connect()
        bench.arm.verify()
        sample = bench.tick(2)
        assert sample.position == pytest.approx(bench.home, abs=2e-3)
        assert (sample.joint_stamp_ns > 0).all()

    def test_where_the_plant_lives_in_this_process_there_is_nothing_to_take_over(self, bench: Bench):
        with pytest.raises(HardwareError, match="nothing to take over"):
            bench.arm.take_over(bench.track(bench.home))
        with pytest.raises(HardwareError, match="connect"):
            bench.arm.read()

    # -- holding ----------------------------------------------------------------------------------------------------

    def test_enabled_it_holds_the_measured_pose(self, bench: Bench):
        pose = bench.enable()
        for _ in range(bench.blind):  # nothing but what `enable` left the drives with
            assert bench.tick().enabled
        assert bench.drift(pose) < 5e-3
        bench.tick(bench.seconds(0.5), lambda _: bench.track(pose))
        assert bench.drift(pose) < 5e-3

    def test_enabling_twice_is_harmless(self, bench: Bench):
        pose = bench.enable()
        bench.tick(10, lambda _: bench.track(pose))
        bench.arm.enable()
        assert bench.tick(bench.blind).enabled
        assert bench.drift(pose) < 5e-3

    def test_holding_ends_a_motion(self, bench: Bench):
        bench.enable()
        bench.set_in_motion()
        where = bench.arm.truth().position
        assert bench.arm.hold().altered == ""
        bench.tick(bench.blind)
        assert bench.drift(where) < 0.1
        assert np.abs(bench.arm.truth().velocity[0]) < 0.2

    # -- commands ---------------------------------------------------------------------------------------------------

    def test_tracking_a_slow_sine(self, bench: Bench):
        start = bench.enable()
        dt, swing = bench.robot.period_ns * 1e-9, 2.0 * np.pi * 0.5
        worst = 0.0
        for step in range(1, bench.seconds(2.0)):
            phase = swing * step * dt
            offset, speed = 0.1 * (1.0 - np.cos(phase)) / 2.0, 0.1 * swing * np.sin(phase) / 2.0
            assert bench.arm.write(bench.track(start + offset, np.full(bench.robot.dof, speed))).altered == ""
            sample = bench.tick()
            worst = max(worst, float(np.abs(sample.position - start - offset).max()))
        assert worst < 0.03

    def test_with_the_drives_off_a_command_says_so_and_moves_nothing(self, bench: Bench):
        bench.connect()
        bench.arm.verify()
        bench.tick()
        sent = bench.arm.write(bench.track(bench.home + 0.3))
        assert "off" in sent.altered
        assert bench.arm.hold().altered
        bench.tick(20, lambda _: bench.track(bench.home + 0.3))
        assert bench.drift(bench.home) < 1e-3

    def test_what_was_written_while_off_does_not_come_true_later(self, bench: Bench):
        """Position and velocity of such a command are forgotten; only its effort may be used to hold."""
        bench.connect()
        bench.arm.verify()
        bench.tick(2)
        gravity = bench.kinematics.gravity(bench.home)
        bench.arm.write(Command(CommandMode.TRACK, bench.home + 0.5, bench.rest + 1.0, gravity))
        bench.arm.enable()
        bench.tick(bench.blind)
        assert bench.drift(bench.home) < 5e-3

    def test_effort_alone_balances_gravity_or_does_not(self, bench: Bench):
        pose = bench.enable()
        bench.tick(
            bench.seconds(0.3),
            lambda s: Command(CommandMode.EFFORT, pose + 1.0, bench.rest, bench.kinematics.gravity(s.position)),
        )
        assert bench.drift(pose) < 0.03
        bench.tick(bench.seconds(0.3), lambda s: Command(CommandMode.EFFORT, pose, bench.rest, bench.rest))
        assert bench.drift(pose) > 0.05

    def test_damping_slows_a_motion(self, bench: Bench):
        bench.enable()
        before = bench.set_in_motion()
        gravity = bench.kinematics.gravity

        def damp(sample: Sample) -> Command:
            return Command(CommandMode.DAMP, sample.position + 1.0, bench.rest + 1.0, gravity(sample.position))

        bench.tick(bench.seconds(0.6), damp)
        assert abs(bench.arm.truth().velocity[0]) < 0.3 * before

    @pytest.mark.parametrize("field", ["position", "velocity", "effort"])
    @pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
    def test_a_command_that_is_not_a_number_is_kept_back(self, bench: Bench, field: str, bad: float):
        pose = bench.enable()
        bench.tick(5, lambda _: bench.track(pose))
        values = getattr(bench.track(pose), field).copy()
        values[2] = bad
        sent = bench.arm.write(bench.track(pose)._replace(**{field: values}))
        assert sent.altered
        bench.tick(bench.blind)
        assert bench.drift(pose) < 5e-3

    def test_a_command_of_another_shape_is_kept_back(self, bench: Bench):
        pose = bench.enable()
        short = np.zeros(bench.robot.dof - 1)
        assert bench.arm.write(Command(CommandMode.TRACK, short, short, short)).altered
        bench.tick(bench.blind)
        assert bench.drift(pose) < 5e-3

    # -- the end ----------------------------------------------------------------------------------------------------

    def test_disabling_takes_the_torque_away(self, bench: Bench):
        pose = bench.enable()
        bench.tick(20, lambda _: bench.track(pose))
        bench.arm.disable()
        bench.tick()
        assert not bench.plant.truth().effort.any()
        sample = bench.tick(bench.seconds(0.5))
        assert not sample.enabled
        if bench.robot.profile.brakes:
            assert bench.drift(pose) < 2e-3
        else:
            assert bench.drift(pose) > 0.05
        assert not bench.plant.truth().effort.any()
        bench.arm.disable()
        assert not bench.tick().enabled

    def test_disabling_what_was_never_enabled_is_harmless(self, bench: Bench):
        bench.arm.disable()
        bench.connect()
        bench.arm.disable()
        bench.arm.verify()
        bench.arm.disable()
        assert not bench.tick().enabled
        assert bench.drift(bench.home) < 1e-3

    def test_enabled_again_it_holds_where_it_is_now(self, bench: Bench):
        old = bench.enable()
        bench.tick(20, lambda _: bench.track(old))
        bench.arm.disable()
        moved = bench.home - 0.15
        bench.plant.place(moved)
        bench.tick(2)
        bench.plant.place(moved)  # an arm without brakes began to fall
        pose = bench.enable_again()
        assert pose == pytest.approx(moved, abs=5e-3)
        worst = 0.0
        for _ in range(bench.blind):
            bench.tick()
            worst = max(worst, bench.drift(pose))
        assert worst < 8e-3
        assert bench.arm.read().enabled

    def test_closing_twice_is_harmless_and_final(self, bench: Bench):
        bench.enable()
        bench.arm.disable()
        bench.arm.close()
        bench.arm.close()
        with pytest.raises(HardwareError):
            bench.arm.read()

    def test_closing_what_was_never_opened_is_harmless(self, bench: Bench):
        bench.arm.close()

    # -- samples ----------------------------------------------------------------------------------------------------

    def test_samples_have_the_promised_form(self, bench: Bench):
        pose = bench.enable()
        stamp, heard = 0, np.zeros(bench.robot.dof, np.int64)
        for _ in range(20):
            sample = bench.tick(1, lambda _: bench.track(pose))
            for array in (sample.position, sample.velocity, sample.effort):
                assert array.shape == (bench.robot.dof,)
                assert array.dtype == np.float64
                assert np.isfinite(array).all()
            assert sample.joint_stamp_ns.shape == (bench.robot.dof,)
            assert sample.joint_stamp_ns.dtype == np.int64
            assert sample.stamp_ns == bench.clock.now_ns()
            assert sample.stamp_ns > stamp
            assert (sample.joint_stamp_ns >= heard).all()
            assert (sample.joint_stamp_ns <= sample.stamp_ns).all()
            assert (sample.stamp_ns - sample.joint_stamp_ns <= 2 * bench.robot.period_ns).all()
            assert sample.faults == ()
            assert sample.enabled is True
            stamp, heard = sample.stamp_ns, sample.joint_stamp_ns

    def test_a_sample_is_not_changed_by_what_comes_after(self, bench: Bench):
        bench.enable()
        sample = bench.arm.read()
        kept = [np.array(array) for array in sample[1:5]]
        bench.set_in_motion()
        for array, before in zip(sample[1:5], kept, strict=True):
            assert (array == before).all()

    def test_the_truth_is_close_to_the_measurement(self, bench: Bench):
        bench.enable()
        bench.set_in_motion()
        sample, truth = bench.arm.read(), bench.arm.truth()
        assert sample.position == pytest.approx(truth.position, abs=3e-3)
        assert sample.velocity == pytest.approx(truth.velocity, abs=0.05)
        assert bench.kinematics.tool(truth.position) == pytest.approx(truth.tool, abs=1e-3)

    def test_the_same_calls_give_the_same_samples(self, robot: Robot):
        runs = []
        for _ in range(2):
            clock = VirtualClock(1_000_000_000)
            bench = Bench(robot, self.open(robot, clock), clock, self.plant)
            bench.enable()
            bench.set_in_motion()
            runs.append(bench.arm.read())
            bench.arm.close()
        for one, other in zip(runs[0], runs[1], strict=True):
            assert np.array_equal(one, other)


class GripperContract(_Contract):
    @pytest.mark.parametrize(
        ("width", "force"),
        [(np.nan, 1.0), (np.inf, 1.0), (-1e-9, 1.0), (1.01, 1.0), (0.5, np.nan), (0.5, 0.0), (0.5, -1.0), (0.5, 1.01)],
    )
    def test_what_it_cannot_do_is_refused(self, bench: Bench, width: float, force: float):
        """Width and force as parts of the largest."""
        bench.enable()
        profile = bench.robot.profile.gripper
        with pytest.raises(ValueError):
            bench.gripper.command(width * profile.width, force * profile.force)

    @pytest.mark.parametrize("part", [0.0, 1.0])
    def test_both_ends_are_allowed(self, bench: Bench, part: float):
        bench.enable()
        profile = bench.robot.profile.gripper
        bench.gripper.command(part * profile.width, profile.force)

    def test_no_call_lets_time_pass(self, bench: Bench):
        bench.enable()
        before = bench.clock.now_ns()
        bench.gripper.command(0.01, 10.0)
        bench.gripper.step()
        bench.gripper.read()
        assert bench.clock.now_ns() == before

    def test_it_goes_where_it_is_told_while_the_arm_holds(self, bench: Bench):
        pose = bench.enable()
        profile = bench.robot.profile.gripper
        for part in (0.8, 0.2, 0.5):
            bench.gripper.command(part * profile.width, profile.force)
            bench.tick(bench.seconds(1.0 + profile.width / profile.speed), lambda _: bench.track(pose))
            assert bench.gripper.read().width == pytest.approx(part * profile.width, abs=0.05 * profile.width)
        assert bench.drift(pose) < 0.01

    def test_samples_have_the_promised_form(self, bench: Bench):
        bench.enable()
        bench.tick(20, lambda s: bench.track(s.position))
        sample = bench.gripper.read()
        assert isinstance(sample, GripperSample)
        assert 0 < sample.stamp_ns <= bench.clock.now_ns()
        assert -1e-3 <= sample.width <= bench.robot.profile.gripper.width + 1e-3
        assert sample.force >= 0.0
