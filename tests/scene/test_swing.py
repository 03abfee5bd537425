"""A contact that swings without settling is reported. A contact that settles and a moving hand are not reported."""

import json
from pathlib import Path

import numpy as np
import pytest
from tests.scene.test_couplings import pressed

from haptether.bridge import save_scene, simulate
from haptether.bridge.scene.swing import contact_swing_n
from haptether.cli import main

TIME_S = np.arange(3000) * 1e-3


def swing(force: np.ndarray, *releases: float) -> float | None:
    return contact_swing_n({"time_s": TIME_S, "device_force": force}, releases)


def test_a_steady_swing_is_given_peak_to_peak_before_the_release() -> None:
    steady = 3.0 + 2.0 * np.sin(2 * np.pi * 5 * TIME_S)
    assert swing(steady) == pytest.approx(4.0, rel=1e-3)
    released = np.where(TIME_S < 1.5, steady, 0.0)
    assert swing(released) is None
    assert swing(released, 1.5) == pytest.approx(4.0, rel=1e-3)
    both = np.stack([steady, 2 * steady], axis=1)
    assert swing(both) == pytest.approx(8.0, rel=1e-3)


@pytest.mark.parametrize(
    "force",
    [
        3.0 + 2.0 * np.exp(-2.0 * TIME_S) * np.sin(2 * np.pi * 5 * TIME_S),
        0.2 * np.sin(2 * np.pi * 5 * TIME_S),
        TIME_S + 0.1 * np.sin(2 * np.pi * 50 * TIME_S),
        np.sin(5 * TIME_S),
        np.zeros(3000),
        np.full(3000, np.nan),
    ],
    ids=["decays", "small", "rises", "slow", "zero", "nan"],
)
def test_what_settles_or_moves_slowly_is_no_swing(force: np.ndarray) -> None:
    assert swing(force) is None


def test_simulate_says_that_a_contact_does_not_settle(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The measured force of a stiff wall swings over 50 ms each way, up to the limiter; a damped spring settles."""
    for kind, swings in [("position-force", True), ("pd-damped", False)]:
        scene = pressed(kind, 0.05)
        assert (simulate(scene).contact_swing_n is not None) is swings
        path = tmp_path / f"{kind}.toml"
        save_scene(scene, path)
        assert main(["simulate", str(path), "--json", str(tmp_path / f"{kind}.json")]) == 0
        assert ("does not settle" in capsys.readouterr().out) is swings
        report = json.loads((tmp_path / f"{kind}.json").read_text())
        assert (report["contact_swing_n"] is not None) is swings
