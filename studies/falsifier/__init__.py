"""Search for the release that throws a device fastest, simplified and written as a scene."""

from haptether.studies.falsifier.release import Release, ReleaseBounds
from haptether.studies.falsifier.search import Falsified, falsify

__all__ = ["Falsified", "Release", "ReleaseBounds", "falsify"]
