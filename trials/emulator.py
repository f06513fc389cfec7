"""Emulated motors in a process of their own: `robotctl emulate` on a pseudo-terminal, with a log of every frame."""

import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

import can

from robotctl.hal.can.bus_ids import tag
from robotctl.hal.can.cia402.codec import HOST_ID, SETPOINT, Mode, Service
from robotctl.hal.can.cia402.machine import Word
from robotctl.hal.can.damiao.codec import Special
from robotctl.hal.can.damiao.registers import TIMEOUT_UNIT_S
from robotctl.hal.errors import HardwareError
from robotctl.hal.robot import Robot
from robotctl.trials.faults import on_canopen

_START_S = 30.0
_POLL_S = 0.05
_LOST = re.compile(
    r"(\S+): (?:ENABLED -> COMMUNICATION_LOST|OPERATION ENABLED -> .* \(HEARTBEAT_LOST\)), "
    r"(\d+) ms after the last frame"
)
_OFF = re.compile(r"(\S+): (?:OPERATION )?ENABLED -> ")


class Heard(NamedTuple):
    """A frame that reached a joint's drive."""

    at_s: float
    """By the drives' own clock."""
    motor: int
    """Its id, with its bus in it: see `hal.can.bus_ids`."""
    kind: str
    """track, damp, or the special command's name."""


class Emulator:
    """The motors of a robot. End it before the frames are asked for: then its log is complete."""

    def __init__(self, folder: Path, robot: Robot, watchdog_s: float) -> None:
        """Start them, with this watchdog in every drive, and their logs in a folder."""
        self._canopen = on_canopen(robot)
        self._ids = {tag(joint.drive.bus, joint.drive.id) for joint in robot.profile.joints if joint.drive}
        self._told = folder / "emulate.log"
        self._frames = folder / "bus.log"
        command = [sys.executable, "-m", "robotctl.cli.main", "emulate"]
        command += ["--robot", str(robot.source), "--log", str(self._frames)]
        if self._canopen:
            command += ["--register", f"all:0x1016.1={HOST_ID << 16 | round(1e3 * watchdog_s)}"]
        else:
            command += ["--register", f"all:TIMEOUT={round(watchdog_s / TIMEOUT_UNIT_S)}"]
        with self._told.open("w") as output:
            self._process = subprocess.Popen(command, stdout=output, stdin=subprocess.DEVNULL)

    def __enter__(self) -> Self:
        deadline = time.monotonic() + _START_S
        while "channel: " not in self._told.read_text():
            if self._process.poll() is not None or time.monotonic() > deadline:
                self.end()
                raise HardwareError("the emulated motors did not come up", "run robotctl emulate")
            time.sleep(_POLL_S)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end()

    @property
    def channel(self) -> str:
        """Where it serves."""
        return self._told.read_text().split("channel: ")[1].split()[0]

    def end(self) -> None:
        """End it. Harmless when it has ended."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
        self._process.wait()

    def off(self) -> set[str]:
        """Return the names of the drives that went off so far, for whatever reason."""
        return set(_OFF.findall(self._told.read_text()))

    def lost(self) -> dict[str, float]:
        """Return for each drive whose watchdog has bitten how long after the last frame, s."""
        return {name: 1e-3 * int(ms) for name, ms in _LOST.findall(self._told.read_text())}

    def heard(self) -> list[Heard]:
        """Return what the joints' drives were sent."""
        base, kind = (Service.RPDO1, _kind_402) if self._canopen else (0, _kind)
        motors = [
            (tag(int(frame.channel.removeprefix("can")), frame.arbitration_id - base), frame)
            for frame in can.LogReader(self._frames)
            if frame.arbitration_id >= base
        ]
        return [Heard(frame.timestamp, motor, kind(bytes(frame.data))) for motor, frame in motors if motor in self._ids]


def _kind(data: bytes) -> str:
    if data[:7] == b"\xff" * 7:
        return Special(data[7]).name
    return "track" if int.from_bytes(data, "big") >> 24 & 0xFFF else "damp"


def _kind_402(data: bytes) -> str:
    word, mode, _ = SETPOINT.unpack(data)
    if word != Word.ENABLE_OPERATION:
        return "DISABLE" if word == Word.DISABLE_VOLTAGE else Word(word).name
    return "track" if mode == Mode.POSITION else "damp"
