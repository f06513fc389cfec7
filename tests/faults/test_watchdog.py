"""The last line: drives in a process of their own switch themselves off when the host dies."""

import os
import re
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from .conftest import MOMENTS, Emulator

pytestmark = pytest.mark.realtime
LOST = re.compile(r"(\S+): ENABLED -> COMMUNICATION_LOST, (\d+) ms after the last frame")


@pytest.fixture
def emulator(tmp_path: Path) -> Iterator[Emulator]:
    emulator = Emulator(tmp_path)
    yield emulator
    emulator.end()


@pytest.mark.parametrize("moment", MOMENTS)
def test_every_motor_goes_off_by_itself_when_nobody_is_left(start: Any, emulator: Emulator, moment: float) -> None:
    run = start("--backend", "can", "--robot", "openarm", "--channel", emulator.channel, "--policy", "random")
    pids = run.wait_running()
    time.sleep(moment)
    for part in ("watchman", "control"):
        os.kill(pids[part], signal.SIGKILL)
    status, output, report = run.finish()
    assert status == 4, output
    assert "the drives go off by their own watchdogs" in report["error"]
    time.sleep(0.3)
    lost = {joint: int(ms) for joint, ms in LOST.findall(emulator.text)}
    assert len([joint for joint in lost if joint != "gripper"]) == 7, emulator.text
    assert max(lost.values()) <= 100
    assert run.left_behind() == []


def test_the_whole_run_in_real_time_through_another_process(start: Any, emulator: Emulator) -> None:
    run = start("--backend", "can", "--robot", "openarm", "--channel", emulator.channel, "--episodes", "1")
    status, output, report = run.finish()
    assert status == 0, output
    assert "servo rate 250 Hz" in output
    assert report["episodes"][0]["success"]
    assert report["safety"]["judged_on"] == "measurement"
    assert "COMMUNICATION_LOST" not in emulator.text
    off = re.findall(r"(\S+): ENABLED -> DISABLED", emulator.text)
    assert len(set(off)) >= 7
