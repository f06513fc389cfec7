"""The drives of an arm on the workbench: one by one, while nothing else of ours has their channel."""

import platform
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime

import robotctl
from robotctl.control import registry
from robotctl.hal.can.channel import Channel, open_channel
from robotctl.hal.can.damiao.registers import ControlMode
from robotctl.hal.can.diagnosis import drives_of
from robotctl.hal.can.dump import Dump, DumpedMotor
from robotctl.hal.can.flash_log import count_writes
from robotctl.hal.can.scan import LAST_ID, scan
from robotctl.hal.can.service import Difference, Motor, make_motor
from robotctl.hal.can.transport import Transport
from robotctl.hal.can.ways import own_way
from robotctl.hal.clock import Clock
from robotctl.hal.errors import ConfigError
from robotctl.hal.profile import DamiaoDrive
from robotctl.hal.robot import Robot


class Workbench:
    """Drives that can be reached. Made by `open_workbench`."""

    def __init__(self, robot: Robot, channel: str, opened: Channel, clock: Clock) -> None:
        wiring = robot.profile.can
        assert wiring is not None
        self.robot = robot
        self.channel = channel
        self._opened = opened
        self._way = own_way(channel, wiring)
        self._transport = Transport(opened, clock, wiring.bitrate)
        self._clock = clock
        self._protocol = robot.profile.protocol
        self._handed: list[Motor] = []
        self._profile: dict[int, tuple[str, DamiaoDrive, ControlMode]] = {
            drive.id: (name, drive, mode) for name, drive, mode in drives_of(robot)
        }

    def motors(self, words: Sequence[str]) -> list[Motor]:
        """Return the drives that are meant by ids, joints' names, or `all` for those that answer; none is also all.

        Raises:
            ConfigError: if a word means nothing.
        """
        ids: list[int] = []
        for word in words or ["all"]:
            ids += self._present() if word == "all" else [self._id(word)]
        return [self._motor(motor) for motor in dict.fromkeys(ids)]

    def one(self, word: str) -> Motor:
        """Return the one drive that a word means.

        Raises:
            ConfigError: if it means none.
        """
        return self._motor(self._id(word))

    def name(self, motor_id: int) -> str:
        """Return the joint's name, or a general one."""
        known = self._profile.get(motor_id)
        return known[0] if known else f"motor {motor_id}"

    def departures(self, motor: Motor) -> list[Difference]:
        """Return what is not as the profile says.

        Raises:
            ConfigError: if the profile does not know the drive.
        """
        if motor.id not in self._profile:
            raise ConfigError(f"{self.robot.source} has no drive 0x{motor.id:02X}", "is this the right robot?")
        _, drive, mode = self._profile[motor.id]
        return motor.departures(self.robot, drive, mode, motor.read())

    def count(self, motor: Motor) -> int:
        """Write down how often a drive's flash was written, and return how often that was from this machine so far."""
        times, motor.flash_writes = motor.flash_writes, 0
        return count_writes(motor.protocol, motor.serial(), times)

    def count_all(self) -> None:
        """Write that down for every drive whose flash was written, whatever came of it."""
        for motor in self._handed:
            if motor.flash_writes:
                self.count(motor)

    def dump(self, motors: Sequence[Motor]) -> Dump:
        """Read everything that drives store."""
        return Dump(
            taken=datetime.now().astimezone().isoformat(timespec="seconds"),
            host=platform.node(),
            version=robotctl.__version__,
            robot=self.robot.profile.name,
            channel=self.channel,
            motors=[
                DumpedMotor(
                    id=motor.id,
                    name=self.name(motor.id),
                    protocol=motor.protocol,
                    serial=motor.serial(),
                    parameters=motor.read(),
                )
                for motor in motors
            ],
        )

    def _present(self) -> list[int]:
        return [motor.id for motor in scan(self._opened, self._clock, LAST_ID, self._way).motors]

    def _id(self, word: str) -> int:
        for motor, (name, _, _) in self._profile.items():
            if word == name:
                return motor
        try:
            motor = int(word, 0)
        except ValueError:
            motor = 0
        if not 1 <= motor <= 0x7F:
            names = ", ".join(name for name, _, _ in self._profile.values())
            raise ConfigError(f"no drive {word!r}", f"use an id from 1 to 0x7F, or one of {names}")
        return motor

    def _motor(self, motor_id: int) -> Motor:
        motor = make_motor(self._protocol, self._transport, self._clock, motor_id, self.name(motor_id))
        self._handed.append(motor)
        return motor


@contextmanager
def open_workbench(channel: str, robot: Robot, clock: Clock) -> Iterator[Workbench]:
    """Open a channel for service, and close it in the end. Sends nothing by itself.

    Raises:
        ConfigError: if the channel's name has no known form, or the robot has no CAN drives.
        BusError: if it cannot be opened, or another robotctl has it: nothing is set on an arm that runs.
    """
    with registry.claimed(channel):
        opened = open_channel(channel, robot, clock)
        try:
            bench = Workbench(robot, channel, opened, clock)
            try:
                yield bench
            finally:
                bench.count_all()
        finally:
            opened.close()
