"""Turn lag: the difference of the wheels follows its command more slowly than their mean.

D = Omega_r - Omega_l, M = (Omega_r + Omega_l) / 2. tau_mean, tau_diff [s]: friction on the ground brakes
turning, so 0.4 and 1.1 to 1.6 s on a Warthog (0.55 on ice), 0.1 and 0.35 s on a Husky. What moves a vehicle
sideways follows like the mean. Change speed and turning separately.

Source: measured on the DRIVE recordings; the powertrain model of DRIVE, Baril et al. 2024, split in two.
"""

from dataclasses import replace

from pipeline.models.effects.drive_lag import are_equal, time_constant, to_one_lag
from pipeline.models.families import SIDES, Excitation, Plausible, Quantity, Spread, declare

_SEEN = Plausible(0.0, 3.0, "wider than the 0.1 to 1.6 s of Husky and Warthog")

TurnLag = declare(
    "turn_lag",
    __doc__,
    ("tau_mean * dM/dt = u - M\ntau_diff * dD/dt = u - D"),
    replace(
        time_constant("tau_mean", "time constant of speed", 0.3, (0.1, 0.4)),
        plausible=_SEEN,
        quantities=(Quantity.SPEED_LAG,),
        between_runs=Spread(0.12),
    ),
    replace(
        time_constant("tau_diff", "time constant of turning", 1.0, (0.3, 1.2)),
        plausible=_SEEN,
        quantities=(Quantity.TURN_LAG,),
        between_runs=Spread(0.24),
    ),
    rank=30,
    kinds=SIDES,
    needs=(Excitation.CHANGES, Excitation.TURNING),
    is_degenerate=are_equal(0.08, 0.02),
    collapse=to_one_lag,
)
