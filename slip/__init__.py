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
    load,
    load_effects,
    table,
)  # fmt: skip

__all__ = [
    "Check", "Diagnosis", "Fit", "Model", "Run", "SlipError", "analyze", "check", "effect", "load",
    "load_effects", "table",
]  # fmt: skip
