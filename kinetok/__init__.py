"""kinetok: the motion of physically simulated characters, as tokens."""

__version__ = "0.1.0"
