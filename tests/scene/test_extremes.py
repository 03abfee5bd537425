"""Every number of a scene at the ends of its range: the run ends, or the refusal is one line."""

import multiprocessing
import re
import resource
import time
from pathlib import Path as FilePath

import pytest
from tests.scene.extremes import BASES, changed, extremes, numbers

from haptether.bridge import SceneError, simulate
from haptether.bridge.scene.load import checked

pytestmark = pytest.mark.slow

LONGEST_S = 20.0
"""Longest processor time in s of 20 ticks, on a busy machine; an endless loop takes for ever."""
MAX_BYTES = 3 << 30
MAX_TICKS = 1000
"""Largest number of ticks that are run; longer scenes are only built."""


def wrong(base: str) -> list[str]:
    """Return the violations of a scene's numbers."""
    resource.setrlimit(resource.RLIMIT_AS, (MAX_BYTES, MAX_BYTES))
    found = []
    for path in numbers(BASES[base]):
        for value in extremes(path):
            what = f"{'.'.join(map(str, path))} = {value!r}"
            begun = time.process_time()
            try:
                scene = checked(changed(BASES[base], path, value), FilePath()).scene
                run = scene.run
                if run.duration_s / run.period_s > MAX_TICKS:
                    continue
                simulate(scene)
            except SceneError as error:
                # The refusal is one line, with the place and a readable number.
                if "\n" in str(error) or re.search(r"\d{40}", str(error)) or not re.match(r"\[?[a-z]", str(error)):
                    found.append(f"{what}: {error}")
            except Exception as error:
                found.append(f"{what}: {type(error).__name__}: {error}"[:200])
            if time.process_time() - begun > LONGEST_S:
                found.append(f"{what}: took {time.process_time() - begun:.1f} s")
    return found


@pytest.mark.sampled(2)
@pytest.mark.parametrize("base", BASES)
def test_a_number_at_the_end_of_its_range_is_run_or_refused_in_one_line(base: str) -> None:
    # The test uses a process of its own: Python cannot interrupt an endless loop in the extension.
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.apply_async(wrong, (base,)).get(timeout=600.0) == []


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        (("master", "encoder_quantum"), 1e-300, "quantum_m = 1e-300"),
        (("safety", "estimator", "quantum_m"), 1e-300, "quantum_m = 1e-300"),
        (("slave", "max_acceleration"), 5e-324, "must be 1e-06 to 1e9"),
        (("slave", "force_sensor", "rate_hz"), 1e-300, "must be 0.001 to 1000000"),
        (("slave", "period_s"), 0.0123456789012, "a whole number of ns"),
        (("operator", "clutch", 0, 1), 1e-12, "must follow one another in time"),
    ],
)
def test_what_cannot_be_is_named(path: tuple[str | int, ...], value: float, said: str) -> None:
    raw = BASES["arm, integrated"]
    if path == ("master", "encoder_quantum"):
        estimator = {"kind": "kalman"}
        raw = changed(raw, path, value)
        raw["safety"] = raw["safety"] | {"estimator": estimator}
    else:
        raw = changed(raw, path, value)
    with pytest.raises(SceneError, match=re.escape(said)):
        checked(raw, FilePath())
