"""P13, P14, P15: what may go wrong between the host and its drives."""

import errno
from collections.abc import Callable
from dataclasses import replace

import can
import numpy as np

from robotctl.hal.robot import Robot
from robotctl.hal.types import Fault, Sample
from robotctl.safety.trip import Category, Protection
from robotctl.sim.motors import trouble as wire
from robotctl.sim.trouble import Misread, NoWatchdog, Reject, Report, Trouble
from robotctl.trials.bench import Bench
from robotctl.trials.clearing import Clears
from robotctl.trials.faults import Planted, between, misread, on_canopen, on_wire, refuse, report
from robotctl.trials.orphans import orphan_scenario, without_bus
from robotctl.trials.refusals import refusal_scenario
from robotctl.trials.scenario import Scenario
from robotctl.trials.shaping import tolerated_scenario
from robotctl.trials.stops import Expected, stop_scenario, untouchable

_UNDELIVERED_TICKS = 5
_COASTING_REST_S = 0.4
_FULL_NS = 40_000_000
_ERROR_BUS_OFF = 0x40
_ERROR_RESTARTED = 0x100


def _timeout_of(seconds: float) -> Callable[[Robot, str, int], None]:
    """Return the attempt to bring up an arm one of whose drives has this watchdog; 0 is none."""

    def attempt(robot: Robot, backend: str, seed: int) -> None:
        bench = Bench(robot, backend, seed)
        axis = int(bench.random.integers(robot.dof))
        name = robot.profile.joints[axis].name
        if bench.twin:
            bench.arm.troubles.append(NoWatchdog(name))
        else:
            bench.arm.connect()
            bench.drive(axis).set_watchdog(seconds)
        with bench:
            pass

    return attempt


def _bus_off(bench: Bench) -> Planted:
    if bench.twin:
        return between(bench, Report(Fault("bus", _ERROR_BUS_OFF, "BUS_OFF", "check cable and termination")))
    report(bench, _ERROR_BUS_OFF)
    return Planted(
        lambda: report(bench, _ERROR_RESTARTED), lambda: all(bus["state"] == "bus-off" for bus in bench.statistics())
    )


def _queue_full(bench: Bench) -> Planted:
    """Nothing leaves the host for a while, and the loop is told so; the drives' watchdogs have not bitten yet."""
    ends = bench.now_ns + _FULL_NS
    _block(bench, blocked=True)

    class Ending(Trouble):
        def on_read(self, sample: Sample) -> Sample:
            if bench.now_ns >= ends and not self.acted:
                self.acted += 1
                _block(bench, blocked=False)
            return sample

    return between(bench, Ending())


def _block(bench: Bench, *, blocked: bool) -> None:
    if bench.twin:
        bench.twin.blocked = "the transmit queue is full" if blocked else ""
    else:
        refuse(bench, can.CanOperationError("a test", errno.ENOBUFS) if blocked else None)


def _unplugged(bench: Bench) -> None:
    refuse(bench, can.CanOperationError("a test", errno.ENODEV))


def _blocked(bench: Bench) -> None:
    _block(bench, blocked=True)


def _no_sense(bench: Bench) -> Planted:
    """A drive's answers lose their last bytes."""
    if bench.twin:
        return between(bench, Reject())
    rejected = bench.count("rejected")
    return on_wire(bench, wire.Short(), [_some(bench)], lambda: bench.count("rejected") > rejected)


def _flipped(bench: Bench) -> Planted:
    """Every second answer of a drive has a bit flipped on its way."""
    begun, strange = bench.now_ns, bench.count("unexpected")

    def showed() -> bool:
        records = bench.since(begun)
        far = np.abs(records["position"] - records["true_position"]).max() > 0.01
        return bool(far) or bench.count("unexpected") > strange

    return on_wire(bench, wire.Corrupt(probability=0.5), [_some(bench)], showed)


def _jumped(bench: Bench) -> Planted:
    return misread(bench, _some(bench), 0.5)


def _no_number(bench: Bench) -> Planted:
    wrong = np.zeros(bench.robot.dof)
    wrong[_some(bench)] = np.nan
    return between(bench, Misread(wrong))


def _on_all(trouble: wire.Trouble, showed: Callable[[Bench, int, int], bool]) -> Callable[[Bench], Planted]:
    """Return trouble of all motors; `showed` is told how many frames were sent and received meanwhile."""

    def plant(bench: Bench) -> Planted:
        sent, received = bench.count("sent"), bench.count("received")
        return on_wire(
            bench,
            trouble,
            range(bench.robot.dof),
            lambda: showed(bench, bench.count("sent") - sent, bench.count("received") - received),
        )

    return plant


def _late_answers(bench: Bench, _sent: int, _received: int) -> bool:
    return all(float(bus["round_trip_us"]["p99"]) > 1e3 for bus in bench.statistics())


def _some(bench: Bench) -> int:
    return int(bench.random.integers(bench.robot.dof))


def scenarios(robot: Robot, backend: str) -> list[Scenario]:
    period = robot.period_ns * 1e-9
    safety = robot.profile.safety
    on_bus = Expected(protection=Protection.BUS, category=Category.BRAKE_OFF, within_s=_UNDELIVERED_TICKS * period)
    # For as long as nothing leaves, the drives go on as they were told last.
    coasting = replace(on_bus, rest_s=_COASTING_REST_S, excused=frozenset({"sphere", "position", "velocity"}))
    # Drives that hear nothing any more go off by their own watchdogs; DAMIAO's with a fault.
    unheard = replace(on_bus, clears=Clears.ACK if on_canopen(robot) else Clears.POWER).losing_torque(robot)
    senseless = Expected(
        protection=Protection.RECEIVE, category=Category.BRAKE_OFF, within_s=safety.rejected_frames * period
    )
    # What is not believed of a joint leaves nothing to damp the arm by.
    unknown = senseless.losing_torque(robot)
    found = [
        refusal_scenario(13, "no watchdog", "a drive has no watchdog", _timeout_of(0.0), ["watchdog"], 3),
        orphan_scenario(13, "loop gone", "the loop is not heard of any more"),
        stop_scenario(
            14, "bus-off", "the controller leaves the bus", _bus_off, on_bus if backend == "sim" else unheard
        ),
        stop_scenario(14, "queue full", "nothing leaves the host for 40 ms", _queue_full, coasting),
        stop_scenario(
            15, "senseless", "answers of a wrong length", _no_sense, senseless if backend == "sim" else unknown
        ),
        stop_scenario(15, "jump", "an encoder jumps by 0.5 rad", _jumped, unknown),
    ]
    if backend == "sim":
        return [*found, stop_scenario(15, "no number", "an angle is no number", _no_number, unknown)]
    too_long = 2.0 * safety.drive_timeout_s
    sooner_or_later = Expected(
        protection=Protection.RECEIVE,
        category=Category.BRAKE_OFF,
        within_s=0.5,
        or_else=((Protection.DRIVE, Category.BRAKE_OFF), (Protection.FEEDBACK, Category.BRAKE_OFF)),
    ).losing_torque(robot)
    return [
        *found,
        refusal_scenario(
            13, "long watchdog", "a watchdog twice as long as allowed", _timeout_of(too_long), ["watchdog"]
        ),
        orphan_scenario(14, "nobody listens", "nothing leaves the host any more", _blocked, without_bus),
        orphan_scenario(14, "unplugged", "the adapter is unplugged", _unplugged, without_bus),
        untouchable(
            stop_scenario(
                15, "flipped bits", "half the answers of a drive have a bit flipped", _flipped, sooner_or_later
            )
        ),
        tolerated_scenario(
            15,
            "twice",
            "every answer comes twice",
            _on_all(wire.Duplicate(), lambda _, sent, received: received > 1.5 * sent),
        ),
        tolerated_scenario(
            15,
            "late and out of order",
            "answers come 1 to 4 ms late",
            _on_all(wire.Delay(delay_s=0.001, jitter_s=0.003), _late_answers),
        ),
        tolerated_scenario(
            15,
            "lost",
            "2 % of all frames are lost",
            _on_all(wire.Drop(probability=0.02), lambda _, sent, received: received < 0.99 * sent),
        ),
    ]
