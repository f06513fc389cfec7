"""Planted mistakes over the kernel's vcan, which knows no bit rates but carries error frames. Few: guests are slow."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from robotctl.cli.main import app
from tests.planted import MISTAKES, Emulator, Mistake, verdicts

if not Path("/sys/class/net/vcan0").exists():
    pytest.skip("needs a vcan0 interface; tests/interop/test_kernel_can.py boots one", allow_module_level=True)

CHANNEL = "socketcan:vcan0"
NAMED = {mistake.name: mistake for mistake in MISTAKES}
PLANTED = [
    # No sweep finds the rate here: the emulated drives break every frame, as real ones would, and that is what shows.
    Mistake("bit rate", ["--register=all:can_br=3"], "bus", "bit rate", "fail", ("x bus error", "another bit rate")),
    Mistake("no power", ["--trouble=powercut:all"], "bus", "power", "fail", ("x no acknowledgement", "alone")),
    NAMED["termination"]._replace(options=["--fd", *NAMED["termination"].options], words=("60 Ohm", "x bus error")),
    NAMED["voltage"]._replace(options=["--fd", *NAMED["voltage"].options]),
]


def doctor(folder: Path) -> tuple[int, list[dict]]:
    report = folder / "doctor.json"
    arguments = ["doctor", "--channel", CHANNEL, "--robot", "openarm", "--json", str(report)]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    return result.exit_code, json.loads(report.read_text())["findings"]


def test_a_sound_arm_is_found_fit_and_the_blind_spot_is_told(tmp_path: Path) -> None:
    with Emulator(tmp_path, "--channel", CHANNEL, "--fd"):
        status, findings = doctor(tmp_path)
    assert status == 0, [finding for finding in findings if finding["level"] == "fail"]
    told = {finding["name"]: finding["text"] for finding in findings if finding["area"] == "bus"}
    assert "no wire and no bit rate" in told["sight"]
    assert "vcan interface: no bit rate" in told["timing"]


@pytest.mark.parametrize("mistake", PLANTED, ids=[mistake.name for mistake in PLANTED])
def test_a_planted_mistake_is_named(tmp_path: Path, mistake: Mistake) -> None:
    with Emulator(tmp_path, "--channel", CHANNEL, *mistake.options):
        status, findings = doctor(tmp_path)
    assert status == 4
    assert verdicts(findings, mistake), [finding for finding in findings if finding["level"] != "ok"]
