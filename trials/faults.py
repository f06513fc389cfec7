"""Faults that are planted alike on the twin and on emulated motors.

Each function takes a bench, mostly one whose arm moves, and returns what it planted. Where a fault is in the plant
both backends get the same; where it is in a drive or on the wire, each gets it in its own terms.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from robotctl.hal.can.damiao.codec import Status
from robotctl.hal.can.damiao.faults import fault_of
from robotctl.hal.profile import Cia402Drive
from robotctl.hal.robot import Robot
from robotctl.hal.types import Sample, Vector
from robotctl.sim import trouble as twin
from robotctl.sim.motors import trouble as wire
from robotctl.trials.bench import Bench


@dataclass(frozen=True, slots=True)
class Planted:
    """A fault that is there."""

    undo: Callable[[], None]
    showed: Callable[[], bool]
    """Whether it really did something; asked once the arm has stopped, before it is undone."""


Fault = Callable[[Bench], Planted]


def fastest(bench: Bench) -> int:
    """Return the joint that moves fastest, by its cap."""
    return int((np.abs(bench.plant.truth().velocity) / bench.robot.limits.velocity).argmax())


def everywhere(bench: Bench) -> range:
    """Return all joints."""
    return range(bench.robot.dof)


def between(bench: Bench, trouble: twin.Trouble) -> Planted:
    """Put trouble of the twin between the loop and the arm, whatever the backend."""
    bench.arm.troubles.append(trouble)
    return Planted(lambda: bench.arm.troubles.remove(trouble), lambda: trouble.acted > 0)


def on_wire(bench: Bench, trouble: wire.Trouble, axes: Iterable[int], showed: Callable[[], bool]) -> Planted:
    """Put some motors into trouble."""
    troubles = [(bench.motors_of(axis).trouble, replace(trouble, motor_id=bench.drive(axis).id)) for axis in axes]
    for place, each in troubles:
        place.add(each)

    def undo() -> None:
        for place, each in troubles:
            place.remove(each)

    return Planted(undo, showed)


# -- in the plant ------------------------------------------------------------------------------------------------------


def stuck(bench: Bench) -> Planted:
    """The joint that moves fastest seizes up."""
    axis, plant, where = fastest(bench), bench.plant, bench.plant.truth().position
    plant.jam(axis, jammed=True)
    return Planted(
        lambda: plant.jam(axis, jammed=False), lambda: bool(abs(plant.truth().position[axis] - where[axis]) < 0.05)
    )


def resisted(bench: Bench, axis: int, stiffness: float, damping: float, seconds: float) -> Planted:
    """A moving joint meets something, which resists with Nm/rad and Nms/rad and is taken away after a while."""
    plant, begun = bench.plant, bench.now_ns
    start = plant.axis(axis)
    ahead = float(np.sign(start.velocity))
    ends = begun + round(seconds * 1e9)

    class Resistance(twin.Trouble):
        def on_plant(self) -> None:
            state = plant.axis(axis)
            depth = max(ahead * (state.position - start.position), 0.0)
            force = stiffness * depth + damping * max(ahead * state.velocity, 0.0) if bench.now_ns < ends else 0.0
            self.acted += force > 0.0
            torque = np.zeros(bench.robot.dof)
            torque[axis] = -ahead * force
            plant.push(torque)

    planted = between(bench, Resistance())

    def undo() -> None:
        plant.push(np.zeros(bench.robot.dof))
        planted.undo()

    return Planted(undo, planted.showed)


def pushed(bench: Bench, torque: Vector, seconds: float) -> Planted:
    """Somebody pushes the joints with some torques (n,), Nm, for a while."""
    plant, begun = bench.plant, bench.now_ns
    plant.push(torque)
    ends = begun + round(seconds * 1e9)

    class Push(twin.Trouble):
        def on_plant(self) -> None:
            if bench.now_ns >= ends:
                plant.push(np.zeros_like(torque))

    planted = between(bench, Push())

    def undo() -> None:
        plant.push(np.zeros_like(torque))
        planted.undo()

    def showed() -> bool:
        records = bench.since(begun)
        return bool(np.abs(records["true_velocity"] - records["command_velocity"]).max() > 0.05)

    return Planted(undo, showed)


def teleported(bench: Bench, pose: Vector) -> Planted:
    """The arm is somewhere else, at rest, from one moment to the next."""
    before, begun = bench.plant.truth().position, bench.now_ns
    bench.plant.place(pose)
    way = float(np.abs(pose - before).max())
    return Planted(lambda: None, lambda: bool(np.abs(bench.since(begun)["true_position"] - before).max() > 0.9 * way))


def pulled(bench: Bench, pose: Vector, seconds: float) -> Planted:
    """Somebody pulls the arm to a pose (n,), rad, and lets go once it is stopped."""
    before, begun, plant = bench.plant.truth().position, bench.now_ns, bench.plant

    class Pull(twin.Trouble):
        def on_plant(self) -> None:
            if not bench.trips:
                self.acted += 1
                part = min((bench.now_ns - begun) / (seconds * 1e9), 1.0)
                plant.place(before + part * (pose - before))

    return between(bench, Pull())


def driven(bench: Bench, axis: int, speed: float) -> Planted:
    """Something drives a joint at a speed, rad/s, for 20 ms, stronger than its drive."""
    ends, plant = bench.now_ns + 20_000_000, bench.plant

    class Drive(twin.Trouble):
        def on_plant(self) -> None:
            if bench.now_ns < ends:
                self.acted += 1
                plant.data.qvel[axis] = speed

    return between(bench, Drive())


# -- in the drives -----------------------------------------------------------------------------------------------------


def mute(bench: Bench, axes: Iterable[int]) -> Planted:
    """Some drives obey, but are not heard of any more."""
    axes = list(axes)
    if bench.twin:
        return between(bench, twin.Mute(axes, _seen(bench)))
    missed = _missed(bench, axes)
    return on_wire(bench, wire.Mute(), axes, lambda: _missed(bench, axes) > missed)


def failed(bench: Bench, axis: int) -> Planted:
    """A drive reports a fault and goes off; cycling its power is what undoes it."""
    fault = fault_of(bench.robot.profile.joints[axis].name, Status.OVER_CURRENT)
    if bench.twin:
        arm = bench.twin
        arm.fail([axis], fault.code, fault.name, fault.hint)
        return Planted(lambda: None, lambda: bool(arm.read().faults))
    drive = bench.drive(axis)
    before = drive.status
    bench.motors_of(axis).trouble.add(wire.Failure(motor_id=drive.id))
    return Planted(lambda: None, lambda: drive.status != before)


def unpowered(bench: Bench, axes: Iterable[int]) -> Planted:
    """Some drives lose their supply."""
    axes = list(axes)
    if bench.twin:
        arm = bench.twin
        planted = between(bench, twin.Mute(axes, _seen(bench)))
        arm.power_down(axes)

        def undo() -> None:
            planted.undo()
            arm.power_up(axes)

        return Planted(undo, lambda: not arm.read().enabled)
    return on_wire(bench, wire.PowerCut(), axes, lambda: not any(bench.drive(axis).powered for axis in axes))


def hot(bench: Bench, axis: int, celsius: float) -> Planted:
    """A drive is too hot. Undone by letting it cool."""
    if bench.twin:
        return between(bench, twin.Heat([axis], celsius))
    thermal = bench.drive(axis).thermal
    before = thermal.rotor
    thermal.rotor = celsius
    thermal.step(0.0, 0.0)

    def undo() -> None:
        thermal.rotor = before
        thermal.step(0.0, 0.0)

    return Planted(undo, lambda: thermal.rotor > before + 5.0)


def runaway(bench: Bench, axis: int, torque: float) -> Planted:
    """A drive turns with a torque of its own, Nm of the joint, whatever it is told."""
    if bench.twin:
        return between(bench, twin.Runaway(bench.twin, axis, torque))
    wiring = bench.robot.profile.joints[axis].drive
    assert wiring is not None
    own = torque / (wiring.sign * wiring.gear)
    return on_wire(bench, wire.Runaway(torque=own), [axis], lambda: bench.drive(axis).shaft.is_running_away)


def weak(bench: Bench, axis: int, part: float) -> Planted:
    """A drive applies a part of its torque; with a negative part, in the wrong direction."""
    if bench.twin:
        return between(bench, twin.Weak(bench.twin, axis, part))
    begun = bench.now_ns

    def showed() -> bool:
        records = bench.since(begun)
        return bool(np.abs(records["command_position"] - records["true_position"])[:, axis].max() > 0.01)

    return on_wire(bench, wire.Weak(part=part), [axis], showed)


def misread(bench: Bench, axis: int, offset: float) -> Planted:
    """A joint is measured somewhere else than it is, rad."""
    if bench.twin:
        shift = np.zeros(bench.robot.dof)
        shift[axis] = offset
        return between(bench, twin.Misread(shift))
    wiring, drive, begun = bench.robot.profile.joints[axis].drive, bench.drive(axis), bench.now_ns
    assert wiring is not None

    def showed() -> bool:
        records = bench.since(begun)
        return bool(np.abs(records["position"] - records["true_position"])[:, axis].max() > 0.5 * abs(offset))

    trouble = wire.Misreport(offset=offset * wiring.sign * wiring.gear, tell=drive.shifted)
    return on_wire(bench, trouble, [axis], showed)


def frozen(bench: Bench, axis: int) -> Planted:
    """A joint is measured at rest where it is now, however it moves."""
    if bench.twin:
        return between(bench, twin.Frozen([axis], _seen(bench)))
    drive, begun = bench.drive(axis), bench.now_ns

    def showed() -> bool:
        records = bench.since(begun)
        return bool(np.abs(records["velocity"] - records["true_velocity"])[:, axis].max() > 0.1)

    return on_wire(bench, wire.Frozen(angle=drive.angle, tell=drive.frozen), [axis], showed)


# -- on all buses ------------------------------------------------------------------------------------------------------


def report(bench: Bench, error_class: int, data: bytes = bytes(8)) -> None:
    """Let every controller tell of an error, in SocketCAN's terms."""
    for bus in bench.buses:
        bus.report(error_class, data)


def refuse(bench: Bench, failure: Exception | None) -> None:
    """Let every bus refuse whatever is sent, or take it again."""
    for bus in bench.buses:
        bus.failure = failure


def on_canopen(robot: Robot) -> bool:
    """Return whether an arm has CiA 402 drives."""
    return any(isinstance(joint.drive, Cia402Drive) for joint in robot.profile.joints)


def faulty(bench: Bench) -> bool:
    """Return whether an emulated drive has a fault."""
    return bench.twin is None and any(drive.is_faulty for drive in bench.drives)


def cycle_power(bench: Bench) -> None:
    """Take the supply from all drives for a moment, as an operator would."""
    (_cycle_twin if bench.twin else _cycle_motors)(bench)


def _cycle_twin(bench: Bench) -> None:
    arm = bench.twin
    assert arm is not None
    planted = unpowered(bench, everywhere(bench))
    bench.run(0.2)
    planted.undo()
    bench.run(0.05)


def _cycle_motors(bench: Bench) -> None:
    for drive in bench.drives:
        drive.power_down()
    bench.run(0.2)
    for drive in bench.drives:
        drive.power_up()
    bench.run(0.05)


def _seen(bench: Bench) -> Sample:
    assert bench.arm.seen is not None
    return bench.arm.seen


def _missed(bench: Bench, axes: Iterable[int]) -> int:
    statistics = bench.arm.bus_statistics()
    assert statistics is not None
    missed = statistics["missed_by_joint"]
    assert isinstance(missed, dict)
    return sum(missed[bench.robot.profile.joints[axis].name] for axis in axes)
