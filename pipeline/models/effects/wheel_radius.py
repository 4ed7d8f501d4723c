"""Wheel radius: all wheels are larger or smaller than nominal, or slip in proportion to their speed.

k is a plain number, off one by 2 to 25 %. Drive at several speeds, straight and turning.

Source: Borenstein and Feng, IEEE T-RA 1996 (UMBmark), the common scale error.
"""

from pipeline.models.families import (
    Excitation,
    Least,
    Level,
    Meaning,
    Parameter,
    Plausible,
    Quantity,
    Spread,
    declare,
    has_speed,
)

WheelRadius = declare(
    "wheel_radius",
    __doc__,
    ("v0 = k * v0\ns0 = k * s0\nw0 = k * w0"),
    Parameter(
        "k",
        "1",
        (0.0, 5.0),
        1.0,
        "true over nominal radius",
        0.92,
        least=Least(0.004, Least.DATA_SHEET),
        plausible=Plausible(
            0.2, 1.3, "radii are off by 2 to 25 %, wheels slip by half or more on soft ground"
        ),
        # On slippery floors wheels spin nearly on the spot; they never fall far behind the vehicle.
        physical=(0.0, 1.3),
        quantities=(Quantity.RADIUS,),
        between_runs=Spread(0.019),
    ),
    scale_role="radius",
    rank=30,
    needs=(Excitation.SPEED_SPREAD,),
    can_show=has_speed,
    readings=(
        Meaning(Level.VEHICLE, "wheel_radius", "a wrong wheel radius"),
        Meaning(Level.TERRAIN, "longitudinal_slip", "longitudinal slip"),
        Meaning(Level.RUN, "wheel_radius", "a change of load, or of the wheels (pressure, wear)"),
    ),
)
