"""Hypothesis profiles: `fast` for every run, `slow` for a search that takes its time.

HAPTETHER_HYPOTHESIS_PROFILE chooses. `fast` tries the same examples each time, so that a change is
judged and not the luck of a draw; `slow` draws new ones.
"""

import os

from hypothesis import settings

settings.register_profile("fast", max_examples=50, deadline=None, derandomize=True)
settings.register_profile("slow", max_examples=2000, deadline=None)
settings.load_profile(os.environ.get("HAPTETHER_HYPOTHESIS_PROFILE", "fast"))
