"""`haptether identify`: the model of simulated devices is found to 2 %, with valid intervals, and within bounds."""

import json
import math
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.devices.plant import Plant, VirtualDevice

from haptether.bridge import load_scene
from haptether.bridge.devices.standalone import EndOfRunError
from haptether.master import MasterSample
from haptether.studies.identification.excitation import DEFAULT_BOUNDS, Bounds, Excitation
from haptether.studies.identification.fit import Estimate, IdentifiedAxis, NotDeterminedError, fit_axis
from haptether.studies.identification.table import encoder_quantum, master_table, warnings


class Motion:
    """Response of a device in virtual time to an excitation, with all written forces."""

    def __init__(
        self,
        device: VirtualDevice,
        *,
        kind: str = "linear",
        bounds: Bounds | None = None,
        period_s: float = 1e-3,
        jitter: float = 0.2,
        axes: tuple[int, ...] | None = None,
        most_s: float = 200.0,
    ) -> None:
        self.bounds = bounds or DEFAULT_BOUNDS[kind]
        self.lead = Excitation(kind, self.bounds, period_s=period_s, axes=axes)  # type: ignore[arg-type]  # of the two
        random = np.random.default_rng(7)
        self.lead.request(0.0)
        time_s, position, written_s, force = [], [], [], []
        at_s = 0.0
        while at_s < most_s:
            at_s += period_s * (1.0 + jitter * random.uniform(-1.0, 1.0))
            sample = device.read(at_s)
            try:
                told = self.lead.step(sample, at_s)
            except EndOfRunError:
                break
            assert told is not None
            device.write(told[0], at_s + 5e-5)
            time_s.append(at_s)
            position.append(sample.position)
            written_s.append(at_s + 5e-5)
            force.append(told[0])
        self.time_s, self.position = np.array(time_s), np.array(position)
        self.written_s, self.force = np.array(written_s), np.array(force)

    def fitted(self, axis: int = 0) -> IdentifiedAxis:
        """Return the fitted model of an axis."""
        begin_s, end_s = self.lead.spans[axis]
        moved = (self.time_s >= begin_s) & (self.time_s <= end_s)
        return fit_axis(self.time_s[moved], self.position[moved, axis], self.written_s, self.force[:, axis])


def off(estimate: Estimate, truth: float) -> float:
    """Return the relative error of an estimate."""
    return abs(estimate.value / truth - 1.0)


REAL: Any = {"quantum": 2.3e-5, "delay_s": 2e-3, "noise": 1e-5}
DEVICES = {
    # m, b, c, and the errors between the device and the bridge.
    "a desktop device with friction": (0.1, 0.5, 0.1, REAL, "linear", None),
    "a heavy one": (1.0, 1.0, 0.2, REAL, "linear", None),
    "a light one": (0.02, 0.2, 0.02, {**REAL, "delay_s": 4e-3}, "linear", None),
    "one with much friction": (0.045, 1.0, 0.26, {**REAL, "quantum": 5.5e-5}, "linear", Bounds(2.0, 0.03, 0.8)),
    "a joint": (0.00199, 0.0059, 0.0182, {"quantum": 2.0 * math.pi / 4096.0, "delay_s": 3e-3}, "joints", None),
}


@pytest.mark.sampled(2)
@pytest.mark.slow
@pytest.mark.parametrize("name", DEVICES)
def test_mass_and_friction_are_found_to_2_percent(name: str) -> None:
    mass_kg, viscous, coulomb, between, kind, bounds = DEVICES[name]
    motion = Motion(VirtualDevice([Plant(mass_kg, viscous, coulomb)], **between), kind=kind, bounds=bounds)
    assert motion.lead.is_complete, motion.lead.ended
    found = motion.fitted()
    assert off(found.mass_kg, mass_kg) < 0.02
    assert off(found.coulomb, coulomb) < 0.02
    # The torque of b is a tenth of the joint's friction at this speed, so the interval of b sets the tolerance.
    assert off(found.viscous, viscous) < (0.1 if kind == "joints" else 0.02)
    assert abs(found.viscous.value - viscous) < 2.5 * found.viscous.half
    assert found.delay_s.value == pytest.approx(between["delay_s"], abs=3e-4)
    assert found.mass_kg.is_determined
    assert found.coulomb.is_determined
    assert found.unexplained < 0.01


@pytest.mark.slow
def test_the_paper_s_device_is_found_and_its_viscous_friction_as_uncertain_as_it_is() -> None:
    """The paper has m = 0.157 kg, c = 0.038 N and b = -0.005 N s/m: 1 mN at the permitted speed."""
    found = Motion(VirtualDevice([Plant(0.157, -0.005, 0.038)], **REAL)).fitted()
    assert off(found.mass_kg, 0.157) < 0.02
    assert off(found.coulomb, 0.038) < 0.02
    assert abs(found.viscous.value + 0.005) < 0.003
    assert not found.viscous.is_determined
    assert any("viscous" in line for line in warnings({0: found}, "linear"))


@pytest.mark.thorough
@pytest.mark.slow
def test_two_axes_are_found_one_after_the_other_and_the_others_stay() -> None:
    plants = [Plant(0.1, 0.5, 0.1), Plant(0.2, 0.8, 0.05)]
    motion = Motion(VirtualDevice(plants, **REAL))
    assert motion.lead.is_complete
    for axis, (mass_kg, coulomb) in enumerate([(0.1, 0.1), (0.2, 0.05)]):
        found = motion.fitted(axis)
        assert off(found.mass_kg, mass_kg) < 0.02
        assert off(found.coulomb, coulomb) < 0.02
    begin_s, end_s = motion.lead.spans[0]
    first = (motion.time_s > begin_s + 0.1) & (motion.time_s < end_s)
    assert np.ptp(motion.position[first, 0]) > 0.01
    assert np.ptp(motion.position[first, 1:], axis=0).max() < 1e-3
    one = Motion(VirtualDevice([Plant(0.1, 0.5, 0.1) for _ in range(3)], **REAL), axes=(2,), most_s=4.0)
    assert list(one.lead.spans) == [2]


@pytest.mark.slow
def test_a_weight_is_found_and_said() -> None:
    found = Motion(VirtualDevice([Plant(0.1, 0.5, 0.1, offset_n=-0.15)], **REAL)).fitted()
    assert found.offset_n.value == pytest.approx(-0.15, rel=0.02)
    assert off(found.mass_kg, 0.1) < 0.02
    assert any("-0.15 N act on it all the time" in line for line in warnings({0: found}, "linear"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("plant", "said"),
    [
        (Plant(0.1, 0.5, 1.5), "is the device held, at a stop, or at rest"),
        (Plant(0.045, 0.0, 0.3), "allow more speed, force or travel"),
    ],
)
def test_a_device_that_the_motion_does_not_tell_is_no_number(plant: Plant, said: str) -> None:
    with pytest.raises(NotDeterminedError, match=said):
        Motion(VirtualDevice([plant], **REAL), period_s=2e-3).fitted()


class Held(Plant):
    """A device in a hand: a spring of 300 N/m with a damper of 8 N s/m, whose force nobody measures."""

    def advance(self, force: float, t: float) -> None:
        super().advance(force - 300.0 * self.x - 8.0 * self.v, t)


@pytest.mark.slow
def test_a_hand_that_holds_it_shows_as_what_the_model_does_not_explain() -> None:
    """The device must not be held for this reason."""
    motion = Motion(VirtualDevice([Held(0.157, 0.0, 0.038)], **REAL), period_s=2e-3)
    try:
        found = motion.fitted()
    except NotDeterminedError as error:
        assert "held" in str(error)  # noqa: PT017  # otherwise see below
    else:
        assert off(found.mass_kg, 0.157) > 0.2
        assert any("unexplained" in line for line in warnings({0: found}, "linear"))


def test_the_other_sign_of_the_force_ends_the_motion_at_once() -> None:
    class Turned(VirtualDevice):
        def write(self, force: tuple[float, ...], at_s: float) -> None:
            super().write(tuple(-f for f in force), at_s)

    motion = Motion(Turned([Plant(0.1, 0.1, 0.02, offset_n=0.05)]))
    assert not motion.lead.is_complete
    assert motion.lead.ended is not None
    assert "at most" in motion.lead.ended


@pytest.mark.slow
@settings(max_examples=8, deadline=None)
@given(
    mass_kg=st.floats(0.01, 2.0),
    viscous=st.floats(0.0, 2.0),
    coulomb=st.floats(0.0, 0.5),
    offset_n=st.floats(-0.5, 0.5),
    delay_s=st.floats(0.0, 0.01),
    force=st.floats(0.1, 5.0),
)
def test_whatever_the_device_force_travel_and_speed_stay_bounded_and_it_ends(
    *, mass_kg: float, viscous: float, coulomb: float, offset_n: float, delay_s: float, force: float
) -> None:
    bounds = Bounds(force, 0.02, 0.3)
    device = VirtualDevice([Plant(mass_kg, viscous, coulomb, offset_n)], delay_s=delay_s, quantum=2e-5)
    motion = Motion(device, bounds=bounds, period_s=2e-3, most_s=60.0)
    assert motion.lead.is_complete or motion.lead.ended is not None
    assert np.abs(motion.force).max(initial=0.0) <= force
    # The sample beyond a bound is the last: nothing is written after it.
    assert np.abs(motion.position - motion.position[0]).max(initial=0.0) <= 0.02
    # The force begins at zero and ramps up.
    assert np.abs(motion.force[0]).max() == 0.0
    early = motion.time_s < 0.1
    assert np.abs(motion.force[early]).max(initial=0.0) <= 0.4 * force


def stepped(lead: Excitation, *steps: tuple[float, MasterSample]) -> list[float]:
    """Return the forces for the samples, until the run ends."""
    forces = []
    for at_s, sample in steps:
        try:
            told = lead.step(sample, at_s)
        except EndOfRunError:
            forces.append(math.nan)
            break
        forces.append(math.nan if told is None else told[0][0])
    return forces


def moving(count: int = 4000) -> Excitation:
    """Return an excitation whose force is on."""
    lead = Excitation("linear", DEFAULT_BOUNDS["linear"])
    lead.request(0.0)
    forces = stepped(lead, *((1e-3 * tick, MasterSample(0.0)) for tick in range(count)))
    assert any(forces)
    return lead


@pytest.mark.parametrize(
    ("at_s", "sample", "said"),
    [
        (4.001, MasterSample(0.0, fault="hot"), "the device reports: hot"),
        (4.03, MasterSample(0.0), "a sample came 31 ms after the one before"),
        (4.001, MasterSample(math.nan), "a sample was refused"),
        (4.001, MasterSample(0.021), "axis 0 is 0.021 from where it began: at most 0.02"),
        (4.001, MasterSample(0.01), "axis 0 moves at"),
        (4.001, MasterSample([0.0, 0.0]), "a sample was refused"),
    ],
)
def test_the_motion_ends_with_the_sample_that_is_wrong(at_s: float, sample: MasterSample, said: str) -> None:
    lead = moving()
    with pytest.raises(EndOfRunError):
        lead.step(sample, at_s)
    assert lead.ended is not None
    assert lead.ended.startswith(said)
    assert not lead.is_complete


def test_nothing_moves_without_a_word_or_after_a_late_one() -> None:
    lead = Excitation("linear", DEFAULT_BOUNDS["linear"])
    assert set(stepped(lead, *((1e-3 * tick, MasterSample(1e-3)) for tick in range(5000)))) == {0.0}
    lead.request(2.9)
    with pytest.raises(EndOfRunError):
        lead.step(MasterSample(1e-3), 5.0)
    assert lead.ended == "it was asked for too long ago"


def identified(mass: float, viscous: float, coulomb: float, half: float = 1e-4) -> IdentifiedAxis:
    return IdentifiedAxis(
        Estimate(mass, half), Estimate(viscous, half), Estimate(coulomb, half), Estimate(0.0, half),
        Estimate(1e-3, half), 1e-3, 0.2,
    )  # fmt: skip


@pytest.mark.parametrize("kind", ["linear", "joints"])
@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("options", [{}, {"host": "10.0.0.1", "gains": [1.0, 2], "raw": True, "of": {'a "b"': "c\\d"}}])
def test_the_table_is_one_that_a_scene_takes(tmp_path: Path, kind: str, count: int, options: dict[str, object]) -> None:
    axes = [identified(0.1 + 0.01 * axis, 0.00005, -0.01) for axis in range(count)]
    text = master_table('my "stylus"', options, kind, axes, 2.3e-5)
    table = tomllib.loads(text)["master"]
    assert table["mass_kg"] == (0.1 if count == 1 else [0.1, 0.11, 0.12])
    # b is not distinguishable from 0, and no friction is negative.
    assert table["viscous"] == table["coulomb"] == (0.0 if count == 1 else [0.0] * 3)
    assert table.get("options", {}) == options
    (tmp_path / "scene.toml").write_text(f"schema = 1\nslave = {{}}\n{text}\n")
    scene = load_scene(tmp_path / "scene.toml")
    assert scene.master.driver == 'my "stylus"'
    assert (scene.master.axes, scene.master.encoder_quantum) == (count, 2.3e-5)
    lines = warnings(dict(enumerate(axes)), kind)
    assert sum("viscous cannot be told from 0" in line for line in lines) == count
    assert sum("negative Coulomb" in line for line in lines) == count


@pytest.mark.parametrize("quantum", [2.3e-5, 0.00153])
def test_the_resolution_is_that_of_the_encoder_or_not_said(quantum: float) -> None:
    x = 0.03 * np.sin(np.arange(5000) * 1e-3)
    assert encoder_quantum(quantum * np.round(x / quantum)) == pytest.approx(quantum, rel=5e-3)
    assert encoder_quantum(x) is None
    assert encoder_quantum(np.zeros(100)) is None


def test_results_can_be_written_as_json() -> None:
    import msgspec

    assert json.loads(msgspec.json.encode(identified(0.1, 0.5, 0.1)))["mass_kg"] == {"value": 0.1, "half": 1e-4}
