"""Raw frames give back exactly the states that were seen, and go out in formats that other tools read."""

import itertools

import can
import numpy as np
import pytest

from robotctl.control.black_box import BlackBox
from robotctl.control.frame_replay import compare, export, frames_of, read_frames, replay_states
from robotctl.control.frame_ring import Flag
from robotctl.control.session import LockstepSession
from robotctl.hal.errors import ConfigError
from robotctl.hal.robot import load_robot
from robotctl.safety.target import JointVelocity


def drive(session: LockstepSession, seconds: float) -> None:
    rng = np.random.default_rng(1)
    session.prepare()
    session.begin()
    for seq in range(round(seconds / 0.05)):
        wanted = rng.uniform(-0.5, 0.5, session.robot.dof) * session.robot.limits.velocity
        deadline = session.clock.now_ns() + 10**8
        session.link.mailbox.put(JointVelocity(wanted, int(session.latest()["epoch"]), seq, deadline))
        session.advance(0.05)


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    """A session over frames, stopped: its ticks, its ring of frames, and the file of its black box."""
    robot = load_robot("openarm")
    with LockstepSession(robot, "can") as session:
        box = BlackBox(robot, session.link, tmp_path_factory.mktemp("box") / "run", {}, 10**18, session.frames)
        session.on_trip = box.on_trip
        drive(session, 1.0)
        session.emergency_stop()
        session.advance(1.5)
        (path,) = box.flush()
        yield session.link.ticks.since(0)[0], session.frames, path


def test_every_tick_is_decoded_into_the_very_state_that_it_saw(seen):
    ticks, frames, _ = seen
    states = list(replay_states(frames.snapshot(), frames.description))
    assert len(ticks) > 1000
    assert [state.stamp_ns for state in states] == ticks["stamp_ns"].tolist()
    for name in ("position", "velocity", "effort"):
        assert np.array([getattr(state, name) for state in states]).tobytes() == ticks[name].tobytes()


def test_another_bit_in_a_frame_shows(seen):
    ticks, frames, _ = seen
    slots = frames.snapshot()
    (reply,) = np.flatnonzero((slots["id"] == 0x13) & (slots["flags"] == Flag.FD))[-100:-99]
    slots["data"][reply][2] ^= 1
    states = list(replay_states(slots, frames.description))
    assert any(state.position[2] != tick["position"][2] for state, tick in zip(states, ticks, strict=True))


def test_both_directions_are_kept_in_their_order(seen):
    _, frames, _ = seen
    kept = [frame for frame in frames_of(frames.snapshot()) if not frame.flags & Flag.MARK]
    sent = [frame for frame in kept if frame.flags & Flag.SENT]
    assert abs(len(kept) - 2 * len(sent)) < 20
    assert {frame.arbitration_id for frame in kept} == {*range(1, 8), *range(0x11, 0x19), 0x308, 0x7FF, 8}
    assert all(before.stamp_ns <= after.stamp_ns for before, after in itertools.pairwise(kept))


def test_the_black_box_holds_frames_and_states_alike(seen):
    *_, path = seen
    found = compare(path)
    assert found.compared == found.ticks > 1000
    assert found.different == 0


@pytest.mark.parametrize("ending", [".log", ".asc"])
def test_exports_are_read_by_others(seen, tmp_path, ending):
    *_, path = seen
    frames = read_frames(path)
    out = tmp_path / f"bus{ending}"
    count = export(frames, out)
    with can.LogReader(out) as reader:
        read = list(reader)
    kept = [frame for frame in frames_of(frames.slots) if not frame.flags & Flag.MARK]
    assert len(read) == count == len(kept)
    for message, frame in zip(read, kept, strict=True):
        assert (message.arbitration_id, bytes(message.data)) == (frame.arbitration_id, frame.data)
        assert message.is_rx is not bool(frame.flags & Flag.SENT)
        assert message.is_fd is bool(frame.flags & Flag.FD)
    with pytest.raises(ConfigError, match="already exists"):
        export(frames, out)


def test_what_cannot_be_replayed_says_so(tmp_path):
    with pytest.raises(ConfigError, match="cannot be read"):
        read_frames(tmp_path / "nothing.mcap")
    with pytest.raises(ConfigError, match="protocol 'x'"):
        list(replay_states(np.zeros(0), {"protocol": "x"}))


def test_a_session_without_a_bus_keeps_no_frames():
    with LockstepSession(load_robot("openarm"), "sim") as session:
        assert session.frames is None
