"""Simulated trips: the plant, its drivers, its sensors, and the scenarios they make.

`trainlog.simulation.scenario` is the way in: ``draw_scenarios`` and ``simulate``.
"""
