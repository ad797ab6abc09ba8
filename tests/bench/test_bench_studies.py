"""Tables of a benchmark: which result goes where, worked by hand, and what they look like."""

from __future__ import annotations

import csv
import io
import math
from typing import Any

import cv2
import numpy as np
import pytest

from ortholoc_edge.bench import bench_page, studies
from ortholoc_edge.bench.campaign import GROUND_TRUTH, Piece
from ortholoc_edge.bench.condition import USUAL, Condition
from ortholoc_edge.bench.paper import Result, Task
from ortholoc_edge.bench.plots import study_plot
from ortholoc_edge.bench.samples import SampleKind
from ortholoc_edge.bench.studies import STUDIES
from ortholoc_edge.bench.tables import Cell, Column, Table


def result(**changes: Any) -> Result:
    values: dict[str, Any] = {
        "condition": USUAL, "task": Task.LOCALIZE, "adhop": False, "me_px": 2.0, "te_m": 0.5, "re_deg": 0.25,
        "rpe_px": 3.0, "rfe": None, "matches": 100, "found": 200, "inliers": 60, "adhop_accepted": None,
        "calibrated": None, "cpu_s": 0.5, "wall_s": 0.6,
    }  # fmt: skip
    return Result(**(values | changes))


NO_POSE = {"te_m": None, "re_deg": None, "rpe_px": None, "inliers": 0}


def piece(*results: Result, **changes: Any) -> Piece:
    values: dict[str, Any] = {
        "sample": "A", "mark": "1-1", "kind": SampleKind.SAME, "split": None, "matcher": "xfeat", "model_sha256": None,
        "height_m": 90.0, "tilt_deg": 20.0, "pixel_m": 0.1,
    }  # fmt: skip
    return Piece(results=results, **(values | changes))


def rows(table: Table) -> list[dict[str, Cell]]:
    return [dict(zip((column.heading for column in table.columns), row, strict=True)) for row in table.rows]


def test_the_main_table_worked_by_hand() -> None:
    pieces = [
        piece(result(te_m=0.5), sample="A"),
        piece(result(te_m=2.0), sample="B"),
        piece(result(**NO_POSE, me_px=None), sample="C"),
        # None of the usual condition.
        piece(result(te_m=99.0, condition=Condition(covisibility=0.5)), sample="D"),
    ]
    (row,) = rows(studies.main_table(pieces, Task.LOCALIZE))
    assert (row["matcher"], row["AdHoP"], row["samples"], row["no pose"]) == ("xfeat", "off", 3.0, 1.0)
    # What has no pose is infinitely wrong, in the median too.
    assert (row["TE m"], row["TE m p90"], row["ME px"]) == (2.0, math.inf, 2.0)
    assert row["1m-1° %"] == pytest.approx(100 / 3)
    assert row["3m-3° %"] == pytest.approx(200 / 3)
    # The paper's for XFeat without AdHoP, table "Quantitative Localization Results".
    assert (row["paper: TE m"], row["paper: 1m-1° %"], row["paper: 5m-5° %"]) == (1.58, 42.7, 61.2)
    assert rows(studies.main_table(pieces, Task.CALIBRATE)) == []


def test_the_papers_figures_are_all_there() -> None:
    found = studies.paper_figures()
    assert len(found) == 2 * 2 * 16
    # Read by eye.
    assert found[Task.LOCALIZE, "gim-dkm", True]["1m_1deg"] == 75.4
    assert found[Task.LOCALIZE, "xfeat-star", False]["me_px"] == 222.2
    assert found[Task.CALIBRATE, "roma", True]["te_m"] == 10.62
    assert found[Task.CALIBRATE, "superpoint-lightglue", False]["rfe_percent"] == 1.9
    assert "rfe_percent" not in found[Task.LOCALIZE, "roma", True]


def test_calibration_tells_whose_focal_length_is_called_one() -> None:
    given = {"task": Task.CALIBRATE}
    pieces = [
        piece(result(**given, rfe=0.01, calibrated=True), sample="A"),
        piece(result(**given, rfe=0.5, calibrated=False), sample="B"),
        piece(result(**given, **NO_POSE, calibrated=False), sample="C"),
    ]
    (row,) = rows(studies.main_table(pieces, Task.CALIBRATE))
    assert (row["RFE %"], row["RFE % of those"]) == (50.0, 1.0)
    assert row["called calibrated %"] == pytest.approx(100 / 3)


def test_what_adhop_changes_sample_by_sample() -> None:
    def both(name: str, before: dict[str, Any], after: dict[str, Any], taken: bool) -> Piece:
        return piece(result(**before), result(**after, adhop=True, adhop_accepted=taken), sample=name)

    pieces = [
        both("gained", {"te_m": 5.0}, {"te_m": 0.5}, True),
        both("lost", {"te_m": 0.5}, {"te_m": 5.0}, True),
        both("as before", {"te_m": 0.7}, {"te_m": 0.7}, False),
        both("found", NO_POSE, {"te_m": 0.2}, True),
        piece(result(), sample="without a second"),
    ]
    (row,) = rows(studies.adhop_table(pieces, Task.LOCALIZE))
    assert (row["samples"], row["taken %"]) == (4.0, 75.0)
    assert (row["1m-1° gained"], row["1m-1° lost"], row["taken though TE worse"]) == (2.0, 1.0, 1.0)
    assert (row["TE m without"], row["TE m with"]) == (pytest.approx(2.85), pytest.approx(0.6))


def test_studies_take_what_is_theirs() -> None:
    scales = [result(condition=Condition(raster_scale=s), te_m=1.0 / s) for s in (0.5, 0.3, 0.1)]
    others = [result(condition=Condition(query_scale=0.5)), result(condition=Condition(covisibility=0.2))]
    pieces = [piece(result(), *scales, *others)]
    (raster, query), (covisibility,) = STUDIES["resolution"], STUDIES["covisibility"]
    found = rows(studies.study_table(pieces, raster, Task.LOCALIZE))
    assert [row["raster scale"] for row in found] == [1.0, 0.5, 0.3, 0.1]
    assert found[3]["TE m"] == 10.0
    assert [row["photo scale"] for row in rows(studies.study_table(pieces, query, Task.LOCALIZE))] == [1.0, 0.5]
    assert [r["covisibility"] for r in rows(studies.study_table(pieces, covisibility, Task.LOCALIZE))] == [1.0, 0.2]


@pytest.mark.parametrize(
    ("study", "changes", "value"),
    [
        ("domain", {"kind": SampleKind.XDOPDSM}, "xDOPDSM"),
        ("height", {"height_m": 49.9}, "0 to 50"),
        ("height", {"height_m": 50.0}, "50 to 75"),
        ("height", {"height_m": 900.0}, "150 and more"),
        ("tilt", {"tilt_deg": 0.0}, "0 to 15"),
        ("tilt", {"tilt_deg": 61.0}, "60 and more"),
    ],
)
def test_classes(study: str, changes: dict[str, Any], value: str) -> None:
    (one,) = STUDIES[study]
    (row,) = rows(studies.study_table([piece(result(), **changes)], one, Task.LOCALIZE))
    assert row[one.headings[0]] == value


def test_classes_come_in_their_order() -> None:
    (height,), (domain,) = STUDIES["height"], STUDIES["domain"]
    pieces = [piece(result(), sample=str(h), height_m=h) for h in (200.0, 10.0, 120.0)]
    found = rows(studies.study_table(pieces, height, Task.LOCALIZE))
    assert [row["height m"] for row in found] == ["0 to 50", "100 to 150", "150 and more"]
    pieces = [piece(result(), sample=k, kind=k) for k in (SampleKind.XDOPDSM, SampleKind.SAME, SampleKind.XDOP)]
    assert [r["kind"] for r in rows(studies.study_table(pieces, domain, Task.LOCALIZE))] == ["R", "xDOP", "xDOPDSM"]


def test_the_truth_has_its_own_study_and_no_other() -> None:
    (confidence,), (covisibility,) = STUDIES["confidence"], STUDIES["covisibility"]
    above = [result(condition=Condition(min_confidence=a), matches=int(200 * (1 - a))) for a in (0.0, 0.5, 0.95)]
    pieces = [piece(*above, matcher=GROUND_TRUTH), piece(result())]
    found = rows(studies.study_table(pieces, confidence, Task.LOCALIZE))
    kept = [(row["confidence above"], row["matches kept %"]) for row in found]
    assert kept == [(0.95, 5.0), (0.5, 50.0), (0.0, 100.0)]
    assert [row["matcher"] for row in rows(studies.study_table(pieces, covisibility, Task.LOCALIZE))] == ["xfeat"]
    assert studies.conditions_for("xfeat", [confidence]) == [USUAL]
    assert len(studies.conditions_for(GROUND_TRUTH, [confidence, covisibility])) == 4
    assert len(studies.conditions_for("xfeat", [confidence, covisibility])) == 7


# -- what they look like -------------------------------------------------------------------------------

TABLE = Table(
    "t", "A title: 50 %", [Column("matcher"), Column("AdHoP"), Column("scale"), Column("TE m"), Column("1m-1° %", 1)],
    [["a_b", "on", 1.0, 0.123456, 100.0], ["a_b", "on", 0.1, math.inf, 0.0], ["c", "off", 1.0, None, 12.34]],
)  # fmt: skip


def test_markdown_latex_and_csv() -> None:
    assert TABLE.markdown().splitlines()[2:] == [
        "| a_b | on | 1.00 | 0.12 | 100.0 |", "| a_b | on | 0.10 | ∞ | 0.0 |", "| c | off | 1.00 | - | 12.3 |",
    ]  # fmt: skip
    latex = TABLE.latex()
    assert r"\begin{tabular}{llrrr}" in latex
    assert r"a\_b & on & 0.10 & $\infty$ & 0.0 \\" in latex
    assert r"1m-1$^\circ$ \%" in latex
    parsed = list(csv.DictReader(io.StringIO(TABLE.csv())))
    assert [row["TE m"] for row in parsed] == ["0.123456", "inf", ""]
    with pytest.raises(ValueError, match="table t"):
        Table("t", "", [Column("a")], [["1", "2"]])


def test_a_plot_has_a_line_for_each_matcher_and_is_the_same_twice() -> None:
    pytest.importorskip("matplotlib")
    table = Table("t", "Title", TABLE.columns, [["a", "on", s, s, 90.0 * s] for s in (1.0, 0.5, 0.1)])
    data = study_plot(table, ["scale"])
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert image.shape == (480, 1200, 3)
    blue = (np.abs(image.astype(int) - (0xB4, 0x77, 0x1F)).max(axis=2) < 30).sum(axis=0)
    assert blue[:600].max() > 0
    assert blue[600:].max() > 0
    assert study_plot(table, ["scale"]) == data


def test_a_page_needs_nothing_else() -> None:
    text = bench_page.page("<T>", ["a & b"], [(TABLE, b"png")], [("<case>", np.zeros((8, 8, 3), np.uint8))])
    assert "&lt;T&gt;" in text
    assert "<case>" not in text
    assert text.count("data:image/") == 2
    for outside in ("http", "src=\"/", "<script", "<link"):
        assert outside not in text
