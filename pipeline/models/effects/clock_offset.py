"""Clock offset: reported poses are stamped too late or too early.

    reported pose(t) = pose(t - d)

d [s]: above zero a pose is stamped after its moment, by a localization that stamps its results when they are
ready or by a clock ahead of the command's. Below zero it is stamped before its moment: the poses move before
the wheels do, which no physics does, only a clock behind the command's. Encoders or a gyro with stamps of
their own separate it from a delay of the drive; without them d > 0 and such a delay are not distinguishable.

Source: header stamps against log times; measured on the DRIVE recordings.
"""

from pipeline.models.effect import Excitation, Late, Least, Parameter, Plausible, ReportEffect, Spread
from pipeline.models.parameter import LEAST_DELAY_S, Conditions, Level, Meaning
from pipeline.run import RunContext, Velocity


class ClockOffset(ReportEffect):
    """Clock offset: reported poses are stamped too late or too early."""

    id = "clock_offset"
    rank = 40
    parameters = (
        Parameter(
            "d",
            "s",
            (-1.0, 1.0),
            0.0,
            "delay of the stamps of poses",
            -0.15,
            starts=(-0.3, -0.1, 0.1, 0.3),
            step=5e-3,
            least=Least(LEAST_DELAY_S, Least.STAMPS, sampled=1.0),
            plausible=Plausible(-0.8, 0.8, "wider than the clocks of the DRIVE recordings"),
            between_runs=Spread(0.14),
        ),
    )
    needs = (Excitation.CHANGES,)
    late = Late.POSES
    readings = (
        Meaning(Level.VEHICLE, "clock_offset", "a constant latency of the localization"),
        Meaning(Level.TERRAIN, "body_inertia", "inertia of the body on this terrain"),
        Meaning(Level.RUN, "clock_offset", "a clock that was reset"),
    )

    def report(self, velocity: Velocity, context: RunContext) -> Velocity:
        """See the formula above."""
        return velocity

    def delay_s(self) -> float:
        """Delay of the stamps of the reported poses [s]."""
        return self.values["d"]

    def can_show(self, conditions: Conditions) -> bool:
        """With a gyro the encoder delay is estimated, too; driving and turning in one run separate both."""
        return conditions.largest.moves_both_ways or not (conditions.encoders and conditions.gyro)

    def is_degenerate(self, conditions: Conditions) -> bool:
        """Whether a late clock is a drive delay (no encoders) or a body lag (relative to a gyro's clock)."""
        return self.values["d"] > 0.0 and (conditions.gyro or not conditions.encoders)

    def is_equivalent(self, conditions: Conditions) -> bool:
        """An early clock has no equivalent; a late one has, without encoders and gyro."""
        return self.values["d"] >= 0.0 and not (conditions.encoders or conditions.gyro)
