"""The reference work unit: any implementation reproduces it, so ours must, however it is run."""

import importlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest

import haptether
from haptether.bridge import load_scene, scene_json

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
SCENE = ROOT / "benches" / "work_unit.toml"


def test_one_run() -> None:
    metrics = haptether.simulate(SCENE).metrics
    assert metrics.max_ejection_velocity == pytest.approx(0.329684270, abs=5e-10)
    assert metrics.intervention_s == pytest.approx(0.05, abs=5e-4)


@pytest.mark.parametrize(("threads", "lanes"), [(1, True), (2, True), (1, False), (2, False)])
def test_a_hundred_depths(threads: int, lanes: bool) -> None:
    depth = 0.01 + 0.05 * np.arange(100) / 99
    samples = {"operator.legs.0.end": -depth}
    swept = haptether.sweep(load_scene(SCENE), samples=samples, threads=threads, lanes=lanes)
    assert swept["max_ejection_velocity"].sum() == pytest.approx(34.971638466, abs=5e-10)
    assert np.rint(swept["intervention_s"] / 1e-3).sum() == 2459


def test_the_rust_bench_has_the_same_scene() -> None:
    stored = json.loads((ROOT / "bridge" / "benches" / "work_unit.json").read_text())
    assert stored == json.loads(scene_json(load_scene(SCENE)))


@pytest.mark.parametrize("scenarios", [1, 100])
@pytest.mark.parametrize("width", [8, 16])
def test_the_bare_kernel_is_the_same_work(
    width: int, scenarios: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benches"))
    batch = importlib.import_module("batch")
    monkeypatch.delitem(sys.modules, "batch")
    kernel = batch.bare_kernel(width, tmp_path)
    if kernel is None:
        pytest.skip("no C++ compiler")
    peaks, on = kernel(batch.depths(scenarios))
    expected_peaks, expected_on = batch.EXPECTED[scenarios]
    assert peaks == pytest.approx(expected_peaks, abs=1e-9 * max(1.0, expected_peaks))
    assert on == expected_on
