"""The report: complete, and each section on its own."""

import json
from pathlib import Path

import pytest

from robotctl.hal.robot import Robot, load_robot
from robotctl.trials.campaign import Campaign, Row
from robotctl.trials.report import as_json, figure, fingerprint, write_section
from robotctl.trials.scenario import Scenario, Trial


def a_campaign(robot: Robot, backend: str = "sim", problem: str = "", missing: tuple[int, ...] = ()) -> Campaign:
    def never(*_: object) -> Trial:
        raise AssertionError

    rows = [
        Row(
            Scenario(17, "stuck", "a joint seizes up", "P17", never),
            [
                Trial([], "P17, category 1", {"reaction_s": 0.010, "standstill_s": 0.1, "position_excess": -0.5}),
                Trial([problem] if problem else [], "", {"reaction_s": 0.030, "standstill_s": float("inf")}),
                Trial([], "P17, category 1", {"reaction_s": 0.011}),
            ],
        ),
        Row(Scenario(25, "unknown key", "a key", "refused", never), [Trial([], "refused")]),
    ]
    return Campaign(robot, backend, rows, list(missing))


def test_json_has_everything_and_no_infinity(panda: Robot) -> None:
    data = json.loads(json.dumps(as_json(a_campaign(panda, problem="it moved", missing=(19,))), allow_nan=False))
    assert (data["robot"], data["backend"], data["simulated"]) == ("panda", "sim", True)
    assert data["configuration"] == fingerprint(panda)
    assert data["published"]["stopping_time_s"] == panda.stopping_time_s
    assert "mujoco" in data["versions"]
    assert data["passed"] is False
    assert data["missing"] == ["P19"]
    stuck, unknown = data["rows"]
    assert (stuck["protection"], stuck["passed"], stuck["problems"]) == ("P17", False, ["it moved"])
    assert [trial["seed"] for trial in stuck["trials"]] == [0, 1, 2]
    assert stuck["trials"][1]["figures"]["standstill_s"] is None
    assert unknown["passed"]


def test_figures_are_median_and_worst(panda: Robot) -> None:
    row = a_campaign(panda).rows[0]
    assert figure(row, "reaction_s") == (0.011, 0.030)
    assert figure(row, "position_excess") == (-0.5, -0.5)
    assert figure(row, "tool_way_m") is None


def test_a_section_replaces_its_own_and_leaves_the_others(panda: Robot, tmp_path: Path) -> None:
    path = tmp_path / "safety-report.md"
    write_section(path, a_campaign(panda, "sim", problem="it moved"))
    write_section(path, a_campaign(load_robot("openarm"), "can"))
    before = path.read_text()
    assert before.index("## openarm on can") < before.index("## panda on sim")
    assert "it moved" in before
    write_section(path, a_campaign(panda, "sim"))
    after = path.read_text()
    assert "it moved" not in after
    assert after.count("## panda on sim") == after.count("## openarm on can") == 1
    assert "simulated" in after.split("## ")[0]
    write_section(path, a_campaign(panda, "sim"))
    assert path.read_text() == after


@pytest.mark.parametrize(
    "words", ["| P17 | stuck: a joint seizes up |", "11 / 30", "P25", "-500 mrad", "stopping_time_s"]
)
def test_a_section_has_a_row_per_scenario(panda: Robot, tmp_path: Path, words: str) -> None:
    path = tmp_path / "report.md"
    write_section(path, a_campaign(panda))
    assert words in path.read_text()


def test_what_is_missing_stands_in_the_section(panda: Robot, tmp_path: Path) -> None:
    path = tmp_path / "report.md"
    write_section(path, a_campaign(panda, missing=(19, 28)))
    assert "no scenario for P19, P28" in path.read_text()


def test_another_limit_is_another_configuration() -> None:
    assert fingerprint(load_robot("panda")) != fingerprint(load_robot("panda", ["joints.0.velocity=0.9"]))
