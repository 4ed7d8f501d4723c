"""Writing a text in one moment."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.report.errors import ReportError

if TYPE_CHECKING:
    from pathlib import Path


def write_text(path: Path, text: str) -> Path:
    """Write a text file; readers see the old one or the new one.

    Raises:
        ReportError: ``export_not_written``.
    """
    part = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_text(text, encoding="utf-8")
        part.replace(path)
    except OSError as error:
        raise ReportError(
            "export_not_written",
            f"cannot be written: {error.strerror}",
            where=str(path),
            hint="Choose another place with --out.",
        ) from error
    return path
