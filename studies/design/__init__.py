"""Design limits of a set-up, before anything moves: delay, stiffness, thresholds, limits."""

from haptether.studies.design.check import check_at_once, check_scene
from haptether.studies.design.delay import ContactLoop, Follower, largest_delay_s, stable_delays, stable_together
from haptether.studies.design.finding import DesignCheck, Finding
from haptether.studies.design.loops import scene_loops, scene_times
from haptether.studies.design.wall import largest_wall_stiffness

__all__ = [
    "ContactLoop",
    "DesignCheck",
    "Finding",
    "Follower",
    "check_at_once",
    "check_scene",
    "largest_delay_s",
    "largest_wall_stiffness",
    "scene_loops",
    "scene_times",
    "stable_delays",
    "stable_together",
]
