"""Pages over all runs lead to each other and to what is there."""

import itertools
import math
import re
from pathlib import Path
from types import SimpleNamespace

import polars as pl
from comparison_store import Run, write_run

from pipeline.analysis.analyze import update_datasets
from pipeline.batch.batch_work import Entry, Ledger
from pipeline.datasets.deployments import draw_up_map
from pipeline.datasets.trend import follow_trend
from pipeline.report import lead_to
from pipeline.report.datasets_page import _position_names, write_map, write_trend
from pipeline.store import Store, see_log


def make_results(folder: Path) -> Store:
    store = Store(folder)
    for number in range(4):
        write_run(
            store, Run(name=f"field/run_{number}", dataset="husky_tile", median=1.0 + number, seconds=20.0)
        )
    update_datasets(store)
    return store


def links_of(path: Path) -> list[str]:
    return re.findall(r'href="([^"]+)"', nav_of(path))


def nav_of(path: Path) -> str:
    nav = re.search(r'<nav id="pages"[^>]*>(.*?)</nav>', path.read_text(encoding="utf-8"))
    assert nav is not None
    return nav[1]


def test_every_page_links_those_that_are_there_and_all_that_came_since(tmp_path: Path) -> None:
    store = make_results(tmp_path)
    assert links_of(tmp_path / "index.html") == []
    assert "slip" not in nav_of(tmp_path / "index.html")
    write_map(store, draw_up_map(store))
    assert links_of(tmp_path / "index.html") == ["map.html"]
    assert links_of(tmp_path / "map.html") == ["index.html"]
    write_trend(store, follow_trend(store, ("dataset",)))
    assert links_of(tmp_path / "index.html") == ["trend.html", "map.html"]
    assert links_of(tmp_path / "trend.html") == ["index.html", "map.html"]
    assert links_of(tmp_path / "map.html") == ["index.html", "trend.html"]
    assert store.examine().problems == ()
    for page in ("index.html", "map.html", "trend.html"):
        assert all((tmp_path / link).is_file() for link in links_of(tmp_path / page))
    update_datasets(store)
    assert links_of(tmp_path / "index.html") == ["trend.html", "map.html"]


def test_names_on_the_map_cover_no_mark_and_no_other_name() -> None:
    places = {"ice": (6.0, 3121.0), "sand": (6.67, 3542.0), "snow": (6.1, 3300.0), "grass": (4.9, 612.0)}
    own = pl.DataFrame(
        [(f"warthog_{name}", *place) for name, place in places.items()],
        schema=["dataset", "complexity", "energy"],
        orient="row",
    )
    points = own.select(pl.lit("Someone2024").alias("key"), "complexity", pl.col("energy") * 1.01)
    drawn = SimpleNamespace(own=own, points=points)
    names = _position_names(drawn, (10.0, 100_000.0))  # type: ignore[arg-type]
    assert set(names.filter("own")["name"]) == set(own["dataset"]), "every own dataset has its name"
    assert "Someone2024" in set(names["name"])

    def put(row: dict[str, float]) -> tuple[float, float]:
        return row["complexity"] * 72.0, 520.0 * math.log(row["energy"] / 10.0) / math.log(10_000.0)

    boxes = [(*put(row), 3.0 * len(row["name"]), 6.0) for row in names.iter_rows(named=True)]
    dots = [(*put(row), 5.0, 5.0) for row in own.iter_rows(named=True)]
    for a, b in itertools.combinations([*boxes, *dots], 2):
        apart = abs(a[0] - b[0]) >= a[2] + b[2] or abs(a[1] - b[1]) >= a[3] + b[3]
        assert apart or (a in dots and b in dots), (a, b)


def test_a_page_elsewhere_leads_to_the_catalogue_that_is_there(tmp_path: Path) -> None:
    assert lead_to(tmp_path / "none", tmp_path) == ""
    make_results(tmp_path / "my results")
    address = lead_to(tmp_path / "my results", tmp_path / "plans" / "one")
    assert address == "../../my%20results/index.html"


def test_the_catalogue_leads_to_reports_alone_and_says_why_a_log_has_no_run(tmp_path: Path) -> None:
    log = tmp_path / "broken <b>.mcap"
    log.write_bytes(b"nothing")
    store = make_results(tmp_path / "results")
    sighting = see_log(log)
    Ledger(store).write(
        Entry(log=sighting, fingerprint="", state="failed", reason="no poses", hint="Look at it.")
    )
    update_datasets(store)
    page = (tmp_path / "results" / "index.html").read_text(encoding="utf-8")
    assert "broken &lt;b&gt;.mcap" in page
    assert "no poses" in page
    assert "Look at it." in page
    assert "field/run_0" in page
    assert re.findall(r'href="([^"]+)"', page) == [], "runs without a report lead nowhere"
    log.unlink()
    update_datasets(store)
    assert "no poses" not in (tmp_path / "results" / "index.html").read_text(encoding="utf-8")
