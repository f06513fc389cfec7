"""After a stop: an operator goes on, by the way that its rule allows and, before that, by every shorter one."""

from enum import Enum

import numpy as np

from robotctl.control.operator import Verb
from robotctl.safety.machine import State
from robotctl.safety.shaper import Clip
from robotctl.trials.bench import Bench
from robotctl.trials.faults import Planted, cycle_power
from robotctl.trials.policies import sway
from robotctl.trials.scenario import Trial

_LOWERING_S = 3.0
_SETTLE_S = 1.0


class Clears(Enum):
    """What it takes to go on."""

    START = "by start"
    ACK = "by ack"
    RETREAT = "by ack, then retreat"
    POWER = "by a power cycle, then ack"


def go_on(bench: Bench, planted: Planted, clears: Clears, trial: Trial) -> None:
    """Undo the fault and go on as an operator would, until the arm moves again."""
    bench.policy = None
    _try_shorter_ways(bench, clears, trial)
    planted.undo()
    bench.run(_SETTLE_S)
    if clears is Clears.POWER:
        trial.require(bool(bench.ask(Verb.ACK)), "ACK was enough without a power cycle")
        cycle_power(bench)
    if clears is not Clears.START:
        _acknowledge(bench, trial)
    if clears is Clears.RETREAT:
        trial.require(bench.loop.supervisor.recovery, "the arm may go on from outside its limits")
    if not trial.problems:
        _move(bench, trial)
        trial.seen += f", cleared {clears.value}"


def _try_shorter_ways(bench: Bench, clears: Clears, trial: Trial) -> None:
    for verb in (Verb.ARM, Verb.HOME, Verb.RETREAT) + ((Verb.START,) if clears is not Clears.START else ()):
        trial.require(bool(bench.ask(verb)), f"{verb.name} led on without an acknowledgement")


def _acknowledge(bench: Bench, trial: Trial) -> None:
    """From HOLD or FAULT to ARMED."""
    held = bench.state is State.HOLD
    text = bench.ask(Verb.ACK)
    if "lowered" in text:
        bench.run(_LOWERING_S)
        text = bench.ask(Verb.ACK)
    if bench.state is State.SILENT:
        text = bench.ask(Verb.SELFTEST)
    if trial.require(not text, f"ACK was refused: {text}") and not held:
        trial.require(bench.state is State.READY, f"ACK led to {bench.state.name}")
        _hold(bench, held=True)
        text = bench.ask(Verb.ARM)
        trial.require(not text, f"ARM was refused: {text}")
        bench.run(0.05)
        _hold(bench, held=False)


def _hold(bench: Bench, *, held: bool) -> None:
    """Lift an arm without brakes, and hold it until its drives do."""
    if bench.robot.profile.brakes:
        return
    for axis in range(bench.robot.dof):
        bench.plant.jam(axis, held)
    if held:
        bench.place(np.array(bench.robot.profile.home))


def _retreat(bench: Bench, trial: Trial) -> None:
    for verb in (Verb.START, Verb.HOME):
        trial.require(bool(bench.ask(verb)), f"{verb.name} moved an arm outside its limits")
    text = bench.ask(Verb.RETREAT)
    if trial.require(not text, f"RETREAT was refused: {text}"):
        bench.until(lambda: bench.state is not State.RESET, 40.0)
        inside = not bench.since(bench.now_ns)["clip"][-1] & Clip.RECOVERY
        trial.require(bench.state is State.ARMED and inside, f"the retreat ended in {bench.state.name}")


def _move(bench: Bench, trial: Trial) -> None:
    if bench.loop.supervisor.recovery:  # it came to rest a little outside, and was not to go on from there
        _retreat(bench, trial)
    trips = len(bench.trips)
    bench.hand_over(sway(bench))
    bench.run(0.3)
    moving = float(np.abs(bench.plant.truth().velocity / bench.robot.limits.velocity).max())
    trial.require(bench.state is State.RUN and moving > 0.1, f"did not move again: {bench.trips[trips:]}")
