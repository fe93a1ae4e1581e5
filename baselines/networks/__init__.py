"""The paper's networks, by name: bare torch modules, one representation of depth out for one fringe image in."""
