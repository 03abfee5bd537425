"""Switch of both sides to another coupling during a run, by an operator's command."""

import itertools
from pathlib import Path

import msgspec
import numpy as np
import pytest
from tests.scene.test_couplings import (
    ARM_K,
    K_HAND,
    K_WALL,
    LIMITER,
    TARGET,
    WALL,
    WITH_GAINS,
    K,
    compliance,
    pressed,
)

from haptether.bridge import COUPLINGS, Run, Scene, SceneError, override_scene, read_recording, simulate

KINDS = [name for name, *_ in COUPLINGS]
SWITCH_S, SLEW = 3.0, 200.0
ENGAGED, COUPLED = 2, (2, 3)


def switched(kinds: tuple[str, ...], at_s: float = SWITCH_S, lasts_s: float = 0.0) -> Scene:
    """Return the pressing hand under the first kind. It switches to the others, 3 s apart, and presses again."""
    changes = [{"at_s": at_s + 3.0 * place, "kind": kind} for place, kind in enumerate(kinds[1:])]
    others = [{"kind": kind} for kind in dict.fromkeys(kinds) if kind != kinds[0]]
    scene = pressed(
        kinds[0],
        0.01,
        run={"duration_s": at_s + 3.0 * len(changes) + lasts_s},
        coupling={"alternatives": others, "changes": changes},
        safety={"limiter": {**LIMITER, "max_slew_n_per_s": SLEW}},
    )
    return override_scene(scene, ['operator.clutch="auto"'])


def engagements(run: Run) -> list[tuple[int, int]]:
    """Return first and last tick of each time that both sides are engaged."""
    signals = run.signals
    assert signals is not None
    coupled = np.concatenate(([False], np.isin(signals.state, COUPLED), [False]))
    edges = np.flatnonzero(coupled[1:] != coupled[:-1])
    return [(int(begin), int(end)) for begin, end in edges.reshape(-1, 2)]


@pytest.mark.parametrize("at_s", [0.7, SWITCH_S], ids=["free motion", "contact"])
@pytest.mark.parametrize("pair", [*itertools.permutations(KINDS, 2)], ids="-".join)
@pytest.mark.sampled(30)
def test_any_switch_begins_without_force_and_without_a_step(pair: tuple[str, str], at_s: float) -> None:
    """The old force fades, the next engagement begins at 0, and no force grows faster than the slew of the limiter."""
    run = simulate(switched(pair, at_s=at_s))
    signals = run.signals
    assert signals is not None
    force = np.ravel(signals.rendered_force)
    (_, first_end), (second, _) = engagements(run)[-2:]
    assert at_s <= signals.time_s[first_end] < at_s + 0.01
    assert signals.time_s[second] < at_s + 1.0
    # Position-force has no half that begins: the gain of the ladder rises from its first tick on.
    assert abs(force[second]) <= (SLEW * 1e-3 if pair[1] == "position-force" else 0.0)
    assert np.diff(np.abs(force)).max() <= SLEW * 1e-3 * (1.0 + 1e-9)
    assert not np.isin(signals.state, (5, 6)).any()


@pytest.mark.parametrize("first", ["position-force", "pspm"])
@pytest.mark.parametrize("kind", [kind for kind in WITH_GAINS if kind != "pspm"])
def test_after_two_switches_the_last_coupling_holds_the_wall(first: str, kind: str) -> None:
    """The force at rest is the closed form of the last kind, from where the sides were at its engagement."""
    gains = {"stiffness": K, "damping": 3.0}
    path = ["{duration_s=1.0,end=0.02}", "{duration_s=6.0,end=0.02}", "{duration_s=0.5,end=0.06}"]
    scene = override_scene(
        switched((first, "wave" if kind != "wave" else "tdpa", kind), at_s=2.0, lasts_s=8.0),
        [f"operator.legs=[{','.join(path)}]"],
    )
    assert scene.coupling is not None
    others = [{"kind": other.kind, **gains} for other in scene.coupling.alternatives]
    tables = {**msgspec.to_builtins(scene.coupling), "alternatives": others}
    signals = simulate(msgspec.structs.replace(scene, coupling=msgspec.convert(tables, type(scene.coupling)))).signals
    assert signals is not None
    begins = np.flatnonzero(np.diff(np.isin(signals.state, COUPLED).astype(int)) == 1) + 1
    assert len(begins) == 3
    hand, arm, force = (np.ravel(part) for part in (signals.position, signals.slave_position, signals.rendered_force))
    apart = hand[begins[-1]] - arm[begins[-1]]
    series = 1 / K_HAND + compliance(kind, 0.02) + 1 / ARM_K + 1 / K_WALL
    assert force[-500:].mean() == pytest.approx(-(TARGET - WALL - apart) / series, rel=2e-2)


def test_energies_begin_anew_and_are_those_of_the_plants(tmp_path: Path) -> None:
    """The difference of the two sums of the master is the work of its force, in each engagement of three kinds."""
    files = (tmp_path / "master.mcap", tmp_path / "slave.mcap")
    run = simulate(switched(("pspm", "wave", "pd-damped")), record=files)
    signals = read_recording(files[0]).signals
    force, position = np.ravel(signals["device_force"]), np.ravel(signals["position"])
    found = engagements(run)
    assert len(found) == 3
    for begin, end in found:
        sums = signals["port_in_j"] - signals["port_out_j"]
        assert sums[begin] == 0.0
        work = np.cumsum(-force[begin : end - 2] * np.diff(position[begin : end - 1]))
        np.testing.assert_allclose(sums[begin + 1 : end - 1], work, atol=1e-6)


def test_a_lost_switch_couples_nothing_until_both_sides_have_made_it() -> None:
    """An outage hides the switch from the slave. Afterwards it follows, and only the same coupling engages."""
    scene = override_scene(
        switched(("pd-damped", "tdpa")),
        ['link.forward.outages=[{times={kind="once",at_s=2.95,duration_s=0.5}}]', "safety.ladder.stop_after_s=1.0"],
    )
    run = simulate(scene)
    signals = run.signals
    assert signals is not None
    begin, end = engagements(run)[-1]
    assert signals.time_s[begin] > 3.9
    assert end == len(signals.time_s)
    alone = np.ravel(signals.rendered_force)[begin:]
    assert alone[0] == 0.0
    assert np.abs(alone).max() < 1.0


def test_a_switch_elsewhere_than_to_an_alternative_is_refused() -> None:
    scene = pressed("pd-damped", 0.01, coupling={"changes": [{"at_s": 1.0, "kind": "wave"}]})
    with pytest.raises(SceneError, match="or of one of its alternatives"):
        simulate(scene)
    twice = {"alternatives": [{"kind": "wave"}, {"kind": "wave"}]}
    with pytest.raises(SceneError, match="wave is there twice"):
        simulate(pressed("pd-damped", 0.01, coupling=twice))
    with pytest.raises(SceneError, match="impedance"):
        simulate(pressed("pd-damped", 0.01, coupling={"alternatives": [{"kind": "wave", "impedance": 1e6}]}))
