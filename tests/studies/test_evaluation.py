"""Evaluation: verdicts of cells, measured values against closed forms, worst release, page, command."""

import json
import re
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from matplotlib.patches import Rectangle
from msgspec.structs import replace

from haptether.bridge import LinksTable, RecordTable, load_scene, simulate
from haptether.cli.entry import main
from haptether.cli.scene.evaluate import Evaluate
from haptether.cli.shared.repeat import command_line
from haptether.netsim import PRESETS, LinkSettings
from haptether.studies import (
    EVALUATED_NETWORKS,
    Evaluation,
    EvaluationCell,
    EvaluationLimits,
    Network,
    draw_evaluation,
    evaluate,
    evaluation_html,
    evaluation_markdown,
    network_of,
)
from haptether.studies.evaluation.evaluate import transmitted_impedance
from haptether.studies.evaluation.result import MOST_HANDS, totals
from haptether.studies.intervals import poisson_interval, wilson_interval
from haptether.studies.task import Task

pytestmark = pytest.mark.slow

CELL: dict[str, Any] = {
    "task": "push", "controllers": "wsc", "round_trip_s": 0.0, "network": "steady", "held": {"complete": 8},
    "hours": 0.1, "holds": 0, "false_trips": 0, "intervention_share": 0.0, "can_push": True, "releases": 8,
    "already_tripped": 0, "dangerous": 4, "thrown": 0,
    "speeds": (0.2, 0.3, 0.3, 0.4), "speed": 0.3, "speed_interval": None, "max_speed": 0.4,
    "detections_s": (0.03,) * 4, "detection_s": 0.03, "undetected": 0,
    "peak_force_n": 3.0, "energy_j": 0.1, "position_rmse_m": 1e-3, "force_rmse_n": 0.1, "stiffness": None,
    "damping": None,
}  # fmt: skip


@pytest.fixture(scope="module")
def found() -> Evaluation:
    return evaluate(
        ["paper_wall", "remote_push"], controllers=("none", "hsc"), round_trips_s=(0.0, 0.1), hands=2, releases=2,
        networks=(EVALUATED_NETWORKS[0], EVALUATED_NETWORKS[3]), threads=1,
    )  # fmt: skip


# ------------------------------------------------------------------------------------------------------- verdicts


@pytest.mark.parametrize(
    ("changes", "verdict"),
    [
        ({}, "safe"),
        ({"held": {"complete": 4, "settled": 4}}, "safe"),
        ({"false_trips": 6}, "safe"),
        ({"false_trips": 7}, "trips"),
        ({"held": {"complete": 7, "hold": 1}, "false_trips": 7}, "uncoupled"),
        ({"holds": 1}, "uncoupled"),
        ({"releases": 0, "dangerous": 0}, "not-measured"),
        ({"releases": 0, "dangerous": 0, "already_tripped": 8, "false_trips": 7}, "trips"),
        ({"held": {"complete": 7, "never-engaged": 1}, "thrown": 1}, "thrown"),
        ({"held": {"complete": 7, "stop": 1}, "thrown": 1}, "thrown"),
        ({"held": {"complete": 7, "diverged": 1}, "thrown": 1}, "diverged"),
        ({"held": {"never-engaged": 8}, "false_trips": None, "hours": 0.0, "releases": 0}, "not-engaged"),
    ],
)
def test_a_cell_says_the_worst_that_happened(changes: dict[str, Any], verdict: str) -> None:
    assert EvaluationCell(**{**CELL, **changes}).verdict(EvaluationLimits()) == verdict


def evaluation(*cells: dict[str, Any]) -> Evaluation:
    made = tuple(EvaluationCell(**{**CELL, **changes}) for changes in cells)
    return Evaluation(
        cells=made, tasks=tuple({cell.task: None for cell in made}), controllers=("wsc",),
        round_trips_s=tuple(sorted({cell.round_trip_s for cell in made})), networks=EVALUATED_NETWORKS,
        limits=EvaluationLimits(), hands=8, releases=4, seed=1, version="0", assumed=(), worst=(),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("unsafe_s", "safe_s"), [((), 0.3), ((0.3,), 0.1), ((0.1,), 0.0), ((0.0,), None), ((0.1, 0.3), 0.0)]
)
def test_safe_up_to_is_before_the_first_round_trip_that_is_not(unsafe_s: tuple[float, ...], safe_s: float) -> None:
    cells = [{"round_trip_s": trip_s, "thrown": int(trip_s in unsafe_s)} for trip_s in (0.0, 0.1, 0.3)]
    assert evaluation(*cells).safe_up_to_s("wsc") == safe_s


def test_the_same_hands_in_several_networks_are_no_more_hands() -> None:
    networks = [{"network": name, "false_trips": trips, "thrown": thrown} for name, trips, thrown in (
        ("steady", 0, 0), ("jitter", 5, 0), ("loss", 2, 1)
    )]  # fmt: skip
    other = {"task": "other", "false_trips": 1, "dangerous": 3}
    counted = totals([EvaluationCell(**{**CELL, **changes}) for changes in (*networks, other)])
    assert (counted.hours, counted.false_trips) == (0.2, 6)
    assert (counted.releases, counted.dangerous, counted.thrown) == (16, 7, 1)


def test_medians_are_those_of_all_releases_and_not_of_the_largest_cell() -> None:
    quick = {"speeds": (0.1,) * 7, "detections_s": (0.05,) * 7, "undetected": 1}
    slow = {"task": "other", "speeds": (0.4,), "detections_s": (0.5,), "undetected": 2}
    counted = totals([EvaluationCell(**{**CELL, **changes}) for changes in (quick, slow)])
    assert (counted.speed, counted.detection_s, counted.undetected) == (0.1, 0.05, 3)
    assert counted.speed_interval == (0.1, 0.4)


def test_a_task_without_a_release_ends_what_is_safe_unless_nothing_can_be_felt_there() -> None:
    nothing = {"task": "other", "releases": 0, "dangerous": 0}
    assert evaluation({}, nothing).safe_up_to_s("wsc") is None
    assert evaluation({}, nothing).unthrown_up_to_s("wsc") is None
    assert evaluation({}, nothing | {"can_push": False}).safe_up_to_s("wsc") == 0.0
    assert evaluation(nothing | {"can_push": False}).safe_up_to_s("wsc") is None
    # A HOLD does not stand for a release.
    assert evaluation({}, nothing | {"holds": 1}).unthrown_up_to_s("wsc") is None


def test_unknown_controllers_tasks_and_empty_cells_are_refused() -> None:
    found = evaluation({})
    with pytest.raises(ValueError, match="controllers = 'hsc': was not evaluated; there is wsc"):
        found.safe_up_to_s("hsc")
    with pytest.raises(ValueError, match="task = 'pull': was not evaluated; there is push"):
        found.unthrown_up_to_s("wsc", "pull")
    with pytest.raises(ValueError, match="no cell"):
        found.verdict(())


def test_false_trips_are_not_throws() -> None:
    cells = [{"round_trip_s": 0.0, "false_trips": 99}, {"round_trip_s": 0.1}, {"round_trip_s": 0.2, "thrown": 1}]
    found = evaluation(*cells)
    assert (found.safe_up_to_s("wsc"), found.unthrown_up_to_s("wsc")) == (None, 0.1)


def test_false_trips_of_all_tasks_and_networks_count_together() -> None:
    """One trip in a short cell is many per hour, but few among all."""
    quiet = [{"task": str(place)} for place in range(9)]
    assert evaluation({"false_trips": 7}, *quiet).safe_up_to_s("wsc") == 0.0
    assert evaluation({"false_trips": 61}, *quiet).safe_up_to_s("wsc") is None
    # A single task has its own rate.
    assert evaluation({"false_trips": 7}, *quiet).safe_up_to_s("wsc", "push") is None


@pytest.mark.parametrize(
    ("changes", "hands", "needed"),
    [
        # 3.84 / (n + 3.84) of n releases without a throw, and 3.69 / T of T hours without a trip.
        ({"releases": 2, "hours": 1.0}, 2, 35),
        ({"releases": 8, "hours": 1.0}, 8, 35),
        ({"releases": 4, "hours": 1.0}, 8, 70),
        ({"releases": 8, "hours": 0.01}, 8, 50),
        ({"releases": 34, "hours": 1.0}, 34, 35),
        ({"releases": 35, "hours": 1.0}, 35, 35),
        ({"releases": 80, "hours": 1.0}, 40, 40),
        # A rate that was observed close to the limit.
        ({"releases": 1000, "hours": 0.1, "false_trips": 5}, 1000, 23_700),
        ({"releases": 8, "hours": 0.1, "false_trips": 6}, 8, MOST_HANDS),
    ],
)
def test_a_safe_cell_is_confirmed_by_its_intervals(changes: dict[str, Any], hands: int, needed: int) -> None:
    found = replace(evaluation(changes), hands=hands)
    assert found.verdict(found.cells) == "safe"
    assert found.hands_needed(found.cells) == pytest.approx(needed, rel=0.1 if needed > 1000 else 0.0)
    assert found.is_confirmed(found.cells) == (needed <= hands)
    counted = totals(found.cells)
    bounds = (wilson_interval(0, counted.releases)[1], poisson_interval(counted.false_trips)[1] / counted.hours)
    assert found.is_confirmed(found.cells) == (bounds[0] <= 0.1 and bounds[1] <= 60.0)
    assert found.unconfirmed("wsc") == (() if needed <= hands else (0.0,))
    assert found.confirmed_up_to_s("wsc") == (0.0 if needed <= hands else None)


def test_a_share_that_may_throw_decides_how_many_hands_are_needed() -> None:
    found = evaluation({"hours": 10.0})
    for share, needed in ((0.4, 8), (0.2, 16), (0.05, 73), (0.01, 381)):
        assert replace(found, limits=EvaluationLimits(thrown_share=share)).hands_needed(found.cells) == needed


def test_confirmed_up_to_is_before_the_first_round_trip_that_is_not() -> None:
    many = {"releases": 80, "hours": 1.0}
    cells = [{"round_trip_s": 0.0, **many}, {"round_trip_s": 0.1}, {"round_trip_s": 0.3, **many}]
    found = evaluation(*cells)
    assert (found.confirmed_up_to_s("wsc"), found.safe_up_to_s("wsc")) == (0.0, 0.3)
    assert found.unconfirmed("wsc") == (0.1,)
    # An unsafe cell is neither confirmed nor hatched.
    assert evaluation({"thrown": 1}).unconfirmed("wsc") == ()
    assert not evaluation({"thrown": 1, **many}).is_confirmed(evaluation({"thrown": 1, **many}).cells)


@pytest.mark.parametrize("columns", [1, 2])
def test_an_unconfirmed_cell_is_hatched_and_says_how_many_hands_it_needs(
    columns: Literal[1, 2], tmp_path: Path
) -> None:
    many = {"releases": 80, "hours": 1.0}
    found = evaluation({"round_trip_s": 0.0, **many}, {"round_trip_s": 0.1, "hours": 1.0})
    path = tmp_path / "evaluation.svg"
    figure = draw_evaluation(found, path, columns)
    cells = [patch for patch in figure.axes[0].patches if isinstance(patch, Rectangle)]
    assert [bool(cell.get_hatch()) for cell in cells] == [False, True]
    assert [text.get_text() for text in figure.axes[0].texts if text.get_text() != "a"] == ["safe", "safe? 35 hands"]
    assert path.read_bytes().startswith(b"<?xml")
    page, text = evaluation_html(found), evaluation_markdown(found)
    assert "<td class=safe>safe, 0.40 m/s</td><td class=unconfirmed>safe? 35 hands, 0.40 m/s</td><td>1</td>" in page
    assert "| safe, 0.40 m/s | safe? 35 hands, 0.40 m/s | 1 |" in text
    assert "Hatched: 1 of 2 safe cells." in text
    assert "Confirmed up to 0 ms; 35 hands of which none is thrown would confirm the rest." in text
    with pytest.raises(ValueError, match="must end in"):
        draw_evaluation(found, tmp_path / "evaluation.gif")


@pytest.mark.parametrize(
    "name",
    ["<script>alert(1)</script>", "<img src=x onerror=y>", "[a](javascript:b)", "a | b", "`a`", "*a*", "two\nlines"],
)
def test_a_name_is_a_name_in_markdown(name: str) -> None:
    text = evaluation_markdown(evaluation({"task": name, "thrown": 1}, {"task": name}), command=f"haptether {name}")
    assert "<script" not in text
    assert "<img" not in text
    assert not re.search(r"(?<!\\)([`*]|\]\()", text)
    # A name with a line or a column of its own would be a row of another table.
    tables = [block.strip().splitlines() for block in text.split("\n\n") if block.startswith("|")]
    assert [len({line.count("|") for line in lines}) for lines in tables] == [1] * len(tables)


# ------------------------------------------------------------------------------------------------------- measured


@pytest.mark.parametrize(("stiffness", "damping", "axes"), [(200.0, 5.0, 1), (1000.0, -20.0, 1), (300.0, 8.0, 3)])
def test_transmitted_impedance_is_that_of_a_spring_and_a_damper(stiffness: float, damping: float, axes: int) -> None:
    run = simulate(load_scene("paper_wall", ["record.every=1", "run.duration_s=1.0"]))
    t = np.arange(1000) * 1e-3
    depth = 0.01 + 0.005 * np.sin(7.0 * t) + 0.002 * np.sin(31.0 * t)
    speed = 0.035 * np.cos(7.0 * t) + 0.062 * np.cos(31.0 * t)
    direction = np.array([[1.0], [0.6, 0.0, 0.8]][axes == 3])
    force = -(stiffness * depth + damping * speed)
    signals = {"position": depth, "velocity": speed, "device_force": force}
    arrays = {name: values if axes == 1 else values[:, None] * direction for name, values in signals.items()}
    found = transmitted_impedance(replace(run, signals=type(run.signals)(arrays)))
    assert found == pytest.approx((stiffness, damping), rel=1e-9)
    nothing = {name: 0.0 * values for name, values in arrays.items()}
    assert transmitted_impedance(replace(run, signals=type(run.signals)(nothing))) == (None, None)


def test_a_late_wall_is_felt_as_one_that_pushes_along(found: Evaluation) -> None:
    """`K x(t - T) = K x - K T V` to first order: 200 N/m at 0.1 s has a damping of -20 N s/m."""
    at_once, late = (found.of(task="paper_wall", controllers="none", round_trip_s=trip)[0] for trip in (0.0, 0.1))
    assert (at_once.stiffness, at_once.damping) == pytest.approx((200.0, 0.0), abs=0.5)
    assert late.stiffness == pytest.approx(200.0, rel=0.1)
    assert late.damping == pytest.approx(-20.0, rel=0.1)


def test_releases_throw_without_a_controller_only(found: Evaluation) -> None:
    for round_trip_s in found.round_trips_s:
        alone = found.of(controllers="none", round_trip_s=round_trip_s)
        watched = found.of(controllers="hsc", round_trip_s=round_trip_s)
        assert sum(cell.thrown for cell in alone) == sum(cell.dangerous for cell in alone) > 0
        assert all(cell.undetected == cell.dangerous and cell.false_trips == 0 for cell in alone)
        assert [cell.dangerous for cell in watched] == [cell.dangerous for cell in alone]
        assert sum(cell.thrown for cell in watched) == 0
        assert all(cell.detection_s is not None and 0.0 <= cell.detection_s < 0.1 for cell in watched if cell.dangerous)
    # A wall has no network, and no arm whose errors could be measured.
    assert {cell.network for cell in found.of(task="paper_wall")} == {"steady"}
    assert {cell.network for cell in found.of(task="remote_push")} == {"steady", "jitter+loss"}
    assert all((cell.position_rmse_m is None) == (cell.task == "paper_wall") for cell in found.cells)


def test_a_torque_throws_at_the_lever_and_is_let_go() -> None:
    arguments = {"round_trips_s": (0.01,), "networks": EVALUATED_NETWORKS[:1], "hands": 2, "releases": 2, "threads": 1}
    found = evaluate(["torque_release"], controllers=("none",), **arguments)  # type: ignore[arg-type]
    (cell,) = found.cells
    assert (cell.verdict(found.limits), cell.releases) == ("thrown", 2)
    # (tau - c) / I t r, for at most the 0.5 s that are watched, plus a grip that resists while it loosens.
    assert cell.max_speed is not None
    assert 0.5 < cell.max_speed < (0.1 - 0.002) / 4e-4 * 0.55 * 0.05


def test_a_hand_lets_go_of_a_force_after_the_end_of_the_scene_too() -> None:
    found = evaluate(["paper_wall"], controllers=("none",), round_trips_s=(10.0,), hands=1, releases=1, threads=1)
    (cell,) = found.cells
    assert (cell.verdict(found.limits), cell.releases) == ("thrown", 1)


def test_where_a_trigger_pushes_alone_no_release_was_measured_and_a_link_is_named_that_is_replaced() -> None:
    found = evaluate(
        ["gripper"], controllers=("none",), round_trips_s=(0.1,), networks=EVALUATED_NETWORKS[:1], hands=1, threads=1
    )
    assert [cell.verdict(found.limits) for cell in found.cells] == ["not-measured"]
    assert found.assumed == ("gripper is run without what its own link has: loss, outages.",)
    assert found.assumed[0] in evaluation_markdown(found)
    assert "no controller: safe at none of these round trips. At 100 ms: not measured" in evaluation_markdown(found)


def test_a_release_under_an_intervention_is_not_one_that_was_survived() -> None:
    """With the paper's threshold HSC holds the force of active_force back throughout: no release is left."""
    found = evaluate(["active_force"], controllers=("none", "hsc"), round_trips_s=(0.0,), hands=3, threads=1)
    alone, watched = found.cells
    assert (alone.releases, alone.already_tripped) == (3, 0)
    assert watched.releases + watched.already_tripped == 3
    assert watched.already_tripped > 0
    assert all(time_s > 0.0 for time_s in watched.detections_s)


def test_threads_change_nothing(found: Evaluation) -> None:
    again = evaluate(
        found.tasks, controllers=found.controllers, round_trips_s=found.round_trips_s, hands=2, releases=2,
        networks=found.networks, threads=2,
    )  # fmt: skip
    assert again.cells == found.cells


def test_the_worst_release_has_its_speed_as_a_scene_of_its_own(found: Evaluation) -> None:
    assert [release.controllers for release in found.worst] == ["none", "hsc"]
    for release in found.worst:
        assert simulate(release.scene).metrics.max_ejection_velocity == release.speed
        assert release.speed == max(
            cell.max_speed for cell in found.of(controllers=release.controllers) if cell.max_speed is not None
        )


def test_what_never_engages_has_no_numbers() -> None:
    found = evaluate(
        ["remote_push"], controllers=("wsc",), round_trips_s=(0.0, 10.0), hands=1, releases=1,
        networks=EVALUATED_NETWORKS[:1], threads=1,
    )  # fmt: skip
    near, far = found.cells
    assert near.verdict(found.limits) != "not-engaged"
    assert far.verdict(found.limits) == "not-engaged"
    assert (far.false_trips, far.peak_force_n, far.energy_j, far.max_speed, far.releases) == (None,) * 4 + (0,)
    assert "not engaged" in evaluation_markdown(found)


def test_a_network_without_delay_has_no_jitter() -> None:
    network = Network(name="jitter", jitter=0.1)
    assert network.link(0.0) == LinkSettings(delay_s=0.0)
    assert network.link(0.1) == LinkSettings(delay_s=0.1, jitter_s=0.1 * 0.1, distribution="gamma")
    found = evaluate(
        ["remote_push"], controllers=("none",), round_trips_s=(0.0,), hands=1, releases=1,
        networks=EVALUATED_NETWORKS[:2], threads=1,
    )  # fmt: skip
    assert [cell.network for cell in found.cells] == ["steady"]


def recording(folder: Path, delay_s: float) -> Path:
    path = folder / "measured.csv"
    path.write_text(f"time_s,delay_s\n0,{delay_s}\n0.5,{delay_s}\n1,\n1.01,{delay_s}\n")
    return path


def test_a_network_with_a_delay_of_its_own_is_met_at_that_alone(tmp_path: Path) -> None:
    lte, measured = network_of("lte-driving"), network_of(str(recording(tmp_path, 0.04)))
    assert (lte.name, measured.name) == ("lte-driving", "measured")
    assert measured.round_trip_s == 0.08
    assert lte.round_trip_s is not None
    assert lte.round_trip_s == pytest.approx(0.086, abs=0.005)
    own_s = (measured.round_trip_s, lte.round_trip_s)
    found = evaluate(
        ["remote_push", "paper_wall"], controllers=("none",), round_trips_s=(0.0,), hands=1, releases=1,
        networks=(lte, EVALUATED_NETWORKS[0], measured), threads=1,
    )  # fmt: skip
    assert found.round_trips_s == tuple(sorted((0.0, *own_s)))
    assert [(cell.network, cell.round_trip_s) for cell in found.of(task="remote_push")] == [
        ("steady", 0.0), ("measured", 0.08), ("lte-driving", lte.round_trip_s)
    ]  # fmt: skip
    # A wall without an arm has the same round trips.
    assert [cell.round_trip_s for cell in found.of(task="paper_wall")] == [0.0, *own_s]
    (worst,) = found.worst
    assert simulate(worst.scene).metrics.max_ejection_velocity == worst.speed
    text = evaluation_markdown(found)
    assert "| controllers | 0 ms | 80 ms measured |" in text
    assert "Network lte-driving: the preset lte-driving, LTE, in a moving car: 44" in text
    assert "measured.csv, from its beginning in each run: 40 ms there and 40 ms back in the mean" in text
    assert [tick.get_text() for tick in draw_evaluation(found).axes[0].get_xticklabels()][1] == "80\nmeasured"


@pytest.mark.parametrize("name", list(PRESETS))
def test_every_preset_may_be_evaluated(name: str) -> None:
    network = network_of(name)
    claimed = {figure.quantity: figure.value for figure in PRESETS[name].figures}
    assert network.round_trip_s is not None
    assert 0.0 < network.round_trip_s < 1.0
    if "round-trip-p50" in claimed:
        assert network.round_trip_s == pytest.approx(claimed["round-trip-p50"], rel=0.5)
    task = Task("remote_push", network.round_trip_s, network=network)
    assert task.base.link is not None
    assert task.held.link == LinksTable(forward=LinkSettings(preset=name), backward=LinkSettings(preset=name))


def test_the_delays_of_both_directions_of_a_recording_are_kept_apart(tmp_path: Path) -> None:
    path = tmp_path / "both.csv"
    path.write_text("time_s,forward_delay_s,backward_delay_s\n0,0.01,0.05\n1,0.01,0.05\n")
    assert network_of(str(path)).own_delay_s == pytest.approx((0.01, 0.05))


def test_the_command_takes_presets_and_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, target = recording(tmp_path, 0.04), tmp_path / "cells.json"
    arguments = ["--controller", "none", "--hands", "1", "--releases", "1", "--json", str(target), "--force"]
    assert main(["evaluate", "remote_push", *arguments, "--network", "starlink", str(path)]) == 0
    report = json.loads(target.read_text())
    assert [cell["network"] for cell in report["cells"]] == ["starlink", "measured"]
    assert [sum(network["own_delay_s"]) for network in report["networks"]] == pytest.approx(
        [cell["round_trip_s"] for cell in report["cells"]], abs=1e-4
    )
    assert "27.6 ms 80 ms controllers starlink measured" in " ".join(capsys.readouterr().out.split())
    (tmp_path / "bad.csv").write_text("a,b\n1,2\n")
    (tmp_path / "lost.csv").write_text("time_s,delay_s\n0,\n1,\n")
    for network, said in (
        (["starlin"], "--network starlin: no such file, and no preset: did you mean starlink?"),
        (["starlin"], "at each --round-trip-s: steady, jitter, loss, jitter+loss"),
        ([str(tmp_path / "bad.csv")], "bad.csv"),
        ([str(tmp_path / "lost.csv")], "nothing arrives"),
        (["starlink", "--round-trip-s", "0.1"], "--round-trip-s: each --network has a delay of its own"),
    ):
        assert main(["evaluate", "remote_push", *arguments, "--network", *network]) == 2
        assert said in " ".join(capsys.readouterr().err.split())


# -------------------------------------------------------------------------------------------------- page and command


def test_the_page_loads_nothing_and_says_each_verdict(found: Evaluation) -> None:
    page, text = (make(found, command="haptether evaluate <b>", worst="worst.toml") for make in (
        evaluation_html, evaluation_markdown
    ))  # fmt: skip
    assert "haptether evaluate &lt;b&gt;" in page
    assert "<svg" in page
    assert not re.findall(r"(?:src|href)=['\"]?(?!#)[a-z/]", page.replace("xlink:href", "href"))
    for controllers in ("no controller", "HSC"):
        assert page.count(f"<td>{controllers}</td>") == text.count(f"| {controllers} |") > 3
    widths = [len(line.split("|")) for line in text.splitlines() if line.startswith("|")]
    tables = [table for table in text.split("\n\n") if table.startswith("|")]
    assert len(tables) == 1 + len(found.tasks) + 3
    assert sum(len(table.splitlines()) for table in tables) == len(widths)
    assert all(len({len(line.split("|")) for line in table.splitlines()}) == 1 for table in tables)


def test_the_command_writes_page_scene_and_cells(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, target = tmp_path / "out", tmp_path / "cells.json"
    arguments = ["--quick", "--controller", "none", "hsc", "--round-trip-s", "0.05", "--network", "steady", "jitter"]
    arguments += ["--hands", "1", "--threads", "1"]
    assert main(["evaluate", "remote_push", *arguments, "--out", str(out), "--json", str(target)]) == 0
    assert sorted(path.name for path in out.iterdir()) == ["evaluation.html", "evaluation.md", "worst.toml"]
    report = json.loads(target.read_text())
    assert [cell["controllers"] for cell in report["cells"]] == ["none", "hsc"] * 2
    assert report["safe_up_to_s"] == {"none": None, "hsc": 0.05}
    assert report["confirmed_up_to_s"] == {"none": None, "hsc": None}
    assert report["hatched"] == {"none": 0, "hsc": 1}
    verdicts = [[row[name] for name in ("controllers", "verdict", "hands_needed")] for row in report["verdicts"]]
    assert verdicts == [["none", "thrown", None], ["hsc", "safe", 35]]
    assert not any(row["confirmed"] for row in report["verdicts"])
    worst = next(release for release in report["worst"] if release["controllers"] == "hsc")
    run = simulate(replace(load_scene(str(out / "worst.toml")), record=RecordTable()))
    assert run.metrics.max_ejection_velocity == pytest.approx(worst["speed"], rel=1e-12)
    shown = capsys.readouterr().out
    shown = " ".join(shown.split())
    assert "HSC: safe up to 50 ms (0 of 1 dangerous releases; at most 79.3 % with 95 % confidence). No longer" in shown
    assert "no controller: safe at none of these round trips. At 50 ms: thrown, in remote_push" in shown
    assert "haptether evaluate remote_push --quick --controller none hsc" in (out / "evaluation.md").read_text()


def test_the_command_that_is_printed_is_the_one_that_ran() -> None:
    command = Evaluate(
        scene=("remote_push",), seed=1234567, round_trip_s=(0.0123456789,), speed=0.1234567, hands=2,
        population="stylus-arm",
    )  # fmt: skip
    assert command_line("evaluate", command) == (
        "haptether evaluate remote_push --round-trip-s 0.0123456789 --hands 2 --speed 0.1234567"
        " --population stylus-arm --seed 1234567"
    )


def test_the_worst_release_of_an_earlier_run_is_removed(tmp_path: Path) -> None:
    (tmp_path / "worst.toml").write_text("old")
    arguments = ["--controller", "none", "--round-trip-s", "0", "--hands", "1", "--releases", "1", "--threads", "1"]
    assert main(["evaluate", "free_motion", *arguments, "--out", str(tmp_path), "--force"]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["evaluation.html", "evaluation.md"]


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (["--hands", "0"], "hands = 0: must be 1 or more"),
        (["--releases", "0"], "releases = 0: must be 1 or more"),
        (["--seed", "-1"], "seed = -1: must be 0 or more"),
        (["--speed", "nan"], "speed = nan: must be a number of at least 0"),
        (["--thrown-share", "-1"], "thrown-share = -1.0: must be a number of at least 0"),
        (["--controller", "wsc+abc"], "'abc' is none of none, vfc, hsc, wsc, pc"),
        (["--controller", "none+wsc"], "'none' is none of"),
        (["--controller", "wsc", "wsc"], "must be one or more, each once"),
        (["--round-trip-s", "-0.1"], "--round-trip-s -0.1: must be 0 to 10 s"),
        (["--network", "bad"], "--network bad: no such file, and no preset: presets are"),
        (["--set", "safety.controllers=[wsc]"], "safety.controllers is what an evaluation varies"),
        (["--set", "link.forward.delay_s=0.1"], "link.forward.delay_s is what an evaluation varies"),
        (["--set", "link={forward={loss=0.1}}"], "link.forward.loss is what an evaluation varies"),
    ],
)
def test_what_cannot_be_is_refused(arguments: list[str], problem: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "paper_wall", *arguments]) == 2
    assert problem in " ".join(capsys.readouterr().err.split())
