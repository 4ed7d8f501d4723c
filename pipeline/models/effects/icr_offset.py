"""ICR offset: the vehicle turns about a point ahead of or behind its reference point.

v_w is the yaw rate of the model. x_icr [m], -0.08 to 0.24, positive ahead; a load at the back moves it
back. A car turns about its rear axle, to -1.35 behind a base_link in its middle. Spin on the spot and drive
curves.

Source: Mandow et al., IROS 2007, the longitudinal coordinate of the instantaneous centres of rotation.
"""

from pipeline.models.families import Effect, Excitation, Least, Parameter, Place, Plausible, Spread, declare
from pipeline.sources import Vehicle


def _is_outside(effect: Effect, vehicle: Vehicle) -> bool:
    """Whether the centre is outside of the axles for any base_link between them: a sensor position."""
    size = vehicle.wheelbase_m or vehicle.track_width_m
    return size is not None and abs(effect.values["x_icr"]) > size


IcrOffset = declare(
    "icr_offset",
    __doc__,
    "v_y += -x_icr * v_w",
    Parameter(
        "x_icr",
        "m",
        (-10.0, 10.0),
        0.0,
        "centre of rotation ahead of base_link",
        0.12,
        least=Least(0.004, Least.MOUNTING),
        plausible=Plausible(
            -1.6,
            1.6,
            "the middle of a sedan is 1.35 m ahead of its rear axle, a mast may stand as far behind",
        ),
        between_runs=Spread(0.013),
    ),
    needs=(Excitation.TURNING,),
    place=Place.CENTRE,
    is_outside=_is_outside,
)
