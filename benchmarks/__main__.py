"""The runner of benchmarks: `make bench` lists them, `make bench NAME=reader ARGS="--repeat 3"` runs one.

A benchmark is a file of this folder that has a function `run(given)`; its name is the file's, the first line
of its docstring says what it measures, `add_arguments(parser)` declares its options. A file that is there is
listed: adding a benchmark is adding a file.
"""

import argparse
import ast
import sys
from importlib import import_module
from pathlib import Path

HERE = Path(__file__).parent
ENTRIES = frozenset({"run", "main"})
"""Functions that make a file a benchmark; one with `main` alone reads its own command line."""
CHECKS = frozenset({"audit", "house"})
"""Commands of `make bench NAME=audit` and `make check`, which measure nothing."""


def list_benchmarks() -> dict[str, str]:
    """What each measures, by its name."""
    found = {}
    for path in sorted(HERE.rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        functions = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
        name = path.relative_to(HERE).with_suffix("").as_posix()
        if functions & ENTRIES and name not in {"__main__", *CHECKS}:
            found[name] = (ast.get_docstring(tree) or "").partition("\n")[0]
    return found


def main(words: list[str]) -> int:
    """Run the benchmark that is named first, or list all."""
    if not words:
        print(*(f"  {name:<18} {about}" for name, about in list_benchmarks().items()), sep="\n")
        return 0
    name, *arguments = words
    # All files are read only where it helps: a benchmark may measure the memory of its process.
    if not (HERE / f"{name}.py").is_file():
        print(f"there is no benchmark {name}; there are {', '.join(list_benchmarks())}", file=sys.stderr)
        return 2
    module = import_module(name.replace("/", "."))
    if not hasattr(module, "run"):
        sys.argv = [f"make bench NAME={name}", *arguments]
        return module.main() or 0
    parser = argparse.ArgumentParser(
        prog=f"make bench NAME={name}",
        description=module.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    if hasattr(module, "add_arguments"):
        module.add_arguments(parser)
    return module.run(parser.parse_args(arguments)) or 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
