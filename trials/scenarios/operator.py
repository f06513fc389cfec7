"""P21, P22, P23, P29, P30: the person, the switch in the hand, and what runs at the person's word."""

from collections.abc import Callable

import numpy as np

from robotctl.control.operator import Verb
from robotctl.control.resetting import PAUSES_S
from robotctl.hal.robot import Robot
from robotctl.safety.deadman import Grip
from robotctl.safety.machine import State
from robotctl.safety.trip import Category, Protection
from robotctl.sim.trouble import Misread
from robotctl.trials.bench import Bench
from robotctl.trials.faults import Planted, between, stuck
from robotctl.trials.refusals import refusal_scenario
from robotctl.trials.resuming import resuming_scenario
from robotctl.trials.scenario import Scenario
from robotctl.trials.stops import Expected, Start, running, stop_scenario

_SOURCES: dict[str, Callable[[Bench], None]] = {
    "key": lambda bench: bench.link.desk.stop(),
    "signal": lambda bench: bench.loop.estop("a signal"),
    "verb": lambda bench: bench.loop.request(Verb.ESTOP),
}


def _from(source: str) -> Callable[[Bench], Planted]:
    def plant(bench: Bench) -> Planted:
        _SOURCES[source](bench)
        return Planted(lambda: None, lambda: "emergency stop" in bench.trips[0]["text"])

    return plant


def _beside_nan(bench: Bench) -> Planted:
    """The emergency stop in the very tick that takes a malformed target, too."""
    bench.policy = None
    from robotctl.safety.target import JointVelocity

    bench.link.mailbox.put(JointVelocity(np.full(bench.robot.dof, np.nan), *bench.stamp()))
    return _from("key")(bench)


def _armed(bench: Bench) -> None:
    bench.demand(Verb.ARM)
    bench.run(0.2)


def _resetting(bench: Bench) -> None:
    running(bench)
    bench.demand(Verb.STOP)
    bench.until(lambda: bench.state is State.HOLD, 2.0)
    bench.policy = None
    bench.demand(Verb.ACK)
    bench.demand(Verb.HOME)
    bench.run(0.3)


def _braking(bench: Bench) -> None:
    running(bench)
    bench.demand(Verb.STOP)
    bench.run(0.02)


def _held(bench: Bench) -> None:
    running(bench)
    bench.demand(Verb.STOP)
    bench.until(lambda: bench.state is State.HOLD, 2.0)


_STATES: dict[str, Start] = {
    "armed": _armed,
    "running": running,
    "resetting": _resetting,
    "braking": _braking,
    "holding": _held,
}


def _with_switch(bench: Bench) -> None:
    bench.link.desk.hold(Grip.HELD)
    running(bench)


def _switch(grip: Grip) -> Callable[[Bench], Planted]:
    def plant(bench: Bench) -> Planted:
        bench.link.desk.hold(grip)
        return Planted(lambda: bench.link.desk.hold(Grip.HELD), lambda: bench.link.desk.grip == grip)

    return plant


def _switch_stuck(bench: Bench) -> Planted:
    """Held on and on, without ever being let go."""

    def undo() -> None:
        bench.link.desk.hold(Grip.RELEASED)
        bench.tick()
        bench.link.desk.hold(Grip.HELD)

    return Planted(undo, lambda: bench.link.desk.grip == Grip.HELD)


def _started_without_switch(robot: Robot, backend: str, seed: int) -> None:
    with Bench(robot, backend, seed) as bench:
        bench.link.desk.hold(Grip.RELEASED)
        running(bench)


def _armed_under_way(robot: Robot, backend: str, seed: int) -> None:
    with Bench(robot, backend, seed) as bench:
        axis = int(bench.random.integers(robot.dof))
        speed = np.zeros(robot.dof)
        speed[axis] = 3.0 * robot.profile.safety.standstill
        between(bench, Misread(velocity=speed))
        bench.demand(Verb.ARM)


def _attended(bench: Bench) -> None:
    bench.attended = True
    running(bench)


def _unattended(bench: Bench) -> Planted:
    """The operator's process, alive until now, shows no more life."""
    beats, bench.attended = bench.link.desk.beats, False

    def undo() -> None:
        bench.attended = True

    return Planted(undo, lambda: bench.link.desk.beats == beats)


def _shaken(bench: Bench) -> Planted:
    """An arm that is measured as moving, for ever, is to settle."""
    planted = between(bench, Misread(velocity=2.0 * bench.robot.profile.safety.standstill))
    bench.demand(Verb.SETTLE)
    return planted


def scenarios(robot: Robot, _backend: str) -> list[Scenario]:
    estop = Expected(protection=Protection.ESTOP, category=Category.BRAKE_OFF)
    squeezed = Expected(protection=Protection.DEADMAN, category=Category.BRAKE_OFF)
    stuck_s = robot.profile.safety.deadman_stuck_s
    return [
        refusal_scenario(21, "armed under way", "an arm that moves is to be armed", _armed_under_way, ["P21"], 3),
        refusal_scenario(22, "not held", "a start with the switch released", _started_without_switch, ["deadman"]),
        resuming_scenario(
            22, "released", "the switch is let go, and held again", _switch(Grip.RELEASED), 1.0, ("P22",), _with_switch
        ),
        resuming_scenario(
            22,
            "unplugged",
            "the switch is unplugged, and comes back",
            _switch(Grip.UNPLUGGED),
            1.0,
            ("P22",),
            _with_switch,
        ),
        stop_scenario(
            22, "squeezed", "the switch is squeezed in panic", _switch(Grip.SQUEEZED), squeezed, _with_switch
        ),
        resuming_scenario(
            22,
            "stuck",
            f"the switch is held for {stuck_s:.0f} s on end",
            _switch_stuck,
            stuck_s,
            ("P22",),
            _with_switch,
            1,
        ),
        *(
            stop_scenario(23, f"{source}, running", f"emergency stop by {source}", _from(source), estop)
            for source in _SOURCES
        ),
        *(
            stop_scenario(23, f"key, {state}", f"emergency stop while {state}", _from("key"), estop, start)
            for state, start in _STATES.items()
            if state != "running"
        ),
        stop_scenario(23, "beside NaN", "emergency stop together with a malformed target", _beside_nan, estop),
        stop_scenario(
            29,
            "never at rest",
            "an arm that is to settle is measured as moving",
            _shaken,
            Expected(
                protection=Protection.RESET,
                category=Category.BRAKE_HOLD,
                within_s=(len(PAUSES_S) + 1) * (2.1 + robot.stopping_time_s)
                + sum(PAUSES_S)
                + len(PAUSES_S) * robot.stopping_time_s,
            ),
            _armed,
        ),
        stop_scenario(
            29,
            "blocked",
            "a joint seizes up on the way home",
            stuck,
            Expected(
                protection=Protection.TRACKING,
                category=Category.BRAKE_OFF,
                within_s=1.0,
                rest_s=1.5,
                or_else=((Protection.CONTACT, Category.BRAKE_HOLD),),
                excused=frozenset({"velocity", "position", "sphere", "drift"}),
            ),
            _resetting,
        ),
        stop_scenario(
            30,
            "operator silent",
            "the operator's process is suspended",
            _unattended,
            Expected(protection=Protection.OPERATOR, category=Category.BRAKE_HOLD, within_s=1.0),
            _attended,
        ),
    ]
