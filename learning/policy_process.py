"""The policy process: one policy at its own rate, with nothing but its mailbox to write to.

It sends a target in every period, `Hold` while no episode runs, so that its silence always means something. Between
episodes it reads one JSON line from stdin per request: `{"goal": [x, y, z]}` begins an episode, `{"rest": true}`
ends it. It says `{"ready": true}` once it can act, or what the `error` is, and answers every goal with why it is
`refused`, empty if it is not.
"""

import json
import os
import select
import signal
import sys
import time
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from robotctl.control.kinematics import Kinematics
from robotctl.control.process_tools import name_process, signal_on_parent_death
from robotctl.control.shared import Link
from robotctl.hal.errors import ConfigError
from robotctl.hal.robot import load_robot
from robotctl.hal.types import Vector
from robotctl.learning.policies import Die, Stall, make_policy
from robotctl.learning.policy import Observation, Policy
from robotctl.safety.machine import State
from robotctl.safety.target import Hold, JointVelocity, Target

VALID_PERIODS = 2
"""A target expires after this many policy periods."""


@dataclass(frozen=True, slots=True)
class PolicyConfig:
    """What a policy process is told at its start."""

    robot: str
    overrides: list[str]
    policy: str
    seed: int
    policy_hz: int
    mailbox_fd: int
    board_fd: int
    slots: int
    operator: int

    def to_json(self) -> str:
        return json.dumps(asdict(self))


def target_of(policy: Policy, record: np.void, goal: Vector, step: int, seq: int, deadline_ns: int) -> JointVelocity:
    """Ask a policy for its velocities at a tick record, and wrap them in a target."""
    observation = Observation(record["position"], record["velocity"], record["tool"], goal, step)
    return JointVelocity(policy.act(observation), int(record["epoch"]), seq, deadline_ns)


def main(text: str) -> int:
    """Run until stdin closes."""
    config = PolicyConfig(**json.loads(text))
    name_process("robotctl-policy")
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal_on_parent_death(signal.SIGKILL, config.operator)
    robot = load_robot(config.robot, config.overrides)
    link = Link.attach(config.mailbox_fd, config.board_fd, robot.dof, config.slots, read_only=True)
    try:
        policy = make_policy(config.policy, robot, Kinematics(robot), config.seed)
    except ConfigError as error:
        _say({"error": error.what})
        return 2
    period_ns = round(1e9 / config.policy_hz)
    goal: Vector | None = None
    step = seq = 0
    _say({"ready": True})
    deadline = time.monotonic_ns()
    while True:
        for request in _requests(deadline):
            if request is None:
                return 0
            goal, step = None, 0
            if "goal" in request:
                refused = policy.begin()
                goal = None if refused else np.array(request["goal"])
                _say({"refused": refused})
        record = link.ticks.latest()
        if record is not None:
            expires = time.monotonic_ns() + VALID_PERIODS * period_ns
            target: Target = Hold(int(record["epoch"]), seq, expires)
            if goal is not None and record["state"] == State.RUN:
                try:
                    target = target_of(policy, record, goal, step, seq, expires)
                except Stall:
                    signal.pause()
                except Die:
                    os.kill(os.getpid(), signal.SIGKILL)
                step += 1
            link.mailbox.put(target)
            seq += 1
        deadline = max(deadline + period_ns, time.monotonic_ns())


def _say(words: dict[str, object]) -> None:
    print(json.dumps(words), flush=True)  # noqa: T201 - the protocol of this process


def _requests(deadline_ns: int) -> list[dict[str, Any] | None]:
    """Return the requests that came in before a deadline; None stands for the end of stdin."""
    requests: list[dict[str, Any] | None] = []
    while (remaining := deadline_ns - time.monotonic_ns()) > 0 or not requests:
        readable, _, _ = select.select([sys.stdin], [], [], max(0.0, remaining * 1e-9))
        if not readable:
            break
        line = sys.stdin.readline()
        requests.append(json.loads(line) if line else None)
        if not line:
            break
    return requests


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
