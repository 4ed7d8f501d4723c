"""Effective wheelbase: a car turns less, or more, than its wheelbase and steering angle predict.

The effective length is l_eff = k l. k is a plain number, off one by a few percent where the sheet has the
wrong length, a rear axle steers along or wheels give way sideways. Steer to both sides at several angles.

Source: kinematic bicycle; Gillespie, Fundamentals of Vehicle Dynamics, low-speed turning.
"""

from pipeline.models.families import (
    ACKERMANN,
    Excitation,
    Least,
    Level,
    Meaning,
    Parameter,
    Plausible,
    Quantity,
    declare,
)

EffectiveWheelbase = declare(
    "effective_wheelbase",
    __doc__,
    "w0 = w0 / k",
    Parameter(
        "k",
        "1",
        (0.2, 5.0),
        1.0,
        "effective over nominal wheelbase",
        1.1,
        least=Least(0.01, Least.DATA_SHEET),
        plausible=Plausible(
            0.5, 2.0, "wider than a wheelbase that is given wrongly, and than wheels give way"
        ),
        quantities=(Quantity.WHEELBASE,),
    ),
    rank=30,
    kinds=ACKERMANN,
    needs=(Excitation.STEERING,),
    readings=(
        Meaning(Level.VEHICLE, "geometry", "a wrong wheelbase"),
        Meaning(Level.TERRAIN, "effective_wheelbase", "wheels that give way sideways"),
        Meaning(Level.RUN, "effective_wheelbase", "a change of load, or of the wheels (pressure, wear)"),
    ),
)
