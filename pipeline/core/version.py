"""The version of this program."""

from pathlib import Path

PACKAGE = "slip-pipeline"


def read_version() -> str:
    """The version that the installed package says; in a checkout that is not installed, the declared one."""
    # Every call of the program passes here, and few ask for the version.
    import importlib.metadata  # noqa: PLC0415
    import tomllib  # noqa: PLC0415

    try:
        return importlib.metadata.version(PACKAGE)
    except importlib.metadata.PackageNotFoundError:
        declared = Path(__file__).parents[2] / "pyproject.toml"
        content = tomllib.loads(declared.read_text(encoding="utf-8"))
        return str(content["project"]["version"])
