"""The ladder of what was named, with intervals and the noise floor, on data that no fit has seen."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from pipeline.motion import HeadingSource, Input, Model, Problem, Timing
from pipeline.motion.workshop import judge_model

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.diagnosis.ground import Ground
    from pipeline.motion.effect import Effect
    from pipeline.motion.workshop import Judgement

_RATE_HZ = 50.0


def rate_effects(
    ground: Ground, source: Input, effects: Sequence[Effect], timing: Sequence[Timing]
) -> Judgement:
    """Judge a model of these effects.

    Args:
        ground: the runs.
        source: the input.
        effects: with their values to start from.
        timing: delays of each run that are no effect.
    """
    known = {effect.id: effect for effect in effects}
    # A skew of the reported heading shows against the reported heading only.
    heading = HeadingSource.POSE if "heading_skew" in known else HeadingSource.AUTO
    if "clock_offset" in known:
        timing = [replace(one, pose_delay_s=0.0) for one in timing]
    elif "heading_skew" in known and ground.has_gyro:
        # The delay against the gyro is the heading's: the position is younger by the skew.
        skew = known["heading_skew"].values["d"]
        timing = [replace(one, pose_delay_s=one.pose_delay_s - skew) for one in timing]
    problem = Problem(ground.runs, ground.vehicle, source, heading=heading, timing=timing, rate_hz=_RATE_HZ)
    return judge_model(problem, Model(ground.vehicle, tuple(effects)))
