"""After a trip the force comes back to a hand only: with nobody there, and with a hand that is back."""

from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import pytest

from haptether.bridge import Run, Scene, SceneError, simulate

RELEASE_S, DURATION_S = 1.0, 8.0
PUSH_N = 3.0


def released(*, remote: bool, operator: dict[str, Any], **safety: float) -> Run:
    """A push that lasts, and a hand that lets go of it at 1 s."""
    release = {"at_s": RELEASE_S, "decay_s": 0.02, "kind": "gain"}
    tables: dict[str, Any] = {
        "schema": 1,
        "run": {"duration_s": DURATION_S},
        "master": {"device": "phantom-desktop"},
        "operator": {"stiffness": 600.0, "damping": 20.0, "release": release, **operator},
        "environment": {"pushers": [{"shape": "ramp", "at_s": 0.1, "rise_s": 0.6, "force_n": PUSH_N}]},
        "safety": {
            "controllers": ["wsc"], "hold_off_s": 0.1, "release_ramp_s": 0.2, "probe_force_n": 0.6, **safety,
        },
        "record": {},
    }  # fmt: skip
    if remote:
        tables["slave"] = {"control": "pd", "mass_kg": 2.0, "stiffness": 2000.0}
    return simulate(msgspec.convert(tables, Scene))


def force_after(run: Run, time_s: float) -> npt.NDArray[np.float64]:
    """Device force in N from then on."""
    assert run.signals is not None
    time = np.asarray(run.signals["time_s"])
    force = np.asarray(run.signals["device_force"]).reshape(len(time), -1)
    later: npt.NDArray[np.float64] = force[time >= time_s, 0]
    return later


@pytest.mark.parametrize("clutch", [None, "once", "auto"], ids=["local", "once", "auto"])
def test_without_a_hand_there_is_one_trip_and_no_force_after_it(clutch: str | None) -> None:
    run = released(remote=clutch is not None, operator={"clutch": clutch} if clutch else {})
    assert [event.detail for event in run.events if event.kind == "trip"] == ["wsc"]
    # Damping and the probe, but nothing of the push.
    assert np.abs(force_after(run, RELEASE_S + 0.3)).max() < 1.2
    assert np.abs(force_after(run, 6.5 if clutch == "once" else DURATION_S - 0.1)).max() < 1e-2
    holds = [event for event in run.events if event.kind == "hold" and event.detail.startswith("master")]
    if clutch:
        assert holds[0].detail == "master: no hand was felt on the device after a push"
        # The fifth probe of a second each.
        assert 4.0 < holds[0].time_s - RELEASE_S < 5.0


@pytest.mark.parametrize("remote", [False, True], ids=["local", "remote"])
def test_a_hand_that_takes_hold_again_has_its_force(*, remote: bool) -> None:
    run = released(remote=remote, operator={"regrasp": {"reaction_s": 0.3, "rise_s": 0.05}})
    assert not [event for event in run.events if event.kind == "hold"]
    # A hand that is back between two tries waits for the next one.
    back = force_after(run, RELEASE_S + 0.3 + 1.5)
    assert back.min() > 0.9 * PUSH_N


@pytest.mark.parametrize(
    ("safety", "said"),
    [
        ({"probe_force_n": 0.3}, "probe_force_n"),
        ({"probe_force_n": -1.0}, "probe_force_n"),
        ({"probe_threshold": 0.0}, "probe_threshold"),
        ({"probe_threshold": 1.0}, "probe_threshold"),
    ],
)
def test_a_probe_that_decides_nothing_is_refused(safety: dict[str, float], said: str) -> None:
    with pytest.raises((SceneError, msgspec.ValidationError), match=said):
        released(remote=False, operator={}, **safety)
