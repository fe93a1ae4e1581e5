"""FPP-C: what breaks a method, axis by axis. Scenes are disturbed in the image formation, and the answers scored, with
a fixed charge for silence."""
