"""Rehearsals in the twin: what they find, and that a real arm does not move where they fail."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from robotctl.control.kinematics import Kinematics
from robotctl.control.operator import Verb
from robotctl.control.process_session import ProcessSession
from robotctl.control.rehearsal import Rehearsal, rehearse
from robotctl.control.session import LockstepSession, Stopped
from robotctl.hal.robot import Robot, load_robot
from robotctl.safety.machine import State

WALL = "keep_out=[{kind: box, name: wall, centre: [0.63, 0.22, 0.45], half: [0.3, 0.02, 0.6]}]"
"""A wall between home and where the first joint has turned to the left."""


def beside(robot: Robot, turn: float) -> np.ndarray:
    start = np.array(robot.profile.home)
    start[int(np.argmax(Kinematics(robot).reach > 0.0))] += turn  # the first that moves the tool
    return start


def test_it_tells_how_a_good_way_home_goes(robot: Robot) -> None:
    found = rehearse(robot, beside(robot, 0.3), Verb.HOME)
    assert found.objection == found.failure == ""
    assert sum(found.violations.values()) == 0
    assert 1.0 < found.duration_s < 10.0
    assert 0.01 < found.tool_speed < 1.05 * robot.profile.safety.reset_tool_speed


def test_it_takes_as_long_as_the_arm_itself(panda: Robot) -> None:
    start = beside(panda, 0.4)
    with LockstepSession(load_robot("panda", [f"twin.start={start.tolist()}"]), "sim") as session:
        session.request(Verb.ARM)
        session.advance(0.002)
        assert session.latest()["true_position"] == pytest.approx(start, abs=1e-3)
        began = session.clock.now_ns()
        session.reset()
        took = (session.clock.now_ns() - began) * 1e-9
    assert rehearse(panda, start, Verb.HOME).duration_s == pytest.approx(took, abs=0.1)


def test_a_way_that_is_barred_is_found_out() -> None:
    robot = load_robot("panda", [WALL])
    found = rehearse(robot, beside(robot, 0.9), Verb.HOME)
    assert found.objection.startswith("it got no further, held back by ")
    assert "PROXIMITY" in found.objection
    assert sum(found.violations.values()) == 0
    assert found.duration_s < 60.0


def test_a_trip_on_the_way_is_found_out() -> None:
    robot = load_robot("panda", ["safety.tracking_speed=0.001", "safety.tracking_speed_share=0.0", "twin.lag_s=0.05"])
    found = rehearse(robot, beside(robot, 0.9), Verb.HOME)
    assert "panda_joint1 moves at" in found.objection


def test_violations_are_an_objection() -> None:
    found = Rehearsal("", 1.0, {"position": 0, "sphere": 3}, 0.2)
    assert found.objection == "it violated sphere in 3 ticks"


def test_what_the_loop_refuses_is_found_out(panda: Robot) -> None:
    assert "seed -1 is negative" in rehearse(panda, beside(panda, 0.0), Verb.RANDOM_START, -1).objection


def test_a_hair_outside_the_limits_is_no_objection(panda: Robot) -> None:
    start = beside(panda, 0.0)
    start[4] = panda.limits.upper[4] + 1e-4
    assert rehearse(panda, start, Verb.HOME).objection == ""


def test_a_retreat_is_rehearsed_from_outside(panda: Robot) -> None:
    start = beside(panda, 0.0)
    start[4] = panda.limits.upper[4] + 0.05
    found = rehearse(panda, start, Verb.RETREAT)
    assert found.objection == ""
    assert found.tool_speed < 0.1


@pytest.fixture
def session(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[ProcessSession]:
    """An armed twin in a process of its own, with the first joint turned away from home."""
    turn, *settings = request.param
    monkeypatch.setenv("ROBOTCTL_RUNTIME_DIR", str(tmp_path))
    settings.append(f"twin.start={beside(load_robot('panda'), turn).tolist()}")
    with ProcessSession(load_robot("panda", settings), "sim", overrides=settings) as session:
        session.request(Verb.ARM)
        session.advance(0.01)
        yield session


@pytest.mark.realtime
@pytest.mark.parametrize("session", [(0.9, WALL)], indirect=True)
def test_nothing_moves_where_the_rehearsal_fails(session: ProcessSession) -> None:
    pages: list[str] = []
    session.on_page = pages.append
    before = session.latest()["true_position"]
    with pytest.raises(Stopped, match=r"HOME was rehearsed in the twin and is refused: it got no further.*PROXIMITY"):
        session.reset()
    session.advance(0.1)
    assert session.state is State.ARMED
    assert session.latest()["true_position"] == pytest.approx(before, abs=1e-3)
    states = [event["state"] for event in session.link.events.since(0)[0] if event["type"] == "state"]
    assert "RESET" not in states
    assert pages == session.pages
    assert "is refused" in pages[0]


@pytest.mark.realtime
@pytest.mark.parametrize("session", [(0.1,)], indirect=True)
def test_where_it_goes_well_the_arm_follows(session: ProcessSession) -> None:
    session.reset(Verb.SETTLE)
    assert session.rehearsals == []  # nothing moves, so nothing is rehearsed
    began = session.clock.now_ns()
    session.reset()
    took = (session.clock.now_ns() - began) * 1e-9
    assert session.latest()["true_position"] == pytest.approx(np.array(session.robot.profile.home), abs=5e-3)
    (found,) = session.rehearsals
    assert found.objection == ""
    assert found.duration_s < took
    assert session.trips == []
