"""How frames tell a projector coordinate: the coding schemes, wrapped phase, and Gray code."""
