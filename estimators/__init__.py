"""Recursive estimators, filters and smoothers; they work on arrays, not on logs or files."""
