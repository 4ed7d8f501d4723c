"""Lateral skid: in a turn the vehicle slides outward.

c [s] grows with speed and falls with grip: 0.02 on tile, 0.15 on ice. A vehicle that drives sideways at s0
slides outward along x as well, by c s0 w0. Drive turns of both signs at several speeds, forward and
backward, to tell it from a shifted centre of rotation.

Source: Seegmiller and Kelly, RSS 2014, the centripetal term of the slip model.
"""

from pipeline.models.families import LEAST_DELAY_S, Excitation, Least, Parameter, Plausible, Spread, declare

LateralSkid = declare(
    "lateral_skid",
    __doc__,
    ("v_x += c * s0 * w0\nv_y += -c * v0 * w0"),
    Parameter(
        "c",
        "s",
        (-0.5, 0.5),
        0.0,
        "outward slip per centripetal acceleration",
        0.1,
        least=Least(LEAST_DELAY_S, Least.STAMPS),
        plausible=Plausible(-0.02, 0.4, "wider than 0.02 on tile and 0.15 on ice"),
        one_sign=True,
        between_runs=Spread(0.064),
    ),
    needs=(Excitation.TURNING, Excitation.SPEED_SPREAD),
)
