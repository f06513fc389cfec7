"""Runs in lockstep: they reach, twin and CAN agree, and the report holds what it promises."""

import functools
import json
from pathlib import Path

import pytest

from robotctl.control.recording_session import SessionRecording
from robotctl.control.session import LockstepSession
from robotctl.control.task_reset import parse
from robotctl.hal.robot import load_robot, robot_names
from robotctl.learning.actor import InlineActor
from robotctl.learning.run import Outcome, report, run_episodes
from robotctl.learning.task import load_task
from robotctl.safety.machine import State

EPISODES = 2
SEED = 7
COMBINATIONS = [(name, "sim") for name in robot_names()] + [("panda", "can"), ("openarm", "can"), ("xarm7", "can")]


@functools.cache
def result_of(name, backend, policy="scripted", steps=150, episodes=EPISODES):
    """Return the outcome of a run, and its report."""
    task = load_task("reach").model_copy(update={"steps": steps})
    about = {"backend": backend, "robot": name, "task": task.name, "policy": policy, "seed": SEED}
    with LockstepSession(load_robot(name), backend) as session:
        actor = InlineActor(session, task, policy, SEED)
        outcome = Outcome()
        run_episodes(session, actor, task, episodes, SEED, outcome)
        made = report(session, outcome, about, SessionRecording(Path("nowhere.mcap")))
    return outcome, json.loads(json.dumps(made, allow_nan=False))


@pytest.mark.parametrize(("name", "backend"), COMBINATIONS)
def test_scripted_reaches_on_every_robot_and_backend(name, backend):
    outcome, made = result_of(name, backend)
    assert outcome.stopped == ""
    assert len(made["episodes"]) == EPISODES
    for episode in made["episodes"]:
        assert episode["success"] is True
        assert episode["final_distance_m"] < 0.01
        assert 5 <= episode["steps"] < 150
    safety = made["safety"]
    assert safety["state"] == "READY"
    assert safety["trips"] == []
    assert safety["violations"] == {"position": 0, "velocity": 0, "sphere": 0}
    assert safety["judged_on"] == "truth"
    assert made["timing"]["servo_hz"] == load_robot(name).profile.servo_hz
    assert made["timing"]["policy_hz"] == pytest.approx(20.0, abs=0.1)


@pytest.mark.parametrize("name", ["panda", "openarm"])
def test_twin_and_can_agree(name):
    twin, can = (result_of(name, backend)[1]["episodes"] for backend in ("sim", "can"))
    for one, other in zip(twin, can, strict=True):
        assert abs(one["final_distance_m"] - other["final_distance_m"]) <= 5e-3
        assert one["success"] == other["success"]
        assert abs(one["steps"] - other["steps"]) <= 3


@pytest.mark.parametrize(("name", "backend"), COMBINATIONS)
def test_the_report_has_all_its_keys(name, backend):
    _, made = result_of(name, backend)
    assert (made["backend"], made["robot"], made["task"], made["seed"]) == (backend, name, "reach", SEED)
    assert set(made["episodes"][0]) == {"success", "final_distance_m", "steps"}
    assert {"state", "trips", "violations", "clipped_ticks"} <= set(made["safety"])
    assert set(made["safety"]["violations"]) == {"position", "velocity", "sphere"}
    timing = made["timing"]
    assert {"servo_hz", "policy_hz", "ticks", "overruns", "tick_us", "lateness_us"} <= set(timing)
    for key in ("tick_us", "lateness_us"):
        assert set(timing[key]) == {"p50", "p99", "p999", "max"}
    assert timing["ticks"] > 1000
    assert (made["can"] is not None) is (backend == "can")
    if backend == "can":
        assert made["can"]["sent"] >= 8 * 500
        assert made["can"]["missed_replies"] == 0
    assert made["recording"] is None  # there was none


@pytest.mark.parametrize("backend", ["sim", "can"])
@pytest.mark.parametrize(
    ("policy", "protection", "category", "words"),
    [
        ("nan", "P9", 2, "not finite"),
        ("stall", "P10", 2, "stopped answering"),
        ("die", "P10", 2, "policy died"),
    ],
)
def test_a_treacherous_policy_ends_the_run_with_the_drives_off(backend, policy, protection, category, words):
    outcome, made = result_of("panda", backend, policy)
    assert protection in outcome.stopped
    assert words in outcome.stopped
    assert made["stopped"] == outcome.stopped
    trip = made["safety"]["trips"][0]
    assert set(trip) == {"protection", "cause", "stop_category", "reaction_ms"}
    assert (trip["protection"], trip["stop_category"]) == (protection, category)
    assert 0.0 <= trip["reaction_ms"] <= 4.0
    assert made["safety"]["state"] in ("READY", "FAULT")
    assert made["episodes"][0]["success"] is False
    assert len(made["episodes"]) == 1
    assert made["safety"]["violations"] == {"position": 0, "velocity": 0, "sphere": 0}


@pytest.mark.parametrize(("name", "backend"), COMBINATIONS)
@pytest.mark.parametrize("policy", ["random", "outward"])
def test_a_hostile_policy_is_clipped_but_harms_nothing(name, backend, policy):
    outcome, made = result_of(name, backend, policy, steps=60, episodes=1)
    assert outcome.stopped == ""
    assert made["safety"]["violations"] == {"position": 0, "velocity": 0, "sphere": 0}
    assert [episode["steps"] for episode in made["episodes"]] == [60]
    if policy == "outward":  # else nothing was tested
        assert made["safety"]["clipped_ticks"] > 500
        assert made["safety"]["worst_excess"]["sphere"] > -0.05
    assert made["safety"]["state"] == "READY"


def test_ticks_that_were_overwritten_unread_are_in_the_report():
    with LockstepSession(load_robot("panda"), "sim") as session:
        slots = session.link.ticks.slots
        for _ in range(slots + 100):
            session.clock.sleep_until(session.clock.now_ns() + session.robot.period_ns)
            session.loop.tick()
        timing = report(session, Outcome(), {}, SessionRecording(Path("none.mcap")))["timing"]
        assert timing["ticks"] == session.link.ticks.head
        assert timing["dropped"] == session.link.ticks.head - slots + 64


def test_an_arm_that_does_not_follow_ends_the_run_and_says_why():
    task = load_task("reach")
    with LockstepSession(load_robot("panda"), "sim") as session:
        actor = InlineActor(session, task, "scripted", 0)
        step = actor.step

        def jam() -> None:
            session._rig.arm._plant.jam(1, jammed=True)
            step()

        actor.step = jam
        # The scripted policy hardly minds a joint that is stuck; an outward one asks it to move.
        actor._policy = InlineActor(session, task, "outward", 0)._policy
        outcome = Outcome()
        run_episodes(session, actor, task, 1, 0, outcome)
        assert "P17" in outcome.stopped
        assert "panda_joint2" in outcome.stopped
        assert session.state is State.FAULT
        assert session.trips[0]["stop_category"] == 1


def test_the_scene_is_set_right_before_every_episode():
    step = {"tool": [0.5, 0.0, 0.45]}
    task = load_task("reach").model_copy(update={"steps": 5, "reset": parse([step])})
    with LockstepSession(load_robot("panda"), "sim", reset=task.reset) as session:
        outcome = Outcome()
        run_episodes(session, InlineActor(session, task, "scripted", 0), task, 2, 0, outcome)
        states = [event["state"] for event in session.link.events.since(0)[0] if event["type"] == "state"]
    assert outcome.stopped == ""
    between = "-".join(states).split("RUN")
    # It wakes up at home; scene, home; after the first episode home, scene, home; after the last one only parking.
    assert [part.count("RESET") for part in between] == [2, 3, 1]
