"""Inputs of the ejection speed bound from a scene."""

from math import hypot, inf

from haptether._core import coupling_facts
from haptether.bridge.scene.checks import checked_spec
from haptether.bridge.scene.resolve import Spec
from haptether.bridge.scene.tables.session import Scene
from haptether.safety import EjectionSettings, EstimatorKind


def settings_of(scene: Scene) -> EjectionSettings:
    """Return device, loop, estimator, limits and thresholds, with defaults and presets filled in.

    For kind "pose" the values are those of the translation.

    Raises:
        SceneError: The scene is invalid.
    """
    spec = checked_spec(scene)
    master, safety, run = spec["master"], spec["safety"], spec["run"]
    limiter = safety["limiter"] or {"max_force_n": inf, "max_slew_n_per_s": inf, "ramp_in_s": 0.0}
    stops = master["stops"]
    is_exact = safety["signals"] == "true" or master["measures_velocity"]
    return EjectionSettings(
        controllers=tuple(safety["controllers"]),
        mass_kg=tuple(master["mass_kg"]),
        viscous=tuple(master["viscous"]),
        coulomb=tuple(master["coulomb"]),
        friction=master["friction"],
        period_s=run["period_s"],
        estimator=None if is_exact else _kind(safety["estimator"]),
        quantum_m=0.0 if is_exact else master["encoder_quantum"],
        max_force_n=limiter["max_force_n"],
        max_slew_n_per_s=limiter["max_slew_n_per_s"],
        force_quantum_n=master["force_quantum_n"],
        energy_threshold_j=safety["energy_threshold_j"],
        wsc_force_threshold_n=safety["wsc_force_threshold_n"],
        energy_ratio=safety["energy_ratio"],
        window=safety["window"],
        grasp_threshold=safety["grasp_threshold"],
        grasp_floor_n=safety["grasp_floor_n"],
        hsc_force_threshold_n=safety["hsc_force_threshold_n"],
        hsc_velocity_threshold=safety["hsc_velocity_threshold"],
        velocity_threshold=safety["velocity_threshold"],
        vfc_force_threshold_n=safety["vfc_force_threshold_n"],
        vfc_form=safety["vfc_form"],
        release_ramp_s=safety["release_ramp_s"],
        damping=safety["damping"],
        probe_force_n=safety["probe_force_n"],
        release_tries=safety["release_tries"],
        travel_m=None if stops is None else hypot(*(high - low for low, high in stops)),
        free_s=_free_s(spec),
        fades=spec["slave"] is not None,
        ramp_in_s=limiter["ramp_in_s"],
        push_may_grow=spec["slave"] is not None and coupling_facts(spec["coupling"]["kind"]).push_may_grow,
        turns=scene.master.kind == "pose",
        outside=_outside(spec),
    )


def _free_s(spec: Spec) -> float:
    """Return the longest time in s without a hand; a grip stronger than the force cap holds until the release."""
    operator, limiter = spec["operator"], spec["safety"]["limiter"]
    lasts_s: float = spec["run"]["duration_s"]
    if operator is None or operator["release"] is None or limiter is None:
        return lasts_s
    grip_n = operator["grip_strength_n"]
    holds = grip_n is None or grip_n > limiter["max_force_n"]
    return max(0.0, lasts_s - operator["release"]["at_s"]) if holds else lasts_s


def _outside(spec: Spec) -> str | None:
    """Return the assumption that a scene violates, or None."""
    limiter, device_n = spec["safety"]["limiter"], spec["master"]["max_force_n"]
    if spec["safety"]["research"] is not None:
        return f"nothing is known of the force of {spec['safety']['research']['controller']}, a controller in Python"
    if limiter is None:
        return "the limiter is off, so the force has no cap"
    if device_n is not None and limiter["max_force_n"] > device_n:
        return f"the limiter lets {limiter['max_force_n']:g} N pass, and the device exerts {device_n:g} N of it"
    environment = spec["environment"]
    if spec["slave"] is None and environment is not None and environment["rendering"] == "continuous":
        return "the force acts at every instant, and is not held between ticks"
    return None


def _kind(table: Spec) -> EstimatorKind:
    """Return the estimator that a table describes."""
    parameters = {name: value for name, value in table.items() if name != "kind"}
    made: EstimatorKind = getattr(EstimatorKind, table["kind"].replace("-", "_"))(**parameters)
    return made
