"""Bound of the speed of a device after a release, for any rendered force."""

from collections.abc import Callable
from math import expm1, inf, isfinite, sqrt
from typing import Literal, Protocol

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from haptether._core import EstimatorKind, SafetySettings
from haptether.safety.ejection.kernel import Kernel, exact, kernel
from haptether.safety.ejection.push import Array, best_push, best_rising_push, worst_push

MAX_LATE_S = 0.02
"""Largest lateness in s of a tick that is executed; at a later tick the loop drops the force."""
THROWN_SPEED = 0.5
"""Speed in m/s above which a release counts as an ejection.

It is above the 0.36 and 0.3 m/s that WSC and HSC of the paper leave, and far below the 1.3 m/s without a controller.

Source: paper Fig. 9 and 10; `docs/check.md`.
"""
BOUNDED = ("hsc", "wsc")
"""Controllers for which a bound exists."""


class EjectionSettings(Struct, frozen=True, kw_only=True):
    """Inputs of the bound: device, loop, estimator, limits, thresholds and the hand before the release."""

    controllers: tuple[str, ...]
    """Controllers in use."""
    mass_kg: tuple[float, ...]
    """Mass m in kg that the safety layer assumes, one value per axis."""
    viscous: tuple[float, ...] = (0.0,)
    """b in N s/m, one value per axis."""
    coulomb: tuple[float, ...] = (0.0,)
    """c in N, one value per axis."""
    friction: Literal["vector", "axis"] = "vector"
    """Direction of c: along the motion, as in the safety layer, or on each axis separately."""
    period_s: float = 1e-3
    """dT in s."""
    estimator: EstimatorKind | None = EstimatorKind()
    """Estimator of V and A from the position; None if V is measured."""
    quantum_m: float = 0.0
    """Resolution of the position in m; 0 is exact."""
    max_force_n: float = 7.9
    """F_max in N."""
    max_slew_n_per_s: float = inf
    """Largest growth of the force in N/s; unloading is not limited."""
    force_quantum_n: float = 0.0
    """Resolution of the force in N; 0 is exact."""
    energy_threshold_j: float = -0.03
    """delta in J, of WSC."""
    wsc_force_threshold_n: float = 0.0
    """F_w in N, of WSC; 0 is Eq. 13 as printed."""
    energy_ratio: float = 0.5
    """eta, of WSC."""
    window: int = 100
    """w in ticks, of WSC."""
    grasp_threshold: float = 1.5
    """zeta, of HSC."""
    grasp_floor_n: float = 1e-3
    """alpha in N, of HSC."""
    hsc_force_threshold_n: float = 0.1
    """F_t in N, of HSC."""
    hsc_velocity_threshold: float = 0.0
    """V_s in m/s, of HSC; 0 is Eq. 14 as printed."""
    velocity_threshold: float = 0.6
    """V_t in m/s, of VFC."""
    vfc_force_threshold_n: float = 1.0
    """F_t in N, of VFC."""
    vfc_form: Literal["product", "both"] = "product"
    """Trip of VFC: the product F_v V exceeds F_t V_t ("product"), or F_v and V exceed F_t and V_t ("both")."""
    release_ramp_s: float = 0.0
    """Fade-out time of an intervention in s."""
    damping: float = 5.0
    """mu in N s/m."""
    probe_force_n: float = 0.0
    """A in N: force of the probe, which tests whether a hand is on the device; 0 is no probe."""
    release_tries: int = 0
    """Number of tries before the force is withheld; 0 is no limit. The bound holds for any number."""
    travel_m: float | None = None
    """X in m: distance between the mechanical stops; None without stops."""
    free_s: float = inf
    """T in s: longest time for which a free device moves, until the end of a run; infinite on a real device."""
    fades: bool = True
    """True if the damping may fade while the device moves, as the ladder requires after a loss of the link."""
    ramp_in_s: float = 0.0
    """Time in s over which every force, including damping, rises from zero at the start."""

    hand_speed: float = 0.0
    """V0 in m/s: speed of the hand at the release."""
    hand_power_w: float | None = None
    """P_h in W: largest power of the hand before the release; default: V0 times the larger of the cap and mu V0."""
    held_force_n: float | None = None
    """F_0 in N: force that the hand held at the release; default: the cap."""
    late_s: float = 0.0
    """J in s, at most 0.02: extra time for which a late tick holds a force; at most one such tick per window."""
    mass_error: float = 0.0
    """Largest relative error of `mass_kg`, at least 0 and below 1."""
    push_may_grow: bool = False
    """True if the coupling may push harder after the release, against A8: HSC then has no bound."""
    turns: bool = False
    """True if the device also turns; rotation has no bound."""
    outside: str | None = None
    """Reason why the scene violates the assumptions and has no bound; None if it satisfies them."""


class HasEjectionSettings(Protocol):
    """Scene or other source of the inputs of the bound."""

    def ejection_settings(self) -> EjectionSettings:
        """Return the inputs of the bound."""


class EjectionTerms(Struct, frozen=True, kw_only=True):
    """Terms of a bound; the Eq. numbers are those of `docs/ejection_bound.md`."""

    lag_s: float
    """Lambda - dT in s: lag of the estimate of V under the growth limit at the greatest V (Eq. 6a)."""
    lag_norm_s: float
    """L_v in s."""
    acceleration: float
    """a = F_max / m in m/s²."""
    threshold_speed: float | None = None
    """v_th in m/s of WSC: speed that the observer does not detect (Eq. 10)."""
    lag_speed: float = 0.0
    """r - a (dT + J) in m/s: excess of the speed over its estimate (Eq. 6a)."""
    tick_speed: float = 0.0
    """a (dT + J) in m/s: speed gained in the tick in which the controller decides."""
    phantom_force_n: float = 0.0
    """rho in N: apparent force of an absent hand (Eq. 8)."""
    phantom_energy_j: float = 0.0
    """W in J: energy of the hand that is still in the window, or only apparent (Eq. 9)."""
    unseen_force_n: float | None = None
    """F_e in N: largest push that HSC never detects (Eq. 13)."""
    floor: float = 0.0
    """r without noise in m/s: no threshold guarantees a lower speed (Eq. 6a)."""
    driven_speed: float = 0.0
    """Speed in m/s that negative viscous friction adds after the trip (Eq. 17)."""
    driven_until: str | None = None
    """Condition that ends this growth; None without growth."""


class ControllerBound(Struct, frozen=True, kw_only=True):
    """Bound of one controller."""

    controller: str
    """Name of the controller, or of two that have a joint bound: "wsc and vfc"."""
    speed: float | None
    """Bound in m/s; None without a bound."""
    reason: str | None
    """Reason for the absence of a bound."""
    terms: EjectionTerms | None = None
    """Terms of the bound."""


class EjectionBound(Struct, frozen=True, kw_only=True):
    """Smallest bound of the controllers: one trip suffices."""

    speed: float | None
    """Largest |V| in m/s after a release; None without a bound."""
    reason: str | None
    """Reason for the absence of a bound."""
    controller: str | None
    """Controller with the smallest bound."""
    of: tuple[ControllerBound, ...]
    """Bound of each controller in use that can have one."""
    assumptions: tuple[str, ...]
    """Assumptions of the bound."""

    def text(self, unit: str = "m/s") -> str:
        """Describe the bound in one line."""
        if self.speed is None:
            return f"no bound on the speed after a release: {self.reason}"
        return f"after a release at most {_rounded_up(self.speed)} {unit}, by {self.controller}"


def ejection_bound(
    of: EjectionSettings | HasEjectionSettings,
    *,
    hand_speed: float | None = None,
    late_s: float | None = None,
    mass_error: float | None = None,
    free_s: float | None = None,
) -> EjectionBound:
    """Compute the largest speed in m/s of a device after a release, for any force that it renders afterwards.

    `|V| <= max(V0, v_th + r)` for WSC, `V² <= V_H² + 2 F_e X / m` for HSC; the result is the smallest bound of the
    controllers in use. WSC and VFC together have a joint bound.

    Args:
        of: Scene or settings.
        hand_speed: V0 in m/s, speed of the hand at the release; by default that of the settings, 0 for a scene.
        late_s: J in s, extra time for which the device may keep a force, 0 to 0.02; by default that of the settings.
        mass_error: Largest relative error of the mass in the safety layer, at least 0 and below 1; by default that of
            the settings.
        free_s: T in s, longest time for which a free device moves. By default the end of a scene's run limits it; pass
            infinity for a real device.

    Raises:
        TypeError: `of` is neither a scene nor settings.
        ValueError: A value is out of range.
        SceneError: The scene cannot be built.

    Source: `docs/ejection_bound.md`, Eq. 6a to 19, on paper Eq. 1, 5, 11, 13 and 14.
    """
    settings = _settings(of)
    changes = {"hand_speed": hand_speed, "late_s": late_s, "mass_error": mass_error, "free_s": free_s}
    settings = replace(settings, **{name: value for name, value in changes.items() if value is not None})
    _check(settings)
    if reason := _no_bound(settings):
        return EjectionBound(speed=None, reason=reason, controller=None, of=(), assumptions=())
    try:
        known = (
            exact(settings.period_s) if settings.estimator is None else kernel(settings.estimator, settings.period_s)
        )
    except ValueError as error:
        return EjectionBound(speed=None, reason=str(error), controller=None, of=(), assumptions=())
    # Values at the ends of their ranges may overflow to infinity, which is no bound.
    with np.errstate(over="ignore", invalid="ignore"):
        model = _Model(settings, known)
        bounds = tuple(
            model.of_wsc() if name == "wsc" else model.of_hsc() for name in BOUNDED if name in settings.controllers
        )
        if (of_both := model.of_wsc_and_vfc()) is not None:
            bounds = (*bounds, of_both)
    found = [(bound.speed, bound) for bound in bounds if bound.speed is not None]
    if not found:
        reason = "; ".join(f"{bound.controller}: {bound.reason}" for bound in bounds)
        return EjectionBound(speed=None, reason=reason, controller=None, of=bounds, assumptions=_assumptions(settings))
    speed, least = min(found, key=lambda pair: pair[0])
    assumptions = _assumptions(settings)
    if least.terms is not None and least.terms.driven_until is not None:
        assumptions = (*assumptions, f"negative viscous friction drives the device {least.terms.driven_until}")
    return EjectionBound(speed=speed, reason=None, controller=least.controller, of=bounds, assumptions=assumptions)


def rising_push(of: EjectionSettings | HasEjectionSettings) -> tuple[float, ...]:
    """Return the force of each tick, oldest first, that maximises V - V^; in shares of the cap, -1 to 1.

    It is the argument of the maximum of Eq. 6a. It is empty if V is measured, if the force has no cap, or if the
    estimator has no kernel.

    Args:
        of: Scene or settings.

    Raises:
        TypeError: `of` is neither a scene nor settings.

    Source: `docs/ejection_bound.md`, Eq. 6a.
    """
    settings = _settings(of)
    if settings.estimator is None or not isfinite(settings.max_force_n):
        return ()
    try:
        known = kernel(settings.estimator, settings.period_s)
    except ValueError:
        return ()
    growth = (settings.max_slew_n_per_s * settings.period_s + settings.force_quantum_n) / settings.max_force_n
    weights = np.append(settings.period_s, known.lag_s)
    push = worst_push(weights + known.rising_speed(growth).lift, growth)
    # Leave out old forces with negligible weights.
    counted = np.flatnonzero(np.abs(weights[: len(push)]) > WORTH * np.abs(weights).max())
    return tuple(map(float, push[: counted[-1] + 1][::-1]))


def _settings(of: EjectionSettings | HasEjectionSettings) -> EjectionSettings:
    if isinstance(of, EjectionSettings):
        return of
    if not hasattr(of, "ejection_settings"):
        message = f"{of!r}: must be a scene, as `load_scene` gives it, or EjectionSettings"
        raise TypeError(message)
    return of.ejection_settings()


def _check(settings: EjectionSettings) -> None:
    for name, (low, high) in RANGES.items():
        value = getattr(settings, name)
        for each in value if isinstance(value, tuple) else (value,):
            # Negated comparison: it also refuses NaN.
            if each is not None and not low <= each <= high:
                allowed = f"above 0 and at most {high:g}" if low == LEAST else f"between {low:g} and {high:g}"
                message = f"{name} = {each}: must be {allowed}"
                raise ValueError(message)
    axes = len(settings.mass_kg)
    if axes == 0:
        message = "mass_kg = (): must have one number an axis, at least one"
        raise ValueError(message)
    for name in ("viscous", "coulomb"):
        value = getattr(settings, name)
        if len(value) not in {1, axes}:
            message = f"{name} = {value}: must have one number, or one for each of the {axes} axes of mass_kg"
            raise ValueError(message)
    if settings.probe_force_n > 0.0 and settings.damping == 0.0:
        message = f"probe_force_n = {settings.probe_force_n}: must be 0 where damping is 0, as nothing slows the probe"
        raise ValueError(message)


def _no_bound(settings: EjectionSettings) -> str | None:
    if not any(name in settings.controllers for name in BOUNDED):
        return "none of hsc and wsc watches"
    if settings.outside is not None:
        return settings.outside
    if settings.max_force_n == inf:
        return "the force has no cap"
    if settings.probe_force_n > 0.0 and SafetySettings.PROBED_DAMPING * settings.damping <= -min(settings.viscous):
        return f"{_negative(settings)}, and the probe pushes while damping of {settings.damping:g} does not outweigh it"
    return None


def _negative(settings: EjectionSettings) -> str:
    return f"viscous friction is negative (b = {min(settings.viscous):g})"


def _assumptions(settings: EjectionSettings) -> tuple[str, ...]:
    hand = (
        "the hand rested against the force and lets go at once"
        if settings.hand_speed == 0.0
        else f"the hand moves at up to {settings.hand_speed:g} m/s, evenly, and lets go at once"
    )
    late = "no tick is late" if settings.late_s == 0.0 else f"a tick is late by at most {settings.late_s * 1e3:g} ms"
    steady = "of hsc alone: from the release on the push neither grows nor turns"
    line = "of wsc alone: the push stays on one line"
    line_counts = "wsc" in settings.controllers and settings.wsc_force_threshold_n > 0.0 and len(settings.mass_kg) > 1
    mass = f"the mass is known to {settings.mass_error * 100:g} %" if settings.mass_error else "the mass is as told"
    measured = ["V is measured without lag or noise"] if settings.estimator is None else []
    return (
        hand,
        mass,
        late,
        "no mechanical stop is met",
        *(["of the point: rotation has no bound"] if settings.turns else []),
        *measured,
        *([steady] if "hsc" in settings.controllers and not settings.push_may_grow else []),
        *([line] if line_counts else []),
    )


class _Model:
    """Terms of the bound for one device, loop and estimator."""

    def __init__(self, settings: EjectionSettings, known: Kernel) -> None:
        self.settings, self.kernel = settings, known
        axes = len(settings.mass_kg)
        self.known_mass = min(settings.mass_kg)
        self.mass = self.known_mass / (1.0 + settings.mass_error)
        self.heaviest = max(settings.mass_kg)
        self.force = settings.max_force_n + 0.5 * settings.force_quantum_n
        # The device exerts the requested force to within half a quantum.
        self.rounded = 0.5 * settings.force_quantum_n
        self.held = self.force if settings.held_force_n is None else min(settings.held_force_n, self.force)
        self.viscous = max(abs(one) for one in settings.viscous)
        self.drives = max(0.0, -min(settings.viscous))
        self.least_coulomb = min(settings.coulomb)
        per_axis = axes > 1 and settings.friction == "axis"
        coulomb = np.broadcast_to(settings.coulomb, axes)
        self.coulomb = float(np.linalg.norm(coulomb) if per_axis else coulomb.max())
        # With several axes the direction of friction varies, so negative parts of the kernel count in full too.
        self.kernel_of_friction = known.acceleration if axes == 1 else np.abs(known.acceleration)
        self.is_modelled = not per_axis
        self.wrong_force = 0.5 * settings.force_quantum_n * sqrt(axes) * known.gain
        step_n = settings.max_slew_n_per_s * settings.period_s + settings.force_quantum_n
        self.growth = step_n / self.force
        self.lag_s = known.growing_lag_s(self.growth)
        self.rising = known.rising_speed(self.growth)
        self.rising_norm_s = float(np.abs(np.append(settings.period_s, known.lag_s) + self.rising.lift).sum())
        self.turned, self.turned_freely = known.turned_speeds(self.growth)
        self.tail_way, self.free_tail_way = known.tail_way(self.growth, settings.window)
        self.readings = known.readings(self.growth)
        self.reading_m = 0.5 * settings.quantum_m * sqrt(axes)
        self.velocity_noise = float(np.abs(known.velocity_noise).sum()) * self.reading_m
        self.acceleration_noise = float(np.abs(known.acceleration_noise).sum()) * self.reading_m
        self.late_s = settings.late_s

    def acceleration(self, speed: float) -> float:
        """Return the acceleration a in m/s² by the force, including the part of a negative b at that speed."""
        return (self.force + self.drives * speed) / self.mass

    def lag(self, speed: float) -> float:
        """Return e in m/s, the largest error of the estimate: `|V - V^|` below that speed (Eq. 5)."""
        friction = self.kernel.lag_norm_s * (self.coulomb + self.viscous * speed)
        late = self.acceleration(speed) * self.late_s
        return (self.force * self.lag_s + friction) / self.mass + late + self.velocity_noise

    def rise(self, speed: float) -> float:
        """Return r of Eq. 6a in m/s: largest excess of the greatest speed over the estimate of the tick before."""
        late = self.acceleration(speed) * self.late_s
        friction = self.coulomb + self.viscous * speed

        def most(push_s: float, norm_s: float, lift_s: float) -> float:
            return (self.force * push_s + friction * norm_s) / self.mass + late * (
                2.0 + lift_s / self.settings.period_s
            )

        free = most(self.lag_s + self.settings.period_s, self.kernel.lag_norm_s + self.settings.period_s, 0.0)
        if self.settings.wsc_force_threshold_n > 0.0 or self.driven_n(speed) > 0.0:
            # V may have been greater before: a push of F_w and negative friction are not detected.
            return free + self.velocity_noise
        lifted = most(self.rising.most, self.rising_norm_s, float(self.rising.lift[0]))
        return min(free, lifted) + self.velocity_noise

    def probed(self, speed: float) -> float:
        """Return the speed in m/s to which a probe drives a free device that stays below `speed`; 0 without a probe.

        `(A + q_F/2 + 1.25 mu e) / (1.25 mu - d) + (A + q_F/2 + d V) (dT + J) / m`; the damping acts on V^.
        """
        settings = self.settings
        if settings.probe_force_n == 0.0:
            return 0.0
        force, damping = settings.probe_force_n + self.rounded, SafetySettings.PROBED_DAMPING * settings.damping
        late_s = settings.period_s + self.late_s
        steady = (force + damping * self.lag(speed)) / (damping - self.drives)
        return steady + (force + self.drives * speed) / self.mass * late_s

    def driven_n(self, speed: float) -> float:
        """Return the force in N by which negative viscous friction drives the device: `(d V - c)+` of Eq. 17."""
        return max(0.0, self.drives * speed - self.least_coulomb)

    def driven(self, start: float, speed: float) -> tuple[float, str | None]:
        """Return the largest speed in m/s after a trip at speed `start`, and the condition that ends its growth.

        The speed is assumed to stay below `speed`. Without growth there is no condition.

        The result is the smallest of three bounds: over the travel (Eq. 18a), within the time (18b) and under damping
        that never fades (18c).
        """
        settings, top = self.settings, max(start, speed)
        if self.driven_n(start) == 0.0:
            return start, None
        found = [(self._driven_for(start, settings.free_s), f"for at most {settings.free_s:g} s")]
        if settings.travel_m is not None:
            over = start + self.driven_n(top) / top * settings.travel_m / self.mass
            found.append((over, "over its whole travel"))
        if not settings.fades:
            found.append((self._driven_against(start, top), "until damping outweighs it, which never fades"))
        return min(found)

    def _driven_for(self, start: float, seconds: float) -> float:
        """Return the speed in m/s after `seconds` of Eq. 17, from `start` above c / d (Eq. 18b)."""
        rate = self.drives * seconds / self.mass
        return start + (start - self.least_coulomb / self.drives) * expm1(rate) if rate < MOST_RATE else inf

    def _driven_against(self, start: float, top: float) -> float:
        """Return the speed in m/s under damping that never fades (Eq. 18c).

        It is infinite if damping or the cap is too small to outweigh negative friction.
        """
        settings, lag, rounded = self.settings, self.lag(top), self.rounded
        if settings.damping <= self.drives:
            return inf
        balanced = (settings.damping * lag + rounded - self.least_coulomb) / (settings.damping - self.drives)
        level = max(start, balanced)
        if (settings.max_force_n - rounded) * (level - lag) < self.driven_n(top) * level:
            return inf
        # From this level on, this share of the damping suffices, at every higher speed too.
        needed = max((self.driven_n(level) + rounded) / (level - lag), self.drives) / settings.damping
        step_n = settings.max_slew_n_per_s * settings.period_s
        slews_s = settings.period_s * (self.driven_n(top) + rounded) / step_n
        undamped_s = needed * settings.ramp_in_s + slews_s + settings.period_s + self.late_s
        return self._driven_for(level, undamped_s)

    def phantom_force(self, speed: float) -> float:
        """Return rho in N, the apparent force of a hand that is long gone: `|F_h^|` below that speed (Eq. 8)."""
        friction = (1.0 + self.kernel.gain) * self.coulomb
        noise = self.heaviest * self.acceleration_noise
        return friction + self._viscous(speed) + self._wrong_mass(speed) + self.wrong_force + noise

    def phantom_energy(self, speed: float) -> float:
        """Return the apparent energy in J of a hand that is long gone, in a window below that speed (Eq. 9).

        Friction of the kind that the safety layer assumes contributes only while its kernel spans a reversal. Noise of
        readings contributes only where the slope of V^ changes.
        """
        known, settings = self.kernel, self.settings
        window_s, mass = settings.window * settings.period_s, self.heaviest
        fastest = speed + self.lag(speed)
        friction = 2.0 * self.coulomb * self._turned(speed)
        if not self.is_modelled:
            friction = (1.0 + known.gain) * self.coulomb * fastest
        viscous = self._viscous(speed) * fastest
        wrong = (self._wrong_mass(speed) + self.wrong_force) * fastest
        steady = (self.coulomb + self.viscous * speed) / self.mass
        force = self.force / self.mass
        noise = self.readings.power(ticks=settings.window, force=force, steady=steady, speed=fastest)
        noise *= self.reading_m * mass
        both = mass * self.acceleration_noise * self.velocity_noise * window_s
        return (friction + viscous + wrong) * window_s + noise + both

    def _viscous(self, speed: float) -> float:
        """Return the remainder of viscous friction in F_h^ in N: b times a bound of `|V^ - g * V|`."""
        known = self.kernel
        lagging = self.acceleration(speed) * known.viscous_lag_s + self.velocity_noise
        return self.viscous * min((1.0 + known.gain) * speed, lagging)

    def _wrong_mass(self, speed: float) -> float:
        """Return the remainder of a wrong mass in F_h^ in N."""
        return self.settings.mass_error * self.kernel.gain * (self.force + self.coulomb + self.viscous * speed)

    def _turned(self, speed: float) -> float:
        """Return `max sum_j g_j |V^|` in m/s over the ages j at which V had another direction than V^ has (Eq. 9b)."""
        share = np.maximum(self.kernel_of_friction, 0.0)
        steady = (self.coulomb + self.viscous * speed) / self.mass
        since = self.acceleration(speed) * self.turned + steady * self.turned_freely + self.velocity_noise
        since = np.minimum(since, speed + self.lag(speed))
        if len(self.settings.mass_kg) > 1:
            # The directions may differ by less than a half turn.
            return float((share * since).sum())
        # |V^| is at most the least `since` of those ages.
        order = np.argsort(since)[::-1]
        return float((since[order] * np.cumsum(share[order])).max())

    def tail_energy(self, speed: float) -> float:
        """Return the energy in J of the hand that A still contains after the release (Eq. 9a).

        The hand held against the push, so a motion with the push takes energy out. A motion against the push puts
        energy in, but the force must first reverse and grow from zero.
        """
        settings = self.settings
        friction = (self.coulomb + self.viscous * speed) / self.mass
        drives = self.drives * speed / self.mass
        # Stiction may have held the push too; the force may then begin up to c beyond zero.
        way = (self.force * self.tail_way) / self.mass + (2.0 * friction + drives) * self.free_tail_way
        moved = (settings.hand_speed + self.velocity_noise) * self.kernel.tail_s
        return self.held * (1.0 + settings.mass_error) * (way + moved)

    def of_wsc(self) -> ControllerBound:
        """Return the bound of WSC, Eq. 7 to 11, and 16."""
        if self.settings.wsc_force_threshold_n > 0.0 and self.settings.travel_m is None:
            reason = "wsc does not see a push of less than F_w, and without mechanical stops nothing ends it"
            return ControllerBound(controller="wsc", speed=None, reason=reason)
        return self._of_energy("wsc", lambda threshold, speed: threshold + self.rise(speed))

    def of_wsc_and_vfc(self) -> ControllerBound | None:
        """Return the joint bound of WSC and VFC, Eq. 15; None if Eq. 15 does not apply or WSC has no bound."""
        settings = self.settings
        watched = {"wsc", "vfc"} <= set(settings.controllers) and settings.wsc_force_threshold_n == 0.0
        if not watched or settings.vfc_form != "product" or len(settings.mass_kg) > 1 or settings.late_s > 0.0:
            return None
        alone = self.of_wsc()
        if alone.speed is None or alone.terms is None or alone.terms.threshold_speed is None:
            return None
        # Grid of V^. The growth of V^ is limited, so VFC limited F_v in the ticks before as well.
        estimated = float(self._allowed(alone.speed)[1].max()) * np.sqrt(np.linspace(0.0, 1.0, GRID))
        most, norm_s = self._limited_rises(estimated[:-1], alone.speed)

        def passes(threshold: Array, speed: float) -> Array:
            steady = (self.coulomb + self.viscous * speed) / self.mass
            reached = estimated[1:] + self.acceleration(speed) * most + steady * norm_s + self.velocity_noise
            highest = np.append(np.maximum.accumulate(reached), threshold.max() + self.rise(speed))
            limited: Array = highest[np.searchsorted(estimated[1:], threshold)]
            return np.minimum(limited, threshold + self.rise(speed))

        return self._of_energy("wsc and vfc", passes)

    def _limited_rises(self, estimated: Array, speed: float) -> tuple[Array, Array]:
        """Return `max sum w f` in s for each newest V^ in m/s, with `F_v V^ <= V_t F_t` at each tick before (Eq. 15).

        The second result in s multiplies the acceleration by friction.
        """
        settings, known = self.settings, self.kernel
        since, freely = known.rises_since(self.growth)
        steady = (self.coulomb + self.viscous * speed) / self.mass
        lower = self.acceleration(speed) * since + steady * freely + 2.0 * self.velocity_noise
        lower[0] = 0.0
        before = np.maximum(estimated[:, None] - lower, 0.0)
        power = settings.velocity_threshold * settings.vfc_force_threshold_n
        with np.errstate(divide="ignore"):
            limit = (np.maximum(power / before, settings.probe_force_n) + self.rounded) / self.force
        weights = np.append(settings.period_s, known.lag_s)
        highest = np.ones((len(estimated), len(weights)))
        ages = min(len(weights), len(since))
        highest[:, :ages] = np.minimum(limit[:, :ages], 1.0)
        most, norm_s = np.full(len(estimated), np.inf), np.zeros(len(estimated))
        lifts = [np.zeros(len(weights))]
        if self.driven_n(speed) == 0.0:
            # With a limited force another lift is the best. That of the greatest V^ is searched, and tried at every V^.
            of_greatest = best_rising_push(weights, self.growth, highest=highest[-1]).lift
            lifts += [share * self.rising.lift for share in (0.5, 1.0, 1.5)]
            lifts += [share * of_greatest for share in (0.5, 0.75, 1.0)]
        for lift in lifts:
            lifted = weights + lift
            found = best_push(np.broadcast_to(lifted, highest.shape), self.growth, highest=highest).max(axis=-1)
            norm_s = np.where(found < most, np.abs(lifted).sum(), norm_s)
            most = np.minimum(most, found)
        return most, norm_s

    def _allowed(self, speed: float) -> tuple[float, Array]:
        """Return W in J below that speed (Eq. 9), and v_th in m/s at each tick since the release (Eq. 10)."""
        settings = self.settings
        power = settings.hand_power_w
        if power is None:
            power = max(self.force, settings.damping * settings.hand_speed) * settings.hand_speed
            power *= 1.0 + settings.mass_error
        # The force of a late tick differs from the next by at most the cap plus the growth beyond zero.
        late = (1.0 + min(self.growth, 1.0)) * self.kernel.gain * self.force * self.late_s
        energy = self.tail_energy(speed) + self.phantom_energy(speed) + late * (speed + self.lag(speed))
        # Ticks since the release, while energy from before is in the window.
        left_s = settings.period_s * np.arange(settings.window, -1, -1)
        whole = abs(settings.energy_threshold_j) + energy + left_s * power
        return energy, np.sqrt(2.0 * settings.energy_ratio * whole / self.known_mass)

    def _of_energy(self, name: str, passes: Callable[[Array, float], Array]) -> ControllerBound:
        """Return the bound of a controller that accepts V^ up to v_th; `passes` maps v_th to the greatest speed."""
        settings = self.settings

        def next_speed(speed: float) -> float:
            reached = passes(self._allowed(speed)[1], speed)
            late_s = self.late_s + settings.period_s * np.arange(1, settings.window + 2) + self.late_s
            sooner = np.minimum(settings.hand_speed + self.acceleration(speed) * late_s, reached)
            # After the window has passed, nothing depends on the time.
            return float(max(settings.hand_speed, sooner.max(), reached[-1], self.probed(speed)))

        unseen_n = settings.wsc_force_threshold_n

        def pushed_on(speed: float) -> float:
            """Add an undetected push of F_w over the travel (Eq. 16), or negative friction (Eq. 17)."""
            tripped = next_speed(speed)
            if unseen_n == 0.0:
                return self.driven(tripped, speed)[0]
            work = 2.0 * (unseen_n + self.rounded + self.drives * speed) * (settings.travel_m or 0.0) / self.mass
            return sqrt(tripped * tripped + work)

        speed = _least_fixed_point(pushed_on, settings.hand_speed)
        if speed is None:
            reason = "friction, noise or errors of the model look like a hand that feeds any speed"
            if self.drives > 0.0 and _least_fixed_point(next_speed, settings.hand_speed) is not None:
                reason = self._undamped()
            return ControllerBound(controller=name, speed=None, reason=reason)
        energy, threshold = self._allowed(speed)
        tripped = next_speed(speed)
        driven, until = self.driven(tripped, speed) if unseen_n == 0.0 else (tripped, None)
        terms = replace(
            self._terms(speed),
            threshold_speed=float(threshold[-1]),
            phantom_energy_j=energy,
            driven_speed=driven - tripped,
            driven_until=until,
        )
        return ControllerBound(controller=name, speed=speed, reason=None, terms=terms)

    def _undamped(self) -> str:
        """Return the reason why negative viscous friction leaves no bound."""
        settings = self.settings
        if settings.damping == 0.0:
            damped = "nothing damps"
        elif settings.fades:
            damped = "nothing damps once the link is lost"
        else:
            damped = f"damping of {settings.damping:g} does not outweigh it"
        is_endless = settings.travel_m is None and settings.free_s == inf
        ends = "without mechanical stops nothing ends it" if is_endless else "it may add any speed"
        return f"{_negative(settings)} and {damped}: {ends}"

    def _terms(self, speed: float) -> EjectionTerms:
        a = self.acceleration(speed)
        tick = a * (self.settings.period_s + self.late_s)
        return EjectionTerms(
            lag_s=self.rising.most - self.settings.period_s,
            lag_norm_s=self.kernel.lag_norm_s,
            acceleration=a,
            lag_speed=self.rise(speed) - tick,
            tick_speed=tick,
            phantom_force_n=self.phantom_force(speed),
            floor=self.rise(speed) - self.velocity_noise,
        )

    def of_hsc(self) -> ControllerBound:
        """Return the bound of HSC, Eq. 12 to 14."""
        settings = self.settings
        if settings.push_may_grow:
            reason = "with this coupling the push may grow after a release, and hsc then has no bound"
            return ControllerBound(controller="hsc", speed=None, reason=reason)
        if settings.travel_m is None:
            reason = "hsc does not see a push of less than F_t, and without mechanical stops nothing ends it"
            return ControllerBound(controller="hsc", speed=None, reason=reason)
        travel_m = settings.travel_m
        asks = settings.probe_force_n > 0.0 or settings.release_tries > 0
        if asks and settings.release_ramp_s == 0.0:
            reason = "hsc does not look at the tick in which the force comes back as a step: give a release_ramp_s"
            return ControllerBound(controller="hsc", speed=None, reason=reason)

        # I of Eq. 13: the negative part of the kernel hides this impulse of a falling push, once, however it falls.
        dip = np.maximum(-self.kernel.acceleration, 0.0)
        impulse = self.held * settings.period_s * float((np.arange(len(dip)) * dip).sum()) / self.mass

        def next_speed(speed: float) -> float:
            push, limit = self._unseen(speed)
            a_tick = self.acceleration(speed) * (settings.period_s + self.late_s)
            gained = self._gained(push, speed)

            def over_travel(force: Array) -> Array:
                # From each tick on, the largest later force works over the whole travel.
                later = np.maximum.accumulate(np.concatenate((force, force[-1:]))[::-1])[::-1]
                work = 2.0 * (later + self.drives * speed) * travel_m / self.mass
                reached: Array = np.sqrt((gained + a_tick) ** 2 + work)
                return reached

            reached = float(min(over_travel(push).min(), over_travel(limit).min() + impulse))
            return max(reached, self.driven(self.probed(speed), speed)[0])

        speed = _least_fixed_point(next_speed, settings.hand_speed)
        if speed is None:
            reason = "friction, noise or errors of the model look like a hand at any speed"
            return ControllerBound(controller="hsc", speed=None, reason=reason)
        terms = replace(self._terms(speed), unseen_force_n=float(min(each[-1] for each in self._unseen(speed))))
        return ControllerBound(controller="hsc", speed=speed, reason=None, terms=terms)

    def _gained(self, push: Array, speed: float) -> Array:
        """Return V_H of Eq. 12: largest speed in m/s at each tick after the release, by the pushes that HSC accepts.

        A tick without a trip has a push of at most `push`, or a V^ of at most V_s. In the second case V is below
        V_s + e, and the whole cap may act over the tick (Eq. 13a).
        """
        settings = self.settings
        slowest, push = settings.hsc_velocity_threshold, push + self.driven_n(speed)
        if slowest == 0.0:
            added = np.cumsum(push) * settings.period_s / self.mass
            return settings.hand_speed + np.concatenate(([0.0], added))
        passes = slowest + self.lag(speed)
        a_tick = self.acceleration(speed) * (settings.period_s + self.late_s)
        gained = [settings.hand_speed]
        for each in push:
            gained.append(max(gained[-1] + each * settings.period_s / self.mass, min(gained[-1], passes) + a_tick))
        # V may be below V_s + e at any later tick as well.
        reached: Array = np.maximum(np.array(gained), passes + a_tick)
        return reached

    def _unseen(self, speed: float) -> tuple[Array, Array]:
        """Return the largest push in N that HSC accepts at each tick after the release (Eq. 12, 13).

        The last value holds for ever. The second result is F* of Eq. 12: the largest force in A that HSC accepts. A
        steady push shows in A in full.
        """
        settings, known = self.settings, self.kernel
        tail = known.tail
        grasp = (1.0 + settings.mass_error) * self.held * np.abs(tail)
        grasp += self.phantom_force(speed) + settings.grasp_floor_n
        # A shows at least `reach F - dip F_0 + tail F_0` of a push F that has not grown since it was F_0.
        reach = np.concatenate(([0.0], np.cumsum(np.maximum(known.acceleration, 0.0))))
        dip = np.concatenate(([0.0], np.cumsum(np.maximum(-known.acceleration, 0.0))))
        limit = np.maximum(settings.hsc_force_threshold_n, settings.grasp_threshold * grasp)
        reach[0] = 1.0
        push = np.maximum((limit + (dip - tail) * self.held) / reach, settings.hsc_force_threshold_n)
        push[0] = self.force
        if settings.release_ramp_s > 0.0:
            # A fading intervention passes this much more at its last tick than at the one before.
            more = 2.0 * self.force * settings.period_s / settings.release_ramp_s
            push, limit = push + more, limit + more
        return np.minimum(push + self.rounded, self.force), np.minimum(limit + self.rounded, self.force)


def _least_fixed_point(of: Callable[[float], float], start: float) -> float | None:
    """Return the least speed that is its own bound, from below; None without such a speed.

    `of` is non-decreasing. Any speed that `of` does not raise is a bound: by induction over the ticks, no speed exceeds
    it. If the iteration is slow, its limit is extrapolated from its rate and refined by bisection.
    """
    speed, last_step = start, 0.0
    for iteration in range(MOST_ITERATIONS):
        following = of(speed)
        if not isfinite(following) or following > FASTEST:
            return None
        step = following - speed
        if step <= speed * TOLERANCE:
            return following * (1.0 + TOLERANCE)
        if iteration >= PLAIN_ITERATIONS and 0.0 < step < last_step:
            guess = following + 1.01 * step * step / (last_step - step)
            if guess <= FASTEST and of(guess) <= guess:
                return _halved(of, following, guess)
        speed, last_step = following, step
    return None


def _halved(of: Callable[[float], float], low: float, high: float) -> float:
    """Bisect for the least speed in [low, high] that `of` does not raise; `of` must not raise `high`."""
    while high - low > TOLERANCE * high:
        middle = 0.5 * (low + high)
        if of(middle) <= middle:
            high = middle
        else:
            low = middle
    return high


LEAST = 5e-324
"""Smallest positive number, for ranges above 0."""
LARGEST = 1e9
"""Upper limit of the values of a scene."""
RANGES = {
    "mass_kg": (LEAST, LARGEST),
    "viscous": (-LARGEST, LARGEST),
    "coulomb": (0.0, LARGEST),
    "period_s": (LEAST, 1.0),
    "quantum_m": (0.0, LARGEST),
    "max_force_n": (LEAST, inf),
    "max_slew_n_per_s": (LEAST, inf),
    "force_quantum_n": (0.0, LARGEST),
    "energy_threshold_j": (-LARGEST, 0.0),
    "wsc_force_threshold_n": (0.0, LARGEST),
    "energy_ratio": (LEAST, 1.0),
    "window": (1, 3_600_000),
    "grasp_threshold": (0.0, LARGEST),
    "grasp_floor_n": (0.0, LARGEST),
    "hsc_force_threshold_n": (0.0, LARGEST),
    "hsc_velocity_threshold": (0.0, LARGEST),
    "velocity_threshold": (0.0, LARGEST),
    "vfc_force_threshold_n": (0.0, LARGEST),
    "release_ramp_s": (0.0, LARGEST),
    "damping": (0.0, LARGEST),
    "probe_force_n": (0.0, LARGEST),
    "release_tries": (0, LARGEST),
    "travel_m": (0.0, LARGEST),
    "free_s": (0.0, inf),
    "ramp_in_s": (0.0, LARGEST),
    "hand_speed": (0.0, 1e3),
    "hand_power_w": (0.0, LARGEST),
    "held_force_n": (0.0, inf),
    "late_s": (0.0, MAX_LATE_S),
    "mass_error": (0.0, 0.999),
}
"""Smallest and largest value of each field."""
MOST_RATE = 700.0
"""Largest exponent; beyond it an exponential is infinite."""
PLAIN_ITERATIONS = 10
WORTH = 0.05
"""Share of the largest weight below which a past force is left out of the worst push."""
GRID = 33
"""Number of speeds V^ at which the forces that VFC accepts are computed."""
MOST_ITERATIONS = 1000
TOLERANCE = 1e-9
FASTEST = 1e3
"""Largest valid speed in m/s, that of the safety layer."""


def _rounded_up(speed: float) -> str:
    """Round up to two decimal places."""
    return f"{np.ceil(speed * 100.0 - 1e-9) / 100.0:.2f}"
