"""No error is cleared inside the command path: a fault of a drive stays for a person, at a service tool."""

import ast
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from robotctl.control.loop import Verb
from robotctl.control.session import LockstepSession, Stopped
from robotctl.hal.can.damiao.codec import Special
from robotctl.hal.robot import load_robot
from robotctl.safety.machine import State
from robotctl.safety.target import JointVelocity
from robotctl.sim.motors.trouble import Failure, Mute, PowerCut, Trouble

ROOT = Path(__file__).parents[1]
PATH = ("hal", "safety", "control", "learning")
"""The packages between a policy and the wire."""


def mentions(word: str) -> set[tuple[str, str]]:
    """Return (file, function) of everything that calls, takes or names `word` in the command path; not who defines it.

    Texts count, too: `getattr` takes them.
    """
    found = set()
    for package in PATH:
        for file in (ROOT / package).rglob("*.py"):
            tree = ast.parse(file.read_text())
            for function, node in _inside(tree, "module"):
                named = isinstance(node, ast.Name) and node.id == word and isinstance(node.ctx, ast.Load)
                taken = isinstance(node, ast.Attribute) and node.attr == word
                written = isinstance(node, ast.Constant) and node.value == word
                if named or taken or written:
                    found.add((str(file.relative_to(ROOT)), function))
    return found


def _inside(node: ast.AST, function: str) -> Iterator[tuple[str, ast.AST]]:
    for child in ast.iter_child_nodes(node):
        yield function, child
        named = child.name if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef) else function
        yield from _inside(child, named)


def test_nobody_calls_the_function_that_clears_faults() -> None:
    arms = {(f"hal/can/{protocol}/arm.py", "clear_faults") for protocol in ("damiao", "cia402")}
    # Those of several arms are called with the joined one's, the gripper's with its arm's, and those nobody calls.
    joined = ("hal/can/joined.py", "clear_faults")
    assert mentions("clear_faults") == {*arms, joined, ("hal/can/damiao/passenger.py", "clear")}
    assert mentions("clear") & {(file, "clear_faults") for file, _ in arms} == {
        ("hal/can/cia402/arm.py", "clear_faults")
    }


def test_the_frame_that_clears_is_made_in_one_place_and_known_to_the_guard() -> None:
    makes, knows = ("hal/can/damiao/power.py", "clear_faults"), ("safety/wire_guard.py", "module")
    assert mentions("CLEAR_ERROR") == {makes, knows}


def test_the_word_that_resets_is_made_in_one_place_and_known_to_the_guard() -> None:
    makes, knows = ("hal/can/cia402/machine.py", "controlword"), ("safety/wire_402.py", "module")
    assert mentions("FAULT_RESET") == {makes, knows}
    assert {file for file, _ in mentions("CLEAR") if "cia402" in file} == {
        "hal/can/cia402/machine.py",
        "hal/can/cia402/power.py",
    }


def test_what_is_looked_for_is_found() -> None:
    assert ("control/operator.py", "selftest") in mentions("verify")
    assert ("control/publisher.py", "report") in mentions("reaction_ms")


def clears(arbitration_id: int, data: bytes) -> bool:
    """Return whether a frame clears a fault: DAMIAO's, or an RPDO1 or a written controlword with bit 7."""
    if arbitration_id & 0x780 == 0x200:
        return bool(data[0] & 0x80)
    if arbitration_id & 0x780 == 0x600:
        return data[0] >> 5 == 1 and data[1:3] == b"\x40\x60" and bool(data[4] & 0x80)
    return data == b"\xff" * 7 + bytes([Special.CLEAR_ERROR])


@pytest.mark.parametrize("name", ["panda", "openarm", "xarm7"])
@pytest.mark.parametrize(
    "trouble",
    [Failure(motor_id=2), PowerCut(motor_id=3), Mute(motor_id=4)],
    ids=lambda trouble: type(trouble).__name__,
)
def test_no_frame_clears_a_fault_whatever_happens_and_whatever_is_asked(name: str, trouble: Trouble) -> None:
    session = LockstepSession(load_robot(name), "can")
    session.open()
    bus = session._rig.arm._channel.bus
    frames: list[tuple[int, bytes]] = []
    receive = bus._receive
    bus._receive = lambda number, data: (frames.append((number, bytes(data))), receive(number, data))
    session.prepare()
    session.begin()
    rng = np.random.default_rng(0)
    for seq in range(60):
        wanted = rng.uniform(-2.0, 2.0, session.robot.dof) * session.robot.limits.velocity
        deadline = session.clock.now_ns() + 10**8
        session.link.mailbox.put(JointVelocity(wanted, int(session.latest()["epoch"]), seq, deadline))
        session.advance(0.05)
        if seq == 30:
            bus.bench.trouble.add(trouble)
    assert session.trips
    # One more drive fails, so that the self-test after an acknowledgement meets a fault.
    bus.bench.trouble.add(Failure(motor_id=1))
    for _ in range(2):
        for verb in (Verb.ACK, Verb.SELFTEST, Verb.ARM, Verb.START, Verb.HOME, Verb.STOP, Verb.DISARM, Verb.ESTOP):
            with suppress(Stopped):
                session.request(verb)
            session.advance(0.5)
        bus.bench.trouble.remove(trouble)
    assert len(frames) > 5000
    assert not any(clears(*frame) for frame in frames)
    assert session._rig.arm._transport.withheld == 0  # the guard was not even asked for one
    assert session.state is not State.RUN
