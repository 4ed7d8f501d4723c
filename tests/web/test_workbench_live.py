"""The page of what is being watched: it says what the terminal of `slip watch` says, word for word."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import cast

import pytest
from chrome import Chrome
from mcap.reader import make_reader
from mcap.writer import Writer
from workbench_server import Workbench

from pipeline.live.watch import read_statements, write_statement
from pipeline.simulate import Scenario, simulate_run, write_log
from pipeline.store import Store

EVIL = "<img src=x onerror=\"window.pwned='yes'\"><script>window.pwned='yes'</script>"


def read_watched(workbench: Workbench) -> list[dict[str, object]]:
    return cast("list[dict[str, object]]", workbench.get("/api/live")["watched"])


def format_rows(rows: list[tuple[str, str]]) -> str:
    """Rows as a terminal shows them: a label once, the text from the eleventh column on."""
    lines, last = [], ""
    for label, text in rows:
        lines.append(f"{'' if label == last else label:<10}{text}".rstrip())
        last = label
    return "\n".join(lines)


@pytest.mark.long
def test_terminal_and_page_say_the_same_at_every_look(workbench: Workbench, tmp_path: Path) -> None:
    source, log = tmp_path / "source.mcap", tmp_path / "run.mcap"
    write_log(
        simulate_run(Scenario(duration_s=60.0, seed=5, effects={"effective_track": {"k": 1.8}})), source
    )
    with source.open("rb") as stream:
        messages = list(make_reader(stream).iter_messages(log_time_order=True))
    said = tmp_path / "said.txt"
    command = [sys.executable, "-m", "pipeline", "watch", str(log), "--results", str(workbench.results)]
    # On a narrow screen lines are folded; a page folds its own.
    wide = {**os.environ, "COLUMNS": "0"}
    seen: list[str] = []
    with log.open("wb") as stream, said.open("wb") as out:
        writer = Writer(stream, chunk_size=1 << 14)
        writer.start(profile="ros2", library="test")
        numbers: dict[int, int] = {}
        process = None
        for count, (schema, channel, message) in enumerate(messages):
            if channel.id not in numbers:
                assert schema is not None
                kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                numbers[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, kind)
            writer.add_message(numbers[channel.id], message.log_time, message.data, message.publish_time)
            if count % 100 == 0:
                stream.flush()
                process = process or subprocess.Popen(command, stdout=out, env=wide)
                time.sleep(0.25)
                seen += [format_rows(one["rows"]) for one in read_watched(workbench)]  # type: ignore[arg-type]
        writer.finish()
        stream.flush()
        assert process is not None
        assert process.wait(120) == 0
    text = "\n".join(line.rstrip() for line in said.read_text().splitlines())
    assert len(set(seen)) > 2
    for statement in seen:
        assert f"{statement}\n" in text
    (last,) = read_watched(workbench)
    assert last["ended"]
    assert text.endswith("\n".join(row[1].rstrip() for row in cast("list[list[str]]", last["rows"])))


def test_the_page_renews_itself_and_text_stays_text(
    chrome: Chrome, workbench: Workbench, tmp_path: Path
) -> None:
    log = tmp_path / "run.mcap"
    chrome.open(workbench.address)
    chrome.wait("document.querySelector('#live')")
    chrome.run("location.href = document.querySelector('#live').href")
    chrome.wait("document.querySelector('#watched .blank')")
    text = "document.querySelector('#watched').innerText"
    write_statement(
        workbench.results, log, [("slip", "0.3 m/s"), ("known", EVIL), ("known", "lag"), ("drive", "turn")]
    )
    chrome.wait(f"{text}.includes('0.3 m/s')")
    assert chrome.run("document.querySelectorAll('#watched tr').length") == 4
    assert EVIL in str(chrome.run(text))
    assert "last look" in str(chrome.run(text))
    write_statement(workbench.results, log, [("enough", "no more driving is needed")], ended=True)
    chrome.wait(f"{text}.includes('no more driving') && !{text}.includes('0.3 m/s')")
    assert "ended" in str(chrome.run(text))
    assert chrome.run("window.pwned") is None
    assert chrome.errors == []


def test_statements_that_no_watch_wrote_are_left_out(workbench: Workbench, tmp_path: Path) -> None:
    store = Store(workbench.results)
    assert read_watched(workbench) == []
    for number, content in enumerate(({}, {"rows": 5}, {"log": "a", "rows": [["b"]], "time": 1.0})):
        store.notes("live").write(str(number), cast("dict[str, object]", content))  # type: ignore[arg-type]
    assert read_watched(workbench) == []
    for number in range(8):
        write_statement(workbench.results, tmp_path / f"{number}.mcap", [("x" * 5000, "y" * 5000)] * 500)
    shown = read_watched(workbench)
    assert len(shown) == 5
    assert str(shown[0]["log"]).endswith("7.mcap")
    assert len(json.dumps(shown)) < 5 * 200 * 2100
    assert [one.log for one in read_statements(store)] == [one["log"] for one in shown]


def test_strangers_see_nothing_of_what_is_watched(workbench: Workbench) -> None:
    for path in ("/live", "/live.js", "/api/live"):
        assert workbench.request("GET", path, known=False)[0] == 403
        assert workbench.request("GET", path)[0] == 200
