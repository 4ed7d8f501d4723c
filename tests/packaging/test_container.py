"""The container file: its commands run here as a builder would run them, where there is no builder."""

import json
import os
import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest

from pipeline.simulate import simulate_case

ROOT = Path(__file__).parents[2]
LINES = [
    line.split(maxsplit=1)
    for line in (ROOT / "Containerfile").read_text(encoding="utf-8").splitlines()
    if line and not line.startswith("#")
]


@pytest.mark.lint
def test_what_the_container_copies_is_there_and_it_starts_slip() -> None:
    copied = [
        word for name, rest in LINES if name == "COPY" and "--from" not in rest for word in rest.split()[:-1]
    ]
    assert {"pipeline", "schemas", "packaging/requirements-container.txt", "pyproject.toml"} <= set(copied)
    ignored = (ROOT / ".gitignore").read_text(encoding="utf-8").split()
    for name in copied:
        assert (ROOT / name).exists()
        assert f"{name}/" not in ignored
    assert json.loads(dict(LINES)["ENTRYPOINT"]) == ["slip"]  # type: ignore[arg-type]


@pytest.mark.lint
def test_the_base_may_be_given_by_its_digest() -> None:
    words = dict(reversed(LINES))
    assert words["ARG"] == "BASE=python:3.11-slim"
    assert [rest.split()[0] for name, rest in LINES if name == "FROM"] == ["${BASE}", "${BASE}"]


@pytest.mark.lint
def test_the_container_has_what_its_page_advises() -> None:
    locked = (ROOT / "packaging" / "requirements-container.txt").read_text(encoding="utf-8")
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"][
        "optional-dependencies"
    ]
    for extra in ("build", "s3", "serve"):
        for wanted in extras[extra]:
            name = re.split(r"[<>=\[]", wanted)[0]
            assert name == "slip-pipeline" or f"\n{name}==" in f"\n{locked}", name


@pytest.mark.lint
@pytest.mark.parametrize(
    "name", ["requirements.txt", "requirements-dev.txt", "packaging/requirements-container.txt"]
)
def test_a_lock_brings_pip_and_setuptools_up_to_date_and_names_no_host(name: str) -> None:
    text = (ROOT / name).read_text(encoding="utf-8")
    blocks = {block.partition("==")[0]: block for block in re.split(r"\n(?=\S)", text)}
    for tool in ("pip", "setuptools"):
        assert "--hash=sha256:" in blocks[tool]
    assert not re.search(r"https?://|--index|--find-links", text)


@pytest.mark.long
def test_the_commands_of_the_container_make_a_program_that_runs_a_batch(tmp_path: Path) -> None:
    folders = {name: tmp_path / name.strip("/").replace("/", "_") for name in ("/opt/slip", "/src", "/data")}
    folders |= {"/var/cache/slip": tmp_path / "cache"}

    def place(text: str) -> str:
        return re.sub("|".join(folders), lambda found: str(folders[found[0]]), text)

    # A container is not told of a checkout.
    work, around = tmp_path, {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    for name, rest in LINES:
        words = place(rest)
        if name == "WORKDIR":
            work = Path(words)
            work.mkdir()
        elif name == "COPY" and "--from" not in rest:
            *sources, target = words.split()
            for source in sources:
                copy = work / target / Path(source).name if target.endswith("/") else work / target
                copy.parent.mkdir(parents=True, exist_ok=True)
                shutil.copytree(ROOT / source, copy) if (ROOT / source).is_dir() else shutil.copy(
                    ROOT / source, copy
                )
        elif name == "ENV":
            for pair in words.replace("$PATH", around["PATH"]).split():
                key, _, value = pair.partition("=")
                around[key] = str(tmp_path) if key == "HOME" else value
        elif name == "RUN":
            subprocess.run(["sh", "-ec", words], cwd=work, env=around, check=True)
    compiled = {path.name for path in folders["/var/cache/slip"].rglob("*.nbi")}
    assert len(compiled) > 10
    simulate_case("husky_tile", out=work / "logs" / "a.mcap", duration_s=20.0)
    batch = ["slip", "batch", "logs", "--results", "results", "--settle", "0", "--json"]
    done = subprocess.run(batch, cwd=work, env=around, capture_output=True, text=True, check=True)
    assert json.loads(done.stdout)["done"] == 1
    assert {path.name for path in folders["/var/cache/slip"].rglob("*.nbi")} == compiled
