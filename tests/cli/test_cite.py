"""`haptether cite`: each method of a scene with the source of its registry, preset or docstring."""

import re
from pathlib import Path

import msgspec
import pytest

from haptether.bridge import COUPLINGS, load_scene, register_controller, scene_names
from haptether.bridge.scene.sources import OBSERVER_OF, MethodSource, bibtex, scene_sources
from haptether.cli import main
from haptether.netsim import PRESETS
from haptether.safety import CONTROLLERS, ESTIMATORS, OBSERVERS, ResearchObservation


class Brake:
    """Brakes.

    Source: Doe and Roe 2020, Eq. 3.
    """

    def step(self, seen: ResearchObservation) -> None: ...


REGISTRY = {name: source for entries in (CONTROLLERS, OBSERVERS, ESTIMATORS, COUPLINGS) for name, _, source in entries}
PARAMETERS = {"low-pass": ", cutoff_hz=50"}
CASES: dict[str, tuple[str, str, str]] = {
    **{name: (f"safety.controllers=[{name}]", "[safety] controllers", REGISTRY[name]) for name, _, _ in CONTROLLERS},
    **{observer: (f"safety.controllers=[{controller}]", "[safety] observer", REGISTRY[observer])
       for controller, observer in OBSERVER_OF.items()},
    **{name: (f'safety.estimator={{kind="{name}"{PARAMETERS.get(name, "")}}}', "[safety.estimator] kind", source)
       for name, _, source in ESTIMATORS},
    **{name: (f"coupling.kind={name}", "[coupling] kind", source) for name, _, source in COUPLINGS},
    **{name: (f"link.forward={{preset={name!r}}}", "[link.forward] preset", preset.source)
       for name, preset in PRESETS.items()},
    "a network of a preset": ("link.forward={preset='starlink'}", "[link.forward.slots]", "arXiv 2601.08439"),
    "jitter": ("link.forward.distribution=pareto", "[link.forward] distribution", "chapter 20"),
    "codel": ("link.forward={rate_bps=1e6, discipline='codel'}", "[link.forward] discipline", "RFC 8289"),
    "a burst": ("link.forward={loss=0.1, mean_burst=3}", "[link.forward] mean_burst", "E. N. Gilbert"),
    "four states": ("link.forward.four_state={p13=0.1, p31=0.5}", "[link.forward.four_state]", "Salsano"),
    "the hand": ("operator.stiffness=200", "[operator]", "Hogan 1989"),
    "its path": ("operator.stiffness=200", "[operator.legs] shape", "Flash and Hogan 1985"),
    "the solver": ("run.duration_s=1", "[run] integrator", "Hairer, Norsett and Wanner 1993"),
    "research": ("safety.research.controller=cited-brake", "[safety.research] controller", "Doe and Roe 2020, Eq. 3"),
    "contact": ("environment.objects.0.contact={stiffness=9, law='hunt-crossley'}",
                "[environment.objects.contact] law", "Hunt and Crossley 1975"),
}  # fmt: skip


@pytest.mark.parametrize(("override", "part", "source"), CASES.values(), ids=CASES)
def test_a_method_has_its_source(override: str, part: str, source: str) -> None:
    register_controller("cited-brake", Brake)
    without = ["link.forward.loss=0"] if "four_state" in override else []
    scene = load_scene("remote_push", [*without, override])
    assert [method for method in scene_sources(scene) if method.part == part and source in method.source]


def test_methods_that_a_scene_does_not_use_are_not_cited() -> None:
    parts = {method.part for method in scene_sources(load_scene("paper_wall", ["safety.controllers=[]"]))}
    assert not [part for part in parts if part.startswith(("[coupling", "[link", "[safety] controllers"))]


def test_each_controller_has_its_observer() -> None:
    assert list(OBSERVER_OF) == [name for name, _, _ in CONTROLLERS]


def test_each_publication_of_a_source_has_an_entry_and_others_are_comments() -> None:
    source = "Niemeyer and Slotine 1991, 2004; Coelho et al. 2019 (100 % of it); paper Eq. 3; INFOCOM 2016"
    text = bibtex((MethodSource(part="[coupling] kind", name="wave", source=source),))
    found = re.findall(r"@misc\{(\S+),\n  (?:author = \{(.*)\},\n  year = \{(\d+)\}|title)", text)
    assert found == [
        ("niemeyerslotine1991", "Niemeyer and Slotine", "1991"),
        ("niemeyerslotine2004", "Niemeyer and Slotine", "2004"),
        ("coelhoothers2019", "Coelho and others", "2019"),
        ("paper", "", ""),
    ]
    assert "note = {[coupling] kind wave: Coelho et al. 2019 (100 \\% of it)}" in text
    assert text.endswith("\n\n% [coupling] kind wave: INFOCOM 2016\n")


@pytest.mark.parametrize("scene", scene_names())
def test_every_shipped_scene_has_whole_entries(
    scene: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["cite", scene, "--bibtex", "methods.bib", "--json", "-"]) == 0
    told = capsys.readouterr()
    report = msgspec.json.decode(told.out)
    assert all(method["source"] for method in report["methods"])
    assert report["paper"] in told.err
    text = (tmp_path / "methods.bib").read_text()
    entries = re.findall(r"@misc\{([a-z0-9-]+),\n((?:  .*\n)+)\}", text)
    assert len({key for key, _ in entries}) == len(entries) == text.count("@misc")
    assert all(body.count("{") == body.count("}") for _, body in entries)
    # No year is invented: each stands in a source.
    years = set(re.findall(r"year = \{(\d+)\}", text))
    assert years <= set(re.findall(r"\b\d{4}\b", " ".join(method["source"] for method in report["methods"])))


def test_bibtex_goes_to_standard_output(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["cite", "remote_push", "--bibtex", "methods.bib"]) == 0
    capsys.readouterr()
    assert main(["cite", "remote_push", "--bibtex", "-"]) == 0
    said = capsys.readouterr()
    assert said.out == (tmp_path / "methods.bib").read_text()
    assert "Hannaford 1989" in said.err
    assert main(["cite", "remote_push", "--bibtex", "-", "--json", "-"]) == 2
    assert "only one of the two can go to standard output" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["methods.bib"]
