from pathlib import Path

import pytest
from constants import choose_numbers, compare, replace_number

from pipeline.estimation import decision
from pipeline.run import signals
from pipeline.stages import align, inputs, timing, trust

pytestmark = pytest.mark.long


def test_what_a_number_changes_is_told_in_words() -> None:
    before: dict[str, float | str] = {"a modulus": 1.0, "a pose_jump pose": "found", "a fails": "ValueError"}
    after: dict[str, float | str] = {"a modulus": 1.1, "a bad_stretch pose": "found", "a fails": "ValueError"}
    assert compare(before, after) == ["+ a bad_stretch pose", "a modulus 1 -> 1.1", "- a pose_jump pose"]
    assert compare(before, {**before, "a modulus": 1.0005}) == []


def test_a_shared_number_is_replaced_wherever_it_was_imported_and_put_back() -> None:
    with replace_number("pipeline.run.signals", "STILL_MPS", 2.0):
        assert signals.STILL_MPS == inputs.STILL_MPS == trust.STILL_MPS == pytest.approx(0.04)
    assert signals.STILL_MPS == inputs.STILL_MPS == trust.STILL_MPS == pytest.approx(0.02)


def test_a_private_number_of_another_file_is_another_number() -> None:
    assert align._FEWEST == timing._FEWEST
    with replace_number("pipeline.stages.timing", "_FEWEST", 0.5):
        assert timing._FEWEST == 100
        assert align._FEWEST == 200


def test_without_files_all_rooms_that_decide_answers_are_asked() -> None:
    every = choose_numbers([], [])
    assert ("pipeline.estimation.decision", "EQUAL", 12.0) in every
    assert not any(module.startswith("pipeline.web") for module, _, _ in every)
    (one,) = choose_numbers([Path(decision.__file__)], ["EQUAL"])
    assert one in every
