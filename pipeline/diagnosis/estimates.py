"""Numbers of all effects that runs tell of, with their errors: by them runs are set side by side."""

import math
from collections.abc import Iterator, Sequence

from pipeline.core.numbers import NORMAL_95
from pipeline.diagnosis.context import Context
from pipeline.diagnosis.diagnosis import EstimatedNumber, Named
from pipeline.identification.judgement import Judgement
from pipeline.identification.unnamed import estimate_unnamed
from pipeline.models import Effect, Model
from pipeline.models.catalogue import list_effects


def list_estimates(
    context: Context, judgement: Judgement, named: Sequence[Named]
) -> Iterator[EstimatedNumber]:
    """Numbers of one judged model, of the clocks that were put right, and of the effects that it lacks.

    Effects that contain one of the model, or are contained in one, are no rivals beside it and are left out.

    Args:
        context: the runs.
        judgement: a model on them.
        named: what the diagnosis names.
    """
    source, model = judgement.problem.source, judgement.fitted.model
    ids = {effect.id for effect in named}
    known = {effect.id for effect in list_effects()}
    candidates = {e.id: e() for e in (*context.list_candidates(source), *context.list_drivetrain())}
    rivals = [
        effect for effect in candidates.values() if effect.id not in ids and not _overlaps(effect, model)
    ]
    for item in (*judgement.estimates.items, *estimate_unnamed(judgement.fitted, rivals)):
        error, number = item.deviation, item.free
        if (
            number.effect in known
            and number.run is None
            and math.isfinite(item.value + error)
            and error > 0.0
        ):
            yield EstimatedNumber(
                source.value, number.effect, number.name, number.unit, item.value, error,
                named=number.effect in ids, at_bound=item.at_bound,
            )  # fmt: skip
    for effect in named:
        for name, value in effect.parameters.items():
            error = (value.high - value.low) / (2.0 * NORMAL_95)
            if effect.id not in model and effect.corrected and math.isfinite(error) and error > 0.0:
                yield EstimatedNumber(
                    source.value, effect.id, name, value.unit, value.value, error,
                    named=True, at_bound=value.at_bound,
                )  # fmt: skip


def _overlaps(effect: Effect, model: Model) -> bool:
    """Whether an effect is a special case of one of the model, or the other way round."""
    return any(effect.id in one.contains or one.id in effect.contains for one in model)
