"""What a comparison leaves behind: tables, a page, figures, and the JSON of `slip compare`."""

from collections.abc import Callable, Iterable
from pathlib import Path

import polars as pl

from pipeline.analysis.options import FigureFormat
from pipeline.fleet.measures import compare_orders
from pipeline.fleet.tables import Answer, write_csv, write_latex
from pipeline.report.elements import Picture
from pipeline.store import Store


def write_answer(store: Store, answer: Answer, figures: FigureFormat | None = None) -> dict[str, Path]:
    """Write `datasets.parquet`, `comparisons.parquet`, CSV and LaTeX tables and `comparison.html`.

    Args:
        store: the results.
        answer: as of `compare_results`.
        figures: also write the two figures to `figures/` in this format.

    Returns:
        The files by name.
    """
    from pipeline.report.comparison import list_pictures, render_comparison  # noqa: PLC0415 - heavy
    from pipeline.report.pages import write_page  # noqa: PLC0415 - heavy

    store.write_results_table("datasets", answer.datasets)
    store.write_results_table("comparisons", answer.comparisons)
    written: dict[str, Path] = {}
    for name, frame in (("datasets", answer.datasets), ("comparisons", answer.comparisons)):
        written |= write_tables(store, name, frame, frame.filter(pl.col("input") == answer.input))
    written["comparison.html"] = write_page(store, "comparison.html", render_comparison(answer))
    return written | write_figures(store, lambda: list_pictures(answer), figures)


def write_tables(store: Store, name: str, frame: pl.DataFrame, shown: pl.DataFrame) -> dict[str, Path]:
    """A table as CSV, and the rows that a paper shows as LaTeX; the files by name."""
    texts = {f"{name}.csv": write_csv(frame), f"{name}.tex": write_latex(name, shown)}
    return {file: store.write_results_text(file, text) for file, text in texts.items()}


def write_figures(
    store: Store, draw: Callable[[], Iterable[Picture]], figures: FigureFormat | None
) -> dict[str, Path]:
    """Draw to `figures/` where a format is asked for; the files by name."""
    if figures is None:
        return {}
    from pipeline.report.export import write_pictures  # noqa: PLC0415 - heavy

    return {path.name: path for path in write_pictures(draw(), store.root / "figures", figures)}


def describe_answer(answer: Answer) -> dict[str, object]:
    """The JSON object of `slip compare`."""
    return {
        "input": answer.input,
        "quantity": answer.quantity,
        "datasets": _list_rows(answer.datasets.filter(pl.col("input") == answer.input)),
        "pairs": _list_rows(answer.comparisons.drop("run", "dataset", "vehicle", "terrain")),
        "orders": [
            vars(one) for one in compare_orders(answer.datasets.filter(pl.col("input") == answer.input))
        ],
        "notes": list(answer.notes),
    }


def _list_rows(frame: pl.DataFrame) -> list[dict[str, object]]:
    return frame.with_columns(pl.col(pl.Enum).cast(pl.String)).to_dicts()
