import pytest

from pipeline.models import catalogue


@pytest.fixture(autouse=True)
def own_effects(monkeypatch: pytest.MonkeyPatch) -> None:
    """What one test loads, another does not know."""
    monkeypatch.setattr(catalogue, "_own", {})
