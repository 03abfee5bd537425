"""Detection of numbers far outside their usual range in a scene, such as a wrong unit (50 for 0.05)."""

import math
import re
from typing import NamedTuple

import msgspec

from haptether.bridge.scene.load import leaf_values
from haptether.bridge.scene.tables.session import LinksTable, Scene


class _Usual(NamedTuple):
    path: re.Pattern[str]
    unit: str
    most: float
    """Largest magnitude in comparable set-ups."""
    slipped: tuple[tuple[str, float], ...]
    """Units that may have been intended, with their size."""


def _usual(path: str, unit: str, most: float, *slipped: tuple[str, float]) -> _Usual:
    return _Usual(re.compile(path), unit, most, slipped)


_MS, _US, _MM = ("ms", 1e-3), ("us", 1e-6), ("mm", 1e-3)
_USUAL = (
    # A geostationary satellite twice over takes 0.6 s one way.
    _usual(r"(link\.(forward|backward)\.(timeline\.\d+\.)?)?delay_s", "s", 2.0, _MS, _US),
    _usual(r"(link\.(forward|backward)\.)?jitter_s", "s", 0.5, _MS, _US),
    _usual(r"link\.(forward|backward)\.jitter_correlation_s", "s", 10.0, _MS, _US),
    _usual(r"round_trip_s", "s", 4.0, _MS, _US),
    _usual(r"(run|slave)\.period_s", "s", 0.02, _MS, _US),
    _usual(r"master\.stops\.\d+(\.\d+)?|operator\.(start|legs\.\d+\.end)(\.\d+)?", "m", 3.0, _MM),
    _usual(r"slave\.position(\.\d+)?|master\.encoder_quantum", "m", 3.0, _MM),
    _usual(r"operator\.stiffness", "N/m", 20_000.0, ("N/mm", 1e3)),
    _usual(r"environment\.\w+\.\d+\.contact\.stiffness", "N/m", 1e8),
    _usual(r"(safety\.limiter|master)\.max_force_n", "N", 200.0, ("mN", 1e-3)),
    _usual(r"operator\.grip_strength_n|environment\.pushers\.\d+\.force_n(\.\d+)?", "N", 500.0, ("mN", 1e-3)),
    _usual(r"safety\.energy_threshold_j", "J", 1.0, ("mJ", 1e-3)),
    _usual(r"safety\.(velocity_threshold|hsc_velocity_threshold)", "m/s", 5.0, ("mm/s", 1e-3)),
    _usual(r"safety\.(hsc|wsc|vfc)_force_threshold_n", "N", 100.0, ("mN", 1e-3)),
)
"""Far beyond all shipped scenes and the devices of docs/devices.md; none is a limit."""


def unusual_numbers(scene: Scene) -> list[str]:
    """Return `unusual_values` of all numbers of a scene, and `estimated_delays`."""
    numbers = unusual_values(scene, of_joints=scene.master.kind == "joints")
    return numbers if scene.link is None else numbers + estimated_delays(scene.link)


def estimated_delays(link: LinksTable) -> list[str]:
    """Return one line for each direction whose recorded delays are half of round trips, hence equal both ways."""
    directions = {"forward": link.forward, "backward": link.backward}
    return [
        f"link.{name}.trace: half of each round trip: the recording of IRTT has no one-way delays"
        for name, settings in directions.items()
        if settings is not None and settings.trace is not None and settings.trace.half_round_trips
    ]


def unusual_values(value: object, path: str = "", *, of_joints: bool = False) -> list[str]:
    """Return one line for each number far outside its usual range, with the unit that may have been intended.

    Args:
        value: A number, or tables and lists of them.
        path: Where in a scene they belong, as `link.forward.delay_s`; or the option that was typed, as `--delay-s` of
            a link or `--round-trip-s` for the sum of both delays.
        of_joints: The units of positions and forces are others: nothing is said of them.
    """
    found = []
    for at, number in leaf_values(msgspec.to_builtins(value), path):
        if isinstance(number, bool) or not isinstance(number, int | float) or not math.isfinite(number):
            continue
        usual = _usual_of(at)
        if usual is None or abs(number) <= usual.most or (of_joints and usual.unit != "s"):
            continue
        named = f"{at} {number:g}" if at.startswith("--") else f"{at} = {number:g}"
        found.append(f"{named}: {usual.unit}, and beyond the usual {usual.most:g}{unit_question(number, at)}")
    return found


def unit_question(number: float, path: str) -> str:
    """The unit that an unusual number may have been meant in, as the end of a message; empty where none fits."""
    usual = _usual_of(path)
    if usual is None or not usual.most < abs(number) < math.inf:
        return ""
    meant = next((one for one in usual.slipped if abs(number) * one[1] <= usual.most), None)
    return "" if meant is None else f"; did you mean {number * meant[1]:.6g} ({number:g} {meant[0]})?"


def _usual_of(path: str) -> _Usual | None:
    key = path[2:].replace("-", "_") if path.startswith("--") else path
    return next((one for one in _USUAL if one.path.fullmatch(key)), None)
