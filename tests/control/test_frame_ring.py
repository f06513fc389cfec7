"""The ring of raw frames: bounded, in order, and readable while it is written to."""

import os

import can
import pytest

from robotctl.control.frame_replay import Frame, frames_of
from robotctl.control.frame_ring import FRAME_DTYPE, Flag, FrameRing


def received(arbitration_id, data, **flags):
    return can.Message(arbitration_id=arbitration_id, data=data, is_extended_id=flags.pop("extended", False), **flags)


def test_what_goes_in_comes_out():
    ring = FrameRing.local(100)
    ring.sent([(1, b"12345678"), (2, b"123")], False, 10)
    ring.mark(11)
    ring.received(received(0x11, b"abcdefgh", is_fd=True), 12)
    ring.received(received(0x1FFFFFFF, b"", extended=True), 13)
    ring.received(received(0x20, bytes(8), is_error_frame=True), 14)
    assert list(frames_of(ring.snapshot())) == [
        Frame(10, 1, b"12345678", Flag.SENT),
        Frame(10, 2, b"123", Flag.SENT),
        Frame(11, 0, b"", Flag.MARK),
        Frame(12, 0x11, b"abcdefgh", Flag.FD),
        Frame(13, 0x1FFFFFFF, b"", Flag.EXTENDED),
        Frame(14, 0x20, bytes(8), Flag.ERROR),
    ]


@pytest.mark.parametrize("length", [0, 16, 20, 64])
def test_long_frames_take_more_slots(length):
    ring = FrameRing.local(100)
    data = bytes(range(length))
    ring.received(received(5, data, is_fd=True), 1)
    ring.mark(2)
    assert next(frames_of(ring.snapshot())).data == data
    assert ring.head == 1 + max(1, -(-length // 16))


def test_a_full_ring_remembers_the_latest():
    ring = FrameRing.local(100)
    for number in range(250):
        ring.mark(number)
    # The oldest ones are left out: the writer may be on them.
    assert [frame.stamp_ns for frame in frames_of(ring.snapshot())] == list(range(214, 250))


def test_the_rest_of_a_frame_whose_begin_is_gone_is_left_out():
    ring = FrameRing.local(130)
    ring.received(received(5, bytes(64), is_fd=True), 1)
    for number in range(2, 66):
        ring.mark(number)
    kept = ring.snapshot()
    assert kept["flags"][0] & Flag.MORE
    assert [frame.stamp_ns for frame in frames_of(kept)] == list(range(2, 66))


def test_another_process_sees_the_same_memory_and_it_cannot_be_cut_short():
    ring = FrameRing.create(100)
    other = FrameRing.attach(ring.fd, 100)
    ring.describe({"protocol": "damiao"})
    ring.mark(7)
    assert other.description == {"protocol": "damiao"}
    assert other.snapshot()["stamp_ns"].tolist() == [7]
    with pytest.raises(PermissionError):
        os.ftruncate(ring.fd, 100)
    os.close(ring.fd)


def test_a_slot_has_32_bytes():
    assert FRAME_DTYPE.itemsize == 32
