"""Sliding-mode control of a train along a speed-position profile; paper 004, section 4."""

from __future__ import annotations

from dataclasses import dataclass

from trainlog.errors import InputError


@dataclass(frozen=True, slots=True)
class Target:
    """Where the train ought to be: position [m], speed [m/s] and acceleration [m/s²]."""

    position: float
    speed: float
    acceleration: float


@dataclass(frozen=True, slots=True)
class SlidingModeController:
    """Control law (34): the estimated resistance is fed forward, the rest is drawn to s = 0.

    Attributes
    ----------
    mass : float [kg]
        That the controller believes.
    convergence : float [1/s]
        lambda of eq. (27): on the sliding surface a position error decays at this rate.
    switching_effort : float [N]
        rho of eq. (32).
    boundary_layer : float [m/s]
        delta of eq. (33): within it the switching is linear, so that it does not chatter.
    effort_limit : float [N]
        The effort is kept between minus and plus this.
    """

    mass: float
    convergence: float = 0.5
    switching_effort: float = 180e3
    boundary_layer: float = 5.0
    effort_limit: float = 250e3

    def __post_init__(self) -> None:
        for name in ("mass", "convergence", "boundary_layer", "effort_limit"):
            if not getattr(self, name) > 0.0:
                raise InputError(
                    f"sliding-mode controller: {name} {getattr(self, name)} is not positive"
                )
        if not self.switching_effort >= 0.0:
            raise InputError("sliding-mode controller: switching_effort is negative")

    def effort(self, position: float, speed: float, target: Target, resistance: float) -> float:
        """The effort [N], positive traction and negative braking.

        Parameters
        ----------
        position, speed : float [m], [m/s]
            As measured.
        target : Target
        resistance : float [N]
            Running resistance and additional resistance together, as estimated.
        """
        error = position - target.position  # (26)
        error_rate = speed - target.speed
        surface = error_rate + self.convergence * error  # (27)
        switching = max(-1.0, min(1.0, surface / self.boundary_layer))  # (33)
        wanted = (
            self.mass * (target.acceleration - self.convergence * error_rate)  # (30)
            + resistance
            - self.switching_effort * switching  # (32)
        )
        return max(-self.effort_limit, min(self.effort_limit, wanted))
