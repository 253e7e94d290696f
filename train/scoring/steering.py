"""A bearing in, the velocities towards it out: one law for policies on the device and planners on the host."""

from __future__ import annotations

from typing import Any

from interactive_nav.robots.spec import TwistMap

TURN_GAIN_PER_S = 4.0
MAX_TURN_RAD_S = 2.0


def velocity_towards(
    twist: TwistMap, bearing_rad: Any, cruise_m_s: float, aligned_rad: float, xp: Any
) -> tuple[Any, Any]:
    """Turns towards a point, and drives the faster the better aligned.

    Args:
        twist: the robot's limits, of its control mode.
        bearing_rad: [...] of the point, 0 ahead, positive to the left.
        cruise_m_s: speed straight ahead.
        aligned_rad: beyond this bearing it turns on the spot.
        xp: `numpy` or `jax.numpy`.

    Returns:
        Linear (m/s) and angular (rad/s) velocity [...].
    """
    most, cruise = min(MAX_TURN_RAD_S, twist.max_angular_rad_s), min(cruise_m_s, twist.max_linear_m_s)
    speed_m_s = xp.where(xp.abs(bearing_rad) < aligned_rad, cruise * xp.cos(bearing_rad), 0.0)
    return speed_m_s, xp.clip(TURN_GAIN_PER_S * bearing_rad, -most, most)
