"""Lines of run.toml that contradict the log: they are named, and no radius, gain or wiring is blamed."""

from pathlib import Path

import pytest
from drawn_motion import draw
from written_logs import write_log

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.core import SlipError
from pipeline.recording.log_setup import set_up_log
from pipeline.results import read_findings
from pipeline.words.findings import format_finding

LOG = Path(__file__).parents[2] / "data_samples" / "husky_tile.mcap"


def find_what_is_told(tmp_path: Path, section: str, line: str, count: int = 1) -> list[str]:
    place = tmp_path / "drive"
    place.mkdir()
    (place / LOG.name).write_bytes(LOG.read_bytes())
    (place / "run.toml").write_text(f"[{section}]\n{line}\n", encoding="utf-8")
    answer = analyze_log(place / LOG.name, Options(out=tmp_path / "results", report=False, diagnosis=False))
    findings = read_findings(answer.summary)
    assert [one.id for one in findings if one.severity == "error"] == (
        ["configured_wrongly"] * count if "rad/s" not in line else []
    )
    return [format_finding(one) for one in findings]


@pytest.mark.parametrize(
    ("section", "line"),
    [
        ("command", 'unit = "rpm"'),
        ("command", "sign = -1"),
        ("command", "exchanged = true"),
        ("wheels", 'unit = "rpm"'),
        ("wheels", 'unit = "m/s"'),
        ("wheels", "sign = -1"),
        ("pose", 'unit = "mm"'),
        ("pose", "heading_deg = 90"),
        ("pose", 'axes = "ned"'),
        ("pose", 'up = "-y"'),
        ("imu", 'unit = "deg/s"'),
    ],
)
def test_a_line_that_the_log_contradicts_is_named_and_nothing_else(
    section: str, line: str, tmp_path: Path
) -> None:
    told = find_what_is_told(tmp_path, section, line)
    assert any(f"[{section}] in run.toml" in one and line in one for one in told)
    assert not any("--wheel-radius" in one or "wired" in one for one in told)


def test_the_same_mistake_in_two_sections_is_named_in_both(tmp_path: Path) -> None:
    both = 'unit = "rpm"\n[wheels]\nunit = "rpm"'
    told = [one for one in find_what_is_told(tmp_path, "command", both, 2) if "contradicts" in one]
    assert [one.partition(" in run.toml")[0] for one in told] == ["[command]", "[wheels]"]


def test_a_file_that_is_not_read_is_told_of_a_log_that_was_analyzed_before(tmp_path: Path) -> None:
    (tmp_path / LOG.name).write_bytes(LOG.read_bytes())
    options = Options(out=tmp_path / "results", report=False, diagnosis=False)
    for is_there in (False, True):
        if is_there:
            (tmp_path / "Run.toml").touch()
        findings = read_findings(analyze_log(tmp_path / LOG.name, options).summary)
        told = [format_finding(one) for one in findings if one.id == "file_not_read"]
        assert [one.partition(":")[0] for one in told] == ["Run.toml beside the log is not read"] * is_there


def test_a_log_that_is_refused_tells_which_file_is_not_read(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log.mcap", draw(51), is_measured=False)
    (tmp_path / "Run.toml").touch()
    options = Options(out=tmp_path / "results", inputs=("measured",))
    with pytest.raises(SlipError) as refused:
        set_up_log(log, options)
    assert "Run.toml beside the log is not read: name it run.toml" in refused.value.hint


@pytest.mark.parametrize("section", ["wheels", "imu"])
def test_a_line_that_says_what_is_so_anyway_is_no_fault(section: str, tmp_path: Path) -> None:
    assert not any("contradicts" in one for one in find_what_is_told(tmp_path, section, 'unit = "rad/s"'))
