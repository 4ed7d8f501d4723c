"""Effective track: a skid-steered vehicle turns less than its track width predicts.

The effective width is b_eff = k b. k is a plain number: 1 without skidding, about 1.9 on a Husky, 1.8 on a
Warthog. On mecanum wheels it scales the sum of track width and wheelbase, on omni wheels the diameter of
their circle. Turn both ways.

Source: Mandow et al., IROS 2007; Baril et al., CRV 2020.
"""

from pipeline.models.families import (
    SIDES,
    Excitation,
    Least,
    Level,
    Meaning,
    Parameter,
    Plausible,
    Quantity,
    Spread,
    declare,
)

EffectiveTrack = declare(
    "effective_track",
    __doc__,
    "w0 = w0 / k",
    Parameter(
        "k",
        "1",
        (0.1, 20.0),
        1.0,
        "effective over nominal track",
        1.8,
        least=Least(0.01, Least.DATA_SHEET),
        plausible=Plausible(0.7, 4.0, "wider than the 1.8 and 1.9 of Warthog and Husky"),
        quantities=(Quantity.TRACK,),
        between_runs=Spread(0.023),
    ),
    rank=20,
    kinds=SIDES,
    needs=(Excitation.TURNING,),
    readings=(
        Meaning(Level.VEHICLE, "geometry", "a wrong track width"),
        Meaning(Level.TERRAIN, "effective_track", "skidding"),
        Meaning(Level.RUN, "effective_track", "a change of load, or of the wheels (pressure, wear)"),
    ),
)
