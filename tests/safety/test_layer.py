"""The whole chain of a tick, against the same chain assembled from its parts."""

import numpy as np
import pytest

from haptether.safety import (
    DeviceModel,
    Estimator,
    Limiter,
    LimiterSettings,
    SafetyController,
    SafetyLayer,
    SafetySettings,
    fault_message,
)

TICKS = 600
LIMITS = LimiterSettings(ramp_in_s=0.05)
SETTINGS = SafetySettings(["hsc", "wsc", "pc"], hsc_force_threshold_n=0.5)


def motion(axes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return positions in m of a stylus that is thrown out at 0.3 s, and the rendered force in N."""
    time_s = np.arange(TICKS) * 1e-3
    along = np.ones(axes) / np.sqrt(axes)
    position = np.outer(np.where(time_s < 0.3, -0.03, -0.03 + 20.0 * (time_s - 0.3) ** 2), along)
    return np.round(position / 2.3e-5) * 2.3e-5, np.outer(np.full(TICKS, 6.0), along)


@pytest.mark.parametrize("axes", [1, 2, 3, 4, 5, 6, 7])
def test_the_chain_is_the_sum_of_its_parts(axes: int) -> None:
    position, rendered = motion(axes)
    device = DeviceModel.phantom_desktop(axes)
    ticks = SafetyLayer(device, SETTINGS, limiter=LIMITS).run(position, rendered)

    of_device, of_rendered = Estimator(axes=axes), Estimator(axes=axes)
    # The requested force is bounded first, so that the observers see a renderable force; the sum is bounded later.
    rendered, rendering = Limiter(LIMITS, axes=axes).run(rendered, np.zeros_like(rendered))
    controller = SafetyController(device, SETTINGS)
    limiter = Limiter(LimiterSettings(ramp_in_s=0.0), axes=axes)
    device_force, last_rendered = np.zeros(axes), np.zeros(axes)
    for n in range(TICKS):
        velocity, acceleration = of_device.step(position[n])
        of_rendered.step(position[n])
        grasp = device.grasp_force(velocity[None], acceleration[None], of_device.align(device_force)[None])[0]
        step = controller.step(velocity, rendered[n], grasp, of_rendered.align(last_rendered))
        device_force, acted = limiter.step(step.device_force, velocity)
        last_rendered = rendered[n]
        np.testing.assert_array_equal(ticks.velocity[n], velocity)
        np.testing.assert_array_equal(ticks.rendered_force[n], rendered[n])
        np.testing.assert_array_equal(ticks.grasp_force[n], grasp)
        np.testing.assert_array_equal(ticks.device_force[n], device_force)
        assert (ticks.tripped[n], ticks.acted[n]) == (step.tripped, acted | rendering[n])
    assert ticks.tripped.any(), "the throw is seen"


def test_a_run_is_its_steps() -> None:
    position, rendered = motion(3)
    device = DeviceModel.phantom_desktop(3)
    ticks = SafetyLayer(device, SETTINGS).run(position, rendered)
    layer = SafetyLayer(device, SETTINGS)
    for n in range(TICKS):
        step = layer.step(position[n], rendered[n])
        np.testing.assert_array_equal(step.device_force, ticks.device_force[n])
        assert (step.tripped, step.acted, step.fault) == (ticks.tripped[n], ticks.acted[n], ticks.fault[n])
        assert step.owed_energy_j == ticks.owed_energy_j[n]


def test_a_saturated_pc_says_what_it_owes() -> None:
    """PC requests more damping than the norm bound of 0.2 N delivers: the rest is owed."""
    velocity = np.full(50, 1.0)
    position = np.cumsum(velocity) * 1e-3
    device = DeviceModel(mass_kg=0.157)
    limits = LimiterSettings(max_force_n=0.2, ramp_in_s=0.0, max_slew_n_per_s=1e6)
    ticks = SafetyLayer(device, SafetySettings(["pc"]), limiter=limits).run(position, np.zeros(50), velocity)
    # Nobody holds and nothing is rendered: E_so = -m V² / (2 eta) + dT sum F_h V, with F_h = -F_device[n-1].
    grasp = np.concatenate([[0.0], -ticks.device_force[:-1]])
    energy = 1e-3 * np.cumsum(grasp * velocity) - 0.157 * velocity**2
    delivered = np.maximum(-ticks.device_force * velocity * 1e-3, 0.0)
    np.testing.assert_allclose(ticks.owed_energy_j, np.maximum(-energy - delivered, 0.0), atol=1e-15)
    assert ticks.owed_energy_j[-1] > 0.1
    assert np.abs(ticks.device_force).max() == pytest.approx(0.2)


def test_a_bad_number_stops_until_reset() -> None:
    position, rendered = motion(1)
    position[100] = np.nan
    layer = SafetyLayer(DeviceModel.phantom_desktop(), SETTINGS)
    ticks = layer.run(position, rendered)
    assert np.abs(ticks.device_force[99]).max() > 0.0
    assert not ticks.device_force[100:].any()
    assert fault_message(int(ticks.fault[100])) == "position is not a finite number"
    assert (ticks.fault[100:] == ticks.fault[100]).all()
    with pytest.raises(ValueError, match="position"):
        layer.reset(float("inf"))
    layer.reset(-0.03)
    assert layer.step(-0.03, 1.0).fault == 0
