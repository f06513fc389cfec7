"""Planted mistakes of wiring and set-up: the run does not start, and says which motor and what to do."""

from pathlib import Path
from typing import Any

import pytest

from .conftest import Emulator

pytestmark = pytest.mark.realtime


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--trouble", "mute:3"], ["openarm_right_joint3 (motor id 0x03)", "power", "termination"]),
        (["--register", "4:TIMEOUT=0"], ["openarm_right_joint4 (motor id 0x04)", "no watchdog", "register 9"]),
        (["--register", "2:ESC_ID=1"], ["openarm_right_joint1", "2 motors answer to id 0x01"]),
        (["--register", "1:TMAX=28"], ["openarm_right_joint1 (motor id 0x01)", "28", "54"]),
        (["--trouble", "fault:5:0xC"], ["openarm_right_joint5", "ROTOR_OVER_TEMPERATURE"]),
    ],
    ids=["mute", "watchdog", "twins", "ranges", "fault"],
)
def test_a_planted_mistake_is_named(start: Any, tmp_path: Path, options: list[str], words: list[str]) -> None:
    emulator = Emulator(tmp_path, *options)
    try:
        run = start("--backend", "can", "--robot", "openarm", "--channel", emulator.channel)
        status, output, report = run.finish()
    finally:
        emulator.end()
    assert status == 4, output
    assert report["safety"]["state"] == "OFF"
    assert words[0] in report["error"]
    for word in words:
        assert word in output, output
    assert "Traceback" not in output
    assert "ENABLED" not in emulator.text
    assert run.left_behind() == []
