"""A scene gives the same numbers alone or in a sweep, over threads, in lanes, and in any order."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import numpy.typing as npt
import pytest
from tests.scene.shipped import shipped

from haptether.bridge import Sweep, scene_names, simulate, sweep

pytestmark = pytest.mark.slow

SHORT = ["run.duration_s=1.9", "operator.release.at_s=1.4"]
ROWS = 21
"""Number of rows: not a multiple of the lanes."""

STIFFNESS = "environment.objects.0.contact.stiffness"

CASES: dict[str, tuple[str, list[str], str, npt.NDArray[np.float64]]] = {
    "local, estimated": ("paper_wall", SHORT, STIFFNESS, np.linspace(100, 500, ROWS)),
    "local, true": ("paper_wall", [*SHORT, "safety.signals=true"], STIFFNESS, np.linspace(100, 500, ROWS)),
    "local, moving wall": ("moving_wall", [], "operator.stiffness", np.linspace(150, 500, ROWS)),
    "bilateral": ("remote_push", [], "run.seed", np.linspace(0, ROWS - 1, ROWS)),
    "bilateral, lanes apart": (
        "remote_push", ["safety.energy_threshold_j=-0.003"], "safety.window", np.array([50.0, 100.0, 150.0] * 7)
    ),
    "bilateral, delay": ("remote_push", [], "link.forward.delay_s", np.linspace(0.01, 0.1, ROWS)),
}  # fmt: skip


def same(one: Sweep, other: Sweep) -> None:
    assert one.columns.keys() == other.columns.keys()
    for name, column in one.columns.items():
        assert column.tobytes() == other[name].tobytes(), name


@pytest.mark.sampled(12)
@pytest.mark.parametrize("name", scene_names(attacks=True))
def test_the_same_scene_and_seed_give_the_same_bytes(name: str) -> None:
    first, second = shipped(name), simulate(name)
    assert first.events == second.events
    assert list(first.signals) == list(second.signals)
    for signal_name, values in first.signals.items():
        assert values.tobytes() == second.signals[signal_name].tobytes(), signal_name


def test_another_seed_gives_another_run() -> None:
    one, other = simulate("remote_push"), simulate("remote_push", overrides=["run.seed=2"])
    assert one.signals["position"].tobytes() != other.signals["position"].tobytes()


@pytest.mark.parametrize("case", CASES)
def test_neither_threads_nor_lanes_nor_order_change_a_row(case: str) -> None:
    scene, overrides, path, values = CASES[case]
    base = sweep(scene, {path: values}, overrides=overrides, threads=1)
    assert len(np.unique(base["peak_device_force"])) + len(np.unique(base["max_ejection_velocity"])) > 2
    same(base, sweep(scene, {path: values}, overrides=overrides, threads=2))
    same(base, sweep(scene, {path: values}, overrides=overrides, threads=2, lanes=False))
    order = np.random.default_rng(5).permutation(ROWS)
    shuffled = sweep(scene, samples={path: values[order]}, overrides=overrides, threads=2)
    back = np.argsort(order)
    same(base, Sweep({name: column[back] for name, column in shuffled.columns.items()}))


@pytest.mark.parametrize("case", CASES)
def test_a_row_of_a_sweep_is_the_scene_alone(case: str) -> None:
    scene, overrides, path, values = CASES[case]
    swept = sweep(scene, {path: values}, overrides=overrides)
    for row in (0, 7, ROWS - 1):
        value = values[row]
        text = str(int(value)) if value.is_integer() else repr(float(value))
        metrics = simulate(scene, overrides=[*overrides, f"{path}={text}"]).metrics
        for name in ("peak_device_force", "passivity_min_j", "intervention_s", "outcome"):
            assert swept[name][row] == getattr(metrics, name), (row, name)
        for name in ("max_ejection_velocity", "time_to_trip_s", "position_rmse_m", "force_rmse_n"):
            expected = getattr(metrics, name)
            assert np.array_equal(swept[name][row], np.nan if expected is None else expected, equal_nan=True)
        assert (swept["false_trips"][row], swept["diverged"][row], swept["ticks"][row]) == (
            metrics.false_trips, metrics.diverged, metrics.ticks
        )  # fmt: skip


def test_a_run_that_ends_early_says_so_and_measures_the_same() -> None:
    long = ["run.duration_s=12"]
    whole = simulate("paper_wall", overrides=long)
    early = simulate("paper_wall", overrides=[*long, "run.stop_early=true"])
    assert whole.metrics.ticks == 12_000
    assert 6_400 < early.metrics.ticks < 12_000
    assert early.events[-1].kind == "settled"
    assert early.events[-1].time_s == pytest.approx(early.metrics.ticks * 1e-3)
    assert early.metrics.max_ejection_velocity == whole.metrics.max_ejection_velocity
    assert early.metrics.time_to_trip_s == whole.metrics.time_to_trip_s
    assert "settled" not in {event.kind for event in whole.events}


@pytest.mark.sampled(1)
@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize(
    "arguments",
    [
        # Hours of rows, and one run of more than a minute.
        ["sweep", "remote_push", "--vary", "run.seed=0:999999:1000000"],
        ["sweep", "paper_wall", "--vary", "operator.damping=1:9:1000000"],
        ["simulate", "three_axis_box", "--set", "run.duration_s=20000", "record.every=1000000"],
    ],
)
def test_a_signal_ends_a_run_promptly(arguments: list[str]) -> None:
    # A background process of a shell inherits an ignored SIGINT.
    program = (
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "from haptether.cli import main; print('ready', file=sys.stderr, flush=True); sys.exit(main(sys.argv[1:]))"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    try:
        assert process.stderr is not None
        assert process.stderr.readline() == "ready\n"
        # Wait until the rows are checked and some are running.
        time.sleep(4.0)
        assert process.poll() is None
        process.send_signal(signal.SIGINT)
        begun = time.monotonic()
        _, said = process.communicate(timeout=20.0)
        assert time.monotonic() - begun < 5.0
        assert process.returncode == 130
        assert "Traceback" not in said
    finally:
        process.kill()
        process.communicate()
