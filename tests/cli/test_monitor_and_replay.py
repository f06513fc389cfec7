"""Exit statuses and reports of listening and of replaying."""

import json

import pytest
from typer.testing import CliRunner

from robotctl.cli.main import app
from robotctl.control.black_box import BlackBox
from robotctl.control.session import LockstepSession
from robotctl.hal.robot import load_robot


def invoke(*words):
    return CliRunner().invoke(app, list(words))


def test_a_quiet_bus_is_listened_to_and_ends_in_time(tmp_path):
    report = tmp_path / "monitor.json"
    result = invoke("monitor", "--channel", "virtual:quiet", "--seconds", "0", "--json", str(report))
    assert result.exit_code == 0
    assert json.loads(report.read_text())["ids"] == []


@pytest.mark.parametrize(("channel", "status"), [("emulated", 2), ("nonsense", 2), ("socketcan:nosuch", 4)])
def test_where_nothing_can_be_heard(channel, status):
    result = invoke("monitor", "--channel", channel, "--seconds", "0")
    assert result.exit_code == status
    assert "try:" in result.output


def test_a_black_box_is_decoded_compared_and_exported(tmp_path):
    robot = load_robot("openarm")
    with LockstepSession(robot, "can") as session:
        box = BlackBox(robot, session.link, tmp_path / "run", {}, 0, session.frames)
        session.on_trip = box.on_trip
        session.prepare()
        session.emergency_stop()
        session.advance(1.2)
        (path,) = box.flush()
    report, out = tmp_path / "replay.json", tmp_path / "bus.asc"
    result = invoke("replay", "--frames", str(path), "--export", str(out), "--json", str(report))
    assert result.exit_code == 0, result.output
    found = json.loads(report.read_text())
    assert found["ticks"] == found["compared"] > 1000
    assert found["different"] == 0
    assert out.stat().st_size > 10_000


def test_what_holds_no_frames_says_so(tmp_path):
    assert invoke("replay", "--frames", str(tmp_path / "nothing.mcap")).exit_code == 2
    robot = load_robot("kinova")
    with LockstepSession(robot, "sim") as session:
        box = BlackBox(robot, session.link, tmp_path / "run", {}, 0, session.frames)
        session.on_trip = box.on_trip
        session.prepare()
        session.emergency_stop()
        session.advance(1.2)
        (path,) = box.flush()
    result = invoke("replay", "--frames", str(path))
    assert result.exit_code == 2
    assert "holds no frames" in result.output
