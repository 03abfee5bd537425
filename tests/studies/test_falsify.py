"""The search for the worst release: bounded, repeatable, simplified, and written as a scene that reproduces it."""

import json
from math import inf
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from haptether.bridge import Scene, SceneError, load_scene, simulate
from haptether.cli import main
from haptether.safety import ejection_bound
from haptether.studies import Falsified, Release, ReleaseBounds, falsify
from haptether.studies.falsifier.release import Releases
from haptether.studies.falsifier.search import _Search

TRIES = 192
FEW = ReleaseBounds(steps=3, longest_s=0.02)


@pytest.fixture(scope="module")
def wall() -> Scene:
    """Return a scene with measured V: a push at the cap nearly reaches the bound."""
    return load_scene("paper_wall")


@pytest.fixture(scope="module")
def found(wall: Scene) -> Falsified:
    return falsify(wall, bounds=FEW, tries=TRIES, seconds=60.0, seed=3, threads=2)


def test_it_comes_near_the_bound_and_not_beyond(found: Falsified) -> None:
    assert found.bound.speed is not None
    assert 0.95 * found.bound.speed < found.worst <= found.bound.speed
    assert found.margin == found.bound.speed - found.worst
    assert found.tried >= TRIES
    assert not found.interrupted


def test_the_same_seed_finds_the_same(wall: Scene, found: Falsified) -> None:
    again = falsify(wall, bounds=FEW, tries=TRIES, seconds=60.0, seed=3, threads=1)
    assert (again.scene, again.speed, again.worst, again.tried) == (
        found.scene,
        found.speed,
        found.worst,
        found.tried,
    )


def test_worst_release_is_simplified(found: Falsified) -> None:
    """A steady push suffices: no idle step is left, and the speed is nearly that of the worst release."""
    assert len(found.release.level_n) <= 2
    assert 0.98 * found.worst <= found.speed <= found.worst
    environment = found.scene.environment
    assert environment is not None
    assert len(environment.pushers) == 1 + len(found.release.level_n)


def test_what_has_no_time_left_is_not_made_simple(wall: Scene) -> None:
    releases = Releases(wall, FEW)
    search = _Search(releases, 1, None)
    rng = np.random.default_rng(1)
    search.speeds([releases.of(rng.uniform(0.1, 0.9, releases.size)) for _ in range(8)])
    tried, best = search.tried, search.best
    assert best is not None
    assert search.simplified(search.speed, -np.inf).held_n == best.held_n
    assert search.tried == tried
    search.simplified(search.speed, np.inf)
    assert search.tried > tried


@pytest.mark.parametrize("name", ["paper_wall", "remote_push", "three_axis_box"])
@pytest.mark.parametrize("push", ["any", "steady"])
def test_releases_keep_their_bounds(name: str, push: str) -> None:
    scene = load_scene(name)
    bounds = ReleaseBounds(push="steady" if push == "steady" else "any", steps=5, decay_s=0.02, delay_s=0.1)
    releases = Releases(scene, bounds)
    rng = np.random.default_rng(1)
    for numbers in [*rng.uniform(0.0, 1.0, (50, releases.size)), np.zeros(releases.size), np.ones(releases.size)]:
        release = releases.of(numbers)
        levels = np.array([release.held_n, *release.level_n])
        assert np.abs(levels).max() <= releases.cap_n * (1 + 1e-12)
        assert release.after_s[0] >= release.decay_s
        assert (np.diff(release.after_s) >= bounds.shortest_s - 1e-12).all()
        assert release.after_s[-1] <= release.decay_s + bounds.span_s + 1e-12
        assert len(release.direction) == releases.axes
        assert np.linalg.norm(release.direction) == pytest.approx(1.0, abs=1e-12)
        assert 0.0 <= release.decay_s <= 0.02
        assert max(release.delay_s) <= (0.1 if scene.link else 0.0)
        if push == "steady":
            assert (np.diff(levels) <= 0.0).all()
            assert (levels >= 0.0).all()
        written = releases.scene_of(release)
        assert written.environment is not None
        # With the backward delay nothing reaches the hand before it lets go.
        sent = [pusher.at_s for pusher in written.environment.pushers[1:]]
        assert all(at_s + release.delay_s[1] >= releases.at_s - 1e-9 for at_s in sent)
        kept = replace(scene.ejection_settings(), free_s=inf)
        assert replace(written.ejection_settings(), free_s=inf) == kept
        assert written.run.duration_s - releases.at_s <= releases.free_s + 1e-9


@pytest.mark.parametrize("push", ["any", "steady"])
def test_the_numbers_of_a_release_give_it_again(wall: Scene, push: str) -> None:
    """To rounding, if its steps fit into the span, so that a search can begin at a known release."""
    bounds = ReleaseBounds(push="steady" if push == "steady" else "any", steps=4, longest_s=0.05)
    releases = Releases(wall, bounds)
    rng = np.random.default_rng(2)
    for numbers in rng.uniform(0.05, 0.95, (50, releases.size)):
        release = releases.of(numbers)
        again = releases.of(releases.numbers(release))
        found = (again.held_n, again.decay_s, again.margin, *again.after_s, *again.level_n)
        wanted = (release.held_n, release.decay_s, release.margin, *release.after_s, *release.level_n)
        assert found == pytest.approx(wanted, abs=1e-9)


def test_on_several_axes_the_push_has_the_direction_of_the_release() -> None:
    """The written and the swept force are the same; middle numbers select the lightest axis."""
    releases = Releases(load_scene("three_axis_box", ("master.mass_kg=[0.2,0.1,0.3]",)), ReleaseBounds(steps=2))
    middle = releases.of(np.full(releases.size, 0.5))
    assert middle.direction == (0.0, 1.0, 0.0)
    aslant = releases.of(np.linspace(0.2, 0.8, releases.size))
    written = releases.scene_of(aslant).environment
    assert written is not None
    row = releases.samples([aslant])
    for place, pusher in enumerate(written.pushers):
        force = np.asarray(pusher.force_n)
        swept = [row[f"environment.pushers.{place}.force_n.{axis}"][0] for axis in range(3)]
        assert force.tolist() == swept
        assert np.abs(np.cross(force, aslant.direction)).max() < 1e-8


def test_a_run_with_an_arm_lasts_until_the_hand_has_let_go() -> None:
    """Times count from engagement, which takes a while, however soon the push steps."""
    releases = Releases(load_scene("three_axis_box", ("safety.controllers=[wsc]",)), ReleaseBounds(steps=1))
    release = Release(
        held_n=7.9,
        decay_s=0.0,
        margin=10.0,
        after_s=(0.004,),
        level_n=(-7.9,),
        direction=(1.0, 0.0, 0.0),
        delay_s=(0.2, 0.2),
    )
    metrics = simulate(releases.scene_of(release)).metrics
    assert metrics.outcome == "complete"
    assert metrics.max_ejection_velocity is not None


def test_ctrl_c_keeps_the_worst_so_far(wall: Scene) -> None:
    calls = []

    def interrupted(tried: int, speed: float) -> None:
        calls.append((tried, speed))
        if len(calls) == 2:
            raise KeyboardInterrupt

    found = falsify(wall, bounds=FEW, seconds=60.0, threads=1, progress=interrupted)
    assert found.interrupted
    assert found.worst >= calls[1][1] > 0.0


@pytest.mark.parametrize(
    ("name", "problem"), [("valve", "kind = pose"), ("paper_wall", "enabled = false"), ("nothing", "no shipped scene")]
)
def test_scenes_without_such_releases_are_refused(name: str, problem: str) -> None:
    overrides = ("safety.limiter={enabled=false}",) if name == "paper_wall" else ()
    with pytest.raises(SceneError, match=problem):
        falsify(load_scene(name, overrides), tries=1)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [({"steps": 0}, "steps = 0: must be between 1 and 40"), ({"loss": 1.0}, "loss = 1.0: must be between 0 and 0.9")],
)
def test_invalid_bounds_are_refused(changes: dict[str, float], problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        ReleaseBounds(**changes)  # type: ignore[arg-type]  # numbers of either kind


def test_the_command_writes_a_scene_that_reproduces(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = [
        "falsify",
        "paper_wall",
        "--controller",
        "wsc,hsc",
        "--tries",
        "48",
        "--steps",
        "2",
        "--threads",
        "1",
        "--json",
        "-",
    ]
    assert main(arguments) == 0
    report = json.loads(capsys.readouterr().out)
    file = tmp_path / "paper_wall_worst.toml"
    assert report["file"] == file.name
    assert report["controllers"] == ["wsc", "hsc"]
    run = simulate(file)
    assert run.metrics.max_ejection_velocity == report["speed"]
    assert report["margin"] == report["bound"]["speed"] - report["worst"]
    assert f"at {report['speed']:.4f} m/s" in file.read_text()
    written = load_scene(file)
    assert ejection_bound(written).speed == report["bound"]["speed"]


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (["--out", "worst.npz"], "worst.npz: must end in .toml"),
        (["--tries", "0"], "tries = 0: must be 1 or more"),
        (["--controller", "abc"], "controllers.0 = \"abc\": must be"),
        (["--seconds", "0"], "seconds = 0.0: must be above 0"),
    ],
)  # fmt: skip
def test_invalid_options_are_refused(
    arguments: list[str], problem: str, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert main(["falsify", "paper_wall", *arguments]) == 2
    assert problem in capsys.readouterr().err
