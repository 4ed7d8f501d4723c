from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from stage_logs import Taken, TakeThrough, record, take

if TYPE_CHECKING:
    from pipeline.simulate import Scenario


@pytest.fixture
def drive(tmp_path: Path) -> TakeThrough:
    """Simulates a scenario, records it and takes the log through the stages."""

    def run(scenario: Scenario, settings: dict[str, object] | None = None, **options: object) -> Taken:
        return take(record(scenario, tmp_path / "run.mcap"), settings, **options)  # type: ignore[arg-type]

    return run
