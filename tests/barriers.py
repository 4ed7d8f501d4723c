"""Barriers on a page, as axe finds them: missing labels, contrast that is too low, what keys cannot reach."""

from __future__ import annotations

import json
from importlib.resources import files
from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from chrome import Chrome

GRAVE = ("serious", "critical")


def find_barriers(chrome: Chrome) -> list[str]:
    """What axe calls serious or critical on the page as it stands: its rule, the element and why."""
    chrome.run(files("axe_core_python").joinpath("axe.min.js").read_text(encoding="utf-8") + ";0")
    found = cast("str", chrome.run("axe.run(document).then((found) => JSON.stringify(found.violations))"))
    return [
        f"{rule['id']}: {node['html'][:160]} {node['failureSummary']}"
        for rule in json.loads(found)
        if rule["impact"] in GRAVE
        for node in rule["nodes"]
    ]
