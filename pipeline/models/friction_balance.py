"""Formulas of the velocities at which the friction of four wheels is in balance.

Four wheels carry the same load. Each slides, and friction of the same size at every wheel points against its
slip; rolling resistance, a share of it, points against the travel of its side. With the forces and their
moment in balance the slip of the wheels of one side is fixed in direction, whatever the speed: with
``g = wheelbase / track`` and ``rolling`` the share,

    sin(delta) = rolling sqrt(1 + g^2),  tan(sigma) = g       both sides travel the same way
    slip of the inner and outer wheels at sigma - delta and sigma + delta to the axle
    sin(epsilon) = rolling / sqrt(1 + g^2)                     the sides travel opposite ways
    slip of all wheels at sigma + epsilon to the axle

from which the yaw rate is that of a wider track, and the sides' mean is slowed in proportion to the yaw rate.
Without rolling resistance the track is wider by 1 + g^2 for every motion.
"""

from typing import Final

_SQUARE: Final = "(wheelbase / track)^2"
_FREE: Final = f"(1 + {_SQUARE})"
"""By how much the track is wider without rolling resistance."""

_LEFT_OVER: Final = f"max(1 - (rolling * {_FREE})^2, 0.01)"
"""Of the friction, squared, what rolling resistance leaves for turning; with none left nothing would turn."""

_WIDER_AHEAD: Final = f"(1 + {_SQUARE} / {_LEFT_OVER})"
_TANGENT: Final = f"rolling / sqrt({_FREE} - rolling^2)"
_WIDER_ON_THE_SPOT: Final = (
    f"(1 + wheelbase / track * (wheelbase / track + {_TANGENT})"
    f" / max(1 - wheelbase / track * {_TANGENT}, 0.1))"
)
_AHEAD: Final = "0.5 * (1 + sign(abs(f_x) - 0.5 * track * abs(f_w)))"
"""One where both sides travel the same way, zero where they travel opposite ways."""

FRICTION_TERMS: Final = {
    "v_x": (
        f"-sign(f_x) * {_AHEAD} * abs(f_w) / {_WIDER_AHEAD} * 0.5 * wheelbase * rolling * {_FREE}^1.5"
        f" * sqrt(max(1 - rolling^2 * {_FREE}, 0)) / {_LEFT_OVER}"
    ),
    "v_w": f"f_w * ({_AHEAD} / {_WIDER_AHEAD} + (1 - {_AHEAD}) / {_WIDER_ON_THE_SPOT} - 1)",
}
"""What is added to the ideal velocity, by channel."""
