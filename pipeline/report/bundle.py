"""The JavaScript that draws: Vega, Vega-Lite and Vega-Embed, out of the Python package that ships them.

Bundling takes most of a second and always gives the same text, so it is kept in the user's cache folder. The
cache is only a shortcut: a missing, damaged or read-only one costs that second and nothing else.
"""

import contextlib
import hashlib
import os
import subprocess
import threading
from importlib.metadata import version
from pathlib import Path

from pipeline.core.interpreter import python_command

_DIGEST_LENGTH = 64
_EXPOSE = "window.vegaEmbed = vegaEmbed;"


def load_bundle() -> str:
    """The script that puts ``vegaEmbed`` on the window, fit to stand inside a script element."""
    path = cache_path()
    cached = _read_checked(path)
    if cached is not None:
        return cached
    import vl_convert  # noqa: PLC0415 - starting its JavaScript engine is what the cache avoids

    # A closing tag inside a string literal would end the element that holds the script.
    script: str = (
        vl_convert.javascript_bundle(_EXPOSE).replace("</script", "<\\/script").replace("<!--", "<\\!--")
    )
    _write_checked(path, script)
    return script


def warm_bundle() -> None:
    """Bundle in a process of its own, so that it overlaps with reading the log.

    The bundler holds the interpreter's lock for as long as it works, so a thread would gain nothing. Returns
    at once; does nothing where the cache is filled or cannot be written.
    """
    path = cache_path()
    if path.is_file() or not _can_write(path.parent):
        return
    threading.Thread(target=_bundle_apart, name="bundle", daemon=True).start()


def _bundle_apart() -> None:
    with contextlib.suppress(OSError):
        subprocess.run(  # noqa: S603 - our own words
            python_command("-c", "from pipeline.report.bundle import load_bundle; load_bundle()"),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            check=False,
        )


def cache_path() -> Path:
    """Where the bundle of the installed version is kept."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    what = hashlib.sha256(_EXPOSE.encode()).hexdigest()[:8]
    return Path(base) / "slip" / f"vega-{version('vl-convert-python')}-{what}.js"


def _read_checked(path: Path) -> str | None:
    try:
        content = path.read_bytes()
    except OSError:
        return None
    digest, _, script = content.partition(b"\n")
    if len(digest) != _DIGEST_LENGTH or hashlib.sha256(script).hexdigest().encode() != digest:
        return None
    return script.decode()


def _write_checked(path: Path, script: str) -> None:
    from pipeline.store.files import replace_file  # noqa: PLC0415 - only where it is not cached yet

    body = script.encode()
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, hashlib.sha256(body).hexdigest().encode() + b"\n" + body, durable=False)


def _can_write(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK)
