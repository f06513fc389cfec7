"""Planted mistakes, told apart by the verbs of commissioning: emulated drives in another process, over slcan."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from robotctl.cli.main import app
from tests.planted import MISTAKES, Emulator, Mistake, verdicts

pytestmark = pytest.mark.realtime


def ask(folder: Path, verb: str, *arguments: str) -> tuple[int, dict]:
    """Run a verb in this process; return its exit status and its report."""
    report = folder / f"{verb}.json"
    result = CliRunner().invoke(app, [*verb.split("-"), *arguments, "--json", str(report)], catch_exceptions=False)
    assert report.exists(), result.output
    return result.exit_code, json.loads(report.read_text())


def test_a_sound_arm_is_found_fit(tmp_path: Path) -> None:
    with Emulator(tmp_path) as emulator:
        status, found = ask(tmp_path, "scan", "--channel", emulator.channel, "--robot", "openarm")
        assert (status, len(found["motors"])) == (0, 8)
        status, report = ask(tmp_path, "doctor", "--channel", emulator.channel, "--robot", "openarm")
        bad = [f for f in report["findings"] if f["level"] != "ok" and f["area"] != "host"]
        assert (status, bad) == (0, [])


@pytest.mark.parametrize("mistake", MISTAKES, ids=[mistake.name for mistake in MISTAKES])
def test_a_planted_mistake_is_named_and_nothing_else_is(tmp_path: Path, mistake: Mistake) -> None:
    with Emulator(tmp_path, *mistake.options) as emulator:
        status, report = ask(tmp_path, "doctor", "--channel", emulator.channel, "--robot", "openarm")
    findings = report["findings"]
    assert status == 4
    assert verdicts(findings, mistake), [f for f in findings if f["level"] != "ok"]
    others = [other.name for other in MISTAKES if other != mistake and verdicts(findings, other)]
    assert others == []
