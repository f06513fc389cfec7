"""Shared memory: whole or nothing, and never in anybody's way."""

import json
import os
import signal
import struct
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from robotctl.control import shared
from robotctl.control.shared import MAX_VALUES, Board, Desk, EventRing, Link, Mailbox, Power, TickRing, tick_dtype
from robotctl.hal.robot import load_robot
from robotctl.safety.admission import Admission
from robotctl.safety.target import FreeDrive, Hold, JointTorque, JointVelocity
from robotctl.safety.trip import Protection

INT64 = st.integers(-(2**63), 2**63 - 1)
HEADS = st.tuples(INT64, INT64, INT64)
VALUES = hnp.arrays(np.float64, st.integers(0, MAX_VALUES), elements=st.floats(width=64))
TARGETS = st.one_of(
    st.builds(lambda kind, v, h: kind(v, *h), st.sampled_from([JointVelocity, JointTorque]), VALUES, HEADS),
    st.builds(lambda kind, h: kind(*h), st.sampled_from([Hold, FreeDrive]), HEADS),
)


def same(one, other):
    if type(one) is not type(other):
        return False
    if hasattr(one, "values"):
        return one[1:] == other[1:] and np.array_equal(one.values, other.values, equal_nan=True)
    return one == other


# -- the mailbox ---------------------------------------------------------------------------------------------------


@given(st.lists(TARGETS, min_size=1, max_size=5))
def test_every_target_comes_through_as_it_was(targets):
    buffer = bytearray(Mailbox.SIZE)
    writer, reader = Mailbox(buffer), Mailbox(buffer)
    assert reader.take() is None
    for target in targets:
        writer.put(target)
        assert same(reader.take(), target)
        assert reader.take() is None


def test_only_the_latest_target_waits():
    buffer = bytearray(Mailbox.SIZE)
    writer, reader = Mailbox(buffer), Mailbox(buffer)
    for seq in range(10):
        writer.put(Hold(0, seq, 0))
    assert reader.take() == Hold(0, 9, 0)


@pytest.mark.parametrize("cut", range(0, Mailbox.SIZE, 8))
def test_a_torn_write_is_invisible(cut):
    """Only the first words of a second target have arrived, its version among them."""
    buffer, next_buffer = bytearray(Mailbox.SIZE), bytearray(Mailbox.SIZE)
    writer, reader = Mailbox(buffer), Mailbox(buffer)
    writer.put(JointVelocity(np.ones(7), 1, 1, 1))
    assert reader.take() is not None
    next_buffer[:] = buffer
    later = Mailbox(next_buffer)
    later._version = 2
    later.put(JointVelocity(np.full(7, 2.0), 2, 2, 2))
    # As put() leaves it half way: the odd version, and part of the body.
    buffer[8:] = next_buffer[8:cut] + buffer[max(8, cut) :] if cut > 8 else buffer[8:]
    struct.pack_into("<Q", buffer, 0, 3)
    assert reader.take() is None
    buffer[:] = next_buffer
    assert reader.take().values[0] == 2.0


def test_a_version_that_moves_while_it_is_read_counts_as_torn(monkeypatch):
    buffer = bytearray(Mailbox.SIZE)
    writer, reader = Mailbox(buffer), Mailbox(buffer)
    writer.put(Hold(0, 1, 0))

    class Form:
        """Whoever reads the body finds the next version begun."""

        size = shared._TARGET.size

        def unpack_from(self, data, at):
            found = original.unpack_from(data, at)
            struct.pack_into("<Q", buffer, 0, 3)
            return found

    original = shared._TARGET
    monkeypatch.setattr(shared, "_TARGET", Form())
    assert reader.take() is None
    monkeypatch.undo()
    writer.put(Hold(0, 2, 0))
    assert reader.take() == Hold(0, 2, 0)


@pytest.mark.parametrize("number", [0, 5, -1, 2**31 - 1])
def test_an_unknown_kind_becomes_something_admission_refuses(number):
    buffer = bytearray(Mailbox.SIZE)
    writer, reader = Mailbox(buffer), Mailbox(buffer)
    writer.put(JointVelocity(np.ones(7), 0, 1, 10**9))
    struct.pack_into("<i", buffer, 32, number)
    target = reader.take()
    assert target is not None
    assert Admission(load_robot("panda")).offer(target, 0, 0).protection is Protection.MALFORMED


@pytest.mark.parametrize("count", [-(2**31), -1, 17, 2**31 - 1])
def test_a_nonsensical_count_does_not_break_the_reader(count):
    buffer = bytearray(Mailbox.SIZE)
    writer, reader = Mailbox(buffer), Mailbox(buffer)
    writer.put(JointVelocity(np.ones(7), 0, 1, 0))
    struct.pack_into("<i", buffer, 36, count)
    assert len(reader.take().values) == (0 if count < 0 else MAX_VALUES)


@given(st.binary(min_size=Mailbox.SIZE, max_size=Mailbox.SIZE))
def test_no_content_whatever_breaks_the_reader(content):
    target = Mailbox(bytearray(content)).take()
    assert target is None or isinstance(target, JointVelocity | JointTorque | Hold | FreeDrive)


def test_seventeen_values_do_not_fit():
    buffer = bytearray(Mailbox.SIZE)
    mailbox = Mailbox(buffer)
    mailbox.put(JointVelocity(np.zeros(16), 0, 0, 0))
    before = bytes(buffer)
    with pytest.raises(ValueError, match="at most 16 values, got 17"):
        mailbox.put(JointVelocity(np.zeros(17), 0, 0, 0))
    assert bytes(buffer) == before


# -- the desk ------------------------------------------------------------------------------------------------------


def test_a_request_waits_until_it_is_answered():
    desk = Desk(bytearray(Desk.SIZE))
    assert desk.pending() is None
    number = desk.ask(7)
    assert desk.pending() == (number, 7)
    assert desk.pending() == (number, 7)
    assert not desk.answered(number)
    desk.answer(number)
    assert desk.answered(number)
    assert desk.pending() is None
    assert desk.ask(8) == number + 1


def test_a_request_carries_an_argument():
    buffer = bytearray(Desk.SIZE)
    operator, loop = Desk(buffer), Desk(buffer)
    operator.ask(7, 2**40)
    assert loop.argument == 2**40
    operator.ask(8)
    assert loop.argument == 0


def test_a_new_request_takes_the_place_of_one_that_nobody_answered():
    desk = Desk(bytearray(Desk.SIZE))
    first = desk.ask(1)
    second = desk.ask(10)
    assert desk.pending() == (second, 10)
    desk.answer(second)
    assert desk.answered(first)


def test_an_emergency_stop_neither_loses_nor_replaces_a_request():
    buffer = bytearray(Desk.SIZE)
    operator, loop = Desk(buffer), Desk(buffer)
    assert not loop.take_stop()
    number = operator.ask(4)
    operator.stop()
    operator.stop()
    assert loop.pending() == (number, 4)
    assert loop.take_stop()
    assert not loop.take_stop()
    operator.stop()
    second = operator.ask(5)
    assert loop.take_stop()
    assert loop.pending() == (second, 5)


def test_a_stop_posted_before_anybody_listens_is_found():
    buffer = bytearray(Desk.SIZE)
    Desk(buffer).stop()
    assert Desk(buffer).take_stop()


# -- the ring of ticks ---------------------------------------------------------------------------------------------

SLOTS = 100


def a_ring(dof=7):
    return TickRing(bytearray(TickRing.size(dof, SLOTS)), 0, dof, SLOTS)


def write(ring, number, dof=7):
    joints = [np.full(dof, number + 0.1 * index) for index in range(7)]
    truth = [np.full(dof, number + 0.8), np.full(dof, number + 0.9), np.full(3, number + 0.95)]
    head = (number, 2 * number, 3 * number, 4 * number, 5 * number, 6 * number, 7 * number, number % 2)
    ring.fill(number, head, (*joints, np.full(3, number + 0.7), *truth))
    ring.publish(number, 9 * number)


@pytest.mark.parametrize("dof", [6, 7, 16])
def test_every_field_of_a_record_is_where_its_name_says(dof):
    ring = a_ring(dof)
    for number in range(3):
        write(ring, number, dof)
    record = ring.latest()
    integers = ["tick", "stamp_ns", "lateness_ns", "epoch", "seq", "state", "clip"]
    assert [int(record[name]) for name in integers] == [2, 4, 6, 8, 10, 12, 14]
    assert (int(record["has_truth"]), int(record["duration_ns"])) == (0, 18)
    fields = ["position", "velocity", "effort", "wanted", "command_position", "command_velocity", "command_effort"]
    for index, name in enumerate(fields):
        assert record[name] == pytest.approx(np.full(dof, 2 + 0.1 * index))
    assert record["tool"] == pytest.approx(np.full(3, 2.7))
    assert record["true_position"] == pytest.approx(np.full(dof, 2.8))
    assert record["true_velocity"] == pytest.approx(np.full(dof, 2.9))
    assert record["true_tool"] == pytest.approx(np.full(3, 2.95))
    assert tick_dtype(dof).itemsize == ring.records.itemsize


def test_nothing_is_seen_before_it_is_published():
    ring = a_ring()
    assert ring.latest() is None
    assert len(ring.since(0)[0]) == 0
    ring.fill(0, (0,) * 8, (np.ones(7),) * 7 + (np.ones(3), np.ones(7), np.ones(7), np.ones(3)))
    assert ring.latest() is None
    ring.publish(0, 5)
    assert int(ring.latest()["duration_ns"]) == 5


def test_the_latest_record_is_a_copy():
    ring = a_ring()
    write(ring, 0)
    record = ring.latest()
    for number in range(1, SLOTS + 1):
        write(ring, number)
    assert int(record["tick"]) == 0


@pytest.mark.parametrize("portion", [1, 3, 35])
def test_a_reader_that_keeps_up_misses_nothing_across_many_turns(portion):
    ring = a_ring()
    seen, cursor = [], 0
    for number in range(5 * SLOTS):
        write(ring, number)
        if number % portion == 0:
            records, cursor, dropped = ring.since(cursor)
            assert dropped == 0
            seen += records["tick"].tolist()
    seen += ring.since(cursor)[0]["tick"].tolist()
    assert seen == list(range(5 * SLOTS))


@pytest.mark.parametrize("count", [30, SLOTS - 1, SLOTS, SLOTS + 1, 250, 1000])
def test_what_was_overwritten_unread_is_counted(count):
    ring = a_ring()
    for number in range(count):
        write(ring, number)
    records, cursor, dropped = ring.since(0)
    assert cursor == count
    assert dropped + len(records) == count
    ticks = records["tick"].tolist()
    assert ticks == list(range(dropped, count))
    # Room is left for the writer, who may be in the oldest slots.
    assert len(records) == min(count, SLOTS - 64)
    assert ring.since(cursor)[1:] == (count, 0)


def test_the_copy_handed_out_does_not_change_under_the_readers_hands():
    ring = a_ring()
    for number in range(20):
        write(ring, number)
    records, _, _ = ring.since(0)
    for number in range(20, 200):
        write(ring, number)
    assert records["tick"].tolist() == list(range(20))


def test_whoever_goes_on_with_a_ring_writes_whole_records_behind_the_last():
    ring = a_ring()
    for number in range(SLOTS + 5):
        write(ring, number)
    record = ring.latest()
    record["tick"], record["tool"] = 4711, 3.0
    ring.append(record)
    assert ring.head == SLOTS + 6
    assert ring.since(SLOTS + 4)[0]["tick"].tolist() == [SLOTS + 4, 4711]
    assert ring.latest()["tool"].tolist() == [3.0, 3.0, 3.0]


# -- the watch -----------------------------------------------------------------------------------------------------


def test_the_watch_tells_of_the_drives_and_of_the_watchman():
    link = Link.local(7, SLOTS)
    number = link.desk.ask(3)
    link.desk.hold(2)
    assert (link.watch.power, link.watch.beats) == (Power.OFF, 0)
    link.watch.power = Power.ON
    link.watch.beat()
    assert (link.watch.power, link.watch.beats) == (Power.ON, 1)
    assert link.desk.pending() == (number, 3)
    assert link.desk.grip == 2
    assert link.events.since(0)[0] == []


# -- the ring of events --------------------------------------------------------------------------------------------


def a_log():
    return EventRing(bytearray(EventRing.SIZE), 0)


def test_events_come_in_order_and_old_ones_are_lost():
    ring = a_log()
    for number in range(1000):
        ring.write({"type": "log", "number": number})
    events, cursor = ring.since(0)
    numbers = [event["number"] for event in events]
    assert numbers == list(range(1000 - len(numbers), 1000))
    assert len(numbers) >= EventRing.SLOTS - 1
    assert ring.since(cursor) == ([], cursor)
    ring.write({"type": "log", "number": 1000})
    assert [event["number"] for event in ring.since(cursor)[0]] == [1000]


@pytest.mark.parametrize("length", [0, 3000, 4030, 4060, 4090, 4100, 100_000])
@pytest.mark.parametrize("letter", ["x", '"', "é", "🤖", "\x00"])
def test_long_texts_are_cut_and_the_next_event_is_whole(length, letter):
    ring = a_log()
    ring.write({"type": "trip", "stamp_ns": 5, "text": letter * length})
    ring.write({"type": "log", "text": "next"})
    (first, second), _ = ring.since(0)
    assert (first["type"], first["stamp_ns"]) == ("trip", 5)
    assert second == {"type": "log", "text": "next"}
    if len(json.dumps({"type": "trip", "stamp_ns": 5, "text": letter * length})) <= EventRing.SLOT - 4:
        assert first["text"] == letter * length
    else:
        assert len(first["text"]) < length


def test_an_event_that_is_too_long_without_its_text_keeps_its_type():
    ring = a_log()
    ring.write({"type": "bus", "stamp_ns": 7, "statistics": ["x" * 10] * 1000})
    assert ring.since(0)[0] == [{"type": "bus", "stamp_ns": 7, "text": "(too long to be kept)"}]


# -- across mappings -----------------------------------------------------------------------------------------------


@pytest.fixture
def link():
    made = Link.create(7, SLOTS)
    yield made
    for fd in made.fds:
        os.close(fd)


def test_a_second_mapping_sees_what_the_first_writes(link):
    mailbox, board = link.fds
    other = Link.attach(mailbox, board, 7, SLOTS)
    write(link.ticks, 0)
    link.events.write({"type": "log", "text": "hello"})
    assert int(other.ticks.latest()["tick"]) == 0
    assert other.events.since(0)[0][0]["text"] == "hello"
    other.mailbox.put(Hold(3, 4, 5))
    assert link.mailbox.take() == Hold(3, 4, 5)
    number = other.desk.ask(2)
    assert link.desk.pending() == (number, 2)
    link.desk.answer(number)
    assert other.desk.answered(number)


def test_a_read_only_mapping_reads_all_and_writes_nothing_but_targets(link):
    mailbox, board = link.fds
    policy = Link.attach(mailbox, board, 7, SLOTS, read_only=True)
    write(link.ticks, 0)
    assert int(policy.ticks.latest()["tick"]) == 0
    policy.mailbox.put(Hold(0, 1, 0))
    assert link.mailbox.take() == Hold(0, 1, 0)
    with pytest.raises(TypeError):
        policy.desk.ask(2)
    with pytest.raises(TypeError):
        policy.desk.answer(1)
    with pytest.raises(TypeError):
        policy.events.write({"type": "trip", "text": "not mine"})
    with pytest.raises((TypeError, ValueError)):
        write(policy.ticks, 1)
    assert not policy.ticks.records.flags.writeable
    assert link.desk.pending() is None
    assert int(link.ticks.latest()["tick"]) == 0


def test_a_read_only_descriptor_cannot_be_mapped_for_writing(link):
    _, board = link.fds
    fd = Board.read_only(board)
    try:
        write(link.ticks, 0)
        assert int(Board.attach(fd, 7, SLOTS).ticks.latest()["tick"]) == 0
        with pytest.raises(PermissionError):
            Link.attach(link.fds[0], fd, 7, SLOTS)
    finally:
        os.close(fd)


def test_the_memory_of_two_links_is_not_the_same(link):
    other = Link.create(7, SLOTS)
    try:
        link.mailbox.put(Hold(0, 1, 0))
        assert other.mailbox.take() is None
    finally:
        for fd in other.fds:
            os.close(fd)


def test_who_holds_the_mailbox_cannot_shrink_it_under_the_loop():
    link = Link.create(7, 200)
    for fd in link.fds:
        for size in (0, 1 << 24):
            with pytest.raises(PermissionError):
                os.ftruncate(fd, size)
    assert link.mailbox.take() is None


@pytest.mark.realtime
@pytest.mark.parametrize("part", ["head", "events", "mailbox", "desk"])
def test_no_process_sees_a_word_on_its_way(part):
    """A store that clears first shows zeros to a neighbour: a ring that begins anew, a request that nobody made."""
    link = Link.create(7, 200)
    pid = os.fork()
    if pid == 0:
        actions = {
            "head": lambda number: link.ticks.publish(number, 0),
            "events": lambda _: link.events.write({"type": "log"}),
            "mailbox": lambda number: link.mailbox.put(Hold(7, number, 7)),
            "desk": lambda _: link.desk.answer(link.desk.ask(3)),
        }
        number = 0
        while os.getppid() != 1:
            number += 1
            actions[part](number)
        os._exit(0)
    try:
        last, changes, deadline = 0, 0, time.monotonic() + 10.0
        while changes < 3_000 and time.monotonic() < deadline:
            match part:
                case "head":
                    value = link.ticks.head
                case "events":
                    value = link.events._head[0]
                case "desk":
                    value, verb = link.desk.pending() or (last, 3)
                    assert verb == 3
                case _:
                    target = link.mailbox.take()
                    assert target is None or (target.epoch, target.deadline_ns) == (7, 7)
                    value = last if target is None else target.seq
            assert value >= last
            changes += value != last
            last = value
        assert changes == 3_000
    finally:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
