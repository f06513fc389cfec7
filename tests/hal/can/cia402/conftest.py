"""An arm of CiA 402 drives on emulated ones, on a virtual clock, with every frame that leaves kept."""

from collections.abc import Iterator

import numpy as np
import pytest

from robotctl.control.kinematics import Kinematics
from robotctl.hal.can.cia402.arm import Cia402Arm
from robotctl.hal.clock import VirtualClock
from robotctl.hal.robot import Robot, load_robot
from robotctl.hal.types import Command, CommandMode, Sample, Vector
from robotctl.sim.motors.cia402 import Cia402Drive


class Desk:
    """The arm, connected and at home; nothing has been sent."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.clock = VirtualClock(1_000_000_000)
        self.arm = Cia402Arm(robot, self.clock, "emulated")
        self.arm.connect()
        self.bus = self.arm.channel.bus
        self.bench = self.bus.bench
        self.home = np.array(robot.profile.home)
        self.rest = np.zeros(robot.dof)
        self.bench.plant.place(self.home)
        self.gravity = Kinematics(robot).gravity
        self.sent: list[tuple[int, bytes]] = []
        receive = self.bus._receive

        def look(arbitration_id: int, data: bytes) -> None:
            self.sent.append((arbitration_id, bytes(data)))
            receive(arbitration_id, data)

        self.bus._receive = look

    def drive(self, which: int | str = 1) -> Cia402Drive:
        return self.bench.drive(which)

    def hold(self, mode: CommandMode = CommandMode.TRACK) -> Command:
        return Command(mode, self.home, self.rest, self.gravity(self.home))

    def enable(self) -> Vector:
        self.arm.verify()
        self.tick()
        self.arm.write(self.hold())
        self.arm.enable()
        return self.arm.read().position

    def tick(self, count: int = 1, command: Command | None = None) -> Sample:
        for _ in range(count):
            self.clock.sleep_until(self.clock.now_ns() + self.robot.period_ns)
            sample = self.arm.read()
            if command is not None:
                self.arm.write(command)
            if self.arm.gripper is not None:
                self.arm.gripper.step()
        return sample

    def seconds(self, seconds: float) -> int:
        return round(seconds * self.robot.profile.servo_hz)


@pytest.fixture(scope="session")
def xarm7() -> Robot:
    return load_robot("xarm7")


@pytest.fixture
def desk(xarm7: Robot) -> Iterator[Desk]:
    made = Desk(xarm7)
    yield made
    made.arm.close()


@pytest.fixture(scope="session")
def mixed() -> Robot:
    """panda with CiA 402 drives in its arm, and the DAMIAO gripper that it has."""
    wiring = "{{protocol: cia402, id: {}, resolution: 65536, rated_torque: 0.9, gear: 50.0, sign: {}}}"
    drives = [f"joints.{axis}.drive={wiring.format(axis + 1, -1 if axis % 2 else 1)}" for axis in range(7)]
    return load_robot("panda", ["servo_hz=200", "can.fd=false", "safety.feedback_stop_s=0.016", *drives])
