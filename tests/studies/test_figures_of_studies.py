"""Figures, tables and captions of the studies: words only, nothing overlaps, valid LaTeX."""

import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from tests.studies.test_evaluation import CELL
from tests.view.figures import check, texts_of

from haptether import __version__
from haptether.cli.entry import main
from haptether.studies import EVALUATED_NETWORKS, Evaluation, EvaluationCell, EvaluationLimits, draw_evaluation
from haptether.studies.latex import escaped
from haptether.studies.task import ROUND_TRIPS_S
from haptether.studies.thresholds.figure import draw_trade_off
from haptether.studies.thresholds.law import THRESHOLD_LAWS
from haptether.studies.thresholds.trade_off import TradeOff, TradeOffRow
from haptether.studies.tuning.figure import draw_tuning
from haptether.studies.tuning.normal_operation import TUNED_FIELDS
from haptether.studies.tuning.tune import RocPoint, TunedThreshold, Tuning
from haptether.view import picture_style
from haptether.view.style.figure import Columns, PictureStyle

pytestmark = pytest.mark.slow


def trade_off(columns: Columns) -> Figure:
    trips = (0.0, 0.1, 0.3)
    rows = [
        TradeOffRow(law=law.name, source=law.source, controller=law.controller, threshold=value, task="push",
                    round_trip_s=trip_s, hours=0.1, false_trips=10 * place, releases=20,
                    missed=max(0, 20 - 4 * place), speed=0.4)
        for law in THRESHOLD_LAWS for place, value in enumerate(law.values) for trip_s in trips
    ]  # fmt: skip
    return draw_trade_off(
        TradeOff(rows=tuple(rows), laws=THRESHOLD_LAWS, tasks=("push",), round_trips_s=trips, hands=6, seed=1),
        columns=columns,
    )


def tuning(columns: Columns) -> Figure:
    def point(field: str, place: int) -> RocPoint:
        return RocPoint(
            threshold=TUNED_FIELDS[field].sign * (0.01 + 0.01 * place), false_trips_per_h=100.0 / (place + 1),
            false_trips_per_h_interval=(1.0, 200.0), releases=16, missed=place, missed_interval=(0.0, 0.9), mev=0.4,
        )  # fmt: skip

    tuned = [
        TunedThreshold(
            controller=of.controller, field=field, unit=of.unit, point=point(field, 2), order=2, grouping=1.0,
            most_per_h=60.0, reached=True, needed_hours=0.1, interventions=(), recorded=point(field, 3),
            roc=tuple(point(field, place) for place in range(8)), peaks=tuple(of.sign * np.linspace(0.09, 0.01, 40)),
        )
        for field, of in TUNED_FIELDS.items()
    ]  # fmt: skip
    return draw_tuning(
        Tuning(files=("a.mcap",), hours=0.1, blocks=1, per_hour=60.0, confidence=0.95, round_trip_s=0.1,
               missed_speed=0.5, hands=16, seed=1, thresholds=tuple(tuned), safety={}, notes=()),
        columns=columns,
    )  # fmt: skip


def evaluation(columns: Columns) -> Figure:
    controllers = ("none", "vfc", "hsc", "wsc", "hsc+wsc", "vfc+hsc+wsc")
    cells = [
        EvaluationCell(**{**CELL, "controllers": name, "round_trip_s": trip_s, "thrown": 4 if name == "none" else 0})
        for name in controllers
        for trip_s in ROUND_TRIPS_S
    ]
    return draw_evaluation(
        Evaluation(cells=tuple(cells), worst=(), tasks=("push",), controllers=controllers, round_trips_s=ROUND_TRIPS_S,
                   networks=EVALUATED_NETWORKS[:1], limits=EvaluationLimits(), hands=8, releases=2, seed=1,
                   version="0", assumed=()),
        columns=columns,
    )  # fmt: skip


@pytest.mark.parametrize("draw", [trade_off, tuning, evaluation])
@pytest.mark.parametrize("columns", [1, 2])
@pytest.mark.parametrize("style", ["screen", "paper"])
def test_no_label_of_a_study_falls_off_or_overlaps_or_is_a_key(
    draw: Callable[[Columns], Figure], columns: Columns, style: PictureStyle
) -> None:
    with picture_style(style):
        figure = draw(columns)
    check(figure)
    assert [text.get_text() for text in texts_of(figure) if re.search(r"[a-z]{2}_[a-z]{2}", text.get_text())] == []
    assert bool(figure.get_suptitle()) == (style == "screen")


def test_text_is_escaped_for_latex() -> None:
    assert escaped("a_b 5 % {x} #1 a&b $ ~ ^ m/s² \\ --set x>1") == (
        r"a\_b 5 \% \{x\} \#1 a\&b \$ \textasciitilde{} \textasciicircum{} m/s\textsuperscript{2} \textbackslash{}"
        r" -{}-set x\textgreater{}1"
    )


SWEEP = (
    "sweep remote_push --vary link.forward.delay_s=0.02,0.1 --vary safety.controllers=none,[hsc] --vary run.seed=1,2"
)
EVALUATE = "evaluate remote_push --controller none hsc --round-trip-s 0.05 --hands 1 --releases 1"


@pytest.mark.parametrize(
    ("command", "columns", "rows", "sources"),
    [
        (f"{SWEEP} --metrics max_ejection_velocity,position_rmse_m", 4, 4, ["HSC", "position-force"]),
        (f"{SWEEP} --summary max_ejection_velocity max_ejection_velocity>0.5 --against safety.controllers=none", 6, 4,
         ["HSC"]),
        (EVALUATE, 3, 2, ["HSC", "position-force"]),
    ],
)  # fmt: skip
def test_latex_has_a_table_and_a_figure_with_command_version_and_sources(
    command: str, columns: int, rows: int, sources: list[str], tmp_path: Path
) -> None:
    tex, picture = tmp_path / "a.tex", tmp_path / "a.pdf"
    files = ["--latex", str(tex), "--plot", str(picture), "--style", "paper", "--columns", "1"]
    assert main([*command.split(), *files]) == 0
    text = tex.read_text()
    bare = re.sub(r"\\[{}]", "", text)
    assert bare.count("{") == bare.count("}")
    opened, closed = re.findall(r"\\begin\{(.*?)\}", text), re.findall(r"\\end\{(.*?)\}", text)
    assert sorted(opened) == sorted(closed)
    assert "figure" in opened
    (body,) = re.findall(r"\\toprule\n(.*?)\\bottomrule", text, re.DOTALL)
    lines = [line for line in body.splitlines() if line != r"\midrule"]
    assert [len(re.split(r"(?<!\\)&", line)) for line in lines] == [columns] * (rows + 1)
    assert all(line.endswith(r" \\") for line in lines)
    for caption in re.findall(r"\\caption\{.*", text):
        assert f"Haptether {__version__}: \\texttt{{haptether {command.split(maxsplit=1)[0]} remote\\_push" in caption
        assert "Eq. 14" in caption
        assert all(f"{source}: " in caption for source in sources), caption
    assert len(re.findall(r"\\caption\{", text)) == 2
    assert r"\includegraphics[width=\linewidth]{a.pdf}" in text
    assert picture.read_bytes().startswith(b"%PDF")
    if shutil.which("pdflatex") and subprocess.run(["kpsewhich", "booktabs.sty"], check=False).returncode == 0:
        packages = r"\documentclass[twocolumn]{article}\usepackage{booktabs,graphicx}"
        (tmp_path / "page.tex").write_text(rf"{packages}\begin{{document}}\input{{a.tex}}\end{{document}}")
        compiled = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "-draftmode", "page.tex"]
        ran = subprocess.run(compiled, check=False, cwd=tmp_path, stdout=subprocess.PIPE, text=True, timeout=60.0)
        assert ran.returncode == 0, ran.stdout
