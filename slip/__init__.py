"""slip in Python: runs, diagnoses and models as objects. What `__all__` lists is for everybody."""

from pipeline.api import (
    Check,
    Diagnosis,
    Fit,
    Model,
    Run,
    SlipError,
    analyze,
    check,
    effect,
    effects,
    load,
    load_effects,
    table,
)  # fmt: skip
from pipeline.models import Excitation, Parameter
from pipeline.models.families import check_formula, declare
from pipeline.run import Rolling

__all__ = [
    "Check", "Diagnosis", "Excitation", "Fit", "Model", "Parameter", "Rolling", "Run", "SlipError",
    "analyze", "check", "check_formula", "declare", "effect", "effects", "load", "load_effects", "table",
]  # fmt: skip
