"""A small network that decides what physics can't: fringe order, object mask, and a bounded
correction of the phase."""
