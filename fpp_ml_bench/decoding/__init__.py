"""From fringe frames to depth: phase, fringe order, triangulation, and the checks of the frames."""
