"""Exports: read back by the readers that others wrote, and by people's viewers' rules."""

import json
import re
import runpy
import shutil
import sys
from collections import Counter
from operator import attrgetter
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import polars as pl
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.estimation.stored_diagnosis import read_slip
from pipeline.models import Model, ModelFile, find_effect
from pipeline.report.viewer_files import write_layout, write_slip_log, write_tables
from pipeline.simulate import simulate_case
from pipeline.sources.one_vehicle import load_vehicle
from pipeline.store import Manifest, Store

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
def manifest(results: Path) -> Manifest:
    (manifest,) = Store(results).manifests()
    return manifest


@pytest.fixture(scope="module")
def derived(manifest: Manifest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    model = Model(load_vehicle(manifest), (find_effect("effective_track")(k=1.7),))
    path = tmp_path_factory.mktemp("derived") / "run_slip.mcap"
    return write_slip_log(manifest, read_slip(manifest, ModelFile(model)), path)


@pytest.fixture(scope="module")
def found(derived: Path) -> dict[str, list[tuple[int, Any]]]:
    """Times and messages by topic, by the official reader."""
    found: dict[str, list[tuple[int, Any]]] = {}
    with derived.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
    return found


def test_readers_of_others_find_what_the_tables_hold(
    manifest: Manifest, derived: Path, found: dict[str, list[tuple[int, Any]]]
) -> None:
    velocities, slip = manifest.read("velocities"), manifest.read("slip")
    measured = found["/slip/velocity/measured"]
    assert [time for time, _ in measured] == velocities["stamp"].to_list()
    assert [message.twist.angular.z for _, message in measured] == velocities["v_w"].to_list()
    moduli = {
        name: [one.data for _, one in found[f"/slip/{name}"]]
        for name in ("modulus_measured", "modulus_command", "residual_modulus_command")
    }
    assert moduli["modulus_measured"] == slip.filter(pl.col("input") == "measured")["modulus"].to_list()
    # The model that is named is nearer than the ideal one.
    assert np.median(moduli["residual_modulus_command"]) < 0.7 * np.median(moduli["modulus_command"])
    assert {"/slip/velocity/model_command", "/slip/pose", "/slip/path", "/slip/segment"} <= set(found)
    assert len(found["/slip/path"][0][1].poses) == velocities.height
    stored = manifest.read("findings").sort(pl.col("t_start").fill_null(0.0), maintain_order=True)
    assert [one.name for _, one in found.get("/slip/findings", [])] == stored["id"].to_list()
    with AnyReader([derived]) as reader:
        others = Counter(
            connection.topic
            for connection, _, raw in reader.messages()
            if reader.deserialize(raw, connection.msgtype)
        )
    assert others == {topic: len(messages) for topic, messages in found.items()}


def test_layouts_name_topics_and_numbers_that_the_log_holds(
    found: dict[str, list[tuple[int, Any]]], tmp_path: Path
) -> None:
    messages = {topic: rows[0][1] for topic, rows in found.items()}
    layout = json.loads(write_layout("foxglove-layout", tmp_path / "layout.json").read_text("utf-8"))
    panels = layout["configById"]
    lines = [
        line["value"] for name, panel in panels.items() if name.startswith("Plot") for line in panel["paths"]
    ]
    tree = ET.parse(write_layout("plotjuggler-layout", tmp_path / "layout.xml"))  # noqa: S314 - our own
    curves = [curve.attrib["name"] for curve in tree.iter("curve")]
    assert len(lines) == len(curves) > 10
    for text, separator in [*((line, ".") for line in lines), *((curve, "/") for curve in curves)]:
        topic = max((one for one in messages if text.startswith(f"{one}{separator}")), key=len, default="")
        assert topic, text
        path = text.removeprefix(f"{topic}{separator}").replace(separator, ".")
        assert isinstance(attrgetter(path)(messages[topic]), float), text
    topics = {*panels["3D!map"]["topics"], panels["RosOut!findings"]["topicToRender"]}
    assert topics - messages.keys() <= {"/slip/findings"}


def test_tables_keep_rows_units_and_frames(manifest: Manifest, tmp_path: Path) -> None:
    for kind in ("csv", "parquet"):
        written = write_tables(manifest, kind, tmp_path)
        assert {path.stem for path in written} == set(manifest.tables)
    slip, stored = pl.read_csv(tmp_path / "slip.csv"), manifest.read("slip")
    assert slip["g_w [rad/s]"].to_list() == stored["g_w"].to_list()
    assert slip["stamp [ns]"].to_list() == stored["stamp"].to_list()
    assert (tmp_path / "findings.csv").read_text().startswith("run,dataset,")
    assert pq.read_schema(tmp_path / "slip.parquet").field("g_w").metadata[b"unit"] == b"rad/s"
    assert pl.read_parquet(tmp_path / "slip.parquet").equals(stored)


def test_the_foxglove_layout_is_of_the_shape_that_its_viewers_save(tmp_path: Path) -> None:
    # What Foxglove Studio and Lichtblick declare: PanelsState, PlotConfig, RendererConfig.
    layout = json.loads(write_layout("foxglove-layout", tmp_path / "l.json").read_text())
    assert set(layout) == {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"}

    leaves, nodes = [], [layout["layout"]]
    while nodes:
        node = nodes.pop()
        if isinstance(node, str):
            leaves.append(node)
            continue
        assert node["direction"] in {"row", "column"}
        assert set(node) <= {"direction", "first", "second", "splitPercentage"}
        nodes += [node["first"], node["second"]]
    panels = layout["configById"]
    assert sorted(leaves) == sorted(panels)
    assert {name.split("!")[0] for name in panels} == {"3D", "Plot", "RosOut"}
    for panel in (one for name, one in panels.items() if name.startswith("Plot!")):
        assert {"paths", "showLegend", "showXAxisLabels", "isSynced", "xAxisVal"} <= set(panel)
        assert panel["xAxisVal"] == "timestamp"
        for path in panel["paths"]:
            assert {"value", "enabled", "timestampMethod"} <= set(path)
            assert path["timestampMethod"] in {"receiveTime", "headerStamp"}


def test_the_plotjuggler_layout_is_what_its_loader_reads(tmp_path: Path) -> None:
    # What restoreSplitter and xmlLoadState of PlotJuggler 3 do: an area is a child of the splitter,
    # as many sizes as areas (it indexes them unchecked); MainWindow zooms to the data after loading.
    root = ET.parse(write_layout("plotjuggler-layout", tmp_path / "l.xml")).getroot()  # noqa: S314 - our own
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


def test_formulas_in_texts_are_texts_in_csv(results: Path, tmp_path: Path) -> None:
    copy = tmp_path / "results"
    shutil.copytree(results, copy)
    (manifest,) = Store(copy).manifests()
    frame = manifest.read("slip").with_columns(terrain=pl.lit("=HYPERLINK(1)"), dataset=pl.lit("@x"))
    frame.with_columns(f_x=pl.lit(-1.5)).write_parquet(manifest.path("slip"))
    write_tables(manifest, "csv", tmp_path / "csv")
    found = pl.read_csv(tmp_path / "csv" / "slip.csv")
    assert found["terrain"].unique().to_list() == ["'=HYPERLINK(1)"]
    assert found["dataset"].unique().to_list() == ["'@x"]
    assert found["f_x [m/s]"].unique().to_list() == [-1.5]
