"""Resets of tasks: steps as data, a door that is pushed shut, a block that is carried back, and what goes wrong."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from robotctl.control.operator import Verb
from robotctl.control.process_session import ProcessSession
from robotctl.control.rehearsal import rehearse
from robotctl.control.session import LockstepSession, Stopped
from robotctl.control.task_reset import PoseStep, PushStep, dump, parse
from robotctl.control.task_routines import Push, ToolTo
from robotctl.hal.errors import ConfigError
from robotctl.hal.robot import Robot, load_robot
from robotctl.safety.machine import State
from robotctl.sim.backend import open_sim
from robotctl.sim.scene import Block, Door, Scene

PADS = {"panda_leftfinger": (0.0, 0.004, 0.045), "panda_rightfinger": (0.0, -0.004, 0.045)}
DOOR = Door(hinge=(0.65, -0.25, 0.449))
SHUT = [{"push": [0.66, 0.0, 0.449], "force": 15.0}, {"tool": [0.5, 0.0, 0.449]}]
TABLE, OVER = 0.3, 0.42
CARRY_BACK = [
    {"grip": 0.08, "force": 20.0},
    {"tool": [0.5, 0.1, OVER]},
    {"tool": [0.5, 0.1, TABLE + 0.02]},
    {"grip": 0.02, "force": 20.0},
    {"tool": [0.5, 0.1, OVER]},
    {"tool": [0.45, -0.1, OVER]},
    {"tool": [0.45, -0.1, TABLE + 0.02]},
    {"grip": 0.08, "force": 20.0},
    {"tool": [0.45, -0.1, OVER]},
]


def ready(robot: Robot, steps: Sequence[dict[str, Any]], scene: Scene | None = None) -> LockstepSession:
    session = LockstepSession(robot, partial(open_sim, scene=scene), reset=parse(steps))
    session.open()
    session.prepare()
    return session


def joint(session: LockstepSession, name: str) -> np.ndarray:
    return np.array(session._rig.arm._plant.data.joint(name).qpos)


def unharmed(session: LockstepSession) -> bool:
    return session.trips == [] and not sum(session.judge.violations.values())


def test_an_open_door_is_pushed_shut(panda: Robot) -> None:
    session = ready(panda, SHUT, DOOR)
    assert joint(session, "door") == pytest.approx(DOOR.opening, abs=1e-3)
    session.reset(Verb.TASK_RESET)
    assert joint(session, "door") == pytest.approx(0.0, abs=5e-3)
    assert session.latest()["true_tool"] == pytest.approx([0.5, 0.0, 0.449], abs=5e-3)
    session.reset()
    assert unharmed(session)


def test_a_push_ends_at_its_force_and_lets_go(panda: Robot) -> None:
    session = ready(panda, SHUT[:1], DOOR)
    session.reset(Verb.TASK_RESET)
    push = Push(panda, session.loop.kinematics, np.array([0.66, 0.0, 0.449]), 15.0, "")
    sample = session._rig.arm.read()
    forces = [
        push.pressing(sample._replace(**{key: record[key] for key in ("position", "velocity", "effort")}))
        for record in session.link.ticks.since(0)[0][::20]
    ]
    assert 15.0 < max(forces) < 25.0
    session.advance(5.0)
    assert abs(push.pressing(session._rig.arm.read())) < 5.0
    # It stood against the shut door, short of where it was sent.
    assert session.latest()["true_tool"][0] == pytest.approx(0.62, abs=5e-3)
    assert unharmed(session)


def test_a_push_that_meets_nothing_goes_the_whole_way(panda: Robot) -> None:
    session = ready(panda, SHUT[:1])
    session.reset(Verb.TASK_RESET)
    assert session.latest()["true_tool"] == pytest.approx([0.66, 0.0, 0.449], abs=5e-3)
    speeds = np.linalg.norm(np.diff(session.link.ticks.since(0)[0]["true_tool"], axis=0), axis=1) * 500
    assert speeds.max() < 0.06


def test_a_block_is_carried_back(panda: Robot) -> None:
    session = ready(panda, CARRY_BACK, Block(at=(0.5, 0.1, TABLE), pads=PADS))
    heights = []
    session.on_poll = lambda: heights.append(joint(session, "block")[2])
    session.reset(Verb.TASK_RESET)
    session.on_poll = None
    assert joint(session, "block")[:3] == pytest.approx([0.45, -0.1, TABLE + 0.02], abs=0.015)
    assert max(heights) > TABLE + 0.09
    session.reset()
    assert unharmed(session)


def test_a_gripper_behind_frames_opens_and_closes(panda: Robot) -> None:
    session = LockstepSession(panda, "can", reset=parse([{"grip": 0.07, "force": 20.0}, {"grip": 0.02, "force": 20.0}]))
    session.open()
    session.prepare()
    widths = []
    session.on_poll = lambda: widths.append(session._rig.gripper.read().width)
    session.reset(Verb.TASK_RESET)
    assert max(widths) == pytest.approx(0.07, abs=5e-3)
    assert widths[-1] == pytest.approx(0.02, abs=5e-3)
    assert unharmed(session)


def test_poses_and_points_are_reached_in_their_order(panda: Robot) -> None:
    pose = [0.2, *panda.profile.home[1:]]
    session = ready(panda, [{"pose": pose}, {"tool": [0.5, 0.0, 0.5]}])
    session.reset(Verb.TASK_RESET)
    records = session.link.ticks.since(0)[0]
    assert np.abs(records["true_position"] - pose).max(axis=1).min() < 5e-3
    assert session.latest()["true_tool"] == pytest.approx([0.5, 0.0, 0.5], abs=4e-3)


def test_the_tool_is_led_along_a_straight_line(robot: Robot) -> None:
    session = LockstepSession(robot, "sim")
    session.open()
    session.prepare()
    start = session.latest()["true_tool"]
    end = start + np.array([-0.05, 0.06, -0.05])
    routine = ToolTo(robot, session.loop.kinematics, end, "line")
    position, sample = session.latest()["command_position"], session._rig.arm.read()
    path = []
    while (wanted := routine.velocity(sample, position)) is not None:
        assert (np.abs(wanted) <= robot.profile.safety.reset_scale * robot.limits.velocity * (1 + 1e-9)).all()
        position = position + 0.002 * wanted
        path.append(session.loop.kinematics.tool(position))
        assert len(path) < 5000
    way = (end - start) / np.linalg.norm(end - start)
    aside = [np.linalg.norm((point - start) - ((point - start) @ way) * way) for point in path]
    assert max(aside) < 5e-3
    assert path[-1] == pytest.approx(end, abs=2e-3)
    speed = np.linalg.norm(np.diff(path, axis=0), axis=1).max() / 0.002
    assert speed <= robot.profile.safety.reset_tool_speed * 1.02


def test_a_step_that_cannot_be_done_ends_in_p29_and_calls_for_the_operator(
    panda: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ToolTo, "timeout_s", 3.0)
    session = ready(panda, [{"tool": [0.5, 0.0, 0.45]}, {"tool": [0.9, 0.0, 0.9]}, {"tool": [0.5, 0.0, 0.45]}])
    with pytest.raises(Stopped, match=r"'task reset, step 1 \(tool\)' did not arrive in 3 tries of 3 s"):
        session.reset(Verb.TASK_RESET)
    assert session.state is State.HOLD
    assert [trip["protection"] for trip in session.trips] == ["P29"]
    assert len(session.pages) == 1
    assert sum(session.judge.violations.values()) == 0


def test_a_door_that_is_blocked_is_pushed_no_harder_than_asked(panda: Robot) -> None:
    session = ready(panda, SHUT, Door(hinge=(0.65, -0.25, 0.449), friction=500.0))
    session.reset(Verb.TASK_RESET)
    assert joint(session, "door") == pytest.approx(DOOR.opening, abs=0.05)
    assert unharmed(session)


def test_without_steps_there_is_no_reset(panda: Robot) -> None:
    session = ready(panda, [])
    with pytest.raises(Stopped, match="the task has no reset"):
        session.reset(Verb.TASK_RESET)
    assert session.state is State.ARMED


@pytest.mark.parametrize(
    ("robot_name", "step", "text"),
    [
        ("panda", {"pose": [0.0]}, r"step 0 \(pose\): 1 values for the 7 joints of panda"),
        ("panda", {"grip": 0.09, "force": 1.0}, r"step 0 \(grip\): 0.09 m with 1.0 N; the gripper does 0.08 m and"),
        ("panda", {"grip": 0.05, "force": 41.0}, r"0.05 m with 41.0 N"),
        ("kinova", {"grip": 0.05, "force": 1.0}, "kinova has no gripper"),
    ],
)
def test_what_a_robot_cannot_do_is_refused_at_the_start(robot_name: str, step: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        LockstepSession(load_robot(robot_name), "sim", reset=parse([step]))


@pytest.mark.parametrize(
    ("step", "text"),
    [
        ({}, "a step has one of pose, tool, grip and push"),
        ({"jump": 1.0}, "a step has one of pose, tool, grip and push"),
        ({"tool": [0.0, 0.0]}, "tool"),
        ({"tool": [0.0, 0.0, float("nan")]}, "finite"),
        ({"tool": [0.0, 0.0, 0.0], "force": 1.0}, "force"),
        ({"push": [0.0, 0.0, 0.0]}, "force"),
        ({"push": [0.0, 0.0, 0.0], "force": -1.0}, "greater than 0"),
        ({"grip": -0.1, "force": 1.0}, "greater than or equal to 0"),
    ],
)
def test_what_is_no_step_is_refused(step: dict[str, Any], text: str) -> None:
    with pytest.raises(ValidationError, match=text):
        parse([step])


def test_steps_survive_the_way_to_another_process() -> None:
    steps = [PoseStep(pose=[0.0, 1.0]), PushStep(push=(0.1, 0.2, 0.3), force=4.0)]
    assert parse(dump(steps)) == steps


def test_a_task_reset_is_rehearsed(panda: Robot) -> None:
    home = np.array(panda.profile.home)
    assert rehearse(panda, home, Verb.TASK_RESET, reset=parse(CARRY_BACK)).objection == ""
    beyond = [*home[:6].tolist(), panda.limits.upper[6] + 0.1]
    found = rehearse(panda, home, Verb.TASK_RESET, reset=parse([{"pose": beyond}]))
    assert found.objection == "it got no further, held back by POSITION"


@pytest.mark.realtime
def test_the_control_process_knows_the_steps(panda: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROBOTCTL_RUNTIME_DIR", str(tmp_path))
    with ProcessSession(panda, "sim", reset=parse([{"tool": [0.5, 0.0, 0.45]}])) as session:
        session.prepare()
        session.reset(Verb.TASK_RESET)
        assert session.latest()["true_tool"] == pytest.approx([0.5, 0.0, 0.45], abs=4e-3)
        session.finish()
