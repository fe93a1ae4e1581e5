"""One examination of a capture, for decode, import and calibrate: what its frames say about
themselves, as findings."""
