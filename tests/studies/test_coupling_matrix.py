"""Couplings by controllers: cells against presses and evaluations alone, strokes, page, figure, commands."""

import json
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from haptether.bridge import load_scene, override_scene, simulate
from haptether.cli.entry import main
from haptether.studies import (
    EVALUATED_NETWORKS,
    CouplingMatrix,
    DemoScene,
    PairCell,
    ReleaseBounds,
    couplings_html,
    couplings_markdown,
    draw_couplings,
    evaluate,
    evaluate_couplings,
    measure_thresholds,
)
from haptether.studies.demo import SCENE, _far, _hand, with_coupling
from haptether.studies.design.contact import scene_numbers
from haptether.studies.design.coupled import virtual_tool
from haptether.studies.design.gains import pressed_couplings
from haptether.studies.design.press import DEPTHS, OUTCOMES, Outcome, press, stroke
from haptether.studies.evaluation.matrix.figure import OUTCOME_COLOURS, shade
from haptether.studies.evaluation.matrix.measure import Median
from haptether.studies.evaluation.matrix.page import CLASSES
from haptether.studies.falsifier.release import Releases
from haptether.studies.thresholds import THRESHOLD_LAWS

pytestmark = pytest.mark.slow

STEADY, BOTH = EVALUATED_NETWORKS[0], EVALUATED_NETWORKS[3]
TRIP_S = 0.04
FEW: dict[str, Any] = {"controllers": ("none", "wsc"), "hands": 1, "releases": 1}


def links(round_trip_s: float) -> list[str]:
    """Return overrides of a link with this delay alone."""
    keys = (f"delay_s={round_trip_s / 2}", "jitter_s=0", "loss=0")
    return [f"link.{way}.{key}" for way in ("forward", "backward") for key in keys]


@pytest.fixture(scope="module")
def found() -> CouplingMatrix:
    return evaluate_couplings(
        "remote_push", couplings=("pd-damped", "pspm"), round_trips_s=(TRIP_S,), networks=(STEADY,), **FEW
    )


# ---------------------------------------------------------------------------------------------------------- measures


def test_a_pair_cell_is_the_press_and_the_stroke_alone(found: CouplingMatrix) -> None:
    scene = load_scene("remote_push", links(TRIP_S))
    for alone in pressed_couplings(scene, 1.0, ("pd-damped", "pspm")):
        (cell,) = found.of(alone.kind)
        pair = override_scene(scene, alone.changes)
        pressed, withdrawn = press(pair, found.wall), stroke(pair, found.wall)
        assert (cell.changes, cell.outcome, cell.runs, cell.held) == (alone.changes, "rests", 2, 0)
        for measured, value in (
            (cell.felt, pressed.felt), (cell.behind_m, pressed.behind), (cell.thrown, pressed.thrown),
            (cell.drift_m, withdrawn.drift), (cell.dissipated_j, withdrawn.dissipated_j),
        ):  # fmt: skip
            assert measured is not None
            assert measured.value == pytest.approx(value, rel=1e-9)
            assert measured.interval is None


@pytest.mark.parametrize("coupling", ["pd-damped", "pspm"])
def test_cells_of_the_hands_are_those_of_an_evaluation_with_these_gains(found: CouplingMatrix, coupling: str) -> None:
    (pair,) = found.of(coupling)
    alone = evaluate(
        ["remote_push"], round_trips_s=(TRIP_S,), networks=(STEADY,), overrides=pair.changes, transmitted=False, **FEW
    )
    assert found.evaluations[coupling].cells == alone.cells
    assert len(alone.cells) == 2


def test_felt_force_is_that_of_the_springs_in_series(found: CouplingMatrix) -> None:
    (cell,) = found.of("pspm")
    gains = dict(change.removeprefix("coupling.").split("=") for change in cell.changes)
    hand = load_scene("remote_push").operator
    assert hand is not None
    rigid = 1.0 / hand.stiffness + 1.0 / found.wall
    assert cell.felt is not None
    # Coulomb friction of the device holds a part.
    assert cell.felt.value == pytest.approx(rigid / (rigid + 1.0 / float(gains["stiffness"])), rel=0.02)


def test_a_network_with_losses_has_intervals_over_its_seeds() -> None:
    pressed = evaluate_couplings(
        "remote_push", couplings=("pspm",), round_trips_s=(0.0,), networks=(replace(BOTH, mean_burst=1.0),),
        **{**FEW, "controllers": ("none",)},
    )  # fmt: skip
    (cell,) = pressed.pairs
    assert (cell.outcome, cell.runs, cell.held) == ("rests", 12, 0)
    assert cell.dissipated_j is not None
    low, high = cell.dissipated_j.interval or (0.0, 0.0)
    assert low < cell.dissipated_j.value < high


PSPM = ("coupling.kind=pspm", "coupling.stiffness=60")
PD = ("coupling.kind=pd-damped", "coupling.stiffness=84", "coupling.damping=6.6")


@pytest.mark.parametrize(
    ("changes", "wall", "outcome", "sign"),
    [
        (PD, 100.0, "rests", 1),
        ((*PD, "slave.period_s=0.002"), 100.0, "rests", 1),
        # A late force gives energy to the hand.
        (("coupling.kind=position-force",), 100.0, "rests", -1),
        (("coupling.kind=position-force-computed", "coupling.stiffness=300"), 2000.0, "swings", -1),
    ],
)
def test_a_stroke_dissipates_under_a_passive_coupling_and_gains_energy_under_others(
    changes: tuple[str, ...], wall: float, outcome: str, sign: int
) -> None:
    made = stroke(load_scene("remote_push", [*links(0.1), *changes]), wall)
    assert made.outcome == outcome
    assert sign * made.dissipated_j > 1e-3
    assert outcome == "swings" or made.drift < 5e-5


@pytest.mark.parametrize("round_trip_s", [0.0, 0.02])
def test_dissipated_energy_is_that_of_dampers_tool_and_late_spring(round_trip_s: float) -> None:
    """`(2 B + B_tool + K (T1 + T2)) int v^2 dt`, with `int v^2 dt = 10/7 d^2 / T` of each minimum-jerk stroke."""
    scene = load_scene("remote_push", [
        *links(round_trip_s), "coupling.kind=pd-damped", "coupling.stiffness=1000", "coupling.damping=6",
        "operator.stiffness=3000", "operator.damping=30",
    ])  # fmt: skip
    damping = 12.0 + virtual_tool(scene_numbers(scene)).damping + 1000.0 * round_trip_s
    travelled_m = 2.0 * DEPTHS["linear"]
    # The wall is soft, so that the arm follows the path.
    assert stroke(scene, 10.0).dissipated_j == pytest.approx(2.0 * damping * 10.0 / 7.0 * travelled_m**2, rel=0.06)


def test_tdpa_leaves_the_arm_behind_after_a_fast_stroke_and_pspm_does_not() -> None:
    tdpa, pspm = (
        stroke(load_scene("remote_push", [*links(0.3), f"coupling.kind={kind}"]), 100.0) for kind in ("tdpa", "pspm")
    )
    assert tdpa.drift > 100.0 * pspm.drift


# --------------------------------------------------------------------------------------------------- page and figure


def cell(
    coupling: str, round_trip_s: float, outcome: Outcome, felt: float | None = 0.5, network: str = "steady"
) -> PairCell:
    known = None if felt is None else Median(value=felt, interval=(felt - 0.1, felt + 0.1))
    return PairCell(
        coupling=coupling, round_trip_s=round_trip_s, network=network, changes=(f"coupling.kind={coupling}",),
        outcome=outcome, runs=12, held=1, felt=known, behind_m=known, drift_m=known, dissipated_j=known, thrown=known,
        stable_up_to_s=None,
    )  # fmt: skip


DRAWN = CouplingMatrix(
    task="push", unit="m", wall=100.0, couplings=("wave", "tdpa"), round_trips_s=(0.0, 0.1),
    networks=(STEADY, BOTH), evaluations={}, refused=("pd-damped at 0 ms: no gains.",),
    pairs=(
        cell("wave", 0.0, "rests", 0.75), cell("wave", 0.1, "rests", 0.51),
        cell("wave", 0.0, "rests", 0.64, "jitter+loss"), cell("wave", 0.1, "swings", 0.2, "jitter+loss"),
        cell("tdpa", 0.0, "rests", 0.94), cell("tdpa", 0.1, "held", None),
        cell("tdpa", 0.0, "diverged", None, "jitter+loss"),
    ),
)  # fmt: skip


def test_a_coupling_rests_up_to_the_first_round_trip_at_which_a_network_makes_it_swing() -> None:
    assert (DRAWN.rests_up_to_s("wave"), DRAWN.rests_up_to_s("tdpa")) == (0.0, None)


def test_page_and_figure_say_force_or_outcome_of_each_cell() -> None:
    page = couplings_markdown(DRAWN, command="haptether evaluate")
    assert "| wave | 64 % | swings |" in page
    assert "| tdpa | diverged | held |" in page
    assert "- wave: rests up to 0 ms; at 100 ms, jitter+loss: swings." in page
    assert "75 (65 to 85)" in page
    assert "pd-damped at 0 ms: no gains." in page
    panels = draw_couplings(DRAWN).axes
    texts = [[(text.get_text()) for text in panel.texts if text.get_gid() != "letter"] for panel in panels]
    assert texts == [["75", "51", "94", "held"], ["64", "swings", "diverged", "-"]]
    colours = [patch.get_facecolor() for patch in panels[1].patches]
    assert len(set(colours)) == 4
    html = couplings_html(DRAWN)
    assert html.count("<svg") == 1
    assert "class=diverged>diverged" in html


def test_the_shade_is_white_for_nothing_and_blue_for_all() -> None:
    assert (shade(0.0), shade(1.0), shade(1.3)) == ("#ffffff", "#60a5d9", "#60a5d9")


def test_each_outcome_that_is_not_at_rest_has_a_colour_in_figure_and_page() -> None:
    unrested = [outcome for outcome in OUTCOMES if outcome != "rests"]
    assert list(OUTCOME_COLOURS) == unrested
    assert set(CLASSES) == set(unrested)


# ---------------------------------------------------------------------------------------------------------- commands


def test_the_command_writes_pages_picture_and_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = (
        "evaluate --couplings pspm --controllers none wsc --hands 1 --releases 1 --round-trip-s 0.04 --network steady"
        f" --out {tmp_path}/out --json {tmp_path}/m.json --plot {tmp_path}/m.png"
    )
    assert main(command.split()) == 0
    assert "pspm: rests up to 40 ms." in capsys.readouterr().out
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["evaluation.html", "evaluation.md"]
    assert (tmp_path / "m.png").stat().st_size > 10_000
    report = json.loads((tmp_path / "m.json").read_text())
    assert {"pairs", "hands", "networks", "wall", "rests_up_to_s"} <= report.keys()
    (pair,), (hands,) = report["pairs"], report["hands"]
    assert set(pair) == set(PairCell.__struct_fields__)
    assert pair["felt"]["value"] > 0.5
    assert [one["cell"]["controllers"] for one in hands["cells"]] == ["none", "wsc"]
    for one in hands["cells"]:
        rate, low, high = one["false_trips_per_h"]
        assert low <= rate < high
    assert hands["unthrown_up_to_s"]["wsc"] == TRIP_S


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("evaluate --couplings waves", "'waves' is none of position-force, position-force-computed"),
        ("evaluate --couplings all --controllers hcs", "'hcs' is none of none, vfc"),
        ("evaluate remote_push valve --couplings all", "compares couplings of one scene"),
        ("evaluate paper_wall --couplings all", "paper_wall: a coupling needs two sides: add [slave]"),
        ("evaluate --couplings all --latex m.tex", "--latex: has verdicts of controllers"),
        ("demo --coupling waves", "coupling = 'waves': must be one of position-force"),
        ("demo --coupling pspm --task pick", "coupling = pspm: of the push with a simulated master only"),
    ],
)
def test_what_does_not_go_together_is_refused_by_name(
    command: str, said: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(command.split()) == 2
    assert said in " ".join(capsys.readouterr().err.split())


def test_both_sides_of_a_demonstration_have_the_coupling_and_its_gains() -> None:
    scene = with_coupling(DemoScene(), "pd-damped")
    assert scene.gains[0] == "coupling.kind=pd-damped"
    sides = [load_scene(words[1], words[3::2]) for words in (_hand(scene, "wsc"), _far(scene))]
    couplings = [side.coupling for side in sides]
    assert couplings[0] == couplings[1] == load_scene(SCENE, scene.gains).coupling
    assert sides[0].safety.controllers == ("wsc",)
    assert load_scene(SCENE, _hand(scene, "none")[3::2]).safety.controllers == ()


def test_thresholds_take_the_coupling_of_a_scene() -> None:
    law = next(law for law in THRESHOLD_LAWS if law.controller == "wsc")
    rows = [
        measure_thresholds(
            tasks=["remote_push"], laws=[replace(law, values=(law.default,))], round_trips_s=(0.1,), hands=1,
            releases=1, overrides=overrides,
        ).rows
        for overrides in ((), PSPM)
    ]  # fmt: skip
    assert rows[0] != rows[1]


def test_releases_of_falsify_are_thrown_through_the_coupling_of_the_scene() -> None:
    speeds = []
    for overrides in ((), PSPM):
        releases = Releases(load_scene("remote_push", ["safety.controllers=[]", *overrides]), ReleaseBounds(steps=1))
        thrown = releases.scene_of(releases.of([0.5] * releases.size))
        assert (thrown.coupling is None) == (not overrides)
        speeds.append(simulate(thrown).metrics.max_ejection_velocity or 0.0)
    # The soft spring of pspm throws the device slower than the full force does.
    assert 0.1 < speeds[1] < 0.7 * speeds[0]
