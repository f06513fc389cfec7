"""Exit statuses and reports of the two verbs that look and do not touch."""

import json

import pytest
import typer
from typer.testing import CliRunner

from robotctl.cli.doctor import doctor
from robotctl.cli.scan import scan
from robotctl.control.registry import claim


@pytest.fixture
def invoke():
    def invoke(verb, *arguments):
        app = typer.Typer()
        app.command()(verb)
        return CliRunner().invoke(app, list(arguments))

    return invoke


def test_scan_of_an_empty_bus(invoke, tmp_path):
    report = tmp_path / "scan.json"
    result = invoke(scan, "--channel", "virtual:empty", "--last", "2", "--json", str(report))
    assert result.exit_code == 4
    assert "nothing answered on the ids 1 to 2" in result.output
    assert json.loads(report.read_text())["motors"] == []


def test_scan_of_the_emulated_drives(invoke, tmp_path):
    report = tmp_path / "scan.json"
    result = invoke(scan, "--channel", "emulated", "--json", str(report))
    assert result.exit_code == 0
    motors = json.loads(report.read_text())["motors"]
    assert [motor["id"] for motor in motors] == list(range(1, 9))
    assert all(motor["identity"]["timeout_s"] > 0 for motor in motors)


def test_scan_of_a_channel_that_is_not_there(invoke):
    assert invoke(scan, "--channel", "socketcan:nosuch").exit_code == 4
    assert invoke(scan, "--channel", "nonsense").exit_code == 2
    assert invoke(scan, "--robot", "nonsense").exit_code == 2


def test_doctor_without_a_channel(invoke, tmp_path):
    report = tmp_path / "doctor.json"
    result = invoke(doctor, "--json", str(report))
    assert result.exit_code == 0
    areas = {finding["area"] for finding in json.loads(report.read_text())["findings"]}
    assert areas == {"host", "profile"}


def test_doctor_with_the_emulated_drives(invoke):
    assert invoke(doctor, "--channel", "emulated").exit_code == 0


def test_doctor_on_a_silent_bus(invoke):
    result = invoke(doctor, "--channel", "virtual:silent")
    assert result.exit_code == 4
    assert "does not answer" in result.output


def test_doctor_on_a_missing_interface(invoke):
    assert invoke(doctor, "--channel", "socketcan:nosuch").exit_code == 4


@pytest.mark.parametrize("verb", [scan, doctor])
def test_a_channel_that_drives_an_arm_is_left_alone(invoke, verb):
    with claim("slcan:/dev/nosuch"):
        result = invoke(verb, "--channel", "slcan:/dev/nosuch")
    assert result.exit_code == 4
    assert "in use by another robotctl" in result.output


def test_scan_of_canopen_nodes(invoke, tmp_path):
    report = tmp_path / "scan.json"
    result = invoke(scan, "--robot", "xarm7", "--last", "9", "--json", str(report))
    assert result.exit_code == 0
    assert "CANopen nodes on emulated" in result.output
    found = json.loads(report.read_text())
    assert found["motors"] == []
    assert [node["id"] for node in found["nodes"]] == list(range(1, 8))
    assert {(node["profile"], node["watchdog_s"], node["status"]) for node in found["nodes"]} == {
        (402, 0.08, "SWITCH ON DISABLED")
    }


def test_doctor_reads_canopen_drives_back(invoke, tmp_path):
    report = tmp_path / "doctor.json"
    result = invoke(doctor, "--robot", "xarm7", "--channel", "emulated", "--json", str(report))
    findings = {entry["name"]: entry for entry in json.loads(report.read_text())["findings"]}
    assert "load the bus by 68 %" in findings["bus load"]["text"]
    assert findings["joint7 (node 7)"]["level"] == "ok"
    drives = [entry for entry in findings.values() if entry["area"] in ("drives", "bus")]
    assert {entry["level"] for entry in drives} == {"ok"}, result.output
