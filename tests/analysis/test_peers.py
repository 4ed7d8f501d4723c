"""Which runs a report sets its own beside."""

import json
from collections.abc import Mapping
from pathlib import Path

from pipeline.analysis.summary import find_peers
from pipeline.store import JSON, Store

OWN: Mapping[str, JSON] = {
    "run": "field/own",
    "dataset": "husky_ice",
    "terrain": "ice",
    "length_scale_m": 1.0,
    "log": {"sha256": "own"},
}


def keep(store: Store, run: str, median: float | None, **more: JSON) -> None:
    by_input = {"command": {"median_modulus": median}, "measured": {"median_modulus": None}}
    summary = {**OWN, "run": run, "by_input": by_input, "log": {"sha256": run}, **more}
    details = {"dataset": summary["dataset"], "log": summary["log"]}
    with store.open_generation(run, "0" * 16) as generation:
        generation.write_text("summary.json", json.dumps(summary))
        generation.commit(details)


def test_peers_are_runs_of_the_dataset_each_recording_once(tmp_path: Path) -> None:
    store = Store(tmp_path)
    assert find_peers(store, OWN) == {}
    keep(store, "field/own", 1.0)
    keep(store, "field/own_again", 1.0, log={"sha256": "own"})
    keep(store, "field/a", 0.4)
    keep(store, "field/a_copy", 0.4, log={"sha256": "field/a"})
    keep(store, "field/b", 0.6)
    keep(store, "field/none", None)
    keep(store, "field/grass", 0.1, dataset="husky_grass")
    keep(store, "field/other_scale", 0.1, length_scale_m=0.5)
    keep(store, "field/wrong", 0.1, findings=[{"severity": "error", "id": "not_moving"}])
    assert find_peers(store, OWN) == {"command": [0.4, 0.6]}


def test_an_unknown_terrain_is_compared_with_nothing(tmp_path: Path) -> None:
    store = Store(tmp_path)
    keep(store, "field/a", 0.4)
    assert find_peers(store, {**OWN, "terrain": "unknown"}) == {}
