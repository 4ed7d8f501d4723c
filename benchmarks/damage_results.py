"""What `slip results verify` notices: bytes of small results changed, files and runs deleted and swapped.

Results of two short simulated logs, one of them analyzed twice, with reports, pools and a comparison. Each
change is made alone and undone. Of manifests, lists, notes and other JSON every byte is changed, of tables
and pages, which a hash covers as a whole, every n-th: in turn one bit, the sign bit, all bits. *Said*
counts what verify tells without calling it damage. Left out is what no manifest names: files over all runs,
older generations, and whole runs that are deleted.
"""

import argparse
import os
import shutil
import tempfile
from collections import Counter
from collections.abc import Mapping
from itertools import cycle
from pathlib import Path
from unittest import mock

from pipeline.analysis import Options
from pipeline.batch import Request
from pipeline.batch.batch_run import run_batch
from pipeline.simulate import simulate_case
from pipeline.store import Store
from pipeline.store import verification as room
from pipeline.store.files import hash_file

FLIPS = (0x01, 0x80, 0xFF)


class Watch:
    """Is told, and says nothing."""

    def plan(self, todo: int, settled: int, size: int) -> None: ...

    def notify(self, line: object, size: int) -> None: ...


class Table:
    """Changes and what was noticed of them, by kind of file."""

    def __init__(self) -> None:
        self.changes: Counter[str] = Counter()
        self.said: Counter[str] = Counter()
        self.missed: Counter[str] = Counter()

    def count(self, kind: str, found: room.Examination, before: room.Examination) -> None:
        self.changes[kind] += 1
        if found.problems:
            return
        self.said[kind] += found.unchecked != before.unchecked
        self.missed[kind] += found.unchecked == before.unchecked

    def show(self, title: str) -> None:
        print(f"\n{title:<44}{'changes':>9}{'noticed':>9}{'said':>10}{'not noticed':>13}")
        for kind, count in self.changes.items():
            noticed = count - self.said[kind] - self.missed[kind]
            print(f"{kind:<44}{count:>9}{noticed:>9}{self.said[kind]:>10}{self.missed[kind]:>13}")
        print(
            f"{'all':<44}{self.changes.total():>9}"
            f"{self.changes.total() - self.said.total() - self.missed.total():>9}"
            f"{self.said.total():>10}{self.missed.total():>13}",
            flush=True,
        )


class Files:
    """The files of results, which are changed one at a time; those that have not changed are hashed once."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._hashes: dict[Path, str] = {}

    def list(self) -> list[str]:
        """Files that hold something: no locks, and nothing that another program keeps there."""
        names = [path.relative_to(self._root).as_posix() for path in self._root.rglob("*") if path.is_file()]
        return sorted(
            name
            for name in names
            if not name.endswith(".lock") and "/claims/" not in name and "/latest/" not in name
        )

    def read(self, name: str) -> bytes | None:
        path = self._root / name
        return path.read_bytes() if path.is_file() else None

    def change(self, name: str, content: bytes | None) -> None:
        path = self._root / name
        self._hashes.pop(path, None)
        path.unlink(missing_ok=True)
        if content is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)

    def examine(self) -> room.Examination:
        with mock.patch.object(room, "hash_file", self._hash):
            return room.examine_results(self._root)

    def _hash(self, path: Path) -> str:
        if path not in self._hashes:
            self._hashes[path] = hash_file(path)
        return self._hashes[path]


def make_results(folder: Path) -> Path:
    """Results of two logs; of one there is an older generation."""
    logs, out = folder / "logs", folder / "out"
    simulate_case("husky_tile", out=logs / "a.mcap", duration_s=6.0, seed=1)
    simulate_case("warthog_ice", out=logs / "b.mcap", duration_s=6.0, seed=2)
    for rate in ("20.0", "10.0"):
        (logs / "a.toml").write_text(f"[velocity]\nrate_hz = {rate}\n")
        options = Options(out=out, report=True)
        request = Request(targets=(str(logs),), options=options, executor="inline", settle_s=0.0)
        outcome = run_batch(request, Watch())
        if outcome.has_failed:
            raise SystemExit(f"the batch failed: {outcome}")
    Store(out).write_results_text("comparison.html", "<p>written by slip compare</p>")
    return out


_OLD = "old generations"


def name_kind(name: str, current: set[str]) -> str:
    """What a file of the results is."""
    parts = name.split("/")
    kinds = {"batch": "notes on logs", "identities": "notes on identities"}
    if parts[0] in kinds:
        return kinds[parts[0]]
    if len(parts) == 1:
        return f"over all runs: *{Path(name).suffix}"
    if parts[-1] == "manifest.json":
        return "manifests"
    return f"*{Path(name).suffix}" if "/".join(parts[:-1]) in current else _OLD


def flip_bytes(files: Files, names: list[str], current: set[str], every: int) -> Table:
    """Every byte of JSON, every n-th of other files."""
    table, flips = Table(), cycle(FLIPS)
    before = files.examine()
    for name in sorted(names, key=lambda name: (name_kind(name, current), name)):
        whole = files.read(name)
        if not whole:
            continue
        for at in range(0, len(whole), 1 if whole[:1] == b"{" else every):
            files.change(name, whole[:at] + bytes([whole[at] ^ next(flips)]) + whole[at + 1 :])
            table.count(name_kind(name, current), files.examine(), before)
        files.change(name, whole)
    return table


class Exchange:
    """Files deleted, cut, and put in the place of others, and what was noticed of it."""

    def __init__(self, files: Files, names: list[str], current: set[str]) -> None:
        self.table = Table()
        self._files, self._names, self._current = files, names, current
        self._before = files.examine()

    def try_all(self) -> Table:
        for name in self._names:
            if self._files.read(name):
                self._try_file(name)
        homes = sorted({name.rpartition("/")[0] for name in self._names if name.endswith("/manifest.json")})
        for home in homes:
            inside = self._list(home)
            for folder in {name.rpartition("/")[0] for name in inside} - {home}:
                self._judge("generations: one more file", {f"{folder}/more.parquet": b"x"})
            for other in homes:
                copied = {f"{other}{name.removeprefix(home)}": self._files.read(name) for name in inside}
                self._judge("runs: copied over", {**dict.fromkeys(self._list(other)), **copied})
        return self.table

    def _try_file(self, name: str) -> None:
        whole = self._files.read(name) or b""
        kind = name_kind(name, self._current)
        self._judge(f"{kind}: cut", {name: whole[: len(whole) // 2]})
        # A note may go, or be that of another name, at any time: it costs a look at the log.
        if not kind.startswith("notes"):
            self._judge(f"{kind}: deleted", {name: None})
            for other in self._names:
                if name_kind(other, self._current) == kind:
                    self._judge(f"{kind}: copied over", {other: whole})

    def _list(self, home: str) -> list[str]:
        return [name for name in self._names if name.startswith(f"{home}/")]

    def _judge(self, kind: str, contents: Mapping[str, bytes | None]) -> None:
        kept = {name: self._files.read(name) for name in contents}
        if kept == contents:
            return
        for name, content in contents.items():
            self._files.change(name, content)
        self.table.count(kind, self._files.examine(), self._before)
        for name, content in kept.items():
            self._files.change(name, content)


def damage_all(every: int) -> int:
    """Print the tables; how many changes were not noticed."""
    folder = Path(tempfile.mkdtemp(prefix="damage-"))
    try:
        out = make_results(folder)
        store = Store(out)
        files = Files(out)
        current = {manifest.folder.relative_to(out).as_posix() for manifest in store.manifests()}
        found = files.examine()
        names = [name for name in files.list() if name not in found.unchecked]
        names = [name for name in names if name_kind(name, current) != _OLD]
        print(f"{len(names)} files, ", end="")
        print(f"{sum(len(files.read(name) or b'') for name in names)} bytes; ", end="")
        print(f"unchanged: {len(found.problems)} problems, {len(found.unchecked)} unchecked")
        one = flip_bytes(files, names, current, every)
        one.show(f"changed bytes (of tables, pages: every {every}.)")
        other = Exchange(files, names, current).try_all()
        other.show("files and runs")
        return one.missed.total() + other.missed.total() + len(found.problems)
    finally:
        shutil.rmtree(folder)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--every", type=int, default=97, help="of tables and pages only every n-th byte")


def run(asked: argparse.Namespace) -> None:
    raise SystemExit(os.EX_OK if damage_all(asked.every) == 0 else 1)
