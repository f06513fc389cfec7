"""`robotctl faults`: exit statuses, reports, and what a person sees."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from robotctl.cli.main import app
from robotctl.safety.weights import WeightsGate

RUNNER = CliRunner()


@pytest.mark.parametrize("backend", ["sim", "can"])
def test_one_protection_with_all_its_reports(tmp_path: Path, backend: str) -> None:
    data, report = tmp_path / "faults.json", tmp_path / "safety-report.md"
    arguments = ["faults", "--backend", backend, "--only", "p26", "--json", str(data), "--report", str(report)]
    result = RUNNER.invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert "too old" in result.output
    rows = json.loads(data.read_text())["rows"]
    assert {row["protection"] for row in rows} == {"P26"}
    assert all(row["passed"] for row in rows)
    assert f"{len(rows)} of {len(rows)} scenarios passed" in result.output
    assert f"## panda on {backend}" in report.read_text()


def test_a_scenario_that_fails_is_told_and_ends_with_status_3(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(WeightsGate, "offer", lambda *_: None)
    data = tmp_path / "faults.json"
    result = RUNNER.invoke(app, ["faults", "--only", "P26", "--json", str(data)])
    assert result.exit_code == 3
    assert "FAIL" in result.output
    assert "P26 NaN" in result.output
    assert json.loads(data.read_text())["passed"] is False


@pytest.mark.parametrize("only", ["P99", "P0", "feedback"])
def test_a_protection_that_there_is_not(only: str) -> None:
    result = RUNNER.invoke(app, ["faults", "--only", only])
    assert result.exit_code == 2
    assert f"unknown protection '{only}'" in result.output


def test_a_robot_without_drives_has_no_campaign_on_can() -> None:
    result = RUNNER.invoke(app, ["faults", "--robot", "kinova", "--backend", "can"])
    assert result.exit_code == 2
    assert "has no CAN drives" in result.output


def test_a_backend_without_a_plant_has_no_campaign() -> None:
    result = RUNNER.invoke(app, ["faults", "--backend", "ros"])
    assert result.exit_code == 2
    assert "use sim, or can for emulated motors" in result.output
