"""The files of the program: `make check` refuses circles of imports between them.

Imports inside functions count, since they only put a circle off; those for the type checker do not.
"""

import ast
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

ROOMS = ("pipeline", "schemas")
EXPLAINED = ("core", "run", "stages", "models", "estimation", "datasets")
"""Rooms whose numbers decide answers."""


@dataclass(frozen=True)
class Source:
    """One file: its path from the root, its text, its tree, and its number of lines."""

    path: Path
    text: str
    tree: ast.Module
    lines: int

    @property
    def module(self) -> str:
        parts = self.path.with_suffix("").parts
        return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def read_sources(root: Path) -> list[Source]:
    """All Python files of the program, sorted by path."""
    paths = sorted(path for room in ROOMS for path in (root / room).rglob("*.py"))
    texts = [(path.relative_to(root), path.read_text("utf-8")) for path in paths]
    return [Source(path, text, ast.parse(text), len(text.splitlines())) for path, text in texts]


def list_faults(sources: list[Source]) -> Iterator[str]:
    """Circles of imports, one line each."""
    try:
        TopologicalSorter(map_imports(sources)).prepare()
    except CycleError as error:
        yield f"import circle: {' -> '.join(reversed(error.args[1]))}"


@dataclass(frozen=True)
class Constant:
    """A number under a name in capitals, its line, and why it has this value; empty where nothing says."""

    name: str
    line: int
    reason: str


def find_room(source: Source) -> str:
    """The room that a file stands in."""
    return source.path.parts[min(1, len(source.path.parts) - 1)]


def list_constants(source: Source) -> list[Constant]:
    """Numbers of a file under names in capitals, with the docstring below or the comment beside or above."""
    lines, body = source.text.splitlines(), source.tree.body
    constants = []
    for node, below in zip(body, [*body[1:], None], strict=True):
        if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
            continue
        target = node.targets[0] if isinstance(node, ast.Assign) else node.target
        names = [one.id for one in ast.walk(target) if isinstance(one, ast.Name) and one.id == one.id.upper()]
        if not names or not _is_number(node.value):
            continue
        match below:
            case ast.Expr(value=ast.Constant(value=str(reason))):
                pass
            case _:
                above = lines[node.lineno - 2] if node.lineno > 1 else ""
                beside = lines[(node.end_lineno or node.lineno) - 1]
                reason = beside.partition("#")[2] or (above[1:] if above.startswith("#") else "")
        constants += [Constant(name, node.lineno, reason.strip()) for name in names]
    return constants


def _is_number(node: ast.expr) -> bool:
    """Whether a value is a number, a tuple with one, or computed from one that is written there."""
    match node:
        case ast.Constant(value=bool()):
            return False
        case ast.Constant(value=int() | float()):
            return True
        case ast.UnaryOp(operand=operand):
            return _is_number(operand)
        case ast.BinOp(left=left, right=right):
            return _is_number(left) or _is_number(right)
        case ast.Tuple(elts=elements):
            return any(_is_number(element) for element in elements)
    return False


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


def main() -> int:
    """Print the counts and what is wrong; 1 where anything is."""
    sources = read_sources(Path(__file__).parents[1])
    faults = list(list_faults(sources))
    print(f"{len(sources)} files, {sum(source.lines for source in sources):,} lines")
    print(*faults, sep="\n", end="\n" if faults else "")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
