"""The adapter's protocol, without a terminal."""

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robotctl.sim.motors.slcan import SlcanAdapter


@pytest.fixture
def adapter() -> SlcanAdapter:
    return SlcanAdapter()


def opened(*settings: bytes) -> SlcanAdapter:
    adapter = SlcanAdapter()
    for command in (*settings, b"O"):
        assert adapter.feed(command + b"\r") == (b"\r", [])
    return adapter


def test_life_of_a_channel(adapter: SlcanAdapter) -> None:
    for command, answer in [
        (b"\r\r\r", b"\r\r\r"),
        (b"C\r", b"\a"),
        (b"F\r", b"\a"),
        (b"t0010\r", b"\a"),
        (b"S8\r", b"\r"),
        (b"S9\r", b"\a"),
        (b"Sx\r", b"\a"),
        (b"O\r", b"\r"),
        (b"O\r", b"\a"),
        (b"S6\r", b"\a"),
        (b"F\r", b"F00\r"),
        (b"t0010\r", b"z\r"),
        (b"C\r", b"\r"),
        (b"L\r", b"\r"),
        (b"t0010\r", b"\a"),
        (b"V\r", b"V1013\r"),
        (b"N\r", b"NROBO\r"),
        (b"?\r", b"\a"),
    ]:
        assert adapter.feed(command)[0] == answer, command


@pytest.mark.parametrize(
    ("line", "answer", "expected"),
    [
        (b"t7FF80100330900000000", b"z\r", (0x7FF, False, False, bytes.fromhex("0100330900000000"))),
        (b"T1FFFFFFF2ABcd", b"Z\r", (0x1FFFFFFF, True, False, b"\xab\xcd")),
        (b"r0013", b"z\r", (1, False, True, b"")),
        (b"R000000010", b"Z\r", (1, True, True, b"")),
    ],
)
def test_frames_from_the_host(line: bytes, answer: bytes, expected: tuple) -> None:
    got, frames = opened().feed(line + b"\r")
    assert got == answer
    (frame,) = frames
    assert (frame.arbitration_id, frame.is_extended_id, frame.is_remote_frame, bytes(frame.data)) == expected


@pytest.mark.parametrize(
    "line",
    [
        b"t",
        b"t80010",
        b"t001",
        b"t0019" + b"00" * 9,
        b"t001200",
        b"t0011zz",
        b"t001100FF",
        b"T200000000",
        b"d0010",
        b"tXYZ0",
    ],
)
def test_frames_that_are_refused(line: bytes) -> None:
    assert opened().feed(line + b"\r") == (b"\a", [])


def test_frames_in_pieces() -> None:
    adapter = opened()
    assert adapter.feed(b"t0012") == (b"", [])
    answer, frames = adapter.feed(b"AABB\rt0020\r")
    assert answer == b"z\rz\r"
    assert [frame.arbitration_id for frame in frames] == [1, 2]


def test_a_line_without_end_is_dropped() -> None:
    adapter = opened()
    answer, frames = adapter.feed(b"t" * 1000)
    assert set(answer) == {ord("\a")}
    assert frames == []
    # What is left of it spoils one more line at most.
    adapter.feed(b"\r")
    assert adapter.feed(b"t0010\r")[0] == b"z\r"


def test_frames_to_the_host() -> None:
    adapter = opened()
    assert adapter.encode(can.Message(arbitration_id=0x11, is_extended_id=False, data=b"\x01\xab")) == b"t011201AB\r"
    assert adapter.encode(can.Message(arbitration_id=0x11, data=b"")) == b"T000000110\r"
    assert (
        adapter.encode(can.Message(arbitration_id=1, is_extended_id=False, is_remote_frame=True, dlc=3)) == b"r0013\r"
    )
    # CAN FD does not pass a classic adapter.
    assert adapter.encode(can.Message(arbitration_id=1, is_extended_id=False, is_fd=True)) == b""
    assert SlcanAdapter().encode(can.Message(arbitration_id=1, is_extended_id=False)) == b""


def test_fd() -> None:
    adapter = opened(b"S8", b"Y5")
    message = can.Message(
        arbitration_id=1, is_extended_id=False, is_fd=True, bitrate_switch=True, data=bytes(12), dlc=12
    )
    line = adapter.encode(message)
    assert line == b"b0019" + b"00" * 12 + b"\r"
    ((frame,)) = adapter.feed(line)[1]
    assert (frame.is_fd, frame.bitrate_switch, frame.dlc, len(frame.data)) == (True, True, 12, 12)
    assert adapter.feed(b"d0011AA\r")[1][0].bitrate_switch is False


def test_time_stamps() -> None:
    adapter = opened(b"Z1")
    message = can.Message(timestamp=60.258, arbitration_id=1, is_extended_id=False)
    assert adapter.encode(message) == b"t00100102\r"


@pytest.mark.parametrize(("setting", "hears"), [(b"S8", True), (b"S6", False), (b"s0014", True), (b"s031C", False)])
def test_another_bit_rate_is_silence(setting: bytes, hears: bool) -> None:
    adapter = opened(setting)
    answer, frames = adapter.feed(b"t0010\r")
    assert answer == b"z\r"
    assert bool(frames) is hears
    assert bool(adapter.encode(can.Message(arbitration_id=1, is_extended_id=False))) is hears


def test_reset_closes() -> None:
    adapter = opened()
    adapter.feed(b"t00")
    adapter.reset()
    assert adapter.feed(b"O\r")[0] == b"\r"


@given(st.lists(st.binary(max_size=200) | st.sampled_from([b"O\r", b"C\r", b"S8\rY5\rO\r", b"t", b"b001F", b"\r"])))
def test_no_bytes_break_it(chunks: list[bytes]) -> None:
    adapter = SlcanAdapter()
    for chunk in chunks:
        _, frames = adapter.feed(chunk)
        for frame in frames:
            adapter.encode(frame)


@given(st.integers(0, 0x7FF), st.binary(max_size=8))
def test_round_trip(identifier: int, data: bytes) -> None:
    adapter = opened()
    line = adapter.encode(can.Message(arbitration_id=identifier, is_extended_id=False, data=data))
    answer, (frame,) = adapter.feed(line)
    assert answer == b"z\r"
    assert (frame.arbitration_id, bytes(frame.data)) == (identifier, data)
