"""Ids of several buses side by side: the bits above the 29 of the wire say which bus a frame is on.

So whoever looks at the frames of a whole robot (the guard, the black box) tells two arms apart whose drives have the
same ids; on the first bus, and on a robot with only one, ids are those of the wire.
"""

_SHIFT = 29
_WIRE = (1 << _SHIFT) - 1


def tag(bus: int, arbitration_id: int) -> int:
    """Return the id of a frame of a bus, counted from 0."""
    return bus << _SHIFT | arbitration_id


def untag(tagged: int) -> tuple[int, int]:
    """Return the bus and the id on its wire."""
    return tagged >> _SHIFT, tagged & _WIRE
