"""Controllers, observers and estimators: one file and one line of a registry, and the same names everywhere."""

import importlib.util
import re
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
