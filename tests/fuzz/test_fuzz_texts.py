"""A short run of the fuzz target; an hour is `python tests/fuzz/fuzz_texts.py`."""

import random
from pathlib import Path

import pytest
from fuzz_texts import (
    CONFIGURATION,
    FORMULAS,
    check_configuration,
    check_formula,
    check_model,
    mutate,
    write_models,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

MODELS = write_models()


@pytest.mark.long
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1))
def test_a_damaged_text_is_read_or_refused_in_one_line(tmp_path: Path, seed: int) -> None:
    rng = random.Random(seed)  # noqa: S311 - no secret
    check_model(mutate(MODELS, rng))
    check_configuration(mutate((CONFIGURATION,), rng), tmp_path)
    check_formula(mutate(FORMULAS, rng), rng)


def test_the_seeds_themselves_are_whole(tmp_path: Path) -> None:
    rng = random.Random(1)  # noqa: S311 - no secret
    for text in MODELS:
        check_model(text)
    check_configuration(CONFIGURATION, tmp_path)
    for text in FORMULAS:
        check_formula(text, rng)
