import subprocess
import sys

WARNING = "import warnings; warnings.warn('overflow', RuntimeWarning, stacklevel=1)"
QUIET = f"from pipeline.core import silence_warnings; silence_warnings(); {WARNING}"


def test_warnings_reach_those_alone_who_ask_for_them() -> None:
    def run(*arguments: str) -> str:
        return subprocess.run([sys.executable, *arguments], check=True, capture_output=True, text=True).stderr

    assert "overflow" in run("-c", WARNING)
    assert run("-c", QUIET) == ""
    assert "overflow" in run("-W", "always", "-c", QUIET)
