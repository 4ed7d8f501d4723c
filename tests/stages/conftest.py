from pathlib import Path

import pytest
from stage_logs import Taken, TakeThrough, record, take

from pipeline.simulate import Scenario


@pytest.fixture(scope="session")
def drive(tmp_path_factory: pytest.TempPathFactory) -> TakeThrough:
    """Simulates a scenario, records it and takes the log through the stages; keeps what was made."""
    folder = tmp_path_factory.mktemp("drives")
    logs: list[tuple[Scenario, Path]] = []
    kept: list[tuple[tuple[object, ...], Taken]] = []

    def run(scenario: Scenario, settings: dict[str, object] | None = None, **options: object) -> Taken:
        log = next((log for known, log in logs if known == scenario), None)
        if log is None:
            log = folder / str(len(logs)) / "run.mcap"
            log.parent.mkdir()
            logs.append((scenario, record(scenario, log)))
        asked = (log, settings, options)
        taken = next((taken for known, taken in kept if known == asked), None)
        if taken is None:
            taken = take(log, settings, **options)  # type: ignore[arg-type]
            kept.append((asked, taken))
        return taken

    return run
