"""Real processes under real signals. Everything runs in a runtime folder of its own, and leaves nothing behind."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import can
import numpy as np
import pytest
from numpy.typing import NDArray

from robotctl.hal.can.damiao.codec import Special, decode_feedback, is_feedback
from robotctl.hal.can.damiao.motors import MOTORS
from robotctl.hal.robot import CONFIGS

KILLS = int(os.environ.get("ROBOTCTL_KILLS", "1"))
MOMENTS = [random.Random(seed).uniform(0.0, 1.5) for seed in range(KILLS)]
"""When to strike, in seconds after a run has got going."""
JOINTS = 7
PATIENT = ("safety.overrun_s=0.1", "safety.heartbeat_s=0.2")
"""Machines that run tests are stalled by their hypervisors, for longer than the 20 ms that a loop may be, and are busy,
for longer than the 100 ms that a policy may be."""
ROBOTCTL = [sys.executable, "-m", "robotctl.cli.main"]


class Run:
    """One `robotctl run` as a child process."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        self.folder = folder
        self.report_path = folder / "report.json"
        self.environment = os.environ | {"ROBOTCTL_RUNTIME_DIR": str(folder)}
        arguments = (*arguments, *(word for setting in PATIENT for word in ("--set", setting)))
        files = ["--json", str(self.report_path)]
        files += [] if "--record" in arguments else ["--record", str(folder / "run.mcap")]
        self.process = subprocess.Popen(
            [*ROBOTCTL, "run", *arguments, *files],
            env=self.environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )

    def pids(self) -> dict[str, int]:
        """Pids of the children by their part, as ps shows them."""
        parts = {
            "robotctl-ctl": "control",
            "robotctl-watch": "watchman",
            "robotctl-policy": "policy",
            "robotctl-rec": "recorder",
        }
        found = {}
        for pid in _children(self.process.pid):
            try:
                name = Path(f"/proc/{pid}/comm").read_text().strip()
            except OSError:
                continue
            if name in parts:
                found[parts[name]] = pid
        return found

    def wait_running(self, timeout_s: float = 30.0) -> dict[str, int]:
        """Return the pids once all four parts run and the first episode has begun."""
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            pids = self.pids()
            if len(pids) == 4:
                time.sleep(1.5)  # armed and on its way
                return pids
            assert self.process.poll() is None, self.process.communicate()[0]
            time.sleep(0.02)
        raise AssertionError("the run did not start")

    def finish(self, timeout_s: float = 60.0) -> tuple[int, str, dict[str, Any]]:
        """Return exit status, output and report."""
        output, _ = self.process.communicate(timeout=timeout_s)
        report = json.loads(self.report_path.read_text()) if self.report_path.exists() else {}
        return self.process.returncode, output, report

    def left_behind(self) -> list[str]:
        """Return what is still there of a run that has ended."""
        left = [f"process {pid}" for pid in _session(self.process.pid)]
        left += [str(path) for path in Path("/dev/shm").glob("*robotctl*")]
        left += [str(path) for path in self.folder.glob("robotctl-*/*.json")]
        return left

    def kill_all(self) -> None:
        for pid in _children(self.process.pid):
            os.kill(pid, signal.SIGKILL)
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()


class Emulator:
    """`robotctl emulate` on a pseudo-terminal, with a log of every frame."""

    def __init__(self, folder: Path, *options: str, robot: str = "openarm") -> None:
        self.log = folder / "emulate.log"
        self.frames = folder / "bus.log"
        command = [*ROBOTCTL, "emulate", "--robot", robot, "--log", str(self.frames), *options]
        with self.log.open("w") as output:
            self.process = subprocess.Popen(command, stdout=output)
        with suppress(PermissionError):  # motors keep time, however busy the host is
            os.sched_setscheduler(self.process.pid, os.SCHED_FIFO, os.sched_param(1))
        deadline = time.monotonic() + 30.0
        while "channel: " not in self.text:
            assert self.process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.05)
        self.channel = self.text.split("channel: ")[1].split()[0]

    @property
    def text(self) -> str:
        return self.log.read_text()

    def end(self) -> None:
        """End it so that its log is complete."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGCONT)
            self.process.send_signal(signal.SIGINT)
        self.process.wait()

    def heard(self) -> list["Heard"]:
        """Return what the joints' drives were sent, once it has ended."""
        return [
            Heard(frame.timestamp, frame.arbitration_id, _kind(bytes(frame.data)))
            for frame in can.LogReader(self.frames)
            if 1 <= frame.arbitration_id <= JOINTS
        ]

    def speeds(self, since_s: float) -> NDArray[np.float64]:
        """Return the measured speeds of all joints from a time on, rad/s."""
        speeds = []
        for frame in can.LogReader(self.frames):
            motor = frame.arbitration_id - 0x10
            if 1 <= motor <= JOINTS and frame.timestamp > since_s and is_feedback(bytes(frame.data), motor):
                ranges = MOTORS["DM8009" if motor <= 2 else "DM4340" if motor <= 4 else "DM4310"]
                speeds.append(decode_feedback(bytes(frame.data), ranges).velocity)
        return np.array(speeds)


class Heard(NamedTuple):
    """A frame that reached a joint's drive."""

    at_s: float
    """By the drives' own clock, which stands still while the emulator does not get to run."""
    motor: int
    kind: str
    """track, damp, or the special command's name."""


def _kind(data: bytes) -> str:
    if data[:7] == b"\xff" * 7:
        return Special(data[7]).name
    return "track" if int.from_bytes(data, "big") >> 24 & 0xFFF else "damp"


def _children(pid: int) -> list[int]:
    try:
        return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []


def _session(pid: int) -> list[int]:
    """Return the live processes whose command line is ours and whose parent was the run."""
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            command = (entry / "cmdline").read_bytes().decode()
            state = (entry / "stat").read_text().rpartition(")")[2].split()[0]
        except OSError:
            continue
        if f'"operator": {pid}' in command or f'"parent": {pid}' in command:
            found += [int(entry.name)] if state != "Z" else []
    return found


@pytest.fixture
def brief(tmp_path: Path) -> tuple[str, str]:
    """Options that make episodes of a task end after 3 s."""
    path = tmp_path / "brief.yaml"
    path.write_text((CONFIGS / "tasks" / "reach.yaml").read_text().replace("steps: 150", "steps: 60"))
    return "--task", str(path)


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Any]:
    runs: list[Run] = []

    def begin(*arguments: str) -> Run:
        folder = tmp_path / f"run{len(runs)}"
        folder.mkdir()
        runs.append(Run(folder, *arguments))
        return runs[-1]

    yield begin
    for run in runs:
        run.kill_all()
