"""Controllers, observers and estimators: one file and one line of a registry, and the same names everywhere."""

import os
import re
import shutil
import subprocess
import typing
from pathlib import Path

import msgspec
import pytest

from haptether.bridge import SafetyTable
from haptether.cli.entry import main
from haptether.safety import CONTROLLERS, ESTIMATORS, OBSERVERS, ControllerName, SafetySettings

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
    assert "controllers: Sequence[ControllerName] = ...," in stub
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


CONTROLLER = """//! Speed controller, for the test that adds one.

use crate::{
    About, DeviceModel, Observation, ParameterError, Real,
    controller::{Controller, Observed, SafetySettings, Verdict},
    lanes::{norm, pack},
    parameter::positive,
};

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

    fn gather(of: &[Self::One]) -> Option<Self> {
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
    let mut gathered = SafetyController::<2>::gather(&[alone.clone()]).unwrap();
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
    shutil.copytree(ROOT / "safety", tmp_path / "safety", ignore=shutil.ignore_patterns("__pycache__"))
    # Build the crate alone, without the dependencies of its other tests.
    change(tmp_path / "Cargo.toml", r"(?m)^(default-)?members = \[.*\]$", r'\1members = ["safety"]')
    change(tmp_path / "safety" / "Cargo.toml", r"(?s)\[dev-dependencies\].*", "")
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
