"""Transport delay: the wheels follow their command after a dead time.

d [s], 0.05 to 0.4: network, controller period, drive. Change commands often; ramps alone show only the sum
of delay and lag.

Source: dead time of a first order plus dead time process; Astrom and Hagglund, Advanced PID Control.
"""

from pipeline.models.families import (
    LEAST_DELAY_S,
    WARTHOG_LAGS,
    Conditions,
    Effect,
    Excitation,
    Late,
    Least,
    Parameter,
    Plausible,
    Quantity,
    Spread,
    declare,
)


def _has_one_clock(effect: Effect, conditions: Conditions) -> bool:
    """Whether there is no other clock: neither encoders nor a gyro."""
    return not (conditions.encoders or conditions.gyro)


TransportDelay = declare(
    "transport_delay",
    __doc__,
    "Omega(t) = u(t - d)",
    Parameter(
        "d",
        "s",
        (0.0, 1.0),
        0.0,
        "dead time from command to wheels",
        0.2,
        starts=(0.05, 0.15, 0.3, 0.5),
        step=5e-3,
        least=Least(LEAST_DELAY_S, Least.STAMPS, sampled=1.0),
        plausible=Plausible(0.0, 0.8, "wider than the 0.5 s after which a ros2_control drive stops"),
        between_runs=Spread(0.06, WARTHOG_LAGS),
        quantities=(Quantity.COMMAND_DELAY,),
    ),
    rank=40,
    late=Late.COMMANDS,
    needs=(Excitation.CHANGES,),
    is_equivalent=_has_one_clock,
)
