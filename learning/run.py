"""A run: episodes of a task on a session, and the report of what happened."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from robotctl.control.kinematics import Kinematics
from robotctl.control.operator import Verb
from robotctl.control.recording_session import SessionRecording
from robotctl.control.session import Session, Stopped
from robotctl.hal.types import Vector
from robotctl.learning.actor import Actor
from robotctl.learning.task import ReachTask
from robotctl.safety.deadman import Grip
from robotctl.safety.machine import State
from robotctl.safety.trip import Protection


@dataclass(frozen=True, slots=True)
class Episode:
    """How one episode ended."""

    success: bool
    final_distance_m: float
    steps: int
    refused: str = ""
    """Why it did not take place: what the policy was to be exchanged for was refused (P26)."""


@dataclass(slots=True)
class Outcome:
    """What a run came to."""

    episodes: list[Episode] = field(default_factory=list)
    stopped: str = ""
    """Why safety ended the run; empty if it did not."""
    policy_hz: float = 0.0


def run_episodes(
    session: Session,
    actor: Actor,
    task: ReachTask,
    episodes: int,
    seed: int,
    outcome: Outcome,
    on_episode: Callable[[int, Episode], None] = lambda *_: None,
) -> None:
    """Run episodes until they are done or safety ends the run; on return the arm is at rest.

    After a stop that safety latched, nothing moves again: the drives go off where the arm stands.

    Args:
        outcome: filled as the run goes on, so that an interruption leaves what was reached so far.

    Raises:
        HardwareError: if the control loop died.
    """
    kinematics = Kinematics(session.robot)
    rate = _RateMeter()
    try:
        session.prepare()
        for index in range(episodes):
            if task.reset:
                session.reset(Verb.TASK_RESET)
                session.reset()
            goal = task.goal(session.robot, kinematics, seed, index)
            episode = _run_episode(session, actor, task, goal, rate)
            outcome.episodes.append(episode)
            on_episode(index, episode)
            if episode.refused:
                continue
            if session.state is not State.RUN:
                raise Stopped(_reason(session, actor))
            session.end()
            if index + 1 < episodes:
                session.reset()
        session.finish()
    except Stopped as error:
        session.poll()
        outcome.stopped = _reason(session, actor) or error.what
        session.bring_to_rest(Verb.DISARM)
    finally:
        outcome.policy_hz = rate.hz


def _run_episode(session: Session, actor: Actor, task: ReachTask, goal: Vector, rate: "_RateMeter") -> Episode:
    period = 1.0 / task.policy_hz
    refused = actor.begin(goal)
    if refused:
        return Episode(False, _distance(session, goal), 0, refused)
    session.begin()
    settled = step = 0
    distance = math.inf
    for step in range(1, task.steps + 1):
        actor.step()
        session.advance(period)
        if step == 2:  # the policy has seen the start by now
            rate.begin(session)
        distance = _distance(session, goal)
        settled = settled + 1 if distance < task.settled else 0
        # HOLD and STOPPING may still clear, if a heartbeat comes back in time.
        if settled >= task.settled_steps or not _may_continue(session, session.state):
            break
    rate.end(session)
    actor.rest()
    return Episode(distance <= task.success and session.state is State.RUN, distance, step)


def _distance(session: Session, goal: Vector) -> float:
    record = session.latest()
    tool = record["true_tool"] if record["has_truth"] else record["tool"]
    return float(np.linalg.norm(tool - goal))


def _may_continue(session: Session, state: State) -> bool:
    if state is State.RUN:
        return True
    session.poll()  # the trip that led to this state may have come after the last look
    if state not in (State.STOPPING, State.HOLD) or not session.trips:
        return False
    trip = session.trips[-1]
    if trip["protection"] == Protection.DEADMAN.label:  # it goes on as soon as the switch is held again
        return session.link.desk.grip != Grip.UNPLUGGED
    grace_ns = session.robot.profile.safety.heartbeat_grace_s * 1e9
    return bool(
        trip["protection"] == Protection.HEARTBEAT.label and session.clock.now_ns() - trip["stamp_ns"] < grace_ns
    )


def _reason(session: Session, actor: Actor) -> str:
    causes = [f"{trip['protection']}: {trip['text']}" for trip in session.trips[-1:]]
    obituary = actor.obituary()
    return "; ".join(causes + ([obituary] if obituary else []))


class _RateMeter:
    """Targets let in per second of running."""

    def __init__(self) -> None:
        self._targets = 0
        self._ns = 0
        self._begun: tuple[int, int] | None = None

    def begin(self, session: Session) -> None:
        record = session.latest()
        self._begun = (int(record["seq"]), int(record["stamp_ns"]))

    def end(self, session: Session) -> None:
        if self._begun is None:
            return
        record = session.latest()
        self._targets += int(record["seq"]) - self._begun[0]
        self._ns += int(record["stamp_ns"]) - self._begun[1]
        self._begun = None

    @property
    def hz(self) -> float:
        return round(self._targets / self._ns * 1e9, 2) if self._ns else 0.0


def report(session: Session, outcome: Outcome, about: dict[str, Any], recording: SessionRecording) -> dict[str, Any]:
    """Return the report of a run, as `--json` writes it.

    `about` names backend, robot, task and seed. `violations` are counted on the plant's true state where there is
    one (`judged_on` says which).
    """
    session.poll()
    return {
        **about,
        "episodes": [
            {"success": e.success, "final_distance_m": round(e.final_distance_m, 6), "steps": e.steps}
            for e in outcome.episodes
        ],
        "safety": {
            "state": session.state.name,
            "trips": [
                {
                    "protection": trip["protection"],
                    "cause": trip["text"],
                    "stop_category": trip["stop_category"],
                    "reaction_ms": trip["reaction_ms"],
                }
                for trip in session.trips
            ],
            "pages": session.pages,
            "refused": [
                {"protection": Protection.WEIGHTS.label, "cause": e.refused} for e in outcome.episodes if e.refused
            ],
            "violations": session.judge.violations,
            "worst_excess": {
                key: round(value, 6) for key, value in session.judge.worst.items() if math.isfinite(value)
            },
            "judged_on": "truth" if session.judge.on_truth else "measurement",
            "clipped_ticks": session.statistics.clipped,
            "stopping_time_s": round(session.robot.stopping_time_s, 3),
        },
        "timing": {**session.statistics.report(), "policy_hz": outcome.policy_hz},
        "can": session.bus_statistics(),
        **recording.report(),
        "stopped": outcome.stopped,
    }
