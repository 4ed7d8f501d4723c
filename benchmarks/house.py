"""The files of the program: counts for people, and what `make check` refuses.

Refused are circles of imports between files, two files of one name, and files of more than `MOST_LINES`.
Imports inside functions count, since they only put a circle off; those for the type checker do not.
"""

import ast
import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

ROOMS = ("pipeline", "schemas")
MOST_LINES = 500  # a longer file is not read in one sitting


@dataclass(frozen=True)
class Source:
    """One file: its path from the root, its tree, and its number of lines."""

    path: Path
    tree: ast.Module
    lines: int

    @property
    def module(self) -> str:
        parts = self.path.with_suffix("").parts
        return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def read_sources(root: Path) -> list[Source]:
    """All files of the program, sorted by path."""
    paths = sorted(path for room in ROOMS for path in (root / room).rglob("*.py"))
    texts = [(path.relative_to(root), path.read_text("utf-8")) for path in paths]
    return [Source(path, ast.parse(text), len(text.splitlines())) for path, text in texts]


def list_faults(sources: list[Source]) -> Iterator[str]:
    """What is wrong, one line each."""
    try:
        TopologicalSorter(map_imports(sources)).prepare()
    except CycleError as error:
        yield f"import circle: {' -> '.join(reversed(error.args[1]))}"
    paths = defaultdict(list)
    for source in sources:
        if source.path.name != "__init__.py":
            paths[source.path.name].append(str(source.path))
    yield from (f"two files of one name: {', '.join(same)}" for same in paths.values() if len(same) > 1)
    long = (source for source in sources if source.lines > MOST_LINES)
    yield from (f"{source.path} has {source.lines} lines, more than {MOST_LINES}" for source in long)


def map_imports(sources: list[Source]) -> Mapping[str, set[str]]:
    """Which modules of the program each module imports while it runs."""
    modules = {source.module for source in sources}
    found: dict[str, set[str]] = {}
    for source in sources:
        package = source.module if source.path.name == "__init__.py" else source.module.rpartition(".")[0]
        named = {
            name for node in _walk_at_run_time(source.tree) for name in _list_targets(node, package, modules)
        }
        found[source.module] = named - {source.module}
    return found


def _walk_at_run_time(node: ast.AST) -> Iterator[ast.AST]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and ast.unparse(child.test).endswith("TYPE_CHECKING"):
            yield from (below for other in child.orelse for below in (other, *_walk_at_run_time(other)))
        else:
            yield child
            yield from _walk_at_run_time(child)


def _list_targets(node: ast.AST, package: str, modules: set[str]) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names if alias.name in modules)
    elif isinstance(node, ast.ImportFrom):
        above = package.split(".")[: len(package.split(".")) + 1 - node.level] if node.level else []
        base = ".".join([*above, *([node.module] if node.module else [])])
        for alias in node.names:
            whole = f"{base}.{alias.name}"
            yield from [whole] if whole in modules else [base] if base in modules else []


def measure_headers(sources: list[Source]) -> float:
    """Share of lines that are docstrings of files and imports above everything else."""
    lines = 0
    for source in sources:
        head = source.tree.body[:1] if ast.get_docstring(source.tree, clean=False) is not None else []
        head += [node for node in source.tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
        head += [
            node
            for node in source.tree.body
            if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        ]
        lines += sum((node.end_lineno or node.lineno) - node.lineno + 1 for node in head)
    return lines / max(sum(source.lines for source in sources), 1)


def main() -> int:
    """Print the counts and what is wrong; 1 where anything is."""
    sources = read_sources(Path(__file__).parents[1])
    faults = list(list_faults(sources))
    lines = sum(source.lines for source in sources)
    print(f"{len(sources)} files, {lines:,} lines, {measure_headers(sources):.1%} of them headers")
    print(*faults, sep="\n", end="\n" if faults else "")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
