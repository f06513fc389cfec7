"""Resets of a session in lockstep: by way-points, to random starts, and what happens when they fail."""

import numpy as np
import pytest

from robotctl.control.operator import Verb
from robotctl.control.session import LockstepSession, Stopped
from robotctl.hal.errors import ConfigError
from robotctl.hal.robot import Robot, load_robot
from robotctl.safety.machine import State
from robotctl.safety.routines import Goto

HOME = [0.0, -0.4, 0.0, -2.2, 0.0, 1.9, 0.785]
VIA = [[0.3, *HOME[1:]], [0.3, -0.2, *HOME[2:]]]
WALL = "keep_out=[{kind: box, name: wall, centre: [0.63, 0.22, 0.45], half: [0.3, 0.02, 0.6]}]"
"""Between home and where the first joint has turned to the left."""
BESIDE = f"twin.start={[0.9, *HOME[1:]]}"


def armed(*settings: str) -> LockstepSession:
    session = LockstepSession(load_robot("panda", list(settings)), "sim")
    session.open()
    session.request(Verb.ARM)
    session.advance(0.01)
    return session


def positions(session: LockstepSession) -> np.ndarray:
    return session.link.ticks.since(0)[0]["true_position"]


def test_the_way_home_goes_by_the_way_points_in_order() -> None:
    session = armed(f"home_via={VIA}", BESIDE)
    session.reset()
    closest = [int(np.abs(positions(session) - pose).max(axis=1).argmin()) for pose in (*VIA, HOME)]
    assert closest == sorted(closest)
    assert len(set(closest)) == 3
    for pose, tick in zip((*VIA, HOME), closest, strict=True):
        assert positions(session)[tick] == pytest.approx(pose, abs=5e-3)


def test_parking_takes_no_way_points() -> None:
    session = armed(f"home_via={VIA}", BESIDE)
    session.reset(Verb.PARK)
    assert np.abs(positions(session) - VIA[1]).max(axis=1).min() > 0.1


def test_a_way_point_where_the_tool_may_not_be_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"home_via\.1: the tool would be \d+ mm past the bound of 'sphere'"):
        armed(f"home_via={[HOME, [0.0, 1.2, 0.0, -0.5, 0.0, 1.9, 0.785]]}")


def test_the_same_seed_leads_to_the_same_start() -> None:
    ends = []
    for seed in (3, 3, 4):
        session = armed()
        session.reset(Verb.RANDOM_START, seed)
        ends.append(session.latest()["command_position"])
        assert np.abs(ends[-1] - HOME).max() > 0.05
    assert np.array_equal(ends[0], ends[1])
    assert np.abs(ends[0] - ends[2]).max() > 0.01


def test_a_bad_seed_is_refused_and_nothing_moves() -> None:
    session = armed()
    with pytest.raises(Stopped, match="seed -5 is negative"):
        session.reset(Verb.RANDOM_START, -5)
    assert session.state is State.ARMED


def test_a_reset_that_never_arrives_is_tried_three_times_then_holds_and_calls_for_the_operator(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Goto, "timeout_s", 4.0)
    session = armed(WALL, BESIDE)
    called: list[str] = []
    session.on_page = called.append
    began = session.clock.now_ns()
    with pytest.raises(Stopped, match="'home' did not arrive in 3 tries of 4 s; free the arm, then acknowledge"):
        session.reset()
    assert (session.clock.now_ns() - began) * 1e-9 > 3 * 4.0 + 4.0
    assert session.state is State.HOLD
    assert [trip["protection"] for trip in session.trips] == ["P29"]
    assert called == session.pages
    assert len(called) == 1
    assert called[0].startswith("P29: reset routine 'home' did not arrive")
    # Nothing goes on, and nothing is acknowledged, without a person.
    session.advance(10.0)
    assert session.state is State.HOLD
    for verb in (Verb.HOME, Verb.START):
        with pytest.raises(Stopped, match="refused"):
            session.request(verb)
    assert sum(session.judge.violations.values()) == 0


def test_a_second_try_may_succeed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Goto, "timeout_s", 1.0)
    session = armed(f"twin.start={[0.3, *HOME[1:]]}")
    session.reset()
    assert session.pages == []
    assert session.trips == []
    speeds = np.abs(session.link.ticks.since(0)[0]["true_velocity"]).max(axis=1)
    moving = speeds > 0.02
    assert int((np.diff(moving.astype(int)) > 0).sum()) == 2  # with a rest in between
    assert session.latest()["true_position"] == pytest.approx(HOME, abs=5e-3)


def test_a_trip_on_the_way_is_not_tried_again_and_calls_for_the_operator(panda: Robot) -> None:
    session = armed(f"twin.start={[0.5, *HOME[1:]]}")
    session.request(Verb.HOME)
    session.advance(0.5)
    session._rig.arm._plant.jam(0, jammed=True)
    with pytest.raises(Stopped, match="panda_joint1"):
        session.wait_for(State.ARMED, timeout_s=60.0)
    assert session.state is State.HOLD
    assert [trip["protection"] for trip in session.trips] == ["P19"]
    assert [page.split(":")[0] for page in session.pages] == ["P19"]


@pytest.mark.parametrize("how", ["estop", "policy"])
def test_nobody_is_called_for_what_a_person_did_or_what_happened_to_a_policy(how: str) -> None:
    session = armed(f"twin.start={[0.5, *HOME[1:]]}")
    if how == "estop":
        session.request(Verb.HOME)
        session.emergency_stop()
    else:
        session.begin()
    session.advance(1.0)
    assert len(session.trips) == 1
    assert session.pages == []
