"""`robotctl stop` from another terminal, and policies that misbehave, in real time."""

import json
import os
import pty
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from typer.testing import CliRunner

from robotctl.cli.main import app
from robotctl.control.session import Session

from .conftest import ROBOTCTL

pytestmark = pytest.mark.realtime


def test_stop_from_another_terminal(start: Any) -> None:
    run = start("--policy", "random", "--episodes", "4")
    run.wait_running()
    stopped = subprocess.run([*ROBOTCTL, "stop"], env=run.environment, capture_output=True, text=True, check=False)
    assert stopped.returncode == 0, stopped.stdout
    assert "stopped panda on sim" in stopped.stdout
    status, output, report = run.finish()
    assert status == 3, output
    trip = report["safety"]["trips"][0]
    assert (trip["protection"], trip["stop_category"]) == ("P23", 1)
    assert "robotctl stop" in trip["cause"]
    assert report["safety"]["state"] == "FAULT"
    again = subprocess.run([*ROBOTCTL, "stop"], env=run.environment, capture_output=True, text=True, check=False)
    assert again.returncode == 4
    assert "nothing is running" in again.stdout


@pytest.mark.parametrize(("policy", "protection"), [("nan", "P9"), ("stall", "P10"), ("die", "P10")])
@pytest.mark.parametrize("backend", ["sim", "can"])
def test_a_treacherous_policy_is_stopped_and_recorded(start: Any, backend: str, policy: str, protection: str) -> None:
    run = start("--backend", backend, "--policy", policy)
    status, output, report = run.finish()
    assert status == 3, output
    assert report["safety"]["trips"][0]["protection"] == protection
    assert report["safety"]["violations"] == {"position": 0, "velocity": 0, "sphere": 0}
    assert report["stopped"].startswith(protection)
    with Path(report["black_boxes"][0]).open("rb") as file:
        events = [
            message.data for _, channel, message in make_reader(file).iter_messages() if channel.topic == "/event"
        ]
    assert any(protection.encode() in event for event in events)


@pytest.mark.parametrize("key", [b" ", b"\x1b"])
def test_one_key_is_the_emergency_stop(tmp_path: Path, key: bytes) -> None:
    master, slave = pty.openpty()
    report = tmp_path / "report.json"
    command = [*ROBOTCTL, "run", "--policy", "random", "--episodes", "4"]
    command += ["--json", str(report), "--record", str(tmp_path / "run.mcap")]
    run = subprocess.Popen(command, stdin=slave, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    os.close(slave)
    time.sleep(4.0)
    deadline = time.monotonic() + 30.0
    while run.poll() is None and time.monotonic() < deadline:  # before the run listens, a key is lost
        os.write(master, key)
        time.sleep(0.5)
    output, _ = run.communicate(timeout=1.0)
    os.close(master)
    assert run.returncode == 3, output
    trip = json.loads(report.read_text())["safety"]["trips"][0]
    assert (trip["protection"], trip["stop_category"]) == ("P23", 1)
    assert trip["reaction_ms"] < 100.0


def test_the_key_works_while_an_interrupted_arm_is_parked(tmp_path: Path) -> None:
    master, slave = pty.openpty()
    report = tmp_path / "report.json"
    command = [*ROBOTCTL, "run", "--robot", "openarm", "--policy", "random", "--episodes", "4"]
    command += ["--json", str(report), "--record", str(tmp_path / "run.mcap")]
    run = subprocess.Popen(command, stdin=slave, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    os.close(slave)
    time.sleep(5.0)
    run.send_signal(signal.SIGINT)
    time.sleep(0.5)
    os.write(master, b" ")
    output, _ = run.communicate(timeout=30)
    os.close(master)
    assert run.returncode == 130, output
    safety = json.loads(report.read_text())["safety"]
    assert [trip["protection"] for trip in safety["trips"]] == ["P23"]
    assert safety["state"] == "FAULT"


def test_an_error_in_the_operators_process_stops_the_arm_at_once(tmp_path: Path, monkeypatch: Any) -> None:
    sessions = []

    def go_wrong(session: Session, *_: Any) -> None:
        sessions.append(session)
        session.prepare()
        session.begin()
        raise BrokenPipeError

    monkeypatch.setattr("robotctl.cli.run.run_episodes", go_wrong)
    result = CliRunner().invoke(app, ["run", "--record", str(tmp_path / "run.mcap")])
    assert isinstance(result.exception, BrokenPipeError)
    assert [trip["text"].split(";")[0] for trip in sessions[0].trips] == ["emergency stop by the operator"]
