"""Where the numbers came from: the log, the program, the configuration."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING

from pipeline.report.run import mapping_in

if TYPE_CHECKING:
    from pipeline.report.sections import Page


def view_provenance(page: Page) -> dict[str, object]:
    """Path and hash of the log, keys and versions, the configuration as it was used."""
    report = page.report
    log, origin = report.part("log"), report.part("provenance")
    rate = report.number("rate_hz")
    facts = [
        ("log", log.get("path")),
        ("SHA-256", log.get("sha256")),
        ("dataset", report.text("dataset")),
        ("rate", f"{rate:g} Hz" if rate is not None else ""),
    ]
    facts += [
        (name, ", ".join(f"{key} {value}" for key, value in mapping_in(origin, name).items()))
        for name in ("versions", "keys")
    ]
    configuration = origin.get("configuration")
    if isinstance(configuration, Mapping):
        configuration = configuration and json.dumps(
            configuration, indent=2, sort_keys=True, ensure_ascii=False, default=str
        )
    return {"facts": [fact for fact in facts if fact[1]], "configuration": configuration}
