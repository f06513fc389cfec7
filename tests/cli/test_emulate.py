import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from robotctl.cli.main import app


@pytest.mark.parametrize(
    ("options", "status"),
    [
        (["--robot", "nobody"], 2),
        (["--robot", "kinova"], 2),
        (["--channel", "nonsense"], 2),
        (["--trouble", "nonsense"], 2),
        (["--trouble", "mute:99"], 2),
        (["--register", "1:9=x"], 2),
        (["--channel", "socketcan:robotctl9"], 4),
        (["--log", "bus.nonsense"], 2),
        (["--log", "/nowhere/bus.log"], 2),
    ],
)
def test_what_cannot_be_done_says_what_to_try(options: list[str], status: int) -> None:
    result = CliRunner().invoke(app, ["emulate", "--seconds", "0", *options])
    assert result.exit_code == status
    assert "try:" in result.output


@pytest.mark.parametrize(
    ("options", "fd"),
    [([], False), (["--channel", "virtual:cli"], False), (["--channel", "virtual:cli", "--fd"], True)],
)
def test_report(tmp_path: Path, options: list[str], fd: bool) -> None:
    path = tmp_path / "emulate.json"
    result = CliRunner().invoke(app, ["emulate", "--robot", "panda", "--seconds", "0", "--json", str(path), *options])
    assert result.exit_code == 0
    report = json.loads(path.read_text())
    assert report["channel"] in result.output
    assert [motor["fd"] for motor in report["motors"]] == [fd] * 8
    assert report["motors"][7] == {
        "joint": "gripper",
        "bus": 0,
        "id": 8,
        "reply_id": 0x18,
        "model": "DM4310",
        "fd": fd,
        "status": 0,
        "flash_cycles": 0,
    }


def test_can_fd_where_none_passes_is_refused():
    result = CliRunner().invoke(app, ["emulate", "--fd", "--seconds", "0"])
    assert result.exit_code == 2
    assert "no CAN FD passes" in result.output
