"""Limits are acknowledged once, and again when they have changed."""

import json
from pathlib import Path

import pytest

from robotctl.control.acknowledgement import acknowledge, require_acknowledged, state_file
from robotctl.hal.errors import ConfigError
from robotctl.hal.robot import Robot, load_robot


@pytest.fixture(autouse=True)
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    return tmp_path


def test_limits_nobody_has_seen_are_shown_in_full(panda: Robot, state: Path) -> None:
    with pytest.raises(ConfigError, match="have not been acknowledged on this machine") as caught:
        require_acknowledged(panda)
    assert "joints.panda_joint1.velocity: 1.0" in caught.value.what
    assert "--accept-limits" in caught.value.remedy
    assert list(state.iterdir()) == []


def test_acknowledged_limits_are_remembered_per_robot(panda: Robot, state: Path) -> None:
    acknowledge(panda)
    require_acknowledged(panda)
    require_acknowledged(load_robot("panda", ["twin.lag_s=0.01"]))  # which limits nothing
    with pytest.raises(ConfigError, match="openarm"):
        require_acknowledged(load_robot("openarm"))
    kept = json.loads((state / "robotctl" / "limits" / "panda.json").read_text())
    assert kept["hash"] == panda.limits_hash


def test_a_change_is_refused_with_its_lines_until_it_is_acknowledged(panda: Robot) -> None:
    acknowledge(panda)
    faster = load_robot("panda", ["joints.2.velocity=1.5"])
    with pytest.raises(ConfigError) as caught:
        require_acknowledged(faster)
    assert caught.value.what.splitlines()[1:] == [
        "- joints.panda_joint3.velocity: 1.0",
        "+ joints.panda_joint3.velocity: 1.5",
    ]
    acknowledge(faster)
    require_acknowledged(faster)
    with pytest.raises(ConfigError):
        require_acknowledged(panda)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"limits": 3}', '{"limits": [1]}'])
def test_a_damaged_file_acknowledges_nothing(panda: Robot, text: str) -> None:
    acknowledge(panda)
    state_file(panda).write_text(text)
    with pytest.raises(ConfigError, match=r"panda\.json cannot be read"):
        require_acknowledged(panda)


def test_a_name_cannot_lead_out_of_the_folder(state: Path) -> None:
    robot = load_robot("panda", ["name=../../panda"])
    assert state_file(robot).parent == state / "robotctl" / "limits"
    acknowledge(robot)
    require_acknowledged(robot)


def test_where_nothing_can_be_written_it_says_so(panda: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", "/dev/null")
    with pytest.raises(ConfigError, match="cannot write /dev/null"):
        acknowledge(panda)


def test_without_the_variable_it_is_the_usual_folder(panda: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("XDG_STATE_HOME")
    assert state_file(panda) == Path.home() / ".local/state/robotctl/limits/panda.json"
