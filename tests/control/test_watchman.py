"""P27: what the watchman takes for silence, and what it does about it. In lockstep, on emulated drives."""

import numpy as np
import pytest

from robotctl.control.kinematics import Kinematics
from robotctl.control.rescue import Rescue
from robotctl.control.session import LockstepSession
from robotctl.control.shared import Link, Power, tick_dtype
from robotctl.control.watchman import Watchman
from robotctl.hal.backend import open_backend
from robotctl.hal.clock import VirtualClock
from robotctl.hal.errors import BusError
from robotctl.hal.robot import Robot, load_robot
from robotctl.safety.machine import State
from robotctl.safety.target import JointVelocity
from robotctl.sim.motors.trouble import Mute, PowerCut

MS = 1_000_000

# -- watching ------------------------------------------------------------------------------------------------------


class Beat:
    """A loop that makes ticks to order, and a watchman that looks every 5 ms."""

    def __init__(self, robot: Robot) -> None:
        self.clock = VirtualClock(10**9)
        self.link = Link.local(robot.dof, 100)
        self.record = np.zeros(1, tick_dtype(robot.dof))[0]
        self.watchman = Watchman(robot, self.link, self.clock, None)

    def looks(self, count: int, *, ticking: bool) -> list[int]:
        """Return after which looks the loop counted as silent."""
        found = []
        for look in range(1, count + 1):
            if ticking:
                self.link.ticks.append(self.record)
            if self.watchman.has_fallen_silent():
                found.append(look)
            self.clock.sleep_until(self.clock.now_ns() + 5 * MS)
        return found


@pytest.fixture
def beat(panda: Robot) -> Beat:
    assert panda.profile.safety.watchman_s == 0.04
    return Beat(panda)


def test_a_loop_that_ticks_is_never_silent(beat: Beat) -> None:
    beat.link.watch.power = Power.ON
    assert beat.looks(1000, ticking=True) == []


def test_a_loop_that_stands_still_is_silent_once_after_40_ms(beat: Beat) -> None:
    beat.link.watch.power = Power.ON
    beat.looks(10, ticking=True)
    # The first look sees that nothing came since the last one, 5 ms ago.
    assert beat.looks(100, ticking=False) == [8]
    beat.looks(1, ticking=True)
    assert beat.looks(100, ticking=False) == [8]


@pytest.mark.parametrize("power", [Power.OFF, Power.CHANGING])
def test_a_loop_that_need_not_tick_may_stand_still(beat: Beat, power: Power) -> None:
    beat.link.watch.power = power
    assert beat.looks(100, ticking=False) == []
    beat.link.watch.power = Power.ON
    assert beat.looks(100, ticking=False) == [9]  # the first look sees that the drives are on


def test_a_watchman_that_slept_itself_gives_the_loop_another_chance(beat: Beat) -> None:
    beat.link.watch.power = Power.ON
    beat.looks(10, ticking=True)
    beat.clock.sleep_until(beat.clock.now_ns() + 1000 * MS)
    assert beat.looks(3, ticking=False) == []
    assert beat.looks(5, ticking=True) == []


# -- taking over ---------------------------------------------------------------------------------------------------


class Scene:
    """An arm that its loop was leading until just now, and what takes it from there."""

    def __init__(self, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
        self.robot = load_robot(name)
        self.session = LockstepSession(self.robot, "can")
        self.session.open()
        self.session.prepare()
        self.session.begin()
        speed = np.full(self.robot.dof, 0.5)
        for step in range(10):
            deadline = self.session.clock.now_ns() + 100 * MS
            self.session.link.mailbox.put(JointVelocity(speed, int(self.session.latest()["epoch"]), step, deadline))
            self.session.advance(0.02)
        arm = self.session._rig.arm
        self.channel = arm._channel
        self.bench = self.channel.bus.bench
        self.frames: list[tuple[int, bytes]] = []
        receive = self.channel.bus._receive
        self.channel.bus._receive = lambda number, data: (
            self.frames.append((number, bytes(data))),
            receive(number, data),
        )
        monkeypatch.setattr("robotctl.hal.can.arm.is_shared", lambda _: True)
        monkeypatch.setattr("robotctl.hal.can.arm.reopen_channel", lambda *_: self.channel)
        self.clock = self.session.clock
        self.rig = open_backend("can", self.robot, self.clock, "emulated")
        self.onset = self.clock.now_ns()
        self.kinematics = Kinematics(self.robot)
        self.speeds: list[float] = []
        self.heights: list[float] = []
        step_gripper = self.rig.gripper.step

        def step() -> None:
            truth = self.bench.plant.truth()
            self.speeds.append(float(np.abs(truth.velocity).max()))
            self.heights.append(float(truth.tool[2]))
            step_gripper()

        self.rig.gripper.step = step

    def rescue(self) -> None:
        Rescue(self.robot, self.session.link, self.clock, self.rig).run("the loop is gone", self.onset)

    @property
    def enabled(self) -> list[bool]:
        return [drive.enabled for drive in self.bench.drives]

    def kinds(self, motor: int) -> list[str]:
        """What a motor was sent, in order: damp, track or off, the same only once in a row."""
        found: list[str] = []
        for number, data in self.frames:
            if number == motor:
                kp = int.from_bytes(data, "big") >> 24 & 0xFFF
                kind = "off" if data == b"\xff" * 7 + b"\xfd" else "track" if kp else "damp"
                found += [kind] if found[-1:] != [kind] else []
        return found


@pytest.fixture
def openarm(monkeypatch: pytest.MonkeyPatch) -> Scene:
    return Scene("openarm", monkeypatch)


def test_an_arm_without_brakes_is_damped_and_lowered_and_its_drives_go_off(openarm: Scene) -> None:
    before = openarm.bench.plant.truth()
    openarm.rescue()
    assert not any(openarm.enabled)
    for motor in range(1, 8):
        assert openarm.kinds(motor) == ["damp", "off"]
    took = (openarm.clock.now_ns() - openarm.onset) * 1e-9
    assert took == pytest.approx(2.5, abs=0.05)
    assert max(openarm.speeds) < 2.5  # as fast as when the loop lowers it
    half_a_second = round(0.5 * openarm.robot.profile.servo_hz)
    assert abs(openarm.heights[half_a_second] - before.tool[2]) < 0.1  # it is held at first
    assert max(openarm.speeds[half_a_second - 50 : half_a_second]) < 0.1


def test_an_arm_with_brakes_is_switched_off_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene("panda", monkeypatch)
    scene.rescue()
    assert not any(scene.enabled)
    for motor in range(1, 8):
        assert scene.kinds(motor) == ["damp", "off"]
    assert scene.clock.now_ns() - scene.onset < 50 * MS


def test_the_session_reads_what_happened_as_a_trip(openarm: Scene) -> None:
    epoch = int(openarm.session.latest()["epoch"])
    openarm.rescue()
    openarm.session.poll()
    trip = openarm.session.trips[-1]
    assert (trip["protection"], trip["stop_category"]) == ("P27", 0)
    assert trip["reaction_ms"] <= 20.0
    assert trip["text"].startswith("the loop is gone; its drives are damped, lowered and switched off; look at the arm")
    assert openarm.session.state is State.FAULT
    assert int(openarm.session.latest()["epoch"]) == epoch + 1
    logs = [event["text"] for event in openarm.session.link.events.since(0)[0] if event["type"] == "log"]
    assert logs[-1] == "the watchman has switched the drives off, and they have confirmed it"


def test_the_ring_goes_on_with_the_arm_on_its_way_down(openarm: Scene) -> None:
    first = openarm.session.link.ticks.head
    openarm.rescue()
    records = openarm.session.link.ticks.since(first)[0]
    assert records["tick"].tolist() == list(range(first, first + len(records)))
    assert (np.diff(records["stamp_ns"]) >= 0).all()
    assert records["state"].tolist() == [State.DISABLED] * (len(records) - 1) + [State.FAULT]
    assert len(records) == pytest.approx(2.5 * openarm.robot.profile.servo_hz, abs=30)
    assert np.abs(records["position"][-1] - openarm.bench.plant.truth().position).max() < 0.02
    assert np.abs(records["command_effort"][100] - openarm.kinematics.gravity(records["position"][100])).max() < 0.2
    assert not records["wanted"].any()


def test_the_gripper_holds_its_opening_until_the_end(openarm: Scene) -> None:
    openarm.rescue()
    frames = [data for number, data in openarm.frames if number == 0x308]
    assert len(frames) == pytest.approx(250, abs=10)
    assert len(set(frames)) == 1


def test_a_joint_that_woke_up_a_turn_off_is_read_as_the_loop_read_it(openarm: Scene) -> None:
    where = openarm.session.latest()["position"].copy()
    where[1] -= 2.0 * np.pi
    record = openarm.session.link.ticks.latest()
    record["position"] = where
    openarm.session.link.ticks.append(record)
    openarm.rig.arm.take_over(openarm.session.loop._motion.damp(where, 1.0))
    assert openarm.rig.arm.read().position == pytest.approx(where, abs=0.01)
    openarm.clock.sleep_until(openarm.clock.now_ns() + 2 * MS)
    openarm.rig.arm.write(openarm.session.loop._motion.damp(where, 1.0))
    assert openarm.rig.arm.read().position == pytest.approx(where, abs=0.01)


def test_an_arm_that_is_not_heard_of_any_more_is_not_lowered_blindly(openarm: Scene) -> None:
    openarm.bench.trouble.add(Mute(motor_id=3))
    openarm.rescue()
    assert not any(openarm.enabled)
    # A quarter of a second of silence, 10 tries of 20 ms to hear that the drive is off.
    assert 250 < (openarm.clock.now_ns() - openarm.onset) / MS < 255 + 10 * 20.5
    logs = [event["text"] for event in openarm.session.link.events.since(0)[0] if event["type"] == "log"]
    assert "openarm_right_joint3" in logs[-1]
    assert "did not confirm" in logs[-1]
    assert "cut the power" in logs[-1]


def test_drives_that_went_off_by_themselves_are_not_lowered(openarm: Scene) -> None:
    openarm.clock.sleep_until(openarm.clock.now_ns() + 200 * MS)
    openarm.rescue()
    assert (openarm.clock.now_ns() - openarm.onset) / MS < 200 + 50
    assert openarm.session.state is State.FAULT


def test_a_drive_without_power_does_not_keep_the_others_on(openarm: Scene) -> None:
    openarm.bench.trouble.add(PowerCut(motor_id=2))
    openarm.rescue()
    assert not any(openarm.enabled)


def test_what_waits_without_power_is_taken_back_and_where_that_fails_it_is_told(
    openarm: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse() -> None:
        raise BusError("old frames may wait in the kernel", "leave the power off")

    for drive in openarm.bench.drives:
        drive.power_down()
    monkeypatch.setattr(openarm.channel.bus, "purge", refuse)
    openarm.rescue()
    logs = [event["text"] for event in openarm.session.link.events.since(0)[0] if event["type"] == "log"]
    assert "old frames may wait in the kernel" in logs[-1]
    assert "leave the power off" in logs[-1]
    assert openarm.session.state is State.FAULT


def test_a_channel_that_cannot_be_opened_is_told(openarm: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise BusError("the adapter is gone")

    monkeypatch.setattr("robotctl.hal.can.arm.reopen_channel", refuse)
    openarm.rescue()
    openarm.session.poll()
    trip = openarm.session.trips[-1]
    assert (trip["protection"], trip["stop_category"]) == ("P27", 0)
    assert trip["text"] == "the loop is gone; its drives cannot be reached: the adapter is gone"
    assert openarm.session.state is State.FAULT


# -- the loop's side -----------------------------------------------------------------------------------------------
