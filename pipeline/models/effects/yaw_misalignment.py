"""Yaw misalignment: the reported heading is off by a constant angle, or the vehicle crabs on a bent axle.

The reported yaw is yaw + psi. psi [rad], 1 to 5 degrees; nearly v_y = -psi v_x. Drive straight forward and
backward; check the mounting of the sensor.

Source: rotation of the reported frame; a crabbing vehicle moves alike.
"""

from pipeline.models.families import Excitation, Least, Level, Meaning, Parameter, Plausible, declare

YawMisalignment = declare(
    "yaw_misalignment",
    __doc__,
    ("v_x = cos(psi) * v_x + sin(psi) * v_y\nv_y = cos(psi) * v_y - sin(psi) * v_x"),
    Parameter(
        "psi",
        "rad",
        (-1.5, 1.5),
        0.0,
        "reported minus true heading",
        0.05,
        least=Least(0.003, Least.MOUNTING),
        plausible=Plausible(-0.35, 0.35, "wider than the 1 to 5 degrees that were seen"),
    ),
    rank=20,
    needs=(Excitation.BOTH_SIGNS,),
    readings=(
        Meaning(Level.VEHICLE, "yaw_misalignment", "a misaligned sensor or a bent axle"),
        Meaning(Level.TERRAIN, "crabbing", "crabbing on this terrain"),
        Meaning(Level.RUN, "yaw_misalignment", "a remounted sensor"),
    ),
)
