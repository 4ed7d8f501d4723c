"""A name from outside never leads out of its folder."""

import os
import unicodedata
from pathlib import Path, PureWindowsPath

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from pipeline.core.untrusted import PathError, resolve_inside
from pipeline.logs import RemotePath
from pipeline.store import StoreError
from pipeline.store.names import encode_run

TRICKS = "ab./\\:~%\0\n \u2024\u2025\u2026\uff0e\uff0f\uff3c\u200d\u2215\u3002\u00a0Cc\u0301"
NAMES = st.one_of(
    st.text(max_size=60),
    st.text(TRICKS, max_size=12),
    st.lists(st.sampled_from(["..", ".", "", "a", "\uff0e\uff0e", "x" * 256]), max_size=6).map("/".join),
)
ROOT = Path("/results/here")


@given(NAMES)
@example("..")
@example("a/../../b")
@example("/etc/passwd")
@example("C:/x")
@example("\uff23\uff1a/x")
@example("a\\..\\..\\b")
@example("\uff0e\uff0e/x")
@example("\u2025/x")
@example(".\u200d./x")
@example(".. /x")
@example("a\0b")
@example("\udc80")
def test_a_name_stays_inside_or_is_refused(name: str) -> None:
    try:
        path = resolve_inside(ROOT, name)
    except PathError:
        return
    read_as = {name, unicodedata.normalize("NFKC", name), unicodedata.normalize("NFC", name)}
    for text in read_as:
        assert Path(os.path.normpath(ROOT / text)).is_relative_to(ROOT)
        windows = PureWindowsPath("C:\\results", text)
        assert windows.is_relative_to("C:\\results")
        assert ".." not in windows.parts
    assert path == ROOT / name
    assert path != ROOT


def test_names_that_lead_elsewhere_are_refused() -> None:
    for name in [
        "",
        ".",
        "..",
        "../x",
        "a/..",
        "a/../../x",
        "/x",
        "//x",
        "a//b",
        "a/",
        "C:\\x",
        "c:x",
        "a\\b",
        "\\\\host\\x",
        "a\0",
        "a\nb",
        "\uff0e\uff0e/x",
        "\u2025",
        ". ./x",
        " ",
        "...",
        "x" * 256,
        "/".join(["x" * 200] * 30),
        "\udcff",
        "\uff21\uff1a/x",
        ".\u200b.",
    ]:
        if name == ". ./x":
            # A part of its own with a space in its middle is an odd name, but a name.
            assert resolve_inside(ROOT, "a. .b/x") == ROOT / "a. .b/x"
        with pytest.raises(PathError) as caught:
            resolve_inside(ROOT, name)
        assert caught.value.code == "path_outside"
        assert len(str(caught.value).splitlines()) == 1


def test_plain_names_are_what_they_say() -> None:
    for name in [
        "a",
        "runs/2026-07/husky 3/manifest.json",
        "é/Ωmega.mcap",
        "a..b",
        ".hidden",
        "x" * 255,
        "10:32/a",
    ]:
        assert resolve_inside(ROOT, name) == ROOT / name


@given(NAMES)
@example("\uff0e\uff0e")
@example("\u2026")
@example("\u2025/\u2026")
@example("\u200d.")
@example("C:/x")
def test_every_run_has_a_folder_that_a_mirror_can_have_too(run: str) -> None:
    try:
        home = encode_run(run)
    except StoreError:
        return
    name = f"runs/{home}/manifest.json"
    assert resolve_inside(ROOT, name) == ROOT / name


def test_links_that_lead_out_are_refused(tmp_path: Path) -> None:
    root, outside = tmp_path / "root", tmp_path / "outside"
    root.mkdir()
    outside.mkdir()
    (root / "there").mkdir()
    (root / "inside").symlink_to("there")
    (root / "out").symlink_to(outside)
    (root / "loop").symlink_to("loop")
    (root / "file").symlink_to(outside / "not there yet")
    assert resolve_inside(root, "inside/x") == root / "inside/x"
    for name in ("out", "out/x", "file", "inside/../out"):
        with pytest.raises(PathError):
            resolve_inside(root, name)
    assert resolve_inside(root, "out/x", follow_links=True) == root / "out/x"
    with pytest.raises(PathError):
        resolve_inside(root, "inside/../out", follow_links=True)
    # The folder's own place is the user's.
    (tmp_path / "elsewhere").symlink_to(root)
    assert resolve_inside(tmp_path / "elsewhere", "x") == tmp_path / "elsewhere" / "x"


def test_nothing_that_is_no_file_is_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("pipe")
    (tmp_path / "device").symlink_to("/dev/zero")
    for name, follow_links in (("pipe", False), ("link", False), ("link", True), ("device", True)):
        with pytest.raises(PathError, match="a pipe, a socket or a device") as caught:
            resolve_inside(tmp_path, name, follow_links=follow_links)
        assert caught.value.code == "not_a_file"


def test_addresses_stay_addresses() -> None:
    root = RemotePath("s3://bucket/recording")
    assert str(resolve_inside(root, "part_0.mcap")) == "s3://bucket/recording/part_0.mcap"
    for name in ("/etc/passwd", "../other/x.mcap", "s3://other/x"):
        with pytest.raises(PathError):
            resolve_inside(root, name)
