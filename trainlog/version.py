"""The version of trainlog, for whatever writes down what made it."""

__version__ = "0.1.0"
