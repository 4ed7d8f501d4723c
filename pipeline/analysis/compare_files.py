"""What a comparison leaves behind: tables, a page, figures, and the JSON of `slip compare`."""

from pathlib import Path

import polars as pl

from pipeline.analysis.options import FigureFormat
from pipeline.fleet.measures import compare_orders
from pipeline.fleet.tables import Answer, write_csv, write_latex
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
    written = {}
    for name, frame in (("datasets", answer.datasets), ("comparisons", answer.comparisons)):
        written[f"{name}.csv"] = store.write_results_text(f"{name}.csv", write_csv(frame))
        shown = frame.filter(pl.col("input") == answer.input)
        written[f"{name}.tex"] = store.write_results_text(f"{name}.tex", write_latex(name, shown))
    written["comparison.html"] = write_page(store, "comparison.html", render_comparison(answer))
    if figures:
        from pipeline.report.export import write_pictures  # noqa: PLC0415 - heavy

        pictures = list_pictures(answer)
        written |= {path.name: path for path in write_pictures(pictures, store.root / "figures", figures)}
    return written


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
