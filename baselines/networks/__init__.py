"""The paper's networks, by name: bare torch modules, one representation of depth out for one fringe
image in. Importing this package does not import torch; `build` and `discriminator` do."""
