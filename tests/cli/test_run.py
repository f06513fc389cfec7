"""`robotctl run` as a person types it: reports, exit statuses, errors that say what to do."""

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from robotctl.cli import run as run_module
from robotctl.cli.main import app
from robotctl.hal.robot import load_robot, profile_path
from robotctl.safety.routines import Goto


def robotctl(folder: Path, *arguments: str) -> tuple[Result, dict[str, Any]]:
    files = ["--json", str(folder / "report.json"), "--record", str(folder / "run.mcap")]
    result = CliRunner().invoke(app, ["run", "--fast", *files, *arguments])
    report = folder / "report.json"
    return result, json.loads(report.read_text()) if report.exists() else {}


@pytest.mark.parametrize("robot", ["panda", "openarm", "kinova", "xarm7"])
def test_the_scripted_policy_reaches_on_the_twin(tmp_path: Path, robot: str) -> None:
    result, report = robotctl(tmp_path, "--robot", robot)
    assert result.exit_code == 0, result.output
    assert [episode["success"] for episode in report["episodes"]] == [True] * 3
    assert max(episode["final_distance_m"] for episode in report["episodes"]) <= 0.01
    assert report["can"] is None
    assert report["safety"]["judged_on"] == "truth"
    assert Path(report["recording"]).stat().st_size > 10_000


@pytest.mark.parametrize("robot", ["panda", "openarm"])
def test_twin_and_frames_end_alike(tmp_path: Path, robot: str) -> None:
    ends = []
    for backend in ("sim", "can"):
        folder = tmp_path / backend
        folder.mkdir()
        result, report = robotctl(folder, "--robot", robot, "--backend", backend, "--episodes", "5", "--seed", "3")
        assert result.exit_code == 0, result.output
        assert all(episode["success"] for episode in report["episodes"])
        ends.append([episode["final_distance_m"] for episode in report["episodes"]])
    assert max(abs(a - b) for a, b in zip(*ends, strict=True)) <= 0.005
    assert report["can"]["sent"] > 1000
    assert report["can"]["missed_replies"] == 0


@pytest.mark.parametrize("backend", ["sim", "can"])
@pytest.mark.parametrize("policy", ["random", "outward"])
def test_hostile_policies_violate_nothing(tmp_path: Path, backend: str, policy: str) -> None:
    result, report = robotctl(tmp_path, "--backend", backend, "--policy", policy, "--episodes", "1")
    assert result.exit_code == 0, result.output
    assert report["safety"]["violations"] == {"position": 0, "velocity": 0, "sphere": 0}
    assert report["episodes"][0]["steps"] == 150
    assert report["safety"]["clipped_ticks"] > 0


@pytest.mark.parametrize("lag", ["0.0", "0.02"])
def test_hostile_policies_violate_nothing_behind_a_lag(tmp_path: Path, lag: str) -> None:
    settings = ["--set", f"twin.lag_s={lag}", "--set", "safety.sphere=projection"]
    result, report = robotctl(tmp_path, "--policy", "outward", "--episodes", "1", *settings)
    assert result.exit_code == 0, result.output
    assert report["safety"]["violations"] == {"position": 0, "velocity": 0, "sphere": 0}


@pytest.mark.parametrize(("policy", "protection"), [("nan", "P9"), ("stall", "P10"), ("die", "P10")])
def test_treacherous_policies_end_with_status_3_and_a_black_box(tmp_path: Path, policy: str, protection: str) -> None:
    result, report = robotctl(tmp_path, "--policy", policy)
    assert result.exit_code == 3, result.output
    assert report["safety"]["trips"][0]["protection"] == protection
    assert report["stopped"]
    assert Path(report["black_boxes"][0]).exists()
    assert not report["episodes"][0]["success"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--robot", "pander"], ["unknown robot 'pander'", "kinova, openarm, openarm_bimanual, panda, xarm7"]),
        (["--task", "juggle"], ["unknown task 'juggle'", "reach"]),
        (["--policy", "magic"], ["unknown policy 'magic'", "scripted"]),
        (["--backend", "ros"], ["unknown backend 'ros'", "can, sim"]),
        (["--channel", "emulated"], ["sim backend has no channel"]),
        (["--backend", "can", "--robot", "kinova"], ["kinova"]),
        (["--backend", "can", "--channel", "nonsense"], ["nonsense", "socketcan:"]),
        (["--set", "safety.sphere=cube"], ["safety.sphere", "'qp' or 'projection'"]),
        (["--set", "nonsense"], ["not of the form key=value"]),
    ],
)
def test_bad_input_says_what_to_do(tmp_path: Path, arguments: list[str], words: list[str]) -> None:
    result, _ = robotctl(tmp_path, *arguments)
    assert result.exit_code == 2, result.output
    for word in words:
        assert word in result.output
    assert "Traceback" not in result.output


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("velocity: 1.0", "velocity: 9.0", ["exceeds the model's 2.175"]),
        ("brakes: true", "breaks: true", ["breaks: unknown key", "panda.yaml:"]),
        ("acceleration: 5.0", "acceleration: .nan", ["panda.yaml:", "finite"]),
        ("id: 2,", "id: 1,", ["used by more than one motor"]),
    ],
)
def test_a_bad_profile_names_file_and_line(tmp_path: Path, old: str, new: str, words: list[str]) -> None:
    path = tmp_path / "panda.yaml"
    path.write_text(profile_path("panda").read_text().replace(old, new, 1))
    result, _ = robotctl(tmp_path, "--robot", str(path))
    assert result.exit_code == 2, result.output
    for word in words:
        assert word in result.output


def test_a_channel_that_does_not_exist_is_missing_hardware(tmp_path: Path) -> None:
    result, _ = robotctl(tmp_path, "--backend", "can", "--channel", "socketcan:can9")
    assert result.exit_code == 4, result.output
    assert "can9" in result.output


def test_lockstep_is_refused_on_drives_in_real_time(tmp_path: Path) -> None:
    result, _ = robotctl(tmp_path, "--backend", "can", "--channel", "virtual:nobody")
    assert result.exit_code == 2, result.output
    assert "leave out --fast" in result.output


@pytest.mark.realtime
def test_a_bus_where_nobody_answers_names_the_motors(tmp_path: Path) -> None:
    command = ["run", "--backend", "can", "--channel", "virtual:nobody", "--record", str(tmp_path / "r.mcap")]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 4, result.output
    for word in ("panda_joint1", "0x01", "power"):
        assert word in result.output


def test_a_recording_is_never_overwritten(tmp_path: Path) -> None:
    (tmp_path / "run.mcap").write_text("precious")
    result, _ = robotctl(tmp_path)
    assert result.exit_code == 2
    assert "already exists" in result.output
    assert (tmp_path / "run.mcap").read_text() == "precious"


def test_a_report_that_cannot_be_written_says_so(tmp_path: Path) -> None:
    command = ["run", "--fast", "--episodes", "1", "--record", str(tmp_path / "r.mcap"), "--json", "/nowhere/r.json"]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 2
    assert "cannot write /nowhere/r.json" in result.output


def test_a_reset_that_fails_calls_for_the_operator(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Goto, "timeout_s", 1.0)
    settings = ["--set", "twin.start=[0.9, -0.4, 0.0, -2.2, 0.0, 1.9, 0.785]", "--set", "safety.reset_scale=0.01"]
    result, report = robotctl(tmp_path, *settings)
    assert result.exit_code == 3, result.output
    assert "operator, please: P29: reset routine 'home' did not arrive in 3 tries of 1 s" in result.output
    assert [page.split(":")[0] for page in report["safety"]["pages"]] == ["P29"]
    assert report["episodes"] == []


def test_real_drives_do_not_move_before_their_limits_are_acknowledged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.setattr(run_module, "may_be_real", lambda channel: True)
    arm = ["--backend", "can", "--episodes", "1"]
    result, _ = robotctl(tmp_path, *arm)
    assert result.exit_code == 2
    assert "the limits of panda have not been acknowledged" in result.output
    assert "try: read this; if it is what the arm should be held to, run again with --accept-limits" in result.output
    assert not (tmp_path / "run.mcap").exists()
    result, report = robotctl(tmp_path, *arm, "--accept-limits")
    assert result.exit_code == 0, result.output
    assert report["limits_hash"] == load_robot("panda").limits_hash
    (tmp_path / "run.mcap").unlink()
    result, report = robotctl(tmp_path, *arm)
    assert result.exit_code == 0, result.output
    (tmp_path / "run.mcap").unlink()
    result, _ = robotctl(tmp_path, *arm, "--set", "sphere.radius=0.41")
    assert result.exit_code == 2
    assert "- sphere.radius: 0.42\n+ sphere.radius: 0.41\n" in result.output


def test_emulated_drives_and_the_twin_ask_for_no_acknowledgement(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    for backend in ("sim", "can"):
        folder = tmp_path / backend
        folder.mkdir()
        result, _ = robotctl(folder, "--backend", backend, "--episodes", "1")
        assert result.exit_code == 0, result.output
    assert not (tmp_path / "robotctl").exists()
