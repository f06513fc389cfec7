"""P3, P5, P12, P17, P24: faults that show in what is measured."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from robotctl.hal.robot import Robot
from robotctl.safety.trip import Category, Protection
from robotctl.trials.bench import Bench
from robotctl.trials.clearing import Clears
from robotctl.trials.faults import (
    Planted,
    driven,
    everywhere,
    failed,
    fastest,
    frozen,
    hot,
    misread,
    mute,
    on_canopen,
    pulled,
    runaway,
    stuck,
    teleported,
    unpowered,
    weak,
)
from robotctl.trials.policies import velocities
from robotctl.trials.poses import at_limit, at_sphere
from robotctl.trials.resuming import resuming_scenario
from robotctl.trials.scenario import Scenario
from robotctl.trials.stops import Expected, still, stop_scenario, untouchable

_BEYOND = 0.005
"""rad or m past where a breach begins."""
_DRIVEN_S = 0.02
_PULL_S = 0.2
_WARMING_S = 0.11
"""In which an emulated drive looks at its temperature."""
_SLOW = 0.25
"""Share of a velocity cap."""
_SPRING_S = 3.0
"""Moved by hand, the arm springs back to where its drives hold it, and swings."""
_CRASH_REST_S = 1.5
"""A joint that seizes up under way is a collision: the rest of the arm swings out on the drives' springs."""
_CRASH = frozenset({"velocity", "position", "sphere"})


def _at_limit(bench: Bench) -> None:
    bench.place(at_limit(bench.robot, np.random.default_rng(bench.seed), _BEYOND)[0])
    still(bench)


def _past_limit(bench: Bench) -> Planted:
    breach = bench.robot.profile.safety.position_breach
    pose, _, _ = at_limit(bench.robot, np.random.default_rng(bench.seed), -breach - _BEYOND)
    return teleported(bench, pose)


def _slipped(bench: Bench) -> Planted:
    breach = bench.robot.profile.safety.position_breach
    _, joint, outward = at_limit(bench.robot, np.random.default_rng(bench.seed), _BEYOND)
    return misread(bench, joint, outward * (breach + 3.0 * _BEYOND))


def _sphere_poses(bench: Bench) -> tuple[np.ndarray, np.ndarray]:
    breach = bench.robot.profile.safety.sphere_breach
    return at_sphere(bench.robot, np.random.default_rng(bench.seed), (-_BEYOND, breach + 0.2 * _BEYOND))


def _at_sphere(bench: Bench) -> None:
    bench.place(_sphere_poses(bench)[0])
    still(bench)


def _outside_sphere(bench: Bench) -> Planted:
    return pulled(bench, _sphere_poses(bench)[1], _PULL_S)


def _kicked(times: float) -> Callable[[Bench], Planted]:
    """Return the fault of something that drives the most sluggish joint at a multiple of its cap."""

    def plant(bench: Bench) -> Planted:
        gains = [joint.gains.kd for joint in bench.robot.profile.joints]
        axis = int(np.argmax([bench.plant.inertia(axis) / kd for axis, kd in enumerate(gains)]))
        return driven(bench, axis, times * float(bench.robot.limits.velocity[axis]))

    return plant


def _slowly(bench: Bench) -> None:
    """Move the first joint alone, so slowly that no torque tells what has become of it before its way does."""
    move = np.zeros(bench.robot.dof)
    move[0] = bench.random.choice([-_SLOW, _SLOW])
    bench.start(velocities(lambda _time, _position: move, 1.0))
    bench.run(bench.random.uniform(0.3, 0.6))


def _unseen(bench: Bench) -> Planted:
    return frozen(bench, fastest(bench))


def _some(bench: Bench) -> int:
    return int(bench.random.integers(bench.robot.dof))


def _wrong_way(bench: Bench) -> Planted:
    return weak(bench, fastest(bench), -1.0)


def _limp(bench: Bench) -> Planted:
    """The joint that has most to carry for its stiffness."""
    stiffness = np.array([joint.gains.kp for joint in bench.robot.profile.joints])
    return weak(bench, int((np.abs(bench.plant.truth().effort) / stiffness).argmax()), 0.0)


def _runaway(bench: Bench) -> Planted:
    axis = fastest(bench)
    return runaway(bench, axis, 0.3 * float(bench.robot.limits.torque[axis]))


def _failed(bench: Bench) -> Planted:
    return failed(bench, _some(bench))


def _one_mute(bench: Bench) -> Planted:
    return mute(bench, [_some(bench)])


def _all_mute(bench: Bench) -> Planted:
    return mute(bench, everywhere(bench))


def _taking_turns(bench: Bench) -> Planted:
    """One joint at a time is heard of, each for as long as is still young."""
    turn = bench.robot.profile.safety.feedback_fault_s / 2.0
    showed = False
    for axis in everywhere(bench):
        planted = mute(bench, set(everywhere(bench)) - {axis})
        bench.run(turn)
        showed |= planted.showed()
        planted.undo()
        if bench.trips:
            break
    last = mute(bench, everywhere(bench))
    return Planted(last.undo, lambda: showed)


def _too_hot(robot: Robot, backend: str, failure: Expected) -> Scenario:
    """Return the scenario of a hot drive: told by its temperature, or, if it has no such object, by its fault."""
    silent = backend == "can" and on_canopen(robot)
    celsius = 105.0 if silent else 95.0
    expected = replace(failure, within_s=_WARMING_S) if silent else failure
    return stop_scenario(
        24, "too hot", f"a drive is at {celsius:.0f} degrees", lambda bench: hot(bench, _some(bench), celsius), expected
    )


def scenarios(robot: Robot, backend: str) -> list[Scenario]:
    safety = robot.profile.safety
    position = Expected(
        protection=Protection.POSITION,
        category=Category.BRAKE_OFF,
        clears=Clears.RETREAT,
        excused=frozenset({"position", "velocity"}),
    )
    # An angle that jumps is not believed at once.
    slipped = replace(position, within_s=2.0 * robot.period_ns * 1e-9)
    outside = Expected(
        protection=Protection.SPHERE,
        category=Category.BRAKE_HOLD,
        clears=Clears.RETREAT,
        within_s=_PULL_S,
        rest_s=_SPRING_S,
        excused=frozenset({"sphere", "velocity"}),
    )
    dead = Expected(
        protection=Protection.FEEDBACK,
        category=Category.BRAKE_OFF,
        within_s=safety.feedback_fault_s,
        rest_s=_CRASH_REST_S,
        excused=_CRASH,
    ).losing_torque(robot)
    silent = Expected(protection=Protection.FEEDBACK, category=Category.BRAKE_OFF, within_s=safety.feedback_fault_s)
    silent = silent.losing_torque(robot)
    led_away = Expected(
        protection=Protection.TRACKING,
        category=Category.BRAKE_OFF,
        within_s=0.4,
        rest_s=_CRASH_REST_S,
        excused=_CRASH,
    )
    crash = replace(
        led_away,
        or_else=((Protection.CONTACT, Category.BRAKE_HOLD), (Protection.OVERSPEED, Category.BRAKE_OFF)),
    )
    not_seen = replace(
        led_away, within_s=safety.tracking_time_s + 0.1, or_else=((Protection.CONTACT, Category.BRAKE_HOLD),)
    ).losing_torque(robot)
    slow = replace(led_away, rest_s=None, excused=frozenset(), within_s=1.5)
    astray = replace(
        led_away,
        or_else=(
            (Protection.CONTACT, Category.BRAKE_HOLD),
            (Protection.OVERSPEED, Category.BRAKE_OFF),
            (Protection.OVERSPEED, Category.CUT),
        ),
    ).losing_torque(robot)
    overspeed = replace(
        led_away,
        protection=Protection.OVERSPEED,
        within_s=_DRIVEN_S,
    )
    failure = Expected(
        protection=Protection.DRIVE,
        category=Category.BRAKE_OFF,
        clears=Clears.POWER,
        rest_s=_CRASH_REST_S,
        excused=_CRASH,
    )
    return [
        stop_scenario(3, "past a limit", "a joint is moved past its soft limit", _past_limit, position, _at_limit),
        stop_scenario(3, "slipped encoder", "a joint is measured past its limit", _slipped, slipped, _at_limit),
        untouchable(
            stop_scenario(
                5, "outside", "the arm is pulled until its tool is outside", _outside_sphere, outside, _at_sphere
            )
        ),
        stop_scenario(12, "one mute", "a drive obeys, but is not heard of", _one_mute, silent),
        stop_scenario(12, "all mute", "no drive is heard of", _all_mute, silent),
        stop_scenario(12, "taking turns", "one drive at a time is heard of", _taking_turns, silent),
        stop_scenario(12, "power lost", "a drive loses its supply", lambda b: unpowered(b, [_some(b)]), dead),
        resuming_scenario(12, "short gap", "no drive is heard of for 30 ms", _all_mute, 0.03),
        stop_scenario(17, "stuck joint", "the fastest joint seizes up", stuck, crash),
        untouchable(stop_scenario(17, "stuck slowly", "the same, slowly", stuck, slow, _slowly)),
        stop_scenario(17, "stuck encoder", "a joint is measured at rest, but moves on", _unseen, not_seen),
        stop_scenario(17, "wrong direction", "a drive pushes the wrong way", _wrong_way, astray),
        stop_scenario(17, "limp drive", "a drive that is on gives no torque", _limp, astray),
        stop_scenario(17, "runaway", "a drive turns with 30 % of its torque by itself", _runaway, astray),
        untouchable(
            stop_scenario(18, "overspeed", "a joint is driven at 1.45 times its cap", _kicked(1.45), overspeed)
        ),
        stop_scenario(
            18,
            "far overspeed",
            "a joint is driven at 2.5 times its cap",
            _kicked(2.5),
            replace(overspeed, category=Category.CUT),
        ),
        stop_scenario(
            24, "drive fault", "a drive reports over-current and goes off", _failed, failure.losing_torque(robot)
        ),
        _too_hot(robot, backend, failure),
    ]
