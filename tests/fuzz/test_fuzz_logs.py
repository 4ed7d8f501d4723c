"""A short run of the fuzz target; an hour is `python tests/fuzz/fuzz_logs.py`."""

import random
from pathlib import Path

from fuzz_logs import check_definition, check_log, mutate, write_seeds
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1))
def test_a_damaged_log_never_breaks_the_reader(tmp_path: Path, seed: int) -> None:
    rng = random.Random(seed)  # noqa: S311 - no secret
    path = tmp_path / "case.mcap"
    path.write_bytes(mutate(write_seeds(tmp_path), rng))
    check_log(path)


@given(seed=st.integers(0, 2**32 - 1))
def test_a_damaged_definition_is_parsed_or_refused(seed: int) -> None:
    check_definition(random.Random(seed))  # noqa: S311 - no secret


def test_the_seeds_themselves_are_whole(tmp_path: Path) -> None:
    for content in write_seeds(tmp_path):
        path = tmp_path / "case.mcap"
        path.write_bytes(content)
        check_log(path)
