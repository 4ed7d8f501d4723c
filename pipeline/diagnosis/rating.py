"""The ladder of what was named, with intervals and the noise floor, on data that no fit has seen."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from pipeline.identification import Input, Problem
from pipeline.identification.judgement import judge_model
from pipeline.models import Model, Timing
from pipeline.models.effect import Late, find_late
from pipeline.runs import HeadingSource

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.diagnosis.ground import Ground
    from pipeline.identification.judgement import Judgement
    from pipeline.models.effect import Effect

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
    clock, skew = find_late(effects, Late.POSES), find_late(effects, Late.HEADING)
    # A skew of the reported heading shows against the reported heading only.
    heading = HeadingSource.POSE if skew is not None else HeadingSource.AUTO
    if clock is not None:
        timing = [replace(one, pose_delay_s=0.0) for one in timing]
    elif skew is not None and ground.has_gyro:
        # The delay against the gyro is the heading's: the position is younger by the skew.
        timing = [replace(one, pose_delay_s=one.pose_delay_s - skew.delay) for one in timing]
    problem = Problem(ground.runs, ground.vehicle, source, heading=heading, timing=timing, rate_hz=_RATE_HZ)
    return judge_model(problem, Model(ground.vehicle, tuple(effects)))
