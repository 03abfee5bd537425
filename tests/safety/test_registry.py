"""Controllers, observers and estimators: one file and one line of a registry, and the same names everywhere."""

import importlib.util
import os
import re
import shutil
import subprocess
import sys
import typing
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from haptether import _core
from haptether.bridge import OBSERVED_SIGNALS, Metrics, Run, SafetyTable, Signals, load_scene, trip_thresholds
from haptether.cli.entry import main
from haptether.cli.live.options import Controller
from haptether.cli.shared.ejection import release_law
from haptether.safety import (
    CONTROLLERS,
    ESTIMATORS,
    OBSERVERS,
    ControllerName,
    Intervention,
    Interventions,
    SafetySettings,
)

ROOT = Path(__file__).resolve().parents[2]


def names(registry: tuple[tuple[str, str, str], ...]) -> list[str]:
    return [name for name, _, _ in registry]


@pytest.mark.parametrize("registry", [CONTROLLERS, OBSERVERS, ESTIMATORS])
def test_each_has_a_name_of_its_own_a_title_and_a_source(registry: tuple[tuple[str, str, str], ...]) -> None:
    assert len(set(names(registry))) == len(registry)
    for name, title, source in registry:
        assert re.fullmatch(r"[a-z][a-z0-9_-]*", name)
        assert title
        assert re.search(r"Eq\. \d|\b(19|20)\d\d", source), "an equation or a publication"


def test_controllers_of_a_scene_and_of_the_stub_are_those_of_the_registry() -> None:
    registered = names(CONTROLLERS)
    assert list(typing.get_args(ControllerName)) == registered
    hints = typing.get_type_hints(SafetyTable)
    assert hints["controllers"] == tuple[ControllerName, ...]
    stub = (ROOT / "python" / "haptether" / "_core.pyi").read_text(encoding="utf-8")
    assert "controllers: Sequence[ControllerName] = ()," in stub
    assert SafetySettings(registered) == SafetySettings(registered[::-1])  # type: ignore[arg-type]


def test_estimators_of_a_scene_are_those_of_the_registry() -> None:
    tables = typing.get_args(typing.get_type_hints(SafetyTable)["estimator"])
    assert [table.__struct_config__.tag for table in tables] == names(ESTIMATORS)


def test_the_list_has_them(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "--json", "-"]) == 0
    listed = msgspec.json.decode(capsys.readouterr().out)
    assert listed["[safety] controllers"] == names(CONTROLLERS)
    assert listed["[safety.estimator] kind"] == names(ESTIMATORS)
    assert listed["observer"] == names(OBSERVERS)


def test_a_master_can_be_given_each_controller() -> None:
    assert list(typing.get_args(Controller)) == ["none", *names(CONTROLLERS)]


def test_interventions_have_what_each_observer_sees() -> None:
    signals = {observed.signal for observed in OBSERVED_SIGNALS.values()}
    for kind in (Intervention, Interventions):
        assert {name for name, value in vars(kind).items() if isinstance(value, property)} == signals


def test_thresholds_are_those_of_the_settings_and_the_papers_otherwise() -> None:
    assert list(trip_thresholds({})) == list(OBSERVED_SIGNALS) == names(CONTROLLERS)
    assert trip_thresholds({}) == {"vfc": 1.0, "hsc": 1.5, "wsc": -0.03, "pc": 0.0}
    # As in the JSON of a scene, with what is no setting of a controller.
    safety = {"controllers": ["speed"], "grasp_threshold": 2.5, "energy_threshold_j": -1, "limiter": None, "x": 3.0}
    assert trip_thresholds(safety) == {"vfc": 1.0, "hsc": 2.5, "wsc": -1.0, "pc": 0.0}


@pytest.mark.parametrize("controllers", [(), *((name,) for name in names(CONTROLLERS)), ("pc", "wsc")])
@pytest.mark.parametrize("cancelling", [_core.CANCELLING, ("pc",), ()])
def test_the_law_of_release_is_told_of_controllers_that_take_the_force_away(
    controllers: tuple[ControllerName, ...], cancelling: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_core, "CANCELLING", cancelling)
    scene = load_scene("paper_wall", [f"safety.controllers=[{','.join(controllers)}]"])
    assert (release_law(scene) is None) == set(controllers).isdisjoint(cancelling)


def fresh(name: str, monkeypatch: pytest.MonkeyPatch) -> Any:  # noqa: ANN401  # a module
    """Load the module again and return it."""
    spec = importlib.util.find_spec(name)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, name, module)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("further", [("speed",), ("speed", "jerk")])
def test_trips_of_further_controllers_are_drawn(further: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    bits = {name: 32 << place for place, name in enumerate(further)}
    monkeypatch.setattr(_core, "CONTROLLERS", (*CONTROLLERS, *((name, name, "Eq. 1") for name in further)))
    monkeypatch.setattr(_core, "TRIP_BITS", (*_core.TRIP_BITS, *bits.items()))
    colours = fresh("haptether.view.style.colours", monkeypatch)
    looks = [str(look) for look in colours.CONTROLLERS.values()]
    assert len(set(looks)) == len(looks) == 1 + len(CONTROLLERS) + len(further)
    tripped = np.full(10, sum(bits.values()), np.uint8)
    signals: dict[str, Any] = {"time_s": np.arange(10) * 1e-3, "tripped": tripped}
    run = Run(scene="a run", seed=1, version="0", signals=Signals(signals), events=(), metrics=Metrics())
    figure = fresh("haptether.view.figures.run", monkeypatch).draw_run(run)
    assert [text.get_text() for text in figure.axes[0].get_yticklabels()] == [name.upper() for name in further]


CONTROLLER = """//! Speed controller, for the test that adds one.

use crate::{
    About, DeviceModel, Observation, ParameterError, Real,
    controller::{Controller, Observed, SafetySettings, Verdict},
    parameter::positive,
};
use haptether_numeric::{norm, pack};

/// Unsafe while `|V| > V_t`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SpeedController<const N: usize, S = f64> {
    velocity_threshold: S,
}

impl<const N: usize, S: Real> Controller<N, S> for SpeedController<N, S> {
    type One = SpeedController<N>;
    const ABOUT: &'static About = &About { name: "speed", title: "speed", source: "|V| > V_t" };
    const OBSERVED: &'static Observed =
        &Observed { symbol: "|V| [m/s]", column: "speed", meaning: "|V| in m/s; null where not observed" };

    fn build(
        _: &DeviceModel<N>,
        _: f64,
        settings: &SafetySettings,
        _: bool,
    ) -> Result<Self::One, ParameterError> {
        let velocity_threshold = positive("velocity_threshold", "V_t", settings.velocity_threshold)?;
        Ok(SpeedController { velocity_threshold })
    }

    fn gather(of: &[&Self::One]) -> Option<Self> {
        Some(Self { velocity_threshold: pack(of, |one| one.velocity_threshold)? })
    }

    #[inline(always)]
    fn step(&mut self, seen: &Observation<N, S>) -> Verdict<N, S> {
        let speed = norm(&seen.velocity);
        Verdict::without_force(speed, speed.simd_gt(self.velocity_threshold))
    }

    fn threshold(settings: &SafetySettings) -> f64 {
        settings.velocity_threshold
    }
}
"""
USE = """//! The controller that was added.
#![allow(clippy::unwrap_used)] // a test may

use haptether_safety::{
    Axes, DeviceModel, Observation,
    controller::{ControllerKind, SafetyController, SafetySettings, Tripped},
};

#[test]
fn it_has_a_name_a_bit_and_a_column_and_it_intervenes() {
    let kind = *ControllerKind::ALL.last().unwrap();
    assert_eq!((kind.about().name, kind.observed().column), ("speed", "speed"));
    assert_eq!(Tripped::of(kind).bits(), 32);
    assert_eq!(Tripped::from_bits(63).names().collect::<Vec<_>>(), ["vfc", "hsc", "wsc", "pc", "speed", "held"]);
    let settings = SafetySettings { controllers: [kind].into(), ..SafetySettings::default() };
    let mut alone = SafetyController::<2>::new(&DeviceModel::phantom_desktop(), 1e-3, &settings).unwrap();
    let mut gathered = SafetyController::<2>::gather(&[&alone]).unwrap();
    for (speed, trips) in [(0.59, false), (0.61, true)] {
        let seen = Observation::exact([0.0, speed].into(), Axes::<2>::new(2.0, 0.0), Axes::zeros());
        let step = alone.step(&seen).unwrap();
        assert_eq!(gathered.respond(&seen, 1.0).lane(0).safety_force, step.safety_force);
        assert_eq!((step.observed[kind], step.tripped == Tripped::of(kind)), (speed, trips));
        let force = if trips { [-2.0, -5.0 * speed] } else { [0.0; 2] };
        assert_eq!(step.safety_force, Axes::from(force));
    }
}
"""


@pytest.mark.thorough
@pytest.mark.alone
@pytest.mark.timeout(600)
def test_a_controller_is_a_file_and_its_line(tmp_path: Path) -> None:
    """Follow CONTRIBUTING.md, "A new controller, observer or estimator"."""
    guide = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    for step in ("`safety/src/controller/speed.rs`", "`mod speed;`", "`Speed: speed::SpeedController;`"):
        assert step in guide
    for name in ("Cargo.toml", "Cargo.lock", "rustfmt.toml", "clippy.toml"):
        shutil.copy(ROOT / name, tmp_path)
    # Build the crate and the one below it, without the dependencies of their other tests.
    for room in ("numeric", "safety"):
        shutil.copytree(ROOT / room, tmp_path / room, ignore=shutil.ignore_patterns("__pycache__"))
        change(tmp_path / room / "Cargo.toml", r"(?s)\[dev-dependencies\].*", "")
    change(tmp_path / "Cargo.toml", r"(?m)^(default-)?members = \[.*\]$", r'\1members = ["numeric", "safety"]')
    shutil.rmtree(tmp_path / "safety" / "tests")

    controllers = tmp_path / "safety" / "src" / "controller"
    (controllers / "speed.rs").write_text(CONTROLLER, encoding="utf-8")
    change(controllers / "mod.rs", r"(?m)^mod registry;\n", r"\g<0>mod speed;\n")
    change(
        controllers / "mod.rs",
        r"(?ms)^registry::controllers! \{.*?(?=^\})",
        r"\g<0>    /// |V| > V_t.\n    Speed: speed::SpeedController;\n",
    )

    (tmp_path / "safety" / "tests").mkdir()
    (tmp_path / "safety" / "tests" / "added.rs").write_text(USE, encoding="utf-8")
    environment = os.environ | {
        "CARGO_TARGET_DIR": str(ROOT / "target" / "added-controller"),
        "CARGO_PROFILE_TEST_OPT_LEVEL": "0",
        "CARGO_PROFILE_TEST_DEBUG": "0",
        "RUSTFLAGS": "-D warnings",
    }
    command = ["cargo", "test", "--offline", "--quiet", "-p", "haptether-safety", "--test", "added"]
    done = subprocess.run(
        command, check=False, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=540
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "1 passed" in done.stdout


def change(path: Path, pattern: str, by: str) -> None:
    text, count = re.subn(pattern, by, path.read_text(encoding="utf-8"))
    assert count, f"{path.name} has no {pattern}"
    path.write_text(text, encoding="utf-8")
