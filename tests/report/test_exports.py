"""Exports: read back by the readers that others wrote, and by people's viewers' rules."""

import json
import re
import runpy
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import polars as pl
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.core import python_command
from pipeline.logs.writer import LogWriter
from pipeline.models import Model, find_effect
from pipeline.report import viewer_files as derived_module
from pipeline.report.export_source import ExportSource
from pipeline.report.viewer_files import (
    write_csv,
    write_derived_log,
    write_foxglove_layout,
    write_plotjuggler_layout,
)
from pipeline.simulate import simulate_case
from pipeline.sources.one_vehicle import load_vehicle
from pipeline.store import Store
from pipeline.store.checksums import encode_manifest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate_case("husky_tile", out=tmp_path_factory.mktemp("log") / "run.mcap", duration_s=40.0)


@pytest.fixture(scope="module")
def results(log: Path) -> Path:
    folder = log.parent / "results"
    analyze_log(log, Options(out=folder, report=False))
    return folder


@pytest.fixture(scope="module")
def source(results: Path) -> ExportSource:
    (manifest,) = Store(results).manifests()
    model = Model(load_vehicle(manifest), (find_effect("effective_track")(k=1.7),))
    return ExportSource(manifest, model)


@pytest.fixture(scope="module")
def derived(source: ExportSource, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_derived_log(source, tmp_path_factory.mktemp("derived") / "run_slip.mcap")


def read_officially(path: Path) -> dict[str, list[tuple[int, object]]]:
    found: dict[str, list[tuple[int, object]]] = {}
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
    return found


def test_the_official_reader_finds_what_the_tables_hold(source: ExportSource, derived: Path) -> None:
    found = read_officially(derived)

    velocities = source.manifest.read("velocities")
    measured = found["/slip/velocity/measured"]
    assert [time for time, _ in measured] == velocities["stamp"].to_list()
    assert [message.twist.angular.z for _, message in measured] == velocities["v_w"].to_list()  # type: ignore[attr-defined]
    modulus = source.manifest.read("slip").filter(pl.col("input") == "measured")["modulus"]
    assert [message.data for _, message in found["/slip/modulus_measured"]] == modulus.to_list()  # type: ignore[attr-defined]
    assert {"/slip/velocity/model", "/slip/predicted_path", "/slip/trail", "/slip/segment"} <= set(found)


def test_another_reader_finds_the_same(derived: Path) -> None:
    official = read_officially(derived)
    counts: dict[str, int] = {}
    with AnyReader([derived]) as reader:
        for connection, _, raw in reader.messages():
            reader.deserialize(raw, connection.msgtype)
            counts[connection.topic] = counts.get(connection.topic, 0) + 1
    assert counts == {topic: len(messages) for topic, messages in official.items()}


def test_predictions_begin_at_the_measured_pose_and_last_two_seconds(derived: Path) -> None:
    found = read_officially(derived)
    poses = found["/slip/pose"]
    times = np.array([time for time, _ in poses])
    for time, path in found["/slip/predicted_path"][5::20]:
        first, last = path.poses[0], path.poses[-1]  # type: ignore[attr-defined]
        pose = poses[int(np.argmin(np.abs(times - time)))][1].pose.position  # type: ignore[attr-defined]
        assert np.hypot(first.pose.position.x - pose.x, first.pose.position.y - pose.y) < 0.15
        assert last.header.stamp.sec - first.header.stamp.sec == 2


def test_measured_ideal_and_model_are_poses_that_part_within_two_seconds(derived: Path) -> None:
    """As poses they are opened by viewers that know no path: Rerun, and PlotJuggler as curves over time."""
    found = read_officially(derived)
    measured = found["/slip/pose"]
    at = np.array([time for time, _ in measured])
    places = np.array([(one.pose.position.x, one.pose.position.y) for _, one in measured])  # type: ignore[attr-defined]
    gaps = {}
    for name in ("ideal", "model"):
        poses = found[f"/slip/pose_{name}"]
        times = np.array([time for time, _ in poses])
        assert np.all(np.diff(times) > 0)
        assert {message.header.frame_id for _, message in poses} == {"map"}  # type: ignore[attr-defined]
        own = np.array([(one.pose.position.x, one.pose.position.y) for _, one in poses])  # type: ignore[attr-defined]
        known = np.column_stack([np.interp(times, at, places[:, axis]) for axis in range(2)])
        gaps[name] = np.linalg.norm(own - known, axis=1)
        # Every two seconds they begin at the measured pose again.
        assert np.quantile(gaps[name], 0.02) < 0.02
        assert gaps[name].max() < 2.0
    assert np.mean(gaps["model"]) < np.mean(gaps["ideal"])


def read_field(message: object, path: list[str]) -> object:
    for name in path:
        message = getattr(message, name)
    return message


def test_layouts_name_topics_and_numbers_that_the_log_holds(
    source: ExportSource, derived: Path, tmp_path: Path
) -> None:
    messages = {topic: rows[0][1] for topic, rows in read_officially(derived).items()}
    layout = json.loads(write_foxglove_layout(source, tmp_path / "layout.json").read_text("utf-8"))
    panels = layout["configById"]
    lines = [
        line["value"] for name, panel in panels.items() if name.startswith("Plot") for line in panel["paths"]
    ]
    tree = ET.parse(write_plotjuggler_layout(source, tmp_path / "layout.xml"))  # noqa: S314 - our own
    curves = [curve.attrib["name"] for curve in tree.iter("curve")]
    assert len(lines) == len(curves) > 10
    for text, separator in [*((line, ".") for line in lines), *((curve, "/") for curve in curves)]:
        topic = max((one for one in messages if text.startswith(f"{one}{separator}")), key=len, default="")
        assert topic, text
        value = read_field(messages[topic], text.removeprefix(f"{topic}{separator}").split(separator))
        assert isinstance(value, float), text
    topics = {*panels["3D!map"]["topics"], panels["RosOut!findings"]["topicToRender"]}
    assert topics - messages.keys() <= {"/slip/findings", "/slip/finding_markers"}


def test_a_long_run_is_exported_in_stretches_that_nobody_sees(
    source: ExportSource, derived: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    largest = []
    write_before = LogWriter.write_before

    def measure(self: LogWriter, log_time: int) -> None:
        largest.append(sum(rows.payloads.nbytes for rows in self._waiting))
        write_before(self, log_time)

    monkeypatch.setattr(LogWriter, "write_before", measure)
    monkeypatch.setattr(derived_module, "LogWriter", partial(LogWriter, chunk_size=20_000))
    cut = write_derived_log(replace(source, stretch_rows=100), tmp_path / "cut.mcap")
    assert len(replace(source, stretch_rows=100).stretches) > 6
    # A stretch waits in memory, and what was written once at the start: never the run.
    with cut.open("rb") as file:
        written = sum(len(message.data) for _, _, message in make_reader(file).iter_messages())
    assert max(largest) < 0.5 * written

    with cut.open("rb") as file:
        times = [message.log_time for _, _, message in make_reader(file).iter_messages(log_time_order=False)]
    assert times == sorted(times)
    one, other = read_officially(derived), read_officially(cut)
    assert set(one) == set(other)
    for topic in set(one) - {"/slip/velocity/model"}:
        assert [time for time, _ in one[topic]] == [time for time, _ in other[topic]]
    # The gyro shows the delay of the poses in fifteen seconds less well than in forty.
    before, after = (
        {time: message.twist.angular.z for time, message in found["/slip/velocity/model"]}  # type: ignore[attr-defined]
        for found in (one, other)
    )
    common = sorted(set(before) & set(after))
    assert len(common) >= len(before) - 2
    apart = np.abs([before[time] - after[time] for time in common])
    assert np.median(apart) < 2e-3
    assert apart.max() < 0.05


def test_csv_holds_every_row_with_units_in_its_heads(source: ExportSource, tmp_path: Path) -> None:
    written = write_csv(source, tmp_path / "csv")

    assert {path.stem for path in written} == set(source.manifest.tables)
    slip = pl.read_csv(tmp_path / "csv" / "slip.csv")
    stored = source.manifest.read("slip")
    assert slip["g_w [rad/s]"].to_list() == stored["g_w"].to_list()
    assert slip["stamp [ns]"].to_list() == stored["stamp"].to_list()
    assert (tmp_path / "csv" / "findings.csv").read_text().startswith("run,dataset,")


def test_the_foxglove_layout_is_of_the_shape_that_its_viewers_save(
    source: ExportSource, tmp_path: Path
) -> None:
    # What Foxglove Studio and Lichtblick declare: PanelsState, PlotConfig, RendererConfig.
    layout = json.loads(write_foxglove_layout(source, tmp_path / "l.json").read_text())
    assert set(layout) == {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"}

    def list_leaves(node: object) -> list[str]:
        if isinstance(node, str):
            return [node]
        assert isinstance(node, dict)
        assert node["direction"] in {"row", "column"}
        assert set(node) <= {"direction", "first", "second", "splitPercentage"}
        return [*list_leaves(node["first"]), *list_leaves(node["second"])]

    panels = layout["configById"]
    assert sorted(list_leaves(layout["layout"])) == sorted(panels)
    assert {name.split("!")[0] for name in panels} == {"3D", "Plot", "RosOut"}
    for name, panel in panels.items():
        if not name.startswith("Plot!"):
            continue
        assert {"paths", "showLegend", "showXAxisLabels", "isSynced", "xAxisVal"} <= set(panel)
        assert panel["xAxisVal"] == "timestamp"
        for path in panel["paths"]:
            assert {"value", "enabled", "timestampMethod"} <= set(path)
            assert path["timestampMethod"] in {"receiveTime", "headerStamp"}
    camera = panels["3D!map"]["cameraState"]
    places = source.manifest.read("velocities").select("x", "y").to_numpy()
    low, high = places.min(axis=0), places.max(axis=0)
    assert np.allclose(camera["targetOffset"][:2], (low + high) / 2.0, atol=0.01)
    assert camera["distance"] >= (high - low).max()


def test_the_plotjuggler_layout_is_what_its_loader_reads(source: ExportSource, tmp_path: Path) -> None:
    # What restoreSplitter and xmlLoadState of PlotJuggler 3 do: an area is a child of the splitter,
    # as many sizes as areas (it indexes them unchecked); MainWindow zooms to the data after loading.
    root = ET.parse(write_plotjuggler_layout(source, tmp_path / "l.xml")).getroot()  # noqa: S314 - our own
    widget = root.find("tabbed_widget")
    assert widget is not None
    assert widget.get("parent") == "main_window"
    (splitter,) = root.iterfind("tabbed_widget/Tab/Container/DockSplitter")
    assert splitter.get("orientation") in {"|", "-"}
    sizes = [float(size) for size in splitter.attrib["sizes"].split(";")]
    assert len(sizes) == len(splitter) == int(splitter.attrib["count"])
    assert sum(sizes) == pytest.approx(1.0)
    for area in splitter:
        assert area.tag == "DockArea"
        (plot,) = area
        assert (plot.tag, plot.get("mode"), plot.get("style")) == ("plot", "TimeSeries", "Lines")
        assert {curve.tag for curve in plot} == {"curve"}
        assert all(re.fullmatch("#[0-9a-f]{6}", curve.attrib["color"]) for curve in plot)


@pytest.mark.parametrize(
    ("name", "more", "words"),
    [
        ("where_it_turns.py", (), "median_modulus"),
        ("fit_by_hand.py", ("effective_track",), "effective_track.k"),
    ],
)
def test_the_examples_run(
    name: str,
    more: tuple[str, ...],
    words: str,
    results: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (run,) = Store(results).runs()
    arguments = [str(results), *((run, *more) if more else ())]
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    runpy.run_path(str(ROOT / "examples" / name))
    assert words in capsys.readouterr().out


MEASURE = """
import resource, sys
from pathlib import Path
from pipeline.report.viewer_files import write_csv
from pipeline.report.export_source import ExportSource
from pipeline.store import Store
def peak():
    if sys.platform == "darwin":
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # Not that of getrusage, which starts at what the process that started this one ever was.
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if "VmHWM" in line)
    return 1024 * int(line.split()[1])
(manifest,) = Store(Path(sys.argv[1])).manifests()
write_csv(ExportSource(manifest), Path(sys.argv[3]))
(manifest,) = Store(Path(sys.argv[2])).manifests()
before = peak()
write_csv(ExportSource(manifest), Path(sys.argv[3]))
print(peak() - before)
"""


def test_csv_of_a_long_run_takes_no_more_memory_than_of_a_short_one(results: Path, tmp_path: Path) -> None:
    """Even where the table is one part of its file."""
    copy = tmp_path / "results"
    shutil.copytree(results, copy)
    (manifest,) = Store(copy).manifests()
    frame = manifest.read("velocities")
    long = pl.concat([frame] * (1 + 1_000_000 // frame.height))
    long.write_parquet(manifest.path("velocities"), row_group_size=long.height)
    entry = replace(manifest.tables["velocities"], rows=long.height)
    grown = replace(manifest, tables={**manifest.tables, "velocities": entry})
    (manifest.folder.parent / "manifest.json").write_bytes(encode_manifest(grown))
    words = [str(results), str(copy), str(tmp_path / "csv")]
    done = subprocess.run(
        python_command("-c", MEASURE, *words), capture_output=True, text=True, check=True, timeout=100
    )
    assert int(done.stdout) < long.estimated_size() / 2


def test_formulas_in_texts_are_texts_in_csv(results: Path, tmp_path: Path) -> None:
    copy = tmp_path / "results"
    shutil.copytree(results, copy)
    (manifest,) = Store(copy).manifests()
    frame = manifest.read("slip").with_columns(terrain=pl.lit("=HYPERLINK(1)"), dataset=pl.lit("@x"))
    frame.with_columns(f_x=pl.lit(-1.5)).write_parquet(manifest.path("slip"))
    write_csv(ExportSource(manifest), tmp_path / "csv")
    found = pl.read_csv(tmp_path / "csv" / "slip.csv")
    assert found["terrain"].unique().to_list() == ["'=HYPERLINK(1)"]
    assert found["dataset"].unique().to_list() == ["'@x"]
    assert found["f_x [m/s]"].unique().to_list() == [-1.5]
