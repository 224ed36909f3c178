"""Record train trips in a standard log, learn from them, and plan robust trajectories."""

__version__ = "0.1.0"
