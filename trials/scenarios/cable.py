"""P12, P14, P15: what a cable, an adapter, and others on the bus can do to an arm that is on CAN."""

import errno
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import can

from robotctl.hal.can.error_frames import ERROR_BUS_OFF, ERROR_CONTROLLER, ERROR_RESTARTED, PASSIVE_DATA, RECOVERED_DATA
from robotctl.hal.can.transport import WAITING_LIMIT_NS
from robotctl.hal.errors import BusError, HardwareError
from robotctl.hal.robot import Robot
from robotctl.hal.types import Sample
from robotctl.safety.trip import Category, Protection
from robotctl.sim.motors import strangers
from robotctl.sim.motors import trouble as wire
from robotctl.sim.trouble import Trouble
from robotctl.trials.bench import Bench
from robotctl.trials.faults import Planted, between, everywhere, on_canopen, on_wire, refuse, report
from robotctl.trials.orphans import orphan_scenario, without_bus
from robotctl.trials.scenario import Scenario, Trial
from robotctl.trials.shaping import tolerated_scenario
from robotctl.trials.stops import Expected, running, stop_scenario

_UNDELIVERED_TICKS = 5
_COASTING_REST_S = 0.4
_SHORT_NS = 40_000_000
"""Shorter than the drives' watchdogs."""
_CUT_NS = 120_000_000
"""Longer than those, and shorter than it takes to give a bus up."""
_GIVEN_UP_S = 0.5
_WATCH_MS = 300
_LATE_S = 0.08
_APART = 0.5
"""rad"""


def _counted(bench: Bench, error: str) -> int:
    """Return how many error frames of a kind came, on the bus with the fewest."""
    return min(int(bus["errors"].get(error, 0)) for bus in bench.statistics())


def _held_back(bench: Bench) -> bool:
    """Return whether every bus has kept so many cycles back that it had to be noticed."""
    return all(bus["send_failures"] >= _UNDELIVERED_TICKS for bus in bench.statistics())


def _for(bench: Bench, nanoseconds: int, end: Callable[[], None], showed: Callable[[], bool]) -> Planted:
    """End what has just begun after a while, whatever the loop does meanwhile."""
    ends = bench.now_ns + nanoseconds

    class Ending(Trouble):
        def on_read(self, sample: Sample) -> Sample:
            if bench.now_ns >= ends and not self.acted:
                self.acted += 1
                end()
            return sample

    planted = between(bench, Ending())
    return Planted(planted.undo, lambda: planted.showed() and showed())


# -- what the controller tells -----------------------------------------------------------------------------------------


def _passive(bench: Bench) -> Planted:
    report(bench, ERROR_CONTROLLER, PASSIVE_DATA)
    return Planted(
        lambda: report(bench, ERROR_CONTROLLER, RECOVERED_DATA),
        lambda: all(bus["state"] == "passive" for bus in bench.statistics()),
    )


def _restarting(bench: Bench) -> Planted:
    """The controller leaves the bus, and the kernel restarts it."""
    report(bench, ERROR_BUS_OFF)
    return _for(bench, _SHORT_NS, lambda: report(bench, ERROR_RESTARTED), lambda: _counted(bench, "bus-off") == 1)


def _noise(bench: Bench) -> Planted:
    return on_wire(
        bench,
        wire.Unterminated(probability=0.01),
        everywhere(bench),
        lambda: _counted(bench, "bus error") > 20,
    )


# -- what does not leave -----------------------------------------------------------------------------------------------


def _full_without_number(bench: Bench) -> Planted:
    """What python-can says where `select` finds no room: the same fault, with no errno in it."""
    refuse(bench, can.CanOperationError("Transmit buffer full"))
    return _for(bench, _SHORT_NS, lambda: refuse(bench, None), lambda: _held_back(bench))


def _occupied(bench: Bench) -> Planted:
    """A node that babbles with the highest priority leaves no room for anybody else."""

    def occupy(occupied: bool) -> None:
        for bus in bench.buses:
            bus.occupied = occupied

    occupy(True)
    return _for(bench, _SHORT_NS, lambda: occupy(False), lambda: _held_back(bench))


def _power_gap(bench: Bench) -> Planted:
    """All drives lose their supply, the gripper's, too, and get it back before the bus is given up."""
    for drive in bench.drives:
        drive.power_down()

    def end() -> None:
        for drive in bench.drives:
            drive.power_up()

    return _for(bench, _CUT_NS, end, lambda: _counted(bench, "no acknowledgement") > 0)


def _down(bench: Bench) -> None:
    refuse(bench, can.CanOperationError("a test", errno.ENETDOWN))


def _up_again(bench: Bench, trial: Trial) -> None:
    """The loop ends, and does not go on by itself when the interface is back."""
    without_bus(bench, trial)
    refuse(bench, None)
    with suppress(BusError):
        bench.tick()
        trial.require(False, "the loop went on when the interface was back")


def _stale(robot: Robot, backend: str, seed: int) -> Trial:
    """Nothing that waited for the power may leave when it returns: not even long afterwards."""
    trial, torque = Trial(), False
    with Bench(robot, backend, seed) as bench:
        running(bench)
        buses, drives, plant, onset = bench.buses, bench.drives, bench.plant, bench.now_ns
        for drive in drives:
            drive.power_down()
        with suppress(BusError):
            bench.run(_GIVEN_UP_S)
            trial.require(False, "the bus was not given up")
        bench.take_events()
        trips = [(trip["protection"], trip["stop_category"]) for trip in bench.trips]
        trial.require(trips == [("P14", Category.BRAKE_OFF), ("P14", Category.CUT)], f"tripped: {trips}")
        trial.require("take the interface down and up" in bench.trips[-1]["text"], f"said: {bench.trips[-1]['text']}")
        trial.figures["reaction_s"] = (bench.trips[0]["stamp_ns"] - onset) * 1e-9
        trial.require(all(bus.waiting() for bus in buses), "no frame waited for the power")
        with suppress(HardwareError):  # no drive confirms that it is off
            bench.loop.shut_down()
        witnesses = [bus.witness() for bus in buses]
        for drive in drives:
            drive.power_up()
        for _ in range(_WATCH_MS):
            bench.clock.sleep_until(bench.now_ns + 1_000_000)
            for bus in buses:
                bus.recv(0.0)
            torque |= bool(plant.truth().effort.any())
        old = [witness.recv(0.0) for witness in witnesses]
        trial.require(old == [None] * len(buses), "old frames were sent when the power came back")
        trial.require(not torque, "torque came back")
    trial.seen = "P14, then the bus was given up; nothing old left"
    return trial


# -- who else is there -------------------------------------------------------------------------------------------------


def _babble(bench: Bench) -> Planted:
    unexpected = bench.count("unexpected")
    return on_wire(bench, strangers.Babble(), everywhere(bench), lambda: bench.count("unexpected") > unexpected + 1000)


def _impostor(bench: Bench) -> Planted:
    axis = _some(bench)
    joint = bench.robot.profile.joints[axis]
    assert joint.drive is not None
    drive = bench.drive(axis)
    begun = bench.now_ns
    received = bench.count("received")

    def showed() -> bool:
        ticks = len(bench.since(begun))
        return bench.count("received") > received + 1.1 * ticks

    other = strangers.Impostor(offset=_APART * joint.drive.sign * joint.drive.gear, tell=drive.shifted)
    return on_wire(bench, other, [axis], showed)


def _chatter(bench: Bench) -> Planted:
    axis, rejected = _some(bench), bench.count("rejected")
    return on_wire(bench, strangers.Chatter(), [axis], lambda: bench.count("rejected") > rejected)


def _late(bench: Bench) -> Planted:
    missed = bench.count("missed_replies")
    return on_wire(
        bench, wire.Delay(delay_s=_LATE_S), everywhere(bench), lambda: bench.count("missed_replies") > missed
    )


def _some(bench: Bench) -> int:
    return int(bench.random.integers(bench.robot.dof))


def scenarios(robot: Robot, backend: str) -> list[Scenario]:
    if backend != "can":
        return []
    period = robot.period_ns * 1e-9
    safety = robot.profile.safety
    told = Expected(protection=Protection.BUS, category=Category.BRAKE_OFF, words="check cable, termination")
    # For as long as nothing leaves, the drives go on as they were told last.
    coasting = replace(told, rest_s=_COASTING_REST_S, excused=frozenset({"sphere", "position"}))
    if on_canopen(robot):  # in mode 8 a drive makes up for the way that it was not told of
        coasting = replace(coasting, excused=coasting.excused | {"velocity"})
    held_back = replace(coasting, within_s=_UNDELIVERED_TICKS * period, words="check power and cable")
    senseless = Expected(
        protection=Protection.RECEIVE,
        category=Category.BRAKE_OFF,
        within_s=safety.rejected_frames * period,
        words="look for another sender on the bus",
    )
    silent = Expected(
        protection=Protection.FEEDBACK,
        category=Category.BRAKE_OFF,
        within_s=safety.feedback_fault_s,
        words="check its power, its connector and the bus",
    )
    found = [
        stop_scenario(12, "very late", "all answers come 80 ms late", _late, silent.losing_torque(robot)),
        stop_scenario(14, "error-passive", "the controller sees too many errors", _passive, told),
        stop_scenario(
            14,
            "restart",
            "the controller leaves the bus, and is restarted after 40 ms",
            _restarting,
            replace(coasting, words="check cable and termination"),
        ),
        stop_scenario(
            14, "full, no errno", "the same full queue, as `select` tells it", _full_without_number, held_back
        ),
        stop_scenario(
            14,
            "no room",
            "a babbling node leaves no room for others for 40 ms",
            _occupied,
            replace(held_back, within_s=held_back.within_s + WAITING_LIMIT_NS * 1e-9),
        ),
        stop_scenario(14, "power gap", "no drive has power for 120 ms", _power_gap, told.losing_torque(robot)),
        Scenario(
            14,
            "stale frames",
            "no drive has power any more; it comes back once the run has ended",
            "P14 category 1, then 0; no old frame leaves",
            _stale,
        ),
        orphan_scenario(14, "down and up", "the interface goes down, and up again", _down, _up_again),
        tolerated_scenario(14, "error frames", "1 % of all frames are broken on the wire", _noise),
        tolerated_scenario(15, "babbling", "a node sends three frames beside every answer", _babble),
        stop_scenario(
            15, "wrong node", "a second motor with the same ids answers, too", _impostor, senseless.losing_torque(robot)
        ),
    ]
    if on_canopen(robot):  # SDO answers and PDOs have ids of their own
        return found
    return [
        *found,
        stop_scenario(15, "look-alikes", "another program reads a drive's registers", _chatter, senseless),
    ]
