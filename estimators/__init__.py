"""Recursive estimators: one sample in, one estimate out; they know arrays, not logs or files."""
