"""Recordings that are being watched, for the page that shows them."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from pipeline.job.live_statement import read_statements

if TYPE_CHECKING:
    from pipeline.store import Store


def list_watched(store: Store) -> dict[str, object]:
    """What `slip watch` says of the recordings that it follows, and how long ago it said so [s]."""
    now = time.time()
    return {
        "watched": [
            {"log": said.log, "rows": said.rows, "ended": said.ended, "age_s": max(now - said.time, 0.0)}
            for said in read_statements(store)
        ]
    }
