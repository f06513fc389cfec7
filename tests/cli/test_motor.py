"""`robotctl motor`: what a person sees, what a script gets, and what is refused."""

import io
import json

import pytest
from rich.console import Console
from typer.testing import CliRunner

from robotctl.cli.confirm import confirm
from robotctl.cli.main import app
from robotctl.hal.can.dump import read_dump
from robotctl.hal.can.flash_log import MANY, count_writes
from robotctl.hal.errors import ConfigError


@pytest.fixture(autouse=True)
def state(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


def invoke(*words, status=0):
    result = CliRunner().invoke(app, ["motor", *words, "--robot", "openarm"])
    assert result.exit_code == status, result.output
    return result.output


def test_info_by_id_and_by_name(tmp_path):
    report = tmp_path / "info.json"
    assert "TIMEOUT 1600" in invoke("info", "0x03", "--json", str(report))
    (entry,) = json.loads(report.read_text())
    assert (entry["id"], entry["status"], entry["parameters"]["VMAX"]) == (3, "DISABLED", 10.0)
    assert "gripper (0x08)" in invoke("info", "gripper")
    assert "use an id" in invoke("info", "elbow", status=2)


@pytest.mark.parametrize("words", [("set-zero", "3"), ("set-id", "3", "9"), ("set-watchdog", "3", "60")])
def test_what_stays_needs_a_persons_word_or_yes(words, tmp_path):
    assert "--yes" in invoke(*words, status=2)
    report = tmp_path / "done.json"
    assert "stored" in invoke(*words, "--yes", "--json", str(report))
    assert json.loads(report.read_text())[0]["flash_writes"] == 1


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_a_person_types_what_is_meant(monkeypatch):
    console = Console(file=io.StringIO())
    monkeypatch.setattr("sys.stdin", Terminal("0x03\n"))
    confirm(console, "0x03 becomes zero", "0x03", yes=False)
    for typed in ("y\n", "0x04\n", ""):
        monkeypatch.setattr("sys.stdin", Terminal(typed))
        with pytest.raises(ConfigError, match="nothing was written"):
            confirm(console, "0x03 becomes zero", "0x03", yes=False)


def test_many_writes_are_warned_of():
    count_writes("damiao", 0x26000003, MANY - 2)
    assert "promised" not in invoke("set-watchdog", "3", "60", "--yes")
    assert "promised" in invoke("set-watchdog", "3", "60", "--yes")


def test_dump_restore_and_diff(tmp_path):
    file = tmp_path / "arm.yaml"
    assert "8 drives" in invoke("dump", str(file))
    assert [motor.id for motor in read_dump(file).motors] == list(range(1, 9))
    assert "as the file says" in invoke("diff", "--file", str(file))
    assert "as the profile says" in invoke("diff")
    assert "nothing to restore" in invoke("restore", str(file), "3")
    file.write_text(file.read_text().replace("KP_APR: 50", "KP_APR: 55"))
    report = tmp_path / "diff.json"
    assert "KP_APR" in invoke("diff", "3", "--file", str(file), "--json", str(report), status=4)
    (entry,) = json.loads(report.read_text())
    assert entry["differences"] == [{"name": "KP_APR", "wanted": 55.0, "found": 50.0}]
    assert "stored" in invoke("restore", str(file), "3", "--yes")


def test_another_motor_than_in_the_file_is_told(tmp_path):
    file = tmp_path / "arm.yaml"
    invoke("dump", str(file))
    # As if the drives 5 and 6 had changed places: the same model, and only the serial numbers tell.
    text = file.read_text().replace("637534213", "five").replace("637534214", "637534213").replace("five", "637534214")
    file.write_text(text)
    output = invoke("diff", "5", "6", "--file", str(file), status=4)
    assert output.count("swapped?") == 2


@pytest.mark.parametrize("words", [("restore",), ("diff", "--file")])
def test_a_dump_that_is_not_there_is_named(words, tmp_path):
    missing = tmp_path / "missing.yaml"
    assert f"{missing}: No such file" in invoke(*words, str(missing), status=2)
