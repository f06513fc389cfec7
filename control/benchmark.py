"""What a tick costs, beside the library calls that no control loop of this kind could avoid, in one process run.

The bare calls are made on the same states, one batch after each tick, so that a noisy machine hits both alike:
forward kinematics of the measured pose, Jacobian of the reference, one ruckig update, one QP, one inverse dynamics;
on the twin the physics step; on a bus one python-can message, send and receive per motor, on its in-process bus.
"""

import time
from collections.abc import Callable
from typing import Any

import can
import daqp
import numpy as np
import pinocchio as pin
import ruckig

from robotctl.control.loop import Loop
from robotctl.control.session import LockstepSession
from robotctl.hal.robot import Robot
from robotctl.safety.target import JointVelocity

_WARM_UP = 500
_TICKS_PER_TARGET = 25


class BareCalls:
    """The library calls alone, each with its inputs ready."""

    def __init__(self, robot: Robot, loop: Loop, physics: Callable[[], None] | None, motors: int) -> None:
        n = robot.dof
        self._model = loop.kinematics.model
        self._data = self._model.createData()
        self._frame = self._model.getFrameId("robotctl_tool")
        self._generator = ruckig.Ruckig(n, robot.period_ns * 1e-9)
        self._request, self._answer = ruckig.InputParameter(n), ruckig.OutputParameter(n)
        self._request.control_interface = ruckig.ControlInterface.Velocity
        self._request.synchronization = ruckig.Synchronization.No
        self._request.max_acceleration = robot.limits.acceleration
        self._request.max_jerk = robot.limits.jerk
        self._hessian, self._upper = np.eye(n), np.full(n + 1, 0.5)
        self._row = np.ones((1, n))
        self._physics = physics
        self._motors = motors
        self._data8 = bytes(8)
        if motors:
            self._bus = can.Bus(interface="virtual", channel="robotctl-bench")
            self._peer = can.Bus(interface="virtual", channel="robotctl-bench")

    def kinematics(self, q: Any, v: Any) -> None:
        pin.forwardKinematics(self._model, self._data, q)
        pin.updateFramePlacement(self._model, self._data, self._frame)
        pin.computeFrameJacobian(self._model, self._data, q, self._frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)

    def limiter(self, q: Any, v: Any) -> None:
        self._request.current_velocity = v
        self._request.target_velocity = q
        self._generator.update(self._request, self._answer)

    def qp(self, q: Any, v: Any) -> None:
        daqp.solve(self._hessian, -v, self._row, self._upper, -self._upper)

    def dynamics(self, q: Any, v: Any) -> None:
        pin.rnea(self._model, self._data, q, v, v)

    def physics(self, q: Any, v: Any) -> None:
        if self._physics is not None:
            self._physics()

    def bus(self, q: Any, v: Any) -> None:
        for motor in range(self._motors):
            self._bus.send(can.Message(arbitration_id=motor, data=self._data8, is_extended_id=False))
            self._peer.recv(0)

    def close(self) -> None:
        if self._motors:
            self._bus.shutdown()
            self._peer.shutdown()


def bench_tick(robot: Robot, backend: str, ticks: int, physics: Callable[[], None] | None = None) -> dict[str, Any]:
    """Time `ticks` ticks of a moving arm and the bare calls between them.

    Args:
        physics: one servo period of the plant's physics alone, or None where there is none.

    Returns:
        Microseconds (p50, p99) of the tick and of each bare call, their sum, and the ratios of the medians.
    """
    motors = robot.dof + (1 if robot.profile.gripper else 0) if backend == "can" else 0
    with LockstepSession(robot, backend) as session:
        session.prepare()
        session.begin()
        bare = BareCalls(robot, session.loop, physics, motors)
        names = ["kinematics", "limiter", "qp", "dynamics"]
        names += ["physics"] if physics is not None else []
        names += ["bus"] if motors else []
        calls = [getattr(bare, name) for name in names]
        spent = np.zeros((ticks, len(calls) + 1))
        rng = np.random.default_rng(0)
        for tick in range(-_WARM_UP, ticks):
            if tick % _TICKS_PER_TARGET == 0:
                _steer(session, rng, tick)
            session.clock.sleep_until(session.clock.now_ns() + robot.period_ns)
            row = [_timed(session.loop.tick)]
            record = session.latest()
            q, v = record["position"], record["velocity"]
            row += [_timed(call, q, v) for call in calls]
            if tick >= 0:
                spent[tick] = row
        bare.close()
    return _report(robot, backend, names, spent / 1e3)


def _steer(session: LockstepSession, rng: np.random.Generator, tick: int) -> None:
    wanted = rng.uniform(-1.0, 1.0, session.robot.dof) * session.robot.limits.velocity
    deadline = session.clock.now_ns() + 100_000_000
    session.link.mailbox.put(JointVelocity(wanted, int(session.latest()["epoch"]), tick + _WARM_UP, deadline))


def _timed(call: Callable[..., None], *arguments: Any) -> int:
    begun = time.perf_counter_ns()
    call(*arguments)
    return time.perf_counter_ns() - begun


def _report(robot: Robot, backend: str, names: list[str], spent: Any) -> dict[str, Any]:
    p50, p99 = np.percentile(spent, (50, 99), axis=0)
    calls = {name: {"p50": round(p50[i], 2), "p99": round(p99[i], 2)} for i, name in enumerate(names, 1)}
    bare = float(sum(call["p50"] for call in calls.values()))
    physics = calls.get("physics", {"p50": 0.0})["p50"]
    return {
        "robot": robot.profile.name,
        "backend": backend,
        "ticks": len(spent),
        "tick_us": {"p50": round(p50[0], 1), "p99": round(p99[0], 1)},
        "bare_us": calls,
        "bare_sum_us": round(bare, 1),
        "ratio": round(p50[0] / bare, 2),
        "ratio_without_physics": round((p50[0] - physics) / (bare - physics), 2),
    }
