"""Planted mistakes, told apart by the verbs of commissioning: emulated drives in another process, over slcan."""

import json
import threading
import time
from pathlib import Path

import can
import pytest
from typer.testing import CliRunner

from robotctl.cli.main import app
from robotctl.hal.can.cia402.codec import Service
from robotctl.hal.can.damiao.codec import BROADCAST_ID, RegisterCommand, encode_register
from tests.planted import MISTAKES, Emulator, Mistake, verdicts

UPLOAD = 0x40
"""Command byte of an SDO request to read."""

pytestmark = pytest.mark.realtime


def ask(folder: Path, verb: str, *arguments: str) -> tuple[int, dict]:
    """Run a verb in this process; return its exit status and its report."""
    report = folder / f"{verb}.json"
    result = CliRunner().invoke(app, [*verb.split("-", 1), *arguments, "--json", str(report)], catch_exceptions=False)
    assert report.exists(), result.output
    return result.exit_code, json.loads(report.read_text())


def test_a_sound_arm_is_found_fit(tmp_path: Path) -> None:
    with Emulator(tmp_path) as emulator:
        status, found = ask(tmp_path, "scan", "--channel", emulator.channel, "--robot", "openarm")
        assert (status, len(found["motors"])) == (0, 8)
        status, report = ask(tmp_path, "doctor", "--channel", emulator.channel, "--robot", "openarm")
        bad = [f for f in report["findings"] if f["level"] != "ok" and f["area"] != "host"]
        assert (status, bad) == (0, [])


def only_asks(frame: can.Message) -> bool:
    """Return whether a frame asks a DAMIAO drive for a register or for feedback, or a CANopen drive for an object."""
    if frame.arbitration_id == BROADCAST_ID:
        return frame.data[2] in (RegisterCommand.READ, RegisterCommand.REFRESH)
    return frame.arbitration_id - Service.SDO in range(1, 128) and frame.data[0] == UPLOAD


@pytest.mark.parametrize("mistake", MISTAKES, ids=[mistake.name for mistake in MISTAKES])
def test_a_planted_mistake_is_named_and_no_other_is_and_nothing_is_touched(tmp_path: Path, mistake: Mistake) -> None:
    log = tmp_path / "bus.log"
    with Emulator(tmp_path, *mistake.options, "--log", str(log)) as emulator:
        status, report = ask(tmp_path, "doctor", "--channel", emulator.channel, "--robot", "openarm")
    findings = report["findings"]
    assert status == 4
    assert verdicts(findings, mistake), [f for f in findings if f["level"] != "ok"]
    assert [other.name for other in MISTAKES if other != mistake and verdicts(findings, other)] == []
    with can.LogReader(log) as reader:
        asked = [frame for frame in reader if frame.is_rx]
    assert len(asked) > 100
    assert [frame for frame in asked if not only_asks(frame)] == []


def test_scan_says_the_same_of_the_bus(tmp_path: Path) -> None:
    with Emulator(tmp_path, "--register=all:can_br=3") as emulator:
        status, report = ask(tmp_path, "scan", "--channel", emulator.channel, "--robot", "openarm")
    assert (status, report["motors"]) == (4, [])
    assert ("bit rate", "fail") in [(finding["name"], finding["level"]) for finding in report["findings"]]
    (heard,) = [attempt for attempt in report["attempts"] if attempt["motors"]]
    assert (heard["bitrate"], heard["fd"], len(heard["motors"])) == (500_000, False, 8)


def test_motors_are_set_and_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    with Emulator(tmp_path, "--register=3:TIMEOUT=0") as emulator:
        where = ("--channel", emulator.channel, "--robot", "openarm")
        kept = tmp_path / "arm.yaml"
        assert ask(tmp_path, "motor-dump", str(kept), *where)[0] == 0
        status, found = ask(tmp_path, "motor-diff", "3", *where)
        assert (status, [d["name"] for d in found[0]["differences"]]) == (4, ["TIMEOUT", "can_br"])
        assert ask(tmp_path, "motor-set-watchdog", "3", "80", "--yes", *where)[0] == 0
        assert ask(tmp_path, "motor-set-id", "3", "0x20", "--yes", *where)[0] == 0
        assert ask(tmp_path, "motor-info", "0x20", *where)[1][0]["parameters"]["TIMEOUT"] == 1600
        assert ask(tmp_path, "motor-set-id", "0x20", "3", "--yes", *where)[0] == 0
        assert ask(tmp_path, "motor-restore", str(kept), "3", "--yes", *where)[0] == 0
        assert ask(tmp_path, "motor-diff", "3", "--file", str(kept), *where)[0] == 0
    cycles = {motor["joint"]: motor["flash_cycles"] for motor in json.loads(emulator.report.read_text())["motors"]}
    assert cycles.pop("openarm_right_joint3") == 4
    assert set(cycles.values()) == {0}


def test_whoever_monitors_says_nothing(tmp_path: Path) -> None:
    with Emulator(tmp_path, "--adapters=2") as emulator:
        talker, listener = json.loads(emulator.report.read_text())["channel"].split(", ")
        status, silent = ask(tmp_path, "monitor", "--channel", listener, "--robot", "openarm", "--seconds", "0.3")
        assert (status, silent["frames"]) == (0, 0)
        with can.Bus(interface="slcan", channel=talker[6:], bitrate=1_000_000, sleep_after_open=0.05) as bus:
            thread = threading.Thread(target=speak, args=(bus, 30))
            thread.start()
            _, heard = ask(tmp_path, "monitor", "--channel", listener, "--robot", "openarm", "--seconds", "2.0")
            thread.join()
    rows = {row["id"]: row for row in heard["ids"]}
    assert set(rows) == {BROADCAST_ID, 0x14}
    assert "openarm_right_joint4: DISABLED" in rows[0x14]["meaning"]
    assert json.loads(emulator.report.read_text())["received"] == 30


def speak(bus: can.BusABC, times: int) -> None:
    time.sleep(1.0)
    for _ in range(times):
        request = encode_register(4, RegisterCommand.REFRESH)
        bus.send(can.Message(arbitration_id=BROADCAST_ID, data=request, is_extended_id=False), 1.0)
        time.sleep(0.02)
