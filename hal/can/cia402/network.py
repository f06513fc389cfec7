"""The `canopen` package on top of our transport: its SDO client, PDO maps and NMT, without its threads.

Everything that it sends goes through `Transport.send`, so that sends are bounded and inspected; it is fed by the
transport's routes. Its SDO client waits on a queue that another thread fills: here the queue itself drains the
transport. While anything waits, the host's heartbeat goes on.
"""

import logging
import queue
import struct
from collections import deque
from collections.abc import Callable, Collection

from canopen import Network, RemoteNode

from robotctl.hal.can.cia402.codec import HOST_ID, NMT_ID, SYNC_ID, Nmt, Service, encode_heartbeat
from robotctl.hal.can.cia402.objects import ERROR_REGISTER, dictionary
from robotctl.hal.can.transport import Transport
from robotctl.hal.clock import Clock

HEARTBEAT_NS = 20_000_000
"""Between two heartbeats of the host: a fifth of the longest consumer time allowed."""

REPLY_TIMEOUT_S = 0.05
TRIES = 5
"""SDO requests before a drive counts as silent."""

# Aborted transfers are raised as well, and without a handler of ours the log would reach the terminal.
logging.getLogger("canopen").addHandler(logging.NullHandler())

_QUESTION = struct.pack("<BHB4x", 0x40, ERROR_REGISTER.index, ERROR_REGISTER.sub)
"""CiA 301, SDO: initiate upload."""
_BEAT = (Service.HEARTBEAT + HOST_ID, encode_heartbeat(Nmt.OPERATIONAL))


class HostNetwork(Network):
    """canopen's network on a transport, and the host's heartbeat."""

    def __init__(self, transport: Transport, clock: Clock, *, beats: bool = True) -> None:
        """Take a transport; without `beats` no heartbeat goes out, so that no drive begins to wait for the next."""
        super().__init__()
        self.transport = transport
        self._clock = clock
        self._beats = beats
        self._beat_ns = clock.now_ns() - HEARTBEAT_NS
        self._inboxes: dict[int, Inbox] = {}

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """Send a frame through the transport; one that does not leave is one that is not answered."""
        self.transport.send(can_id, bytes(data))

    def attach(self, node_id: int) -> RemoteNode:
        """Return the node with this id, its SDO replies routed to it. Sends nothing."""
        node = self.add_node(RemoteNode(node_id, dictionary()))
        node.sdo.responses = self._inboxes[node_id] = Inbox(self.wait)
        node.sdo.MAX_RETRIES = TRIES
        node.sdo.RESPONSE_TIMEOUT = REPLY_TIMEOUT_S
        reply_id = Service.SDO_REPLY + node_id

        def take(data: bytearray, stamp_ns: int) -> bool:
            if len(data) != 8:
                return False
            self.notify(reply_id, data, stamp_ns * 1e-9)
            return True

        self.transport.by_id[reply_id] = take
        return node

    def prove_empty(self, node_id: int, commands: Collection[int]) -> None:
        """As `Transport.prove_empty`, by asking a node for its error register, which nobody else does.

        Waits for the answer, which would else be taken for that to the next request.
        """
        inbox = self._inboxes[node_id]
        inbox.empty()
        if self.transport.prove_empty((Service.SDO + node_id, _QUESTION), {NMT_ID, SYNC_ID, *commands}):
            self.wait(lambda: inbox.is_filled, REPLY_TIMEOUT_S)

    def beat(self) -> list[tuple[int, bytes]]:
        """Return the heartbeat if it is due, as a frame to send at once."""
        now = self._clock.now_ns()
        if not self._beats or now - self._beat_ns < HEARTBEAT_NS:
            return []
        self._beat_ns = now
        return [_BEAT]

    def wait(self, done: Callable[[], bool], timeout_s: float) -> bool:
        """As `Transport.wait`, with the heartbeat going on meanwhile."""
        deadline = self._clock.now_ns() + round(timeout_s * 1e9)
        while True:
            for can_id, data in self.beat():
                self.transport.send(can_id, data)
            left = deadline - self._clock.now_ns()
            if self.transport.wait(done, max(min(left, HEARTBEAT_NS), 0) * 1e-9):
                return True
            if left <= HEARTBEAT_NS:
                return False


class Inbox:
    """Stands in for the queue of canopen's SDO client."""

    def __init__(self, wait: Callable[[Callable[[], bool], float], bool]) -> None:
        self._wait = wait
        self._frames: deque[bytes] = deque()

    def put(self, frame: bytes) -> None:
        self._frames.append(frame)

    def empty(self) -> bool:
        """Return True; what came too late for an earlier request is forgotten, since nobody asks but before a new one.

        On False the client would put a queue of its own in this one's place.
        """
        self._frames.clear()
        return True

    @property
    def is_filled(self) -> bool:
        """Whether an answer has come that nobody has taken."""
        return bool(self._frames)

    def get(self, block: bool = True, timeout: float | None = None) -> bytes:
        """Return the next frame.

        Raises:
            queue.Empty: if none comes in time.
        """
        if not self._wait(lambda: self.is_filled, timeout or 0.0):
            raise queue.Empty
        return self._frames.popleft()
